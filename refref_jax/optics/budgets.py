"""How much of the light is followed, and how much room it gets.

At every interface light splits into a reflected and a transmitted part, so a camera ray grows a
tree of paths. A budget says which branches are followed:

- `STRAIGHT`: none; light ignores the objects, as in a plain NeRF.
- `PAPER`: the paper's oracle. One path of at most 10 bends, refracted wherever it can be and
  totally reflected elsewhere, without loss, and one reflection at the first surface, which is not
  traced any further.
- `TREE`: every branch that carries at least 2 % of its pixel's light.
- `PAPER_NO_REFLECTION`, `PAPER_NO_TIR`: the paper's ablations: `PAPER` without the reflection at
  the first surface, and with paths that go straight on where they would be reflected totally.

Source: paper (arXiv 2505.05848), sections 4 and 5 (ablation study), for all but the tree.
"""

import dataclasses
import math
from typing import Literal, NamedTuple, get_args

Reflections = Literal["none", "first", "all"]
TotalReflection = Literal["followed", "ended"]
Reentry = Literal["possible", "impossible"]
Unfinished = Literal["kept", "dark"]


@dataclasses.dataclass(frozen=True)
class Budget:
    """Which light to follow.

    The capacity factors bound memory, per camera ray of a pool. What does not fit is the least
    light there is, and it is returned as lost; see `wavefront`. The defaults are generous for
    images of which glass fills a part; a pool of few rays that all meet much glass may need more.

    Attributes:
      bends: most refractions and reflections of a path.
      reflections: `none` follows total reflections only; `first` adds the reflection at the first
        surface, untraced; `all` follows every reflection.
      total_reflection: `followed`, or `ended`: a path that meets one then goes on along its last
        direction, as in the paper's ablation.
      cut: smallest throughput worth following, by the largest of its RGB. A weaker branch leaves
        its share to its sibling, so no energy is lost.
      reentry: `impossible` promises that a ray which has left the objects meets none again, as
        around one convex body: it is not cast again.
      unfinished: light of paths that run out of bends. `kept` goes on along its last direction,
        as in the paper; `dark` is lost, as in renderers that stop after a number of bounces.
      live_per_ray: room for rays that are still to be cast.
      segments_per_ray: room for segments of paths, beyond the camera rays themselves.
      paths_per_ray: room for finished paths.
    """

    bends: int
    reflections: Reflections
    total_reflection: TotalReflection = "followed"
    cut: float = 0.0
    reentry: Reentry = "possible"
    unfinished: Unfinished = "kept"
    live_per_ray: float = 6.0
    segments_per_ray: float = 24.0
    paths_per_ray: float = 8.0

    def __post_init__(self) -> None:
        """Checks what tracing relies on."""
        if self.bends < 0:
            raise ValueError(f"A path can not have {self.bends} bends. Give 0 or more.")
        if not 0.0 <= self.cut < 1.0:
            raise ValueError(
                f"The cut is a share of a pixel's light, in [0, 1), not {self.cut}. Give 0.02 for "
                "2 %."
            )
        if self.reflections not in get_args(Reflections):
            raise ValueError(
                f"The reflections are 'none', 'first' or 'all', not {self.reflections!r}. Choose "
                "one."
            )
        if self.total_reflection not in get_args(TotalReflection):
            raise ValueError(
                "Total reflection is 'followed' or 'ended', not "
                f"{self.total_reflection!r}. Choose one."
            )
        if self.reentry not in get_args(Reentry):
            raise ValueError(
                f"Re-entry is 'possible' or 'impossible', not {self.reentry!r}. Choose one."
            )
        if self.unfinished not in get_args(Unfinished):
            raise ValueError(
                f"Unfinished light is 'kept' or 'dark', not {self.unfinished!r}. Choose one."
            )
        for name in ("live_per_ray", "segments_per_ray", "paths_per_ray"):
            if not 1.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} is {getattr(self, name)}, but every ray needs room for itself. Give a "
                    "number of at least 1."
                )


class Room(NamedTuple):
    """Most records that the lists of a pool keep, by the capacity factors of its budget.

    Attributes:
      live: rays that are still to be cast.
      segments: of paths, camera rays included.
      paths: finished ones.
    """

    live: int
    segments: int
    paths: int


STRAIGHT = Budget(bends=0, reflections="none", live_per_ray=1.0, paths_per_ray=1.0)
PAPER = Budget(
    bends=10,
    reflections="first",
    live_per_ray=1.0,
    segments_per_ray=11.0,
    paths_per_ray=2.0,
)
TREE = Budget(bends=24, reflections="all", cut=0.02)

PAPER_NO_REFLECTION = dataclasses.replace(PAPER, reflections="none")
PAPER_NO_TIR = dataclasses.replace(PAPER, total_reflection="ended")

BUDGETS = {
    "straight": STRAIGHT,
    "paper": PAPER,
    "tree": TREE,
    "paper_no_reflection": PAPER_NO_REFLECTION,
    "paper_no_tir": PAPER_NO_TIR,
}


def room(budget: Budget, rays: int) -> Room:
    """Returns the room that a budget gives a pool of rays."""
    return Room(
        live=math.ceil(rays * budget.live_per_ray),
        segments=math.ceil(rays * (1.0 + budget.segments_per_ray)),
        paths=math.ceil(rays * budget.paths_per_ray),
    )


def capacity_for(budget: Budget, rays: int, *, mean: float, deviation: float) -> int:
    """Returns the room for the paths of a batch of a scene.

    One standard deviation above the mean number of paths of a random batch, rounded up to 8. A
    batch in six loses its weakest paths, and training logs their light. A step costs as much as its
    room, so that room for all of them would cost 6 % of it.

    Args:
      budget: which light to follow.
      rays: rays in a batch.
      mean: mean number of paths of the scene's camera rays.
      deviation: its standard deviation over rays.
    """
    most = room(budget, rays).paths
    needed = rays * mean + math.sqrt(rays) * deviation
    return max(rays, min(most, 8 * math.ceil(needed / 8)))
