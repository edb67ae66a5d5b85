"""What --help prints: what a command does and its options, on one screen, or all of it."""

import inspect
import re
import textwrap
from collections.abc import Sequence
from types import ModuleType

from absl import flags

WIDTH = 100
"""Columns of what is printed."""

LINES = 40
"""Most lines of --help."""

REQUIRED = "must have a value other than None"
"""What absl says of an option that must be given."""

# Options that --help has a line for; of more it names the rest.
_MOST = 24

_WIDEST_NAME = 21


def help_text(module: ModuleType, first: Sequence[str], again: str) -> str:
    """Returns what a command does, how it is called, and its options, a line for each.

    Those that must be given come first, and then those of `first`. If there are too many, there is
    a line for these alone, and the others are named.
    """
    options = options_of(module)
    foremost = [name for name in options if is_required(options[name])]
    foremost += [name for name in first if name not in foremost]
    others = [name for name in options if name not in foremost]
    listed = foremost + (others if len(options) <= _MOST else [])
    lines = [_documentation(module).splitlines()[0], "", *_usage(module), "", "Options:"]
    lines += [_line(options[name]) for name in listed]
    if named := [f"--{name}" for name in options if name not in listed]:
        lines += wrapped(" ".join(named), "Also: ", "  ")
    lines += ["", *wrapped(again, "Given again: ", "  "), "--helpfull tells all of it."]
    return "\n".join(lines)


def full_text(module: ModuleType, again: str) -> str:
    """Returns all that a command tells of itself and of its options."""
    lines = [_documentation(module), ""]
    for flag in options_of(module).values():
        lines.append(f"  --{flag.name}: {_values(flag)}".rstrip(": "))
        lines += wrapped(meaning(flag), "      ", "      ")
    lines += ["", *wrapped(again, "Given again: ", "  ")]
    lines.append("Options may also be read from a file of lines: --flagfile=FILE.")
    return "\n".join(lines)


def options_of(module: ModuleType) -> dict[str, flags.Flag]:
    """Returns the options of a command, without the older names that some have too."""
    found = flags.FLAGS.get_key_flags_for_module(module)
    return {flag.name: flag for flag in found if not flag.help.startswith("Alias for --")}


def is_required(flag: flags.Flag) -> bool:
    """Returns whether an option must be given."""
    return any(REQUIRED in (each.message or "") for each in flag.validators)


def _documentation(module: ModuleType) -> str:
    return inspect.cleandoc(module.__doc__ or "").rstrip()


def _usage(module: ModuleType) -> list[str]:
    """Returns the lines of a module's documentation that call it, up to the first gap after."""
    lines = _documentation(module).splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith("python -m ")), len(lines))
    until = next((i for i in range(begin, len(lines)) if not lines[i]), len(lines))
    return [f"  {line}" for line in lines[begin:until]]


def meaning(flag: flags.Flag) -> str:
    """Returns what an option means, without what absl adds to it."""
    text = re.sub(r"^<[^>]*>: ", "", flag.help)
    return " ".join(re.sub(r";\s*repeat this option.*", "", text, flags=re.DOTALL).split())


def _values(flag: flags.Flag) -> str:
    if flag.boolean:
        return ""
    words = [" or ".join(getattr(flag.parser, "enum_values", []))]
    words.append("required" if is_required(flag) else "")
    words.append("" if flag.default in (None, []) else f"by default {_default(flag)}")
    return ", ".join(filter(None, words))


def _default(flag: flags.Flag) -> str:
    return flag.serializer.serialize(flag.default) if flag.serializer else str(flag.default)


def _line(flag: flags.Flag) -> str:
    """Returns the line of an option: its name and default, and the beginning of what it means."""
    shown = f"--{flag.name}"
    if not flag.boolean and flag.default not in (None, []):
        value = _default(flag)
        fits = len(shown) + len(value) < _WIDEST_NAME
        shown += f"={value}" if fits else ""
    text = meaning(flag)
    if choices := getattr(flag.parser, "enum_values", None):
        text = f"{', '.join(choices)}. {text}"
    must = "*" if is_required(flag) else " "
    start = f"{must} {shown:{_WIDEST_NAME}}  "
    return start + textwrap.shorten(text, WIDTH - len(start), placeholder=" ...")


def wrapped(text: str, start: str, indent: str) -> list[str]:
    """Returns a text in lines of `WIDTH`, the first begun by `start`, the others by `indent`."""
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=start,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
