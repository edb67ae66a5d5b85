"""Indices of refraction as commands take them."""

import math
from collections.abc import Sequence

_LARGEST = 5.0


def parse_named(words: Sequence[str]) -> dict[str, float]:
    """Returns the indices of materials and meshes that `--ior=NAME=NUMBER` flags give.

    Raises:
      ValueError: if one is not of that form, or its number is not an index.
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
    """Returns the index of one reconstructed body that `--ior=NUMBER` gives.

    Raises:
      ValueError: if no solid or liquid in air could have it.
    """
    if not 1.0 < _number(word) < _LARGEST:
        raise ValueError(
            f"--ior={word} is no index of refraction of one body in air. Give a number above 1 and "
            f"below {_LARGEST:g}, as in --ior=1.5, or leave it out to have it estimated."
        )
    return float(word)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan
