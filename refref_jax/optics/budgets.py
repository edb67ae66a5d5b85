"""How much of the light is followed.

The paper's oracle follows one path of at most 10 bends, refracted wherever it can be and totally
reflected elsewhere, and one reflection at the first surface, which it does not trace any
further. A plain NeRF follows no bend at all.

Source: paper (arXiv 2505.05848), section 4.
"""

import dataclasses
import math
from typing import Literal


@dataclasses.dataclass(frozen=True)
class Budget:
    """Which light to follow.

    Attributes:
      bends: most refractions and total reflections of a path.
      reflections: `first` adds the reflection at the first surface.
    """

    bends: int
    reflections: Literal["none", "first"]


STRAIGHT = Budget(bends=0, reflections="none")
PAPER = Budget(bends=10, reflections="first")

BUDGETS = {"straight": STRAIGHT, "paper": PAPER}


def capacity_for(budget: Budget, rays: int, hit_fraction: float) -> int:
    """Returns a room for reflections that batches of a scene practically never outgrow.

    Six standard deviations above the mean number of hits in a random batch, rounded up to 64.

    Args:
      budget: which light to follow.
      rays: rays in a batch.
      hit_fraction: share of the scene's camera rays that meet a surface.
    """
    if budget.reflections == "none":
        return 0
    spread = math.sqrt(rays * hit_fraction * (1.0 - hit_fraction))
    needed = rays * hit_fraction + 6.0 * spread
    return min(rays, 64 * math.ceil(needed / 64))
