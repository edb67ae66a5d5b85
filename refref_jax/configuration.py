"""Writes nested frozen dataclasses as JSON text, and reads them back exactly.

A field with a default may be missing, as it is in files of versions that did not know it.

Fields may be numbers, strings, booleans, `None`, other dataclasses, and tuples of these.
"""

import dataclasses
import json
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

_Config = TypeVar("_Config")


def write(path: Path, config: Any) -> None:
    """Writes a configuration as readable text."""
    text = json.dumps(dataclasses.asdict(config), indent=2) + "\n"
    path.write_text(text, encoding="utf-8")


def read(path: Path, kind: type[_Config]) -> _Config:
    """Reads a configuration of a known kind.

    Raises:
      ValueError: if the file is missing or not JSON, or a key is missing, unknown or of the
        wrong type; the message names the file and the key. A key with a default may be missing.
    """
    if not path.is_file():
        raise ValueError(f"{path} does not exist. Give a folder that a command wrote.")
    try:
        return _build(kind, json.loads(path.read_text(encoding="utf-8")), kind.__name__)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{path} does not hold a {kind.__name__} ({error}). Restore the file, or write it "
            "again with this version."
        ) from error


def _build(kind: Any, value: Any, where: str) -> Any:
    """Converts parsed JSON to an annotated type."""
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(kind, value, where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return _build_tuple(arguments, value, where)
    if origin is typing.Literal:
        if not any(value == option and type(value) is type(option) for option in arguments):
            raise ValueError(f"{where} is {value!r}, not one of {arguments}")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _build(next(a for a in arguments if a is not type(None)), value, where)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{where} is {value!r}, not of type {kind.__name__}")
    return value


def _build_dataclass(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {value!r}, not an object")
    hints = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    names = [field.name for field in fields if field.name in value]
    needed = {field.name for field in fields if field.default is dataclasses.MISSING}
    if missing := needed - set(value):
        raise ValueError(f"{where} lacks {', '.join(map(repr, sorted(missing)))}")
    if unknown := set(value) - set(names):
        raise ValueError(f"{where} has the unknown {', '.join(map(repr, sorted(unknown)))}")
    return kind(**{name: _build(hints[name], value[name], f"{where}.{name}") for name in names})


def _build_tuple(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise ValueError(f"{where} is {value!r}, not a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise ValueError(f"{where} has {len(value)} items, not {len(arguments)}")
    items = zip(arguments, value, strict=True)
    return tuple(_build(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(items))
