"""Path settings: the branches of light that are traced, and the capacities of the buffers for them.

At every interface light splits into a reflected and a transmitted ray, so a camera ray has a tree
of paths. Path settings select the branches to follow. The presets are:

- `STRAIGHT`: none; light ignores the objects, as in a plain NeRF.
- `PAPER`: the paper's oracle. One path of at most 10 bends, refracted wherever it can be and
  totally reflected elsewhere, without loss, and one reflection at the first surface, which is not
  traced any further.
- `TREE`: every branch with a throughput of at least 2 %.
- `PAPER_NO_REFLECTION`, `PAPER_NO_TIR`: the paper's ablations: `PAPER` without the reflection at
  the first surface, and with paths that continue straight at total internal reflections.

`Detail` selects which segments of traced paths are stored, to save memory.

Source: paper (arXiv 2505.05848), sections 4 and 5 (ablation study), for all but the tree.
"""

import dataclasses
import math
from typing import Any, Literal, NamedTuple, get_args

from refref_jax.choices import Footprint
from refref_jax.configuration import FORMER_VALUES, FORMERLY

Reflections = Literal["none", "first", "all"]
TotalReflection = Literal["followed", "ended"]
Reentry = Literal["possible", "impossible"]
TruncatedPaths = Literal["background", "black"]
Tally = Literal["none", "parts"]

FORMER_TRUNCATION = {"kept": "background", "dark": "black"}
"""Values of `truncated_paths` by their names in earlier versions."""

# Max bends and throughput threshold for which the capacity factors below were measured.
_PAPER_BENDS = 10
_TREE_BENDS = 24
_TREE_MIN_THROUGHPUT = 0.02

# Capacities do not grow for thresholds below this one, so that memory is bounded.
_SMALLEST_SCALED_THRESHOLD = 5e-4


@dataclasses.dataclass(frozen=True)
class Detail:
    """Contents of stored light paths.

    Attributes:
      segments: `all` segments, or only those `outside` the objects and the last one.
      most: maximum number of segments per path; `all` needs max bends + 1. Of a longer path, the
        first segment and the last ones are kept.
      footprint: `differential` carries derivatives across the pixel (see `RayDifferential`).
      tally: `parts` stores each path's hit counts and path lengths per part.
    """

    segments: Literal["all", "outside"]
    most: int
    footprint: Footprint = "cone"
    tally: Tally = "none"

    def __post_init__(self) -> None:
        """Validates the number of segments."""
        if self.most < 1:
            raise ValueError(f"most is {self.most}; a path has at least one segment. Give >= 1.")


def everything(bends: int) -> Detail:
    """Returns the settings that store complete paths."""
    return Detail("all", bends + 1)


@dataclasses.dataclass(frozen=True)
class PathSettings:
    """Path settings: the branches to follow, and the capacity for them.

    The capacity factors limit the memory per camera ray. If a buffer is full, the paths of least
    throughput are dropped, and the dropped throughput is returned; see `wavefront`. A factor of
    `None` is derived from the throughput threshold and the max bends (`capacity_factors`), so
    `dataclasses.replace(TREE, min_throughput=0.002)` also has capacity for the additional paths. A
    batch of few rays that all hit much glass may need larger factors.

    Attributes:
      max_bends: largest number of refractions and reflections of a path.
      reflections: reflections to follow. `none` follows only total internal reflections; `first`
        adds the reflection at the first surface, untraced; `all` follows every reflection.
      total_reflection: treatment of total internal reflection. `followed` reflects paths; `ended`
        lets them continue straight, as in the paper's ablation.
      min_throughput: throughput threshold for following a branch, compared to the largest RGB
        component. A weaker branch leaves its share to its sibling, so that energy is conserved.
      reentry: `impossible` states that a ray that has left the objects never hits one again, as
        with one convex object; such rays are not cast again.
      truncated_paths: treatment of paths that reach the max bends. `background` ends them on the
        background along their last direction, as in the paper; `black` makes them black, as in
        renderers with a max depth.
      live_per_ray: capacity for rays still to be cast, per camera ray; at least 1.
      segments_per_ray: capacity for path segments per camera ray, in addition to the camera rays.
      paths_per_ray: capacity for finished paths, per camera ray.
    """

    max_bends: int = dataclasses.field(metadata={FORMERLY: "bends"})
    reflections: Reflections
    total_reflection: TotalReflection = "followed"
    min_throughput: float = dataclasses.field(default=0.0, metadata={FORMERLY: "cut"})
    reentry: Reentry = "possible"
    truncated_paths: TruncatedPaths = dataclasses.field(
        default="background", metadata={FORMERLY: "unfinished", FORMER_VALUES: FORMER_TRUNCATION}
    )
    live_per_ray: float | None = None
    segments_per_ray: float | None = None
    paths_per_ray: float | None = None

    def __post_init__(self) -> None:
        """Validates the values."""
        check_max_bends(self.max_bends)
        check_min_throughput(self.min_throughput)
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
        if self.truncated_paths not in get_args(TruncatedPaths):
            raise ValueError(
                f"truncated_paths is {self.truncated_paths!r}, which is unknown. Use 'background' "
                "or 'black'."
            )
        for name, usual in _usual_factors(self)._asdict().items():
            factor = getattr(self, name)
            if factor is not None and not 1.0 <= factor < math.inf:
                raise ValueError(
                    f"{name} is {factor}, but every ray needs a capacity of at least 1. Give a "
                    "number of at least 1, or None."
                )
            # A default factor that is written out, as in files of older runs, still adapts.
            if factor == usual:
                object.__setattr__(self, name, None)


def check_max_bends(max_bends: int) -> None:
    """Raises a `ValueError` if max bends are negative."""
    if max_bends < 0:
        raise ValueError(f"max_bends is {max_bends}, which is negative. Give 0 or more.")


def check_min_throughput(min_throughput: float) -> None:
    """Raises a `ValueError` if a throughput threshold is outside [0, 1)."""
    if not 0.0 <= min_throughput < 1.0:
        raise ValueError(
            f"min_throughput is {min_throughput}, outside [0, 1). Give 0.02 for 2 % of a pixel's "
            "light."
        )


class CapacityFactors(NamedTuple):
    """Capacities per camera ray; see `PathSettings`."""

    live_per_ray: float
    segments_per_ray: float
    paths_per_ray: float


def capacity_factors(settings: PathSettings) -> CapacityFactors:
    """Returns the capacity factors of path settings, with defaults for those that are `None`.

    The defaults are generous for images that are partly filled by glass. If all reflections are
    followed, capacities grow with the inverse square root of a threshold below 0.02; the capacity
    for segments also grows with the max bends. Measured: without this growth, a flask of three
    media drops 0.27 % of its light at a threshold of 0.002.
    """
    set_here = (settings.live_per_ray, settings.segments_per_ray, settings.paths_per_ray)
    pairs = zip(set_here, _usual_factors(settings), strict=True)
    return CapacityFactors(*(usual if given is None else given for given, usual in pairs))


def _usual_factors(settings: PathSettings) -> CapacityFactors:
    if settings.max_bends == 0:
        return CapacityFactors(1.0, 24.0, 1.0)
    if settings.reflections != "all":
        return CapacityFactors(1.0, max(1.0, settings.max_bends / _PAPER_BENDS) * 11.0, 2.0)
    segments = max(1.0, settings.max_bends / _TREE_BENDS) * 24.0
    growth = math.sqrt(
        max(1.0, _TREE_MIN_THROUGHPUT / max(settings.min_throughput, _SMALLEST_SCALED_THRESHOLD))
    )
    return CapacityFactors(growth * 6.0, growth * segments, growth * 8.0)


class Capacities(NamedTuple):
    """Capacities of the buffers of a batch of rays, from the capacity factors.

    Attributes:
      live: capacity for rays still to be cast.
      segments: capacity for path segments, including the camera rays.
      paths: capacity for finished paths.
    """

    live: int
    segments: int
    paths: int


STRAIGHT = PathSettings(max_bends=0, reflections="none")
PAPER = PathSettings(max_bends=10, reflections="first")
TREE = PathSettings(max_bends=24, reflections="all", min_throughput=0.02)

PAPER_NO_REFLECTION = dataclasses.replace(PAPER, reflections="none")
PAPER_NO_TIR = dataclasses.replace(PAPER, total_reflection="ended")

PATH_PRESETS = {
    "straight": STRAIGHT,
    "paper": PAPER,
    "tree": TREE,
    "paper_no_reflection": PAPER_NO_REFLECTION,
    "paper_no_tir": PAPER_NO_TIR,
}


def make_path_settings(
    paths: str, *, min_throughput: float | None = None, max_bends: int | None = None
) -> PathSettings:
    """Returns preset path settings by name, with another throughput threshold or max bends.

    Raises:
      ValueError: if rays are straight, but `min_throughput` or `max_bends` is given.
    """
    settings = PATH_PRESETS[paths]
    given: dict[str, Any] = {"min_throughput": min_throughput, "max_bends": max_bends}
    changed = {n: x for n, x in given.items() if x is not None and x != getattr(settings, n)}
    if settings.max_bends == 0 and changed:
        raise ValueError(
            f"paths={paths} has neither min_throughput nor max_bends. Leave them out, or use "
            "paths=tree."
        )
    return dataclasses.replace(settings, **changed)


def capacities(settings: PathSettings, rays: int) -> Capacities:
    """Returns the capacities for a number of camera rays."""
    factors = capacity_factors(settings)
    return Capacities(
        live=math.ceil(rays * factors.live_per_ray),
        segments=math.ceil(rays * (1.0 + factors.segments_per_ray)),
        paths=math.ceil(rays * factors.paths_per_ray),
    )


def capacity_for(
    settings: PathSettings, rays: int, *, mean: float, deviation: float, multiple: int = 8
) -> int:
    """Returns the capacity for the paths of a batch of a scene.

    This is the mean number of paths of a random batch plus one standard deviation, rounded up. One
    batch in six drops its weakest paths, and training logs their throughput. The cost of a step is
    proportional to this capacity; a capacity for all paths would cost 6 % more.

    Args:
      settings: path settings.
      rays: number of rays in a batch.
      mean: mean number of paths per camera ray of the scene.
      deviation: standard deviation of the number of paths over rays.
      multiple: number that divides the capacity, unless all paths are fewer. With 128, matrix
        products of NVIDIA GPUs need no padding, which would copy all factors.
    """
    most = capacities(settings, rays).paths
    needed = rays * mean + math.sqrt(rays) * deviation
    return max(rays, min(most, multiple * math.ceil(needed / multiple)))
