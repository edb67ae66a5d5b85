"""Writes the output folders of commands, atomically and without overwriting foreign files.

A command writes its files into a temporary folder inside its output folder, which is locked, and
moves them to their places when it succeeds. It also writes `command.json`: the command, all flags
of its last call, and the list of its files. With --overwrite only files on that list that the call
itself writes are replaced. All other files in the folder are left alone.
"""

import contextlib
import errno
import json
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from experiments.cli import app
from refref_jax import atomic_files, configuration

NOTE = "command.json"

# Inside the output folder, which may be a mount point: files are moved within one file system.
_DRAFT = ".unfinished"


@contextlib.contextmanager
def fresh(out: Path, *, module: str, writes: Sequence[str], overwrite: bool) -> Iterator[Path]:
    """Yields an empty folder, whose files are moved to `out` if the context succeeds.

    Args:
      out: output folder of the command, which may contain other files.
      module: `__name__` of the command, whose flags are recorded.
      writes: names in the folder that this call writes.
      overwrite: whether results of an earlier call may be replaced.

    Raises:
      ValueError: if existing files may not be replaced, or another process writes there.
    """
    place = {"module": module, "writes": writes, "overwrite": overwrite}
    replaceable(out, **place)
    existed, draft = out.exists(), out / _DRAFT
    out.mkdir(parents=True, exist_ok=True)
    with atomic_files.hold(out):
        try:
            # Checked again, as another process may have written meanwhile.
            earlier = replaceable(out, **place)
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir()
            yield draft
            _take_place(draft, out, module, earlier)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
            if not existed:
                _remove_empty(out)


@contextlib.contextmanager
def fresh_file(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yields the path of a temporary file that replaces `path` if the context succeeds."""
    check_file(path, overwrite=overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_files.written_file(path) as draft:
        yield draft


def check_file(path: Path, *, overwrite: bool) -> None:
    """Raises `ValueError` if a file exists and may not be replaced, or if it is a folder."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder, not a file. Give another name.")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists. Give another --out, or use --overwrite to replace it.")


def check_folder(out: Path) -> None:
    """Raises `ValueError` if a folder cannot be written to; does not leave behind a new one."""
    if out.exists() and not out.is_dir():
        return  # who writes there says what it is
    missing = [each for each in (out, *out.parents) if not each.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise ValueError(
            f"--out={out} cannot be written to ({error.strerror}). Give another folder."
        ) from error
    finally:
        for each in missing:
            _remove_empty(each)


def note(out: Path, module: str, files: Iterable[Path] = ()) -> None:
    """Records a command, its flags and the files that it has written in its folder."""
    command = sys.modules[module]
    content = {
        "command": app.name_of(command),
        "options": {name: flag.value for name, flag in app.flags_of(command).items()},
        "files": [path.as_posix() for path in sorted(files)],
    }
    with atomic_files.written_file(out / NOTE) as path:
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def replaceable(out: Path, *, module: str, writes: Sequence[str], overwrite: bool) -> set[Path]:
    """Returns the files of earlier calls that may be replaced, relative to `out`; see `fresh`.

    Commands call this first, so that no work is wasted. It raises `ValueError` if there are files
    that may not be replaced.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, not a folder. Give another --out.")
    noted = _noted(out, module)
    own = set() if noted is None else {NOTE, *(path.parts[0] for path in noted)}
    _refuse_strangers(out, [name for name in (*writes, NOTE) if name not in own])
    there = {path for path in _present(out, noted) if path.parts[0] in writes}
    if there and not overwrite:
        shown = ", ".join(path.as_posix() for path in sorted(there)[:2])
        raise ValueError(
            f"{out} contains the results of an earlier call ({shown}, ...). Use --overwrite to "
            "replace them, or another --out."
        )
    return there


def _take_place(draft: Path, out: Path, module: str, earlier: set[Path]) -> None:
    """Moves new files to their places, and removes other files of `earlier`.

    If the process is killed at any time, the record lists all files of the command.
    """
    new = {path.relative_to(draft) for path in draft.rglob("*") if path.is_file()}
    _refuse_strangers(out, sorted(new - earlier))
    kept = _present(out, _noted(out, module)) - earlier
    note(out, module, new | earlier | kept)
    for path in new:
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        atomic_files.move(draft / path, out / path)
    _remove(out, earlier - new)
    note(out, module, new | kept)


def _refuse_strangers(out: Path, names: Iterable[Path | str]) -> None:
    if strangers := [out / name for name in names if (out / name).exists()]:
        raise ValueError(
            f"{strangers[0]} was not written by this command, according to {NOTE} next to it. "
            "Remove it, or give another --out: --overwrite keeps foreign files."
        )


def _remove(out: Path, files: set[Path]) -> None:
    """Removes files, and folders that become empty."""
    for path in files:
        (out / path).unlink(missing_ok=True)
    folders = {parent for path in files for parent in path.parents} - {Path()}
    for folder in sorted(folders, reverse=True):  # nested folders first
        _remove_empty(out / folder)


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


def _noted(out: Path, module: str) -> set[Path] | None:
    """Returns the files recorded by a command; `None` if there is no record."""
    try:
        content = configuration.parse_json((out / NOTE).read_text(encoding="utf-8"))
        command, files = content["command"], {Path(name) for name in content["files"]}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    within = all(x.parts and not x.is_absolute() and ".." not in x.parts for x in files)
    return files if within and command == app.name_of(sys.modules[module]) else None


def _present(out: Path, files: set[Path] | None) -> set[Path]:
    return {path for path in files or () if (out / path).is_file()}
