"""What each method's line looks like in every chart: the same whatever else is measured."""

from collections.abc import Sequence
from typing import NamedTuple

from experiments.benchmarking.methods import FULL, METHODS
from experiments.figures.style import COLOURS

_DASHES = (None, "7 3", "2 3")

_MAIN = [method.name for method in METHODS.values() if method.group == "main"]


class Line(NamedTuple):
    """A line's looks.

    Attributes:
      colour: index into `plotting.COLOURS`.
      dash: as SVG has it; `None` for an unbroken line.
    """

    colour: int
    dash: str | None


def look(method: str) -> Line:
    """Returns the looks of a method.

    An ablation has none of the colour of the method that it is compared with, and is dashed where
    the colours of its group are used up. Methods that this version does not know look alike.
    """
    if method not in METHODS:
        return Line(len(COLOURS) - 1, _DASHES[-1])
    if method in _MAIN:
        return Line(_MAIN.index(method), None)
    group = METHODS[method].group
    full = look(FULL[group])
    free = [i for i in range(len(COLOURS)) if i != full.colour]
    place = [name for name in METHODS if METHODS[name].group == group].index(method)
    return Line(free[place % len(free)], _DASHES[place // len(free)])


def families(methods: Sequence[str]) -> list[list[str]]:
    """Returns which methods share a chart: the main ones, and each kind of ablation with its own.

    Args:
      methods: names of all that there are, in their order.
    """
    groups = {name: METHODS[name].group if name in METHODS else "main" for name in methods}
    found = [[name for name in methods if groups[name] == "main"]]
    for kind, full in FULL.items():
        if kind in groups.values():
            found.append([name for name in methods if name == full or groups[name] == kind])
    return [names for names in found if names]
