"""How a stage leaves its result: under another name first, and under its own when it is whole.

Whoever is killed in between leaves what the next attempt removes.
"""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def unfinished_folder(target: Path) -> Iterator[Path]:
    """Yields an empty folder that takes the place of the target when the context ends well."""
    beside = _beside(target)
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir()
    yield beside
    if target.exists():
        shutil.rmtree(target)
    beside.rename(target)


@contextlib.contextmanager
def unfinished_file(target: Path) -> Iterator[Path]:
    """Yields the path of a file that takes the place of the target when the context ends well."""
    beside = _beside(target)
    yield beside
    beside.replace(target)


def _beside(target: Path) -> Path:
    return target.with_name(f".{target.name}.unfinished")
