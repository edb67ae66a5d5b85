"""Writes nested frozen dataclasses as JSON, and reads them back exactly.

Fields with a default may be missing, as in files of older versions. A field that was renamed is
also read under its earlier name, `formerly` in its metadata.

Fields may be numbers, strings, booleans, `None`, other dataclasses, and tuples of these. If a field
is annotated with a base class, the key `kind` of its value selects the variant of that class.

The leaves of a tree of dataclasses can be options (`option`), which are accessed by their names
(`options_of`).
"""

import collections
import dataclasses
import difflib
import functools
import json
import math
import numbers
import os
import reprlib
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple, TypeVar

from refref_jax import atomic_files

_Config = TypeVar("_Config")

Variants = Mapping[type, Mapping[str, type]]
"""Variants of each base class, by their key `kind`; the first is the default."""

_KIND = "kind"

_WRAPPER = textwrap.TextWrapper(
    width=100,
    initial_indent="  ",
    subsequent_indent="    ",
    break_long_words=False,
    break_on_hyphens=False,
)

FORMERLY = "formerly"
"""Key of a field's metadata: the name of the field in files of earlier versions."""

FORMER_VALUES = "former_values"
"""Key of a field's metadata: its values by their names in files of earlier versions."""

NOT_FINITE = ("inf", "-inf", "nan")
"""Names of the numbers that JSON does not support."""

# Levels of nesting in a file that is read: every format here has fewer than ten.
_DEEPEST = 64

# Characters of a word that are compared with others, which takes time proportional to their square.
_LONGEST_WORD = 80

_ABRIDGED = reprlib.Repr()
_ABRIDGED.maxlevel, _ABRIDGED.maxlist, _ABRIDGED.maxstring, _ABRIDGED.maxlong = 4, 8, 80, 40


def write(path: Path, config: Any) -> None:
    """Writes a configuration as indented JSON, atomically."""
    text = json.dumps(dataclasses.asdict(config), indent=2) + "\n"
    with atomic_files.written_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def parse_json(text: str | bytes) -> Any:
    """Parses JSON text from untrusted files.

    Raises:
      ValueError: if the text is not JSON, is nested too deeply, or has a key twice.
    """
    try:
        found = json.loads(text, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    level = [found]
    for _ in range(_DEEPEST):
        level = [inner for each in level for inner in _inside(each)]
    if level:
        raise ValueError("it is nested too deeply")
    return found


def _inside(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = collections.Counter(key for key, _ in pairs)
        raise ValueError(f"it has the key {abridged(counts.most_common(1)[0][0])} twice")
    return found


def abridged(value: Any) -> str:
    """Returns a value of a file as text for messages, shortened if it is long."""
    return _ABRIDGED.repr(value)


def string_safe(value: Any) -> Any:
    """Replaces numbers that JSON does not support by their names."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return _each(value, string_safe)


def from_string_safe(value: Any) -> Any:
    """Inverts `string_safe`."""
    if isinstance(value, str) and value in NOT_FINITE:
        return float(value)
    return _each(value, from_string_safe)


def _each(value: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(value, dict):
        return {key: change(item) for key, item in value.items()}
    return [change(item) for item in value] if isinstance(value, list) else value


def read(path: Path, kind: type[_Config], *, variants: Variants | None = None) -> _Config:
    """Reads a configuration of a given class.

    Args:
      path: path of the file.
      kind: class of the configuration.
      variants: variants of the base classes in the configuration.

    Raises:
      ValueError: if the file is missing or not JSON, or a key is missing, unknown or of the
        wrong type; the message names the file and the key. A key with a default may be missing.
    """
    if not path.is_file():
        raise ValueError(f"{path} does not exist. Give a folder that a command wrote.")
    try:
        content = parse_json(path.read_text(encoding="utf-8-sig"))
        return build(content, kind, variants=variants)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{path} is not a valid {kind.__name__} ({error}). Correct or restore the file."
        ) from error


def build(content: Any, kind: type[_Config], *, variants: Variants | None = None) -> _Config:
    """Builds a configuration from the result of `parse_json`; see `read`.

    Raises:
      ValueError: if a key is missing, unknown or of the wrong type; the message names the key.
    """
    return _build(kind, content, kind.__name__, variants or {})


def convert(value: Any, kind: Any, *, name: str) -> Any:
    """Converts a JSON value to the annotated type of a field; see `read`.

    Args:
      value: number, string, `None`, or list of these, as parsed from JSON.
      kind: annotation of the field.
      name: name of the value, for error messages.

    Raises:
      ValueError: if the value has another type, or is not one of the allowed values.
    """
    return _build(kind, value, name, {})


def convert_fields(record: Any) -> None:
    """Converts the values of a new dataclass to the annotations of its fields, in place.

    Raises:
      ValueError: if a value has another type; the message names the field, or the `name` in its
        metadata.
    """
    hints = hints_of(record.__class__)
    for field in dataclasses.fields(record):
        value, kind = getattr(record, field.name), hints[field.name]
        name = field.metadata.get("name") or field.name
        if not isinstance(kind, type) or not dataclasses.is_dataclass(kind):
            object.__setattr__(record, field.name, convert(plain(value), kind, name=name))
        elif not isinstance(value, kind):
            raise ValueError(f"{name} is {value!r}, not of type {kind.__name__}.")


def nearest(word: str, words: Iterable[str], *, similarity: float = 0.6) -> str | None:
    """Returns the most similar of some words, or `None` if none is similar enough."""
    found = difflib.get_close_matches(word[:_LONGEST_WORD], list(words), 1, similarity)
    return found[0] if found else None


@functools.cache
def hints_of(owner: Any) -> Mapping[str, Any]:
    """Returns the annotations of a class by field."""
    return types.MappingProxyType(typing.get_type_hints(owner))


def plain(value: Any) -> Any:
    """Returns a value as JSON represents it; NumPy's numbers become Python's."""
    if isinstance(value, Mapping):
        return [[name, plain(each)] for name, each in sorted(value.items())]
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, bool):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value)
    return str(value) if isinstance(value, PurePath) else value


class Option(NamedTuple):
    """One option of a configuration.

    Attributes:
      name: name of the option.
      section: field of the configuration that contains the option; empty if it is there itself.
      field: dataclass field of the option in its section.
    """

    name: str
    section: str
    field: dataclasses.Field[Any]


def option(
    default: Any,
    *,
    name: str = "",
    formerly: str = "",
    after: tuple[str, ...] = (),
    comparison: typing.Literal["strict", "none"] = "strict",
) -> Any:
    """Declares an option as a field of a dataclass.

    Args:
      default: value if none is given; `None` for a decision that is taken later.
      name: name of the option if it differs from that of the field.
      formerly: name of the option and the field in earlier versions, which is still read.
      after: options on which the decision depends. Overriding one of them takes it again, unless
        the option itself is an override.
      comparison: `none` if configurations that differ in this option alone count as equal.
    """
    metadata = {"name": name, "after": after, FORMERLY: formerly or None}
    return dataclasses.field(default=default, metadata=metadata, compare=comparison == "strict")


def options_of(kind: type) -> Iterator[Option]:
    """Yields all options of a configuration class: its fields, and those of its sections.

    A field of the class itself that is not compared is not an option.
    """
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(field.default):
            for leaf in dataclasses.fields(field.default):
                yield Option(leaf.metadata["name"] or leaf.name, field.name, leaf)
        elif field.compare:
            yield Option(field.name, "", field)


def type_of(kind: type, chosen: Option) -> Any:
    """Returns the annotation of the field of an option of a configuration class."""
    owner = hints_of(kind)[chosen.section] if chosen.section else kind
    return hints_of(owner)[chosen.field.name]


@functools.cache
def present_name(kind: type, name: str) -> str:
    """Returns the name of an option for its name in this or an earlier version."""
    former = {each.field.metadata.get(FORMERLY): each.name for each in options_of(kind)}
    return former.get(name, name)


def convert_options(kind: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Converts values of options to the types of their fields; `None` becomes the default.

    Args:
      kind: class of the configuration.
      given: values by name, present or former.

    Returns:
      The values by the present names of the options.

    Raises:
      ValueError: if a value has another type, is not one of the choices, or has no option.
    """
    options = {each.name: each for each in options_of(kind)}
    given = {present_name(kind, name): value for name, value in given.items()}
    if unknown := sorted(set(given) - set(options)):
        raise ValueError(
            f"There is no option {unknown[0]!r}. Choose from {', '.join(sorted(options))}."
        )
    return {
        name: options[name].field.default
        if value is None
        else convert(plain(value), type_of(kind, options[name]), name=name)
        for name, value in given.items()
    }


def describe(values: Mapping[str, Any], reasons: Mapping[str, str]) -> list[str]:
    """Returns lines of text with values, grouped by the reasons for them.

    Args:
      values: values by the names of options.
      reasons: reasons by the names of options.
    """
    by_reason: dict[str, list[str]] = {}
    for name, value in values.items():
        by_reason.setdefault(reasons[name], []).append(f"{name}={_shown(value)}")
    texts = (f"{reason}: {', '.join(each)}" for reason, each in by_reason.items())
    return [line for text in texts for line in _WRAPPER.wrap(text)]


def _shown(value: Any) -> str:
    """Returns a value as text."""
    if isinstance(value, tuple):
        return ",".join(f"{x[0]}={x[1]:g}" if isinstance(x, tuple) else str(x) for x in value)
    return f"{value:g}" if isinstance(value, float) and math.isfinite(value) else str(value)


def _build(kind: Any, value: Any, where: str, variants: Variants) -> Any:
    """Converts parsed JSON to an annotated type."""
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(kind, value, where, variants)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return _build_tuple(arguments, value, where, variants)
    if origin is typing.Literal:
        if not any(value == option and type(value) is type(option) for option in arguments):
            raise ValueError(f"{where} is {abridged(value)}, not one of {arguments}")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        (other,) = (a for a in arguments if a is not type(None))
        return _build(other, value, where, variants)
    if type(value) is int and abs(value) > sys.float_info.max:
        raise ValueError(f"{where} is too large: a number of {value.bit_length()} bits")
    if kind is float and type(value) is int:
        return float(value)
    if isinstance(value, str):
        _check_text(value, where)
    if value != value:
        raise ValueError(f"{where} is NaN, not a number")
    if type(value) is not kind:
        raise ValueError(f"{where} is {abridged(value)}, not of type {kind.__name__}")
    return value


def _check_text(value: str, where: str) -> None:
    """Refuses text that cannot be part of a path."""
    try:
        os.fsencode(value)
        possible = "\0" not in value
    except UnicodeEncodeError:
        possible = False
    if not possible:
        shown = abridged(value)
        raise ValueError(f"{where} is {shown}, which holds a character that no name can have")


def _build_dataclass(kind: Any, value: Any, where: str, variants: Variants) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {abridged(value)}, not an object")
    kind = _variant(variants[kind], value, where) if kind in variants else kind
    hints = hints_of(kind)
    fields = dataclasses.fields(kind)
    value = _with_present_names(fields, value)
    names = [field.name for field in fields if field.name in value]
    needed = {field.name for field in fields if field.default is dataclasses.MISSING}
    if missing := needed - set(value):
        raise ValueError(f"{where} lacks {', '.join(map(repr, sorted(missing)))}")
    if unknown := set(value) - set(names):
        raise ValueError(f"{where} has the unknown key {_unknown(sorted(unknown)[0], hints)}")
    built = {n: _build(hints[n], value[n], f"{where}.{n}", variants) for n in names}
    return kind(**built)


def _unknown(key: str, hints: Mapping[str, Any]) -> str:
    """Returns an unknown key with advice: the nearest known one, or the section that it is in."""
    for section, kind in hints.items():
        if dataclasses.is_dataclass(kind) and key in {f.name for f in dataclasses.fields(kind)}:
            return f"{key!r}, which belongs in {section!r}"
    near = nearest(key, hints)
    return abridged(key) + (f": did you mean {near!r}?" if near else "")


def _with_present_names(
    fields: Sequence[dataclasses.Field[Any]], value: dict[str, Any]
) -> dict[str, Any]:
    """Renames keys and values of earlier versions, except keys whose present name exists too."""
    names = {field.metadata.get(FORMERLY): field.name for field in fields}
    present = {old: new for old, new in names.items() if new not in value}
    renamed = {present.get(key, key): item for key, item in value.items()}
    for field in fields:
        former, item = field.metadata.get(FORMER_VALUES, {}), renamed.get(field.name)
        if isinstance(item, str | int) and item in former:
            renamed[field.name] = former[item]
    return renamed


def _variant(known: Mapping[str, type], value: dict[str, Any], where: str) -> type:
    """Returns the class named by the key `kind` of a value, or the first."""
    name = value.get(_KIND, next(iter(known)))
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"{where}.{_KIND} is {name!r}, not one of {', '.join(known)}")
    return known[name]


def _build_tuple(
    arguments: tuple[Any, ...], value: Any, where: str, variants: Variants
) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise ValueError(f"{where} is {abridged(value)}, not a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise ValueError(f"{where} has {len(value)} items, not {len(arguments)}")
    items = zip(arguments, value, strict=True)
    return tuple(
        _build(kind, item, f"{where}[{i}]", variants) for i, (kind, item) in enumerate(items)
    )


# ---- Checks of single values, for files with a form of their own ----
Vector = tuple[float, float, float]


class UnsuitableError(ValueError):
    """A value is not suitable; the message says what is, to follow the word Give."""


def as_number(value: Any) -> float:
    """Returns a number, or NaN for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value) if abs(value) < 1e300 else math.inf  # of integers of any size


def as_vector(value: Any) -> Vector:
    """Returns three numbers, or NaN three times for any other value."""
    if not isinstance(value, list) or len(value) != 3:
        return math.nan, math.nan, math.nan
    first, second, third = map(as_number, value)
    return first, second, third


def number_within(least: float, most: float, wanted: str) -> Callable[[Any], float]:
    """Returns a check of a finite number in a range."""

    def check(value: Any) -> float:
        if not (least <= as_number(value) <= most and as_number(value) < math.inf):
            raise UnsuitableError(wanted)
        return as_number(value)

    return check


def vector_within(least: float, most: float, wanted: str) -> Callable[[Any], Vector]:
    """Returns a check of three finite numbers in a range."""

    def check(value: Any) -> Vector:
        if not all(least <= each <= most and abs(each) < math.inf for each in as_vector(value)):
            raise UnsuitableError(wanted)
        return as_vector(value)

    return check


def of_type(kind: type, wanted: str) -> Callable[[Any], Any]:
    """Returns a check of the type of a value; text is not empty, and a number has 32 bits."""

    def check(value: Any) -> Any:
        wide = type(value) is int and abs(value) >= 2**31
        if type(value) is not kind or value == "" or "\0" in str(value) or wide:
            raise UnsuitableError(wanted)
        return value

    return check


def one_of(*names: str) -> Callable[[Any], str]:
    """Returns a check of a name."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or value not in names:
            near = nearest(value, names) if isinstance(value, str) else None
            raise UnsuitableError(f"one of {', '.join(names)}{f': {near}?' if near else ''}")
        return value

    return check
