"""One process at a time trains a run.

The lock is the operating system's: it ends with the process that holds it, however that ends. Where
there is none of the kind (Windows), nothing is locked.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # pragma: no cover
    fcntl = None

_FILE = ".lock"


@contextlib.contextmanager
def hold(run: Path) -> Iterator[None]:
    """Keeps other processes from training a run, for as long as the context lasts.

    Args:
      run: its folder.

    Raises:
      ValueError: if another process trains it.
    """
    with (run / _FILE).open("a+", encoding="utf-8") as file:
        if fcntl is not None:
            _lock(file.fileno(), run)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def _lock(descriptor: int, run: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        holder = (run / _FILE).read_text("utf-8").strip()
        raise ValueError(
            f"Another process ({holder or 'unknown'}) trains {run}. Wait until it ends, or stop it."
        ) from error
