"""The options of a training as flags: one for each value of `TrainConfig`, made from its fields.

A flag has the option's name, the choices or the type of its annotation, and the words of its
attribute line. A new option of training is a field of the configuration, and its use.
"""

import inspect
import re
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from absl import flags

from experiments.cli import app
from refref_jax.training import config as training_config
from refref_jax.training.config import Option, TrainConfig

AUTO = "auto"
"""Value of a choice that leaves it to the scene or the preset."""


def define_flags() -> dict[str, flags.FlagHolder]:
    """Defines the flags of all options, and `--config`, for the module that calls this.

    Returns:
      The flags by name, without `--config`.
    """
    flags.DEFINE_string(
        "config",
        None,
        "File of a configuration, as a run's config.json; the other flags override it.",
    )
    return {option.name: _define(option) for option in training_config.options_of()}


def given(holders: Mapping[str, flags.FlagHolder]) -> dict[str, Any]:
    """Returns the values of the options that the command line gives, by name."""
    options = {option.name: option for option in training_config.options_of()}
    return {
        name: _parse(options[name], holder.value)
        for name, holder in holders.items()
        if holder.present
    }


def chosen(holders: Mapping[str, flags.FlagHolder], **instead: Any) -> TrainConfig:
    """Returns the configuration of the command line: that of `--config`, with the flags on top.

    Args:
      holders: what `define_flags` returned.
      **instead: values in place of those of flags.

    Raises:
      ValueError: if the file is not a configuration, or a value makes no sense.
    """
    base, path = TrainConfig(), flags.FLAGS["config"].value
    if path is not None:
        from refref_jax.training import run_folder

        base = run_folder.read_config_file(Path(path))
    values = given({name: each for name, each in holders.items() if name not in instead})
    scene = values.get("scene", "")
    if base.scene.path and scene and Path(scene).resolve() == Path(base.scene.path).resolve():
        del values["scene"]  # the same, by another path
    return base.override(**values, **instead)


def _define(option: Option) -> flags.FlagHolder:
    kind, name = _kind(option), option.name
    default = option.field.default
    text = _meaning(option)
    if default not in (None, "", ()):
        text += f" By default {default}."
    if typing.get_origin(kind) is Literal:
        automatic = [AUTO] if default is None else []
        return flags.DEFINE_enum(name, None, [*automatic, *typing.get_args(kind)], text)
    if name == "ior":
        text += " As glass=1.52; may be repeated."
        holder = flags.DEFINE_multi_string(name, None, text)
    elif typing.get_origin(kind) is tuple:
        holder = flags.DEFINE_list(name, None, text)
    elif kind is int and name == "seed":
        return flags.DEFINE_integer(name, None, text, 0, 2**32 - 1)
    else:
        define = {int: flags.DEFINE_integer, float: flags.DEFINE_float, str: flags.DEFINE_string}
        holder = define[kind](name, None, text)
    if name != "ior":  # which is written otherwise for a reconstructed object
        app.check(holder, lambda value: _check(option, value))
    return holder


def _check(option: Option, value: Any) -> None:
    if value is not None:
        TrainConfig().override(**{option.name: _parse(option, value)})


def _parse(option: Option, value: Any) -> Any:
    """Returns the value of an option, of that of its flag."""
    if value == AUTO:
        return None
    if option.name == "ior":
        return tuple(sorted(dict(map(parse_index, value)).items()))
    if isinstance(value, list):
        number = typing.get_args(_kind(option))[0]
        try:
            return tuple(map(number, value))
        except ValueError:
            raise ValueError(
                f"--{option.name}={','.join(value)} is not a list of numbers. Write as in "
                f"--{option.name}=32,20."
            ) from None
    return value


def parse_index(word: str) -> tuple[str, float]:
    """Returns what `--ior=NAME=NUMBER` gives.

    Raises:
      ValueError: if it is not of that form, or not an index of refraction.
    """
    name, _, number = word.partition("=")
    try:
        index = float(number)
    except ValueError:
        index = 0.0
    if not name or not 0.0 < index < float("inf"):
        raise ValueError(
            f"--ior={word} is not NAME=NUMBER with a positive number. Write as in --ior=glass=1.52."
        )
    return name, index


def _kind(option: Option) -> Any:
    """Returns the type of an option that is given."""
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
