"""How commands read their options: what is wrong is told at once, and --help fits a screen.

Nothing here imports JAX, and commands import what does after their options are read; see
`late_imports`. The options of a command are absl's key flags of its module.
"""

import difflib
import os
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterable, Sequence
from types import ModuleType
from typing import Any, NamedTuple, NoReturn

from absl import flags

from experiments.cli import command_help

_HELP = ("--help", "-help", "-h", "--helpshort")
_HELP_FULL = ("--helpfull", "-helpfull")


def did_you_mean(word: str, names: Iterable[str], *, shown: str = "{}", most: int = 1) -> str:
    """Returns ` Did you mean NAME?`, or nothing if no name is like the word.

    Args:
      word: what was given.
      names: what could have been.
      shown: how a name is shown.
      most: names that are suggested.
    """
    near = difflib.get_close_matches(word, list(names), n=most)
    return f" Did you mean {' or '.join(map(shown.format, near))}?" if near else ""


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
      first: names of the options that decide most; see `command_help.help_text`.
      again: what the command does when it is given again.

    Returns:
      The words that are no options, the name first.
    """
    asked = set(words[1 : words.index("--") if "--" in words else len(words)])
    if asked & {*_HELP, *_HELP_FULL}:
        if asked & set(_HELP_FULL):
            _show(command_help.full_text(module, again))
        else:
            _show(command_help.help_text(module, first, again))
        sys.exit(0)
    try:
        return flags.FLAGS(words)
    except flags.Error as error:
        fail(_explained(error, module))


def _show(text: str) -> None:
    """Prints a text, of which the reader may take no more than he likes, as `head` does."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def fail(message: str) -> NoReturn:
    """Ends the command because of what the user gave."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def refuse_words(module: ModuleType, given: Sequence[str], arguments: Sequence[str]) -> None:
    """Ends the command if there are more or fewer arguments than it takes."""
    if len(given) == len(arguments):
        return
    options = command_help.options_of(module)
    for word in given:
        if word.partition("=")[0] in options:
            fail(f"Unexpected argument {word!r}. Did you mean --{word}?")
    if len(given) < len(arguments):
        fail(f"{arguments[len(given)]} is missing. Give {' '.join(arguments)}; see --help.")
    fail(f"Unexpected argument {given[len(arguments)]!r}. Options begin with --; see --help.")


def name_of(module: ModuleType) -> str:
    """Returns the name of a command, as `experiments.train`, however it was started."""
    spec = module.__spec__
    return module.__name__ if spec is None else spec.name.removesuffix(".__main__")


def resolved(module: ModuleType) -> dict[str, Any]:
    """Returns the values of all options of a command, given or not."""
    return {name: flag.value for name, flag in command_help.options_of(module).items()}


class Settled(NamedTuple):
    """Options that an earlier call has settled.

    Attributes:
      names: of the options.
      told: what tells how they are.
    """

    names: Collection[str]
    told: str


def echo(module: ModuleType, arguments: Sequence[str], settled: Settled | None = None) -> str:
    """Returns the command as it was given, and below it the options that hold by default.

    Args:
      module: of the command.
      arguments: what was given besides options.
      settled: options that hold as an earlier call has them, and not by default.
    """
    options = command_help.options_of(module).values()
    elsewhere = settled.names if settled else ()
    # What has no value, or an empty one, changes nothing.
    rest = [
        each
        for each in options
        if not (each.present or each.name in elsewhere or each.value in (None, [], False))
    ]
    given = [*map(shlex.quote, arguments), *(_written(each) for each in options if each.present)]
    lines = command_help.wrapped(" ".join((name_of(module), *given)), "", "  ")
    if rest:
        lines += command_help.wrapped(" ".join(map(_written, rest)), "  by default: ", "    ")
    if settled:
        lines.append(f"  all others as it was begun: {settled.told}")
    return "\n".join(lines)


def _written(flag: flags.Flag) -> str:
    """Returns an option with its value, as a shell takes it."""
    return " ".join(shlex.quote(word) for word in flag.serialize().splitlines())


def _explained(error: flags.Error, module: ModuleType) -> str:
    """Returns what is wrong with an option, and which was meant."""
    options = command_help.options_of(module)
    if isinstance(error, flags.UnrecognizedFlagError):
        near = did_you_mean(error.flagname, options, shown="--{}")
        return f"There is no option --{error.flagname}.{near or ' See --help.'}"
    if command_help.REQUIRED in str(error):
        missing = [
            each
            for each in options.values()
            if each.value is None and command_help.is_required(each)
        ]
        told = " ".join(f"Give --{each.name}: {command_help.meaning(each)}" for each in missing)
        return f"{', '.join(f'--{each.name}' for each in missing)} must be given. {told}"
    if found := re.fullmatch(r"Missing value for flag -*(.*)", str(error)):
        return f"--{found[1]} has no value. Give it as in --{found[1]}=VALUE."
    found = re.fullmatch(r"flag --(\w+)=(.*?): (.*)", str(error), re.DOTALL)
    if found is None or found[1] not in options:
        return str(error)
    name, value, reason = found.groups()
    if choices := getattr(options[name].parser, "enum_values", None):
        near = did_you_mean(value, choices)
        return f"--{name}={value} is none of {', '.join(choices)}.{near}"
    parser = options[name].parser
    if reason.startswith(("invalid literal", "could not convert")):
        whole = "whole " if isinstance(parser, flags.IntegerParser) else ""
        return f"--{name}={value} is no {whole}number. Give one."
    if reason.endswith(f" is not {parser.syntactic_help}"):
        return f"--{name}={value} is out of range. Give {_range(parser)}."
    if options[name].boolean and "Non-boolean" in reason:
        return f"--{name}={value} is neither true nor false. Give --{name} or --no{name}."
    # A reason that names the option says what is wrong with it in full.
    return reason if f"--{name}" in reason else f"--{name}={value}: {reason}"


def _range(parser: flags.FloatParser | flags.IntegerParser) -> str:
    """Returns which numbers an option takes, one end of which has a bound at least."""
    least, most = parser.lower_bound, parser.upper_bound
    if least is not None and most is not None:
        return f"{least} to {most}"
    return f"{least} or more" if most is None else f"{most} or less"
