"""How commands read their options: what is wrong is told at once, and --help fits a screen.

Nothing here imports JAX, and commands import what does after their options are read; see
`late_imports`. The options of a command are absl's key flags of its module.
"""

import difflib
import inspect
import re
import shlex
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from types import ModuleType
from typing import Any

from absl import flags

WIDTH = 100
"""Columns of what is printed."""

LINES = 40
"""Most lines of --help."""

# Options that --help has a line for; of more it names the rest.
_MOST = 24

_REQUIRED = "must have a value other than None"  # absl's words
_WIDEST_NAME = 21
_HELP = ("--help", "-help", "-h", "--helpshort")
_HELP_FULL = ("--helpfull", "-helpfull")


def did_you_mean(word: str, names: Iterable[str], *, shown: str = "{}") -> str:
    """Returns ` Did you mean NAME?`, or nothing if no name is like the word."""
    near = difflib.get_close_matches(word, list(names), n=1)
    return f" Did you mean {shown.format(near[0])}?" if near else ""


def check(holder: flags.FlagHolder, refuse: Callable[[Any], Any]) -> None:
    """Has the value of an option checked as soon as it is read.

    Args:
      holder: the option.
      refuse: is called with its value, and raises a `ValueError` that says what is wrong.
    """

    def hold(value: Any) -> bool:
        try:
            refuse(value)
        except ValueError as error:
            raise flags.ValidationError(str(error)) from error
        return True

    flags.register_validator(holder.name, hold)


def read(words: Sequence[str], module: ModuleType, *, first: Sequence[str], again: str) -> list:
    """Reads the options of a command, or prints its help, or what is wrong with them, and exits.

    Args:
      words: of the command line, its name first.
      module: of the command.
      first: names of the options that decide most; see `help_text`.
      again: what the command does when it is given again.

    Returns:
      The words that are no options, the name first.
    """
    asked = set(words[1 : words.index("--") if "--" in words else len(words)])
    if asked & {*_HELP, *_HELP_FULL}:
        full = bool(asked & set(_HELP_FULL))
        print(full_text(module, again) if full else help_text(module, first, again))
        sys.exit(0)
    try:
        return flags.FLAGS(words)
    except flags.Error as error:
        fail(_explained(error, module))


def fail(message: str) -> None:
    """Ends the command because of what the user gave."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def refuse_words(module: ModuleType, given: Sequence[str], arguments: Sequence[str]) -> None:
    """Ends the command if there are more or fewer arguments than it takes."""
    if len(given) < len(arguments):
        fail(f"{arguments[len(given)]} is missing. Give {' '.join(arguments)}; see --help.")
    if len(given) > len(arguments):
        extra = given[len(arguments)]
        name = extra.partition("=")[0]
        near = f" Did you mean --{extra}?" if name in _options(module) else ""
        fail(f"Unexpected argument {extra!r}. Options begin with --.{near or ' See --help.'}")


def name_of(module: ModuleType) -> str:
    """Returns the name of a command, as `experiments.train`, however it was started."""
    spec = module.__spec__
    return module.__name__ if spec is None else spec.name.removesuffix(".__main__")


def resolved(module: ModuleType) -> dict[str, Any]:
    """Returns the values of all options of a command, given or not."""
    return {name: flag.value for name, flag in _options(module).items()}


def echo(module: ModuleType, arguments: Sequence[str]) -> str:
    """Returns the command as it was given, and below it the options that hold by default."""
    options = _options(module).values()
    # What has no value, or an empty one, changes nothing.
    rest = [each for each in options if not each.present and each.value not in (None, [], False)]
    given = [*map(shlex.quote, arguments), *(_written(each) for each in options if each.present)]
    lines = _wrapped(" ".join((name_of(module), *given)), "", "  ")
    if rest:
        lines += _wrapped(" ".join(map(_written, rest)), "  by default: ", "    ")
    return "\n".join(lines)


def help_text(module: ModuleType, first: Sequence[str], again: str) -> str:
    """Returns what a command does, how it is called, and its options, a line for each.

    Those that must be given come first, and then those of `first`. If there are too many, there is
    a line for these alone, and the others are named.
    """
    options = _options(module)
    foremost = [name for name in options if _is_required(options[name])]
    foremost += [name for name in first if name not in foremost]
    others = [name for name in options if name not in foremost]
    listed = foremost + (others if len(options) <= _MOST else [])
    lines = [_documentation(module).splitlines()[0], "", *_usage(module), "", "Options:"]
    lines += [_line(options[name]) for name in listed]
    if named := [f"--{name}" for name in options if name not in listed]:
        lines += _wrapped(" ".join(named), "Also: ", "  ")
    lines += ["", *_wrapped(again, "Given again: ", "  "), "--helpfull tells all of it."]
    return "\n".join(lines)


def full_text(module: ModuleType, again: str) -> str:
    """Returns all that a command tells of itself and of its options."""
    lines = [_documentation(module), ""]
    for flag in _options(module).values():
        lines.append(f"  --{flag.name}: {_values(flag)}".rstrip(": "))
        lines += _wrapped(_help_of(flag), "      ", "      ")
    lines += ["", *_wrapped(again, "Given again: ", "  ")]
    lines.append("Options may also be read from a file of lines: --flagfile=FILE.")
    return "\n".join(lines)


def _options(module: ModuleType) -> dict[str, flags.Flag]:
    """Returns the options of a command, without the older names that some have too."""
    found = flags.FLAGS.get_key_flags_for_module(module)
    return {flag.name: flag for flag in found if not flag.help.startswith("Alias for --")}


def _is_required(flag: flags.Flag) -> bool:
    return any(_REQUIRED in (each.message or "") for each in flag.validators)


def _documentation(module: ModuleType) -> str:
    return inspect.cleandoc(module.__doc__ or "").rstrip()


def _usage(module: ModuleType) -> list[str]:
    """Returns the lines of a module's documentation that call it, up to the first gap after."""
    lines = _documentation(module).splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith("python -m ")), len(lines))
    until = next((i for i in range(begin, len(lines)) if not lines[i]), len(lines))
    return [f"  {line}" for line in lines[begin:until]]


def _written(flag: flags.Flag) -> str:
    """Returns an option with its value, as a shell takes it."""
    return " ".join(shlex.quote(word) for word in flag.serialize().splitlines())


def _help_of(flag: flags.Flag) -> str:
    """Returns what an option means, without the list of values that absl puts before it."""
    return " ".join(re.sub(r"^<[^>]*>: ", "", flag.help).split())


def _values(flag: flags.Flag) -> str:
    if flag.boolean:
        return ""
    words = [" or ".join(getattr(flag.parser, "enum_values", []))]
    words.append("required" if _is_required(flag) else "")
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
    text = _help_of(flag)
    if choices := getattr(flag.parser, "enum_values", None):
        text = f"{', '.join(choices)}. {text}"
    must = "*" if _is_required(flag) else " "
    start = f"{must} {shown:{_WIDEST_NAME}}  "
    return start + textwrap.shorten(text, WIDTH - len(start), placeholder=" ...")


def _wrapped(text: str, start: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=start,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _explained(error: flags.Error, module: ModuleType) -> str:
    """Returns what is wrong with an option, and which was meant."""
    options = _options(module)
    if isinstance(error, flags.UnrecognizedFlagError):
        near = did_you_mean(error.flagname, options, shown="--{}")
        return f"There is no option --{error.flagname}.{near or ' See --help.'}"
    if _REQUIRED in str(error):
        missing = [each for each in options.values() if each.value is None and _is_required(each)]
        told = " ".join(f"Give --{each.name}: {_help_of(each)}" for each in missing)
        return f"{', '.join(f'--{each.name}' for each in missing)} must be given. {told}"
    found = re.fullmatch(r"flag --(\w+)=(.*?): (.*)", str(error), re.DOTALL)
    if found is None or found[1] not in options:
        return str(error)
    name, value, reason = found.groups()
    if choices := getattr(options[name].parser, "enum_values", None):
        near = did_you_mean(value, choices)
        return f"--{name}={value} is none of {', '.join(choices)}.{near}"
    if reason.startswith(("invalid literal", "could not convert")):
        whole = "whole " if isinstance(options[name].parser, flags.IntegerParser) else ""
        return f"--{name}={value} is no {whole}number. Give one."
    # A reason that names the option says what is wrong with it in full.
    return reason if f"--{name}" in reason else f"--{name}={value}: {reason}"
