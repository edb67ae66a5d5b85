"""Estimates the refractive index of a part from images by gradient descent.

A trained field, usually of the background, is rendered along the main branches of the light paths
through the scene, and the colours are compared with the images. The error is differentiable with
respect to the scene's indices of refraction, corners and normals.

As a function of the index, the error has one narrow valley, about 0.15 wide for a ball whose
background is as detailed as its images and much wider for flat faces, with ripples outside of it.
The error is therefore first evaluated on a ladder of indices. Descents start from its best rungs
and from the index that the user expects. They use only the sign of the derivative, with steps that
grow while it stays the same and shrink when it changes (resilient propagation): near the critical
angle single rays have unbounded derivatives, which must not determine the length of a step.

The standard error is estimated from the curvature of the valley: views are split into groups, a
parabola is fitted to each group, and the scatter of their minima is measured. It excludes errors
common to all views, such as an object that is too large.

This is one of the modules that call `jax.jit`.

Sources: paper (arXiv 2505.05848), photometric loss; its use for the index is ours. Riedmiller and
Braun (1993), resilient propagation (RPROP).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics.differentiable_paths import follow_main_branches
from refref_jax.optics.media import Scene, with_index
from refref_jax.optics.path_settings import PathSettings
from refref_jax.reconstruct import ReconstructionError
from refref_jax.render import pixels
from refref_jax.render.model import ModelConfig, Params

TRACING = PathSettings(max_bends=12, reflections="all", min_throughput=0.02)
"""Threshold as in the tree, half as many bends: the main branches of few rays are longer."""

REFLECTIONS = 3
"""Number of first surfaces at which a reflection is followed."""

# Errors below this, in sRGB, enter squared and larger ones linearly: a trained field is wrong by a
# hundredth anyway, and where the geometry is wrong a few rays see something else.
_NOISE = 0.01

# Largest error of a pixel, in sRGB: light that comes from where no photograph shows the background,
# such as the roof of a room, is predicted at random.
_CAP = 0.35


class Evidence(NamedTuple):
    """Pixels, and the field that should explain them.

    Attributes:
      params: parameters of the field.
      rays: rays of the pixels.
      rgb: true sRGB of the pixels, in `[0, 1]`.
    """

    params: Params
    rays: Rays
    rgb: Float[Array, "rays 3"]


class Slope(NamedTuple):
    """Mean error at an index, and its derivative."""

    error: Float[Array, ""]
    slope: Float[Array, ""]


def errors(
    evidence: Evidence, scene: Scene, *, config: ModelConfig, settings: PathSettings = TRACING
) -> Float[Array, " rays"]:
    """Returns the Charbonnier error of each pixel: of its sRGB difference, capped at 0.35.

    Args:
      evidence: pixels and the field to compare with.
      scene: scene that refracts their rays.
      config: configuration of the field's model; its footprint must be `cone`.
      settings: path settings, see `differentiable_paths`.

    Raises:
      ValueError: if the model's footprint is not `cone`.
    """
    if config.footprint != "cone":
        raise ValueError(
            f"The model's footprint is {config.footprint!r}, but single paths have no derivatives "
            "across the pixel. Train the background with the footprint 'cone'."
        )
    count = evidence.rays.radii.shape[0]
    follow = functools.partial(
        follow_main_branches, scene, settings=settings, reflections=REFLECTIONS
    )
    branches = jax.vmap(follow)(evidence.rays)
    paths = jax.tree.map(lambda x: x.reshape(count * (1 + REFLECTIONS), *x.shape[2:]), branches)
    paths = paths._replace(rays=jnp.repeat(jnp.arange(count), 1 + REFLECTIONS))
    jitter = pixels.no_jitter(config, paths.radii.shape[0])
    full_trust = jnp.ones_like(evidence.rgb, shape=())
    seen = pixels.render_pixels(
        evidence.params, config, paths, jitter, rays=count, anneal=full_trust
    )
    difference = jnp.mean(jnp.square(seen.rgb - evidence.rgb), axis=-1)
    return jnp.minimum(jnp.sqrt(difference + _NOISE**2) - _NOISE, _CAP)


@functools.partial(jax.jit, static_argnames=("part", "config"))
def errors_at_index(
    index: Float[Array, ""],
    evidence: Evidence,
    scene: Scene,
    *,
    part: int,
    config: ModelConfig,
) -> Float[Array, " rays"]:
    """Returns `errors` for a given index of refraction of one part."""
    return errors(evidence, with_index(scene, index, part=part), config=config)


@functools.partial(jax.jit, static_argnames=("part", "config"))
def slope_at_index(
    index: Float[Array, ""],
    evidence: Evidence,
    scene: Scene,
    *,
    part: int,
    config: ModelConfig,
) -> Slope:
    """Returns the mean of `errors_at_index` and its derivative, in forward mode."""

    def mean(at: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.mean(errors_at_index(at, evidence, scene, part=part, config=config))

    return Slope(*jax.jvp(mean, (index,), (jnp.ones_like(index),)))


LOWEST, HIGHEST = 1.01, 2.8
"""Range of plausible indices: transparent materials in air."""

# Factors on the step if the derivative keeps its sign, and if it does not (or the error grows).
_GROW, _SHRINK = 1.3, 0.4

# Half-width of the parabola for the standard error, and number of groups of views.
_APART = 0.01
_PARABOLA = (-_APART, 0.0, _APART)
_GROUPS = 10


@dataclasses.dataclass(frozen=True)
class IndexSearch:
    """Settings of the search for an index.

    Attributes:
      lowest: lowest rung of the ladder.
      highest: highest rung of the ladder.
      spacing: distance between rungs; more than half the width of a valley may miss it.
      descents: number of best rungs from which to descend.
      step: length of a descent's first step.
      tolerance: length of a descent's last step.
      most: largest number of steps of a descent.
    """

    lowest: float = 1.2
    highest: float = 2.5
    spacing: float = 0.05
    descents: int = 4
    step: float = 0.02
    tolerance: float = 2e-4
    most: int = 25

    def __post_init__(self) -> None:
        """Validates the ladder."""
        if not LOWEST <= self.lowest < self.highest <= HIGHEST:
            raise ReconstructionError(
                f"The range of indices is {self.lowest} to {self.highest}. Choose lowest and "
                f"highest within {LOWEST} and {HIGHEST}."
            )
        if min(self.spacing, self.step, self.tolerance) <= 0.0 or min(self.descents, self.most) < 1:
            raise ReconstructionError(
                "Spacing, steps and their numbers must be positive. Correct the search."
            )


class Descent(NamedTuple):
    """Iterates of one descent.

    Attributes:
      indices: visited indices, the start first and the best one last.
      errors: mean errors at these indices.
    """

    indices: tuple[float, ...]
    errors: tuple[float, ...]


class IndexEstimate(NamedTuple):
    """An estimate of an index of refraction.

    Attributes:
      index: best index.
      deviation: standard deviation of the index; `inf` if the error has no valley there.
      error: mean error of the pixels at the index, sRGB.
      ladder: indices and errors of the ladder.
      descents: descents from the best rungs, and from the user's start; the best one first.
    """

    index: float  # type: ignore[assignment]  # hides tuple.index
    deviation: float
    error: float
    ladder: Descent
    descents: tuple[Descent, ...]


def estimate_index(
    evidence: Evidence,
    scene: Scene,
    views: Int[np.ndarray, " rays"],
    *,
    part: int,
    config: ModelConfig,
    search: IndexSearch = IndexSearch(),
    start: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> IndexEstimate:
    """Estimates the index of refraction of one part that best explains its pixels.

    Args:
      evidence: pixels that see the part, and a field of the background.
      scene: scene; the part's own index is ignored.
      views: image number of each ray, for the standard error.
      part: number of the part.
      config: configuration of the field's model.
      search: settings of the search.
      start: index that the user expects, from which a descent always starts.
      progress: function called with the number of evaluations done, and the most there can be.

    Raises:
      ReconstructionError: if there are no pixels, or no error is finite.
    """
    if not len(views):
        raise ReconstructionError("No pixel sees the object. Check the masks and the cameras.")
    ladder = rungs(search)
    show = _counter(progress, most_looks(search, start=start))

    def errors(index: float) -> Float[np.ndarray, " rays"]:
        show()
        return _errors(index, evidence, scene, part=part, config=config)

    def slope(index: float) -> tuple[float, float]:
        show()
        at = np.asarray(index, evidence.rgb.dtype)
        found = slope_at_index(at, evidence, scene, part=part, config=config)
        return float(found.error), float(found.slope)

    heights = tuple(float(errors(rung).mean()) for rung in ladder)
    if not np.any(np.isfinite(heights)):
        raise ReconstructionError(
            "No error of a pixel is finite. Check the field that the pixels are compared with."
        )
    starts = [ladder[i] for i in lowest_rungs(heights, search.descents)]
    starts += [] if start is None else [start]
    ways = [descend(slope, at, search) for at in starts]
    ways.sort(key=lambda way: way.errors[-1] if math.isfinite(way.errors[-1]) else math.inf)
    best = ways[0].indices[-1]
    triple = np.stack([errors(best + shift) for shift in _PARABOLA])
    deviation = scatter_of_bottoms(triple, views, _APART)
    return IndexEstimate(best, deviation, ways[0].errors[-1], Descent(ladder, heights), tuple(ways))


def most_looks(search: IndexSearch, *, start: float | None = None) -> int:
    """Returns the largest number of evaluations of the error."""
    descents = search.descents + (start is not None)
    return len(rungs(search)) + search.most * descents + len(_PARABOLA)


def descend(
    slope: Callable[[float], tuple[float, float]], start: float, search: IndexSearch
) -> Descent:
    """Descends from a start by the sign of the derivative.

    Args:
      slope: function that returns error and derivative at an index.
      start: initial index, clipped to the plausible range.
      search: settings of the search.
    """
    at = min(max(start, LOWEST), HIGHEST)
    error, derivative = slope(at)
    way, step = [(at, error)], search.step
    for _ in range(search.most - 1):
        if step < search.tolerance or derivative == 0.0 or not math.isfinite(derivative):
            break
        onward = min(max(at - math.copysign(step, derivative), LOWEST), HIGHEST)
        there, turned = slope(onward)
        if not there < error:
            step *= _SHRINK
            continue
        step *= _GROW if turned * derivative > 0.0 else _SHRINK
        at, error, derivative = onward, there, turned
        way.append((at, error))
    return Descent(*zip(*way, strict=True))


def scatter_of_bottoms(
    errors: Float[np.ndarray, "3 rays"], views: Int[np.ndarray, " rays"], apart: float
) -> float:
    """Returns the standard deviation of a valley's minimum, from groups of views.

    Args:
      errors: error of each ray at three indices: `apart` below the minimum, at it, and above.
      views: view of each ray; all rays of a view are in the same group.
      apart: distance between the indices.
    """
    names, number = np.unique(views, return_inverse=True)
    groups = min(_GROUPS, len(names))
    counts = np.bincount(number % groups, minlength=groups)
    below, here, above = (np.bincount(number % groups, each) / counts for each in errors)
    whole = below.mean() + above.mean() - 2.0 * here.mean()
    if groups < 2 or not whole > 0.0:
        return math.inf
    # The curvature of all groups together, since that of a single group may be zero.
    bottoms = -0.5 * apart * (above - below) / whole
    return float(bottoms.std(ddof=1) / math.sqrt(groups))


def rungs(search: IndexSearch) -> tuple[float, ...]:
    """Returns the indices of the ladder."""
    count = math.ceil((search.highest - search.lowest) / search.spacing - 1e-9)
    return tuple(float(rung) for rung in np.linspace(search.lowest, search.highest, count + 1))


def lowest_rungs(heights: Sequence[float], count: int) -> list[int]:
    """Returns the lowest rungs, but no two adjacent ones, which would share a valley."""
    chosen: list[int] = []
    for rung in np.argsort(np.where(np.isfinite(heights), heights, np.inf), kind="stable"):
        if len(chosen) < count and all(abs(int(rung) - other) > 1 for other in chosen):
            chosen.append(int(rung))
    return chosen


def _errors(
    index: float, evidence: Evidence, scene: Scene, *, part: int, config: ModelConfig
) -> Float[np.ndarray, " rays"]:
    at = np.asarray(index, evidence.rgb.dtype)
    found = errors_at_index(at, evidence, scene, part=part, config=config)
    return np.asarray(found, np.float64)


def _counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[], None]:
    done = 0

    def show() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    return show
