"""Files and folders that appear whole: they are written under another name first.

An error, or Ctrl-C, leaves nothing of it. Whoever is killed in between leaves what the next attempt
removes.
"""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def unfinished_folder(target: Path) -> Iterator[Path]:
    """Yields an empty folder that takes the place of the target when the context ends well."""
    draft = beside(target)
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir()
    try:
        yield draft
        if target.exists():
            shutil.rmtree(target)
        draft.rename(target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextlib.contextmanager
def appearing(target: Path) -> Iterator[Path]:
    """Yields an empty folder that becomes the target at the end, unless there is an error."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".converting-", dir=target.parent) as place:
        folder = Path(place) / target.name
        folder.mkdir()
        yield folder
        folder.rename(target)


@contextlib.contextmanager
def unfinished_file(target: Path) -> Iterator[Path]:
    """Yields the path of a file that takes the place of the target when the context ends well."""
    draft = beside(target)
    try:
        yield draft
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def beside(target: Path) -> Path:
    """Returns the name of a target as long as it is not whole."""
    return target.with_name(f".{target.name}.unfinished")
