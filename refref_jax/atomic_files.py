"""Atomic writing of files and folders, locks on folders, and arrays from untrusted files.

Files and folders are written under a temporary name and then renamed. On an error or Ctrl-C, the
temporary file is removed. If the process is killed, it remains and is removed by the next attempt.

Locks are held by the operating system on the folder itself: they leave no file behind, and end with
the process that holds them. On systems without such locks (Windows), folders are not locked.
"""

import contextlib
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np

Stop = Literal["process", "machine"]
"""Failure that a write survives: termination of the process, or a crash of the machine."""

UNFINISHED = ".unfinished"
"""Suffix of temporary files and folders."""

# Largest ratio of the unpacked to the packed size of arrays, above a size that is always read.
_MOST_PACKED, _ALWAYS_READ = 64, 1 << 28


@contextlib.contextmanager
def written_file(target: Path, *, survives: Stop = "process") -> Iterator[Path]:
    """Yields the path of a temporary file that replaces the target if the context succeeds.

    Args:
      target: path of the file, in an existing folder.
      survives: failure that leaves the file complete: that of the process, or also of the machine.
        For `machine`, the content is synced to disk before the file is renamed.
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
    """Yields an empty temporary folder that replaces the target if the context succeeds."""
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
    """Yields an empty temporary folder that becomes the target if the context succeeds.

    Its name is unique, so that two processes never share it. A target that is not empty is an
    error.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as place:
        folder = Path(place) / target.name
        folder.mkdir()
        yield folder
        move(folder, target)


def move(finished: Path, target: Path) -> None:
    """Moves a complete file or folder to its target in the same file system.

    A file or an empty folder at the target is replaced.
    """
    os.replace(finished, target)


def beside(target: Path) -> Path:
    """Returns the temporary path of a target."""
    return target.with_name(f".{target.name}{UNFINISHED}")


def _import_locks() -> ModuleType | None:
    """Returns the module of file locks, or `None` on systems without it."""
    try:
        import fcntl
    except ImportError:  # pragma: no cover
        return None
    return fcntl


@contextlib.contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Locks a folder against other processes for the duration of the context.

    Args:
      folder: folder in which only one process works at a time, such as that of a run.

    Raises:
      ValueError: if another process holds the lock.
    """
    fcntl = _import_locks()
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


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads all arrays of an `.npz` file; nothing in it is unpickled.

    Raises:
      OSError: if the file cannot be opened.
      ValueError: if it is not such a file, or is packed so densely that it is not of numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(each.file_size for each in archive.infolist())
        if size > max(_ALWAYS_READ, _MOST_PACKED * path.stat().st_size):
            raise ValueError(f"it would unpack to {size} bytes")
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError):
        raise
    except Exception as error:  # NumPy passes on errors of zipfile, zlib and the tokenizer
        raise ValueError(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}") from error
