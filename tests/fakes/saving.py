"""Waits until it is to stop, ends its step, and then saves, as a training does.

The step ends half a second after there is a file `go`.

python -m tests.fakes.saving --folder=...
"""

import os
import time
from pathlib import Path

from absl import flags

from experiments.cli import app

_FOLDER = flags.DEFINE_string("folder", None, "Where it writes.")


def main():
    folder = Path(_FOLDER.value)
    end = time.monotonic() + 60.0
    with app.Interrupt() as interrupt:
        (folder / "pid").write_text(str(os.getpid()))
        (folder / "ready").touch()
        while not interrupt.requested and time.monotonic() < end:
            time.sleep(0.02)
        while not (folder / "go").exists() and time.monotonic() < end:
            time.sleep(0.02)
        time.sleep(0.5)
        with (folder / "saved").open("a") as file:
            file.write("saved\n")
        (folder / "ended").touch()


if __name__ == "__main__":
    app.run(main)
