"""Path settings: which light is followed, and the capacities of its buffers.

Selects which segments of traced paths are stored, to save memory.

Path settings: the branches of light that are traced, and the capacity for them.

At every interface light splits into a reflected and a transmitted ray, so a camera ray has a tree
of paths. Path settings select the branches to follow. The presets are:

- `STRAIGHT`: none; light ignores the objects, as in a plain NeRF.
- `PAPER`: the paper's oracle. One path of at most 10 bends, refracted wherever it can be and
  totally reflected elsewhere, without loss, and one reflection at the first surface, which is not
  traced any further.
- `TREE`: every branch with a throughput of at least 2 %.
- `PAPER_NO_REFLECTION`, `PAPER_NO_TIR`: the paper's ablations: `PAPER` without the reflection at
  the first surface, and with paths that continue straight at total internal reflections.

Source: paper (arXiv 2505.05848), sections 4 and 5 (ablation study), for all but the tree.
"""

import dataclasses
import math
from typing import Literal, NamedTuple, get_args

from refref_jax.choices import Footprint


@dataclasses.dataclass(frozen=True)
class Detail:
    """Contents of stored light paths.

    Attributes:
      segments: `all` segments, or only those `outside` the objects and the last one.
      most: maximum number of segments per path; `all` needs max bends + 1. Of a longer path, the
        first segment and the last ones are kept.
      footprint: `differential` carries derivatives across the pixel (see `ray_differentials`).
      tally: `parts` stores each path's hit counts and path lengths per part.
    """

    segments: Literal["all", "outside"]
    most: int
    footprint: Footprint = "cone"
    tally: Literal["none", "parts"] = "none"

    def __post_init__(self) -> None:
        """Validates the number of segments."""
        if self.most < 1:
            raise ValueError(f"most is {self.most}; a path has at least one segment. Give >= 1.")


def everything(bends: int) -> Detail:
    """Returns the settings that store complete paths."""
    return Detail("all", bends + 1)


Reflections = Literal["none", "first", "all"]
TotalReflection = Literal["followed", "ended"]
Reentry = Literal["possible", "impossible"]
Unfinished = Literal["kept", "dark"]

# Max bends and throughput threshold for which the capacity factors below were measured.
_PAPER_BENDS = 10
_TREE_BENDS = 24
_TREE_CUT = 0.02

# Capacities do not grow for thresholds below this one, so that memory is bounded.
_SMALLEST_CUT_WITH_ROOM = 5e-4


@dataclasses.dataclass(frozen=True)
class Budget:
    """Path settings: the branches to follow, and the capacity for them.

    The capacity factors bound memory, per camera ray traced together. If a buffer is full, the
    paths of least throughput are dropped, and the dropped throughput is returned; see `wavefront`.
    A factor of `None` is derived from the throughput threshold and the max bends
    (`capacity_factors`), so `dataclasses.replace(TREE, cut=0.002)` also has capacity for the
    additional paths. A batch of few rays that all hit much glass may need larger factors.

    Attributes:
      bends: max bends, the largest number of refractions and reflections of a path.
      reflections: reflections to follow. `none` follows only total internal reflections; `first`
        adds the reflection at the first surface, untraced; `all` follows every reflection.
      total_reflection: `followed`, or `ended`: paths continue straight at a total internal
        reflection, as in the paper's ablation.
      cut: throughput threshold for following a branch, compared to the largest RGB component. A
        weaker branch leaves its share to its sibling, so that energy is conserved.
      reentry: `impossible` states that a ray that has left the objects never hits one again, as
        with one convex object; such rays are not cast again.
      unfinished: treatment of truncated paths, which reach the max bends. `kept` ends them on the
        background along their last direction, as in the paper; `dark` makes them black, as in
        renderers with a max depth.
      live_per_ray: capacity for rays still to be cast, per camera ray; at least 1.
      segments_per_ray: capacity for path segments per camera ray, in addition to the camera rays.
      paths_per_ray: capacity for finished paths, per camera ray.
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
        """Validates the values."""
        check_bends(self.bends)
        check_cut(self.cut)
        if self.reflections not in get_args(Reflections):
            raise ValueError(
                f"reflections is {self.reflections!r}, which is unknown. Use 'none', 'first' or "
                "'all'."
            )
        if self.total_reflection not in get_args(TotalReflection):
            raise ValueError(
                f"total_reflection is {self.total_reflection!r}, which is unknown. Use 'followed' "
                "or 'ended'."
            )
        if self.reentry not in get_args(Reentry):
            raise ValueError(
                f"reentry is {self.reentry!r}, which is unknown. Use 'possible' or 'impossible'."
            )
        if self.unfinished not in get_args(Unfinished):
            raise ValueError(
                f"unfinished is {self.unfinished!r}, which is unknown. Use 'kept' or 'dark'."
            )
        for name, usual in _usual_factors(self)._asdict().items():
            factor = getattr(self, name)
            if factor is not None and not 1.0 <= factor < math.inf:
                raise ValueError(
                    f"{name} is {factor}, but every ray needs a capacity of at least 1. Give a "
                    "number of at least 1, or None."
                )
            # A default factor that is written out (as in files of older runs) still follows cut.
            if factor == usual:
                object.__setattr__(self, name, None)


def check_bends(bends: int) -> None:
    """Refuses, by a `ValueError`, a number that can not be the max bends."""
    if bends < 0:
        raise ValueError(f"bends is {bends}, which is negative. Give 0 or more.")


def check_cut(cut: float) -> None:
    """Refuses, by a `ValueError`, a number that can not be a throughput threshold."""
    if not 0.0 <= cut < 1.0:
        raise ValueError(
            f"The throughput threshold cut is {cut}, outside [0, 1). Give 0.02 for 2 % of a "
            "pixel's light."
        )


class CapacityFactors(NamedTuple):
    """Capacities per camera ray; see `Budget`."""

    live_per_ray: float
    segments_per_ray: float
    paths_per_ray: float


def capacity_factors(budget: Budget) -> CapacityFactors:
    """Returns the capacity factors of path settings; `None` is derived from `cut` and `bends`.

    The defaults are generous for images that are partly filled by glass. If all reflections are
    followed, capacities grow with the inverse square root of a threshold below 0.02; the capacity
    for segments also grows with the max bends. Measured: without this growth, a flask of three
    media drops 0.27 % of its light at a threshold of 0.002.
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
    """Capacities of the buffers of a batch of rays, from the capacity factors.

    Attributes:
      live: capacity for rays still to be cast.
      segments: capacity for path segments, including the camera rays.
      paths: capacity for finished paths.
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
    """Returns preset path settings by name, with another throughput threshold or max bends.

    Raises:
      ValueError: if rays are straight, but `cut` or `bends` is given.
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
    """Returns the capacities for a number of camera rays."""
    factors = capacity_factors(budget)
    return Room(
        live=math.ceil(rays * factors.live_per_ray),
        segments=math.ceil(rays * (1.0 + factors.segments_per_ray)),
        paths=math.ceil(rays * factors.paths_per_ray),
    )


def capacity_for(budget: Budget, rays: int, *, mean: float, deviation: float) -> int:
    """Returns the capacity for the paths of a batch of a scene.

    This is one standard deviation above the mean number of paths of a random batch, rounded up to a
    multiple of 8. One batch in six drops its weakest paths, and training logs their throughput. The
    cost of a step is proportional to this capacity; a capacity for all paths would cost 6 % more.

    Args:
      budget: path settings.
      rays: number of rays in a batch.
      mean: mean number of paths per camera ray of the scene.
      deviation: standard deviation of the number of paths over rays.
    """
    most = room(budget, rays).paths
    needed = rays * mean + math.sqrt(rays) * deviation
    return max(rays, min(most, 8 * math.ceil(needed / 8)))
