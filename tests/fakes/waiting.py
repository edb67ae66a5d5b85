"""Waits for a command in a thread, as the benchmark does, and stops it when it is to stop itself.

python -m tests.fakes.waiting FOLDER
"""

import contextlib
import signal
import sys
from concurrent import futures
from pathlib import Path

from experiments.cli import app
from experiments.runs import subprocesses


def _command_line(name, options):
    return [sys.executable, "-m", f"tests.fakes.{name}", *options]


def _work(folder):
    with contextlib.suppress(subprocesses.RunFailedError):
        subprocesses.run("saving", f"--folder={folder}", log=folder / "run.log")


if __name__ == "__main__":
    # As at a terminal: who is started in the background, or by nohup, ignores them.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    subprocesses.command_line = _command_line
    app.stop_at_kill()
    # Not `Thread.join`: interrupted once, it takes the thread for ended (CPython 3.11).
    pool = futures.ThreadPoolExecutor(1)
    try:
        pool.submit(_work, Path(sys.argv[1])).result()
    except KeyboardInterrupt:
        with subprocesses.stopping():
            pool.shutdown()
        sys.exit(app.INTERRUPTED)
