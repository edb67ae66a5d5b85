"""Parses indices of refraction from the command line."""

import math
from collections.abc import Sequence

_LARGEST = 5.0


def parse_named(words: Sequence[str]) -> dict[str, float]:
    """Returns the indices of materials and meshes from `--ior=NAME=NUMBER` flags.

    Raises:
      ValueError: if a word does not have that form, or its number is not an index.
    """
    indices = {}
    for word in words:
        name, _, number = word.partition("=")
        if not name or not 0.0 < _number(number) < math.inf:
            raise ValueError(
                f"--ior={word} is not NAME=NUMBER with a positive number. Write as in "
                "--ior=glass=1.52."
            )
        indices[name] = float(number)
    return indices


def parse(word: str) -> float:
    """Returns the index of a single reconstructed object from `--ior=NUMBER`.

    Raises:
      ValueError: if the index is implausible for a solid or liquid in air.
    """
    if not 1.0 < _number(word) < _LARGEST:
        raise ValueError(
            f"--ior={word} is not an index of refraction of one object in air. Give a number above "
            f"1 and below {_LARGEST:g}, as in --ior=1.5, or remove it to estimate the index."
        )
    return float(word)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan
