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

# Bends and cut for which the capacity factors below were measured.
_PAPER_BENDS = 10
_TREE_BENDS = 24
_TREE_CUT = 0.02

# Capacities do not grow for smaller cuts, which would take any amount of memory.
_SMALLEST_CUT_WITH_ROOM = 5e-4


@dataclasses.dataclass(frozen=True)
class Budget:
    """Which light to follow.

    The capacity factors bound memory, per camera ray of a pool. What does not fit is the least
    light there is, and it is returned as lost; see `wavefront`. A factor of `None` follows from the
    cut and the bends (`capacity_factors`), so `dataclasses.replace(TREE, cut=0.002)` also has room
    for the paths that the finer cut adds. A pool of few rays that all meet much glass may need
    more than that.

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
      live_per_ray: capacity for rays that are still to be cast, per camera ray; at least 1.
      segments_per_ray: capacity for segments of paths, beyond the camera rays themselves.
      paths_per_ray: capacity for finished paths.
    """

    bends: int
    reflections: Reflections
    total_reflection: TotalReflection = "followed"
    cut: float = 0.0
    reentry: Reentry = "possible"
    unfinished: Unfinished = "kept"
    live_per_ray: float | None = None
    segments_per_ray: float | None = None
    paths_per_ray: float | None = None

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
        for name, usual in _usual_factors(self)._asdict().items():
            factor = getattr(self, name)
            if factor is not None and not 1.0 <= factor < math.inf:
                raise ValueError(
                    f"{name} is {factor}, but every ray needs room for itself. Give a number of at "
                    "least 1, or None."
                )
            # The usual factor, written out (as in files of older runs), goes on following the cut.
            if factor == usual:
                object.__setattr__(self, name, None)


class CapacityFactors(NamedTuple):
    """Capacities per camera ray; see `Budget`."""

    live_per_ray: float
    segments_per_ray: float
    paths_per_ray: float


def capacity_factors(budget: Budget) -> CapacityFactors:
    """Returns the capacity factors of a budget, those it does not set by its cut and bends.

    Generous for images of which glass fills a part. Where all reflections are followed, room grows
    as the inverse square root of a cut below 0.02; that of segments also grows with the bends.
    Measured: at a cut of 0.002 a flask of three media loses 0.27 % of its light without either.
    """
    set_here = (budget.live_per_ray, budget.segments_per_ray, budget.paths_per_ray)
    pairs = zip(set_here, _usual_factors(budget), strict=True)
    return CapacityFactors(*(usual if given is None else given for given, usual in pairs))


def _usual_factors(budget: Budget) -> CapacityFactors:
    if budget.bends == 0:
        return CapacityFactors(1.0, 24.0, 1.0)
    if budget.reflections != "all":
        return CapacityFactors(1.0, max(1.0, budget.bends / _PAPER_BENDS) * 11.0, 2.0)
    segments = max(1.0, budget.bends / _TREE_BENDS) * 24.0
    growth = math.sqrt(max(1.0, _TREE_CUT / max(budget.cut, _SMALLEST_CUT_WITH_ROOM)))
    return CapacityFactors(growth * 6.0, growth * segments, growth * 8.0)


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


STRAIGHT = Budget(bends=0, reflections="none")
PAPER = Budget(bends=10, reflections="first")
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


def budget_of(paths: str, *, cut: float | None = None, bends: int | None = None) -> Budget:
    """Returns a budget by name, with another cut or number of bends.

    Raises:
      ValueError: if light is straight and has a cut or bends nevertheless.
    """
    budget = BUDGETS[paths]
    given = {"cut": cut, "bends": bends}
    changed = {n: x for n, x in given.items() if x is not None and x != getattr(budget, n)}
    if budget.bends == 0 and changed:
        raise ValueError(
            f"paths={paths} has no cut and no bends. Leave them out, or use paths=tree."
        )
    return dataclasses.replace(budget, **changed)


def room(budget: Budget, rays: int) -> Room:
    """Returns the room that a budget gives a pool of rays."""
    factors = capacity_factors(budget)
    return Room(
        live=math.ceil(rays * factors.live_per_ray),
        segments=math.ceil(rays * (1.0 + factors.segments_per_ray)),
        paths=math.ceil(rays * factors.paths_per_ray),
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
