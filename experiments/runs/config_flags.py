"""Defines the options of a training as flags, one for each field of `TrainConfig`.

A flag has the name of the option, the choices or the type of its annotation, and its attribute line
as help text. A new option of training only needs a field of the configuration and the code that
uses it.
"""

import inspect
import re
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from absl import flags

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.runs import refraction_indices
from refref_jax import configuration
from refref_jax.training import config as training_config
from refref_jax.training import config_files
from refref_jax.training.config import Option, TrainConfig

AUTO = "auto"
"""Value of an option that is left to the scene or the preset; it overrides a file."""

Say = Callable[[str], None]

# Examples of lists, for error messages.
_EXAMPLES = {int: "32,20", float: "0.03,0.003"}


class _Words(list):
    """A list of words that is printed as the user wrote it."""

    def __str__(self) -> str:
        return ",".join(self)


class _ListParser(flags.ListParser):
    def parse(self, argument: Any) -> _Words:
        return _Words(super().parse(argument))


class _IntegerParser(flags.IntegerParser):
    def parse(self, argument: Any) -> Any:
        return argument if argument == AUTO else super().parse(argument)


class _FloatParser(flags.FloatParser):
    def parse(self, argument: Any) -> Any:
        return argument if argument == AUTO else super().parse(argument)


def define_flags() -> dict[str, flags.FlagHolder]:
    """Defines the flags of all options, and `--config`, for the module that calls this.

    Returns:
      The flags by name, without `--config`.
    """
    flags.DEFINE_string(
        "config",
        None,
        "Configuration file, such as a run's config.json; other flags override it, and "
        "--NAME=auto resets an option.",
    )
    options = list(training_config.options_of())
    holders = {option.name: _define(option) for option in options}
    for option in options:
        if former := option.field.metadata.get(configuration.FORMERLY):
            cli_flags.alias(former, option.name)
    return holders


def given(holders: Mapping[str, flags.FlagHolder]) -> dict[str, Any]:
    """Returns the values of the options that are on the command line, by name."""
    options = {option.name: option for option in training_config.options_of()}
    return {
        name: _parse(options[name], holder.value)
        for name, holder in holders.items()
        if holder.present
    }


def base() -> TrainConfig:
    """Returns the configuration of `--config`, without the other flags.

    Raises:
      ValueError: if the file is not a configuration.
    """
    path = flags.FLAGS["config"].value
    if path == "":
        raise ValueError("--config is empty. Give a file, such as runs/demo/config.json.")
    return TrainConfig() if path is None else config_files.read_to_begin(Path(path))


def chosen(holders: Mapping[str, flags.FlagHolder], *, say: Say, **instead: Any) -> TrainConfig:
    """Returns the configuration of the command line: that of `--config`, overridden by flags.

    Args:
      holders: flags that `define_flags` returned.
      say: function called with the decisions of the file that are made again.
      **instead: values that replace those of flags.

    Raises:
      ValueError: if the file is not a configuration, or a value is invalid.
    """
    below = base()
    values = given({name: each for name, each in holders.items() if name not in instead})
    for name in ("scene", "properties", "reconstruction"):
        before, now = below.get(name), values.get(name)
        if before and now and Path(now).resolve() == Path(before).resolve():
            del values[name]  # the same folder, by another path
    return on_top(below, values | instead, say=say)


def on_top(below: TrainConfig, values: Mapping[str, Any], *, say: Say) -> TrainConfig:
    """Overrides a configuration, and reports the decisions that are made again because of it.

    Args:
      below: configuration to override, from `--config` if that is set.
      values: new values, by the names of the options.
      say: function called with lines of text.
    """
    config, (decided, kept) = below.override(**values), below.followers(**values)
    options = [option.name for option in training_config.options_of()]
    again = [name for name in options if name in decided and below.get(name) != config.get(name)]
    stays = [name for name in options if name in kept]
    file = flags.FLAGS["config"].value
    if file is not None and again:
        say(f"decided again because of flags that override {file}: {', '.join(again)}")
    if file is not None and stays:
        say(f"kept from {file}: {', '.join(stays)} (reset with --{stays[0]}=auto)")
    return config


def _define(option: Option) -> flags.FlagHolder:
    kind, name = _kind(option), option.name
    default = option.field.default
    text = _meaning(option)
    if default not in (None, "", ()):
        text += f" By default {default}."
    if typing.get_origin(kind) is Literal:
        return flags.DEFINE_enum(name, None, [AUTO, *typing.get_args(kind)], text)
    if name == "ior":
        text += " As glass=1.52; may be repeated."
        holder = flags.DEFINE_multi_string(name, None, text)
    elif typing.get_origin(kind) is tuple:
        holder = flags.DEFINE(_ListParser(), name, None, text, serializer=flags.ListSerializer(","))
    else:
        parser = {int: _IntegerParser, float: _FloatParser, str: flags.ArgumentParser}[kind]()
        holder = flags.DEFINE(parser, name, None, text, serializer=flags.ArgumentSerializer())
    if name != "ior":  # its syntax differs for a reconstructed object
        app.check(holder, lambda value: _check(option, value))
    return holder


def _check(option: Option, value: Any) -> None:
    if value is not None:
        TrainConfig().override(**{option.name: _parse(option, value)})


def _parse(option: Option, value: Any) -> Any:
    """Converts the value of a flag to that of its option."""
    if value == AUTO and (_kind(option) is not str or option.name == "properties"):
        return None
    if option.name == "ior" and value == [AUTO]:
        return None
    if option.name == "ior":
        return refraction_indices.parse_named(value)
    if isinstance(value, list):
        if value == [AUTO]:
            return None
        number, *others = typing.get_args(_kind(option))
        any_count = Ellipsis in others
        try:
            if any_count or len(value) == 1 + len(others):
                return tuple(map(number, value))
        except ValueError:
            pass
        example = _EXAMPLES[number] if any_count else ",".join([*("0" for _ in others), "2"])
        numbers = "numbers" if any_count else f"{1 + len(others)} numbers"
        raise ValueError(
            f"--{option.name}={','.join(value)} is not a list of {numbers}. Write as in "
            f"--{option.name}={example}."
        )
    return value


def parse_text(name: str, text: str) -> Any:
    """Returns the value of an option that is given as text, as on the command line.

    Raises:
      ValueError: if there is no such option, or the value is invalid.
    """
    options = {option.name: option for option in training_config.options_of()}
    if name not in options:
        raise ValueError(f"There is no option {name}.{app.did_you_mean(name, options)}")
    option, kind = options[name], _kind(options[name])
    value: Any = text
    if name == "ior" or typing.get_origin(kind) is tuple:
        value = text.split(",")
    elif kind in (int, float) and text != AUTO:
        try:
            value = kind(text)
        except ValueError:
            noun = "an integer" if kind is int else "a number"
            raise ValueError(f"{name} is {text!r}, not {noun}.") from None
    value = _parse(option, value)
    TrainConfig().override(**{name: value})
    return value


def _kind(option: Option) -> Any:
    """Returns the type of an option that is not `None`."""
    kind = training_config.type_of(option)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        (kind,) = (each for each in typing.get_args(kind) if each is not type(None))
    return kind


def _meaning(option: Option) -> str:
    """Returns the attribute line of an option's field."""
    owner = TrainConfig if not option.section else type(getattr(TrainConfig(), option.section))
    text = inspect.getdoc(owner)
    found = re.search(rf"^  {option.field.name}: (.*?)(?=^  \w+: |\Z)", text, re.M | re.S)
    return " ".join(found[1].split())
