"""Parses the options of a sweep: those of `experiments.train`, and `rays_per_pixel`.

This module does not import JAX, so that mistakes are reported before it is imported.
"""

from collections.abc import Sequence

from experiments.runs import config_flags
from refref_jax import choices
from refref_jax.training import config as training_config

OF_EVALUATION = ("rays_per_pixel",)
"""Options of the evaluation only."""


def present_name(name: str) -> str:
    """Returns the name of an option, or of a point, for its name in this or an earlier version."""
    option, *value = name.split("=", 1)
    return "=".join([training_config.present_name(option), *value])


def parse_base(words: Sequence[str]) -> dict[str, str]:
    """Returns the options given by words such as `min_throughput=0.05` or `samples_per_ray=48,32`.

    Raises:
      ValueError: if a word does not have that form.
    """
    options = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name and equals and value):
            raise ValueError(
                f"--base={word} is not NAME=VALUE. Write for example --base=min_throughput=0.05."
            )
        options[present_name(name)] = value
        _check(present_name(name), value, f"--base={word}")
    return options


def parse_values(words: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Returns the values of options from words such as `max_bends=2/6`.

    Raises:
      ValueError: if a word does not have that form.
    """
    values = {}
    for word in words:
        name, equals, given = word.partition("=")
        name = present_name(name)
        values[name] = tuple(value for value in given.split("/") if value)
        if not (name and equals and values[name]):
            raise ValueError(
                f"--values={word} is not NAME=A/B. Write for example --values=max_bends=2/6."
            )
        for value in values[name]:
            _check(name, value, f"--values={word}")
    return values


def _check(name: str, value: str, given: str) -> None:
    """Refuses an option that does not exist, or a value that is out of range."""
    try:
        if name in OF_EVALUATION:
            choices.side_of(int(value))
        else:
            config_flags.parse_text(name, value)
    except ValueError as error:
        raise ValueError(f"{given}: {error}") from error
