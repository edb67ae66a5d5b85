"""Where commands write: whole or not at all, and never over what is not their own.

A command writes its files into a draft beside its folder, and moves them there when it has ended
well. With them goes `command.json`: the command, all its options, and the files that it wrote. Only
with --overwrite, and only files that are listed there, are replaced; whatever else lies in
the folder stays.
"""

import contextlib
import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments import command_line
from experiments.r3f import stages

NOTE = "command.json"


@contextlib.contextmanager
def fresh(out: Path, *, module: str, writes: Sequence[str], overwrite: bool) -> Iterator[Path]:
    """Yields an empty folder, whose files come to `out` when the context ends well.

    Args:
      out: folder of the command, which may hold other things too.
      module: `__name__` of the command, whose options are noted.
      writes: names in the folder that the command gives to what it writes.
      overwrite: whether results of an earlier call may be replaced.

    Raises:
      ValueError: if there is anything in the place that may not be replaced.
    """
    earlier = replaceable(out, module=module, writes=writes, overwrite=overwrite)
    draft = stages.beside(out.resolve())  # which has a name, even if it is `.`
    draft.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir()
    try:
        yield draft
        files = sorted(path.relative_to(draft) for path in draft.rglob("*") if path.is_file())
        _refuse_strangers(out, [path for path in files if str(path) not in earlier])
        note(draft, module, files)
        _remove(out, earlier)
        for path in (*files, Path(NOTE)):
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            (draft / path).replace(out / path)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextlib.contextmanager
def fresh_file(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yields the path of a file that takes the place of `path` when the context ends well.

    Raises:
      ValueError: if there is something already, and it is not to be replaced.
    """
    check_file(path, overwrite=overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    with stages.unfinished_file(path) as draft:
        yield draft


def check_file(path: Path, *, overwrite: bool) -> None:
    """Refuses to replace a file without being asked to, and a folder at all.

    Raises:
      ValueError: if there is one.
    """
    if path.is_dir():
        raise ValueError(f"{path} is a folder, and a file is to be written. Give another name.")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists. Give another --out, or --overwrite to replace it.")


def note(out: Path, module: str, files: Sequence[Path] = ()) -> None:
    """Notes a command, its options, and the files that it has written, in its folder."""
    command = sys.modules[module]
    content = {
        "command": command_line.name_of(command),
        "options": command_line.resolved(command),
        "files": [path.as_posix() for path in files],
    }
    with stages.unfinished_file(out / NOTE) as path:
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def replaceable(out: Path, *, module: str, writes: Sequence[str], overwrite: bool) -> set[str]:
    """Returns the files of an earlier call, which may be replaced; see `fresh`.

    Commands ask it before they do anything else, so that none works in vain.

    Raises:
      ValueError: if there is anything in the place that may not be replaced.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, and a folder is needed. Give another --out.")
    noted = _read(out / NOTE)
    if noted is None or noted["command"] != command_line.name_of(sys.modules[module]):
        _refuse_strangers(out, [Path(name) for name in (*writes, NOTE)])
        return set()
    there = {name for name in noted["files"] if (out / name).is_file()}
    if there and not overwrite:
        raise ValueError(
            f"{out} holds the results of an earlier call ({', '.join(sorted(there)[:2])}, ...). "
            "Give --overwrite to replace them, or another --out."
        )
    return there


def _refuse_strangers(out: Path, names: Sequence[Path]) -> None:
    if strangers := [out / name for name in names if (out / name).exists()]:
        raise ValueError(
            f"{strangers[0]} is not of this command, as far as {NOTE} beside it tells. Remove it, "
            "or give another --out: --overwrite replaces nothing of others."
        )


def _remove(out: Path, files: set[str]) -> None:
    """Removes files, and the folders that are empty then."""
    for name in files:
        (out / name).unlink(missing_ok=True)
    for folder in {parent for name in files for parent in Path(name).parents} - {Path()}:
        with contextlib.suppress(OSError):
            (out / folder).rmdir()


def _read(path: Path) -> dict[str, Any] | None:
    """Returns what a folder's note says; `None` if there is none, or it is another's."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        valid = isinstance(content["command"], str) and all(
            isinstance(name, str) and not Path(name).is_absolute() and ".." not in Path(name).parts
            for name in content["files"]
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return content if valid else None
