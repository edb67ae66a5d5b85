"""Means over scenes or views, with their standard errors; what is not known is never counted."""

import math
import statistics
from collections.abc import Iterable
from typing import NamedTuple


class Cell(NamedTuple):
    """A number of a table.

    Attributes:
      mean: over scenes; `None` if no scene has the value.
      error: standard error of the mean over scenes; `None` for fewer than two.
      count: scenes that have the value.
      digits: after the point, where they are not its column's: those that the paper prints.
    """

    mean: float | None = None
    error: float | None = None
    count: int = 0
    digits: int | None = None


NOTHING = Cell()
"""What is not known."""


def mean_over(values: Iterable[float | None]) -> Cell:
    """Returns the mean of one value a scene, or a view.

    The standard error is the standard deviation (with n - 1) over the square root of n. A mean that
    is infinite, as the PSNR of equal images is, has none. Of `inf` and `-inf` together no mean is
    known; one `nan` makes a mean `nan`.
    """
    known = [value for value in values if value is not None]
    if not known or {math.inf, -math.inf} <= set(known):
        return NOTHING
    mean = math.fsum(known) / len(known) if all(map(math.isfinite, known)) else sum(known)
    if len(known) < 2 or not math.isfinite(mean):
        return Cell(mean, None, len(known))
    return Cell(mean, statistics.stdev(known) / math.sqrt(len(known)), len(known))
