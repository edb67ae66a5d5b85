"""One process at a time works in a folder: trains a run, or makes scenes.

The lock is the operating system's, on the folder itself: it leaves no file behind, and ends with
the process that holds it, however that ends. Where there is none of the kind (Windows), nothing is
locked.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # pragma: no cover
    fcntl = None


@contextlib.contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Keeps other processes out of a folder, for as long as the context lasts.

    Args:
      folder: of a run, or of anything that this is asked for.

    Raises:
      ValueError: if another process holds it.
    """
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"Another process works in {folder}. Wait until it ends, or stop it."
            ) from error
        yield
    finally:
        os.close(descriptor)
