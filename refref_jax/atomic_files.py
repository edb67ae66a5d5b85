"""Files and folders that appear whole, and the lock of a folder.

What is written gets another name first, and its own by a rename, in this module alone. An error, or
Ctrl-C, leaves nothing of it. Whoever is killed in between leaves what the next attempt removes.

The lock is the operating system's, on the folder itself: it leaves no file behind, and ends with
the process that holds it, however that ends. Where there is none of the kind (Windows), nothing is
locked.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

try:
    import fcntl
except ImportError:  # pragma: no cover
    fcntl = None

Stop = Literal["process", "machine"]
"""What may end while a file is written."""

UNFINISHED = ".unfinished"
"""How names end of what is not whole yet."""


@contextlib.contextmanager
def written_file(target: Path, *, survives: Stop = "process") -> Iterator[Path]:
    """Yields the path of a file that takes the place of the target when the context ends well.

    Args:
      target: path of the file, in an existing folder.
      survives: whose sudden end the file is whole after. For that of the machine, the content is
        synced to the disk before the file gets its name.
    """
    draft = beside(target)
    try:
        yield draft
        if survives == "machine":
            with draft.open("rb") as file:
                os.fsync(file.fileno())
        os.replace(draft, target)
    finally:
        draft.unlink(missing_ok=True)


@contextlib.contextmanager
def written_folder(target: Path) -> Iterator[Path]:
    """Yields an empty folder that takes the place of the target when the context ends well."""
    draft = beside(target)
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir()
    try:
        yield draft
        if target.exists():
            shutil.rmtree(target)
        move(draft, target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextlib.contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yields an empty folder that becomes the target when the context ends well.

    Its name is new every time, so that two processes do not meet in it. A target that holds
    anything already is an error.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as place:
        folder = Path(place) / target.name
        folder.mkdir()
        yield folder
        move(folder, target)


def move(finished: Path, target: Path) -> None:
    """Moves a file or a folder that is whole to its place in the same file system.

    A file or an empty folder in that place is replaced.
    """
    os.replace(finished, target)


def beside(target: Path) -> Path:
    """Returns the name of a target as long as it is not whole."""
    return target.with_name(f".{target.name}{UNFINISHED}")


@contextlib.contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Keeps other processes out of a folder, for as long as the context lasts.

    Args:
      folder: that of a run, or of anything else in which one process works at a time.

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
