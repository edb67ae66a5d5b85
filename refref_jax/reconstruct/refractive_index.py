"""Estimates a refractive index from images by gradient descent.

How well a geometry explains the pixels that see it, with gradients.

A field that is already there, usually of the background, is looked at along the main branches of
light through the geometry, and what is seen is compared with the images. The comparison has
gradients with respect to all of the geometry: indices of refraction, corners and normals.

This is one of the modules that call `jax.jit`.

Source: paper (arXiv 2505.05848), photometric loss; the estimation by it is ours.

The index of refraction of a part, by descent from many starts on what its pixels should show.

The error of the pixels over the index has one narrow valley, about 0.15 wide for a ball whose
background is as fine as its images, and much wider for flat faces; beside it there are ripples. So
the error is looked at on a ladder of indices first, and the descent begins at its best rungs, and
at the index that the user expects. Descents go by the sign of the derivative, with steps that grow
while it stays and shrink when it turns (resilient propagation): near the critical angle single rays
have derivatives without bound, and no step may be as long as these say.

The error bar comes from the curvature of the valley: views are put into groups, each group's
parabola has its own bottom, and the bottoms scatter. What is wrong in the same way for all views,
such as a body that is too large, is not in it.

Source: Riedmiller and Braun (1993), resilient propagation (RPROP).
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
from refref_jax.optics.path_settings import Budget
from refref_jax.optics.scene import Scene, with_index
from refref_jax.reconstruct import ReconstructionError
from refref_jax.render import pixels
from refref_jax.render.model import ModelConfig, Params

TRACING = Budget(bends=12, reflections="all", cut=0.02)
"""The tree's cut, and half of its bends: the main branches of few rays are longer."""

REFLECTIONS = 3
"""At how many of the first surfaces a reflection is followed."""

# An error below this, in sRGB, counts by its square, one above it as it is: a hundredth is what a
# trained field is wrong by anyway. Where geometry is wrong, a few rays see something else
# altogether.
_NOISE = 0.01


class Evidence(NamedTuple):
    """Pixels, and the field that should explain them.

    Attributes:
      params: of the field.
      rays: of the pixels.
      rgb: their true sRGB, in `[0, 1]`.
    """

    params: Params
    rays: Rays
    rgb: Float[Array, "rays 3"]


class Slope(NamedTuple):
    """The mean error at an index, and its derivative."""

    error: Float[Array, ""]
    slope: Float[Array, ""]


def errors(
    evidence: Evidence, geometry: Scene, *, config: ModelConfig, budget: Budget = TRACING
) -> Float[Array, " rays"]:
    """Returns each pixel's error in sRGB: Charbonnier's, of the length of the difference.

    Args:
      evidence: the pixels.
      geometry: what bends their light.
      config: of the field's model; its footprint must be `cone`.
      budget: which light is followed, see `differentiable_paths`.

    Raises:
      ValueError: if the model's footprint is another.
    """
    if config.footprint != "cone":
        raise ValueError(
            f"The model's footprint is {config.footprint!r}, but single paths carry no derivatives "
            "across the pixel. Train the background with 'cone'."
        )
    count = evidence.rays.radii.shape[0]
    follow = functools.partial(
        follow_main_branches, geometry, budget=budget, reflections=REFLECTIONS
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
    return jnp.sqrt(difference + _NOISE**2) - _NOISE


@functools.partial(jax.jit, static_argnames=("part", "config"))
def errors_at_index(
    index: Float[Array, ""],
    evidence: Evidence,
    geometry: Scene,
    *,
    part: int,
    config: ModelConfig,
) -> Float[Array, " rays"]:
    """Returns `errors` with an index of refraction for one part."""
    return errors(evidence, with_index(geometry, index, part=part), config=config)


@functools.partial(jax.jit, static_argnames=("part", "config"))
def slope_at_index(
    index: Float[Array, ""],
    evidence: Evidence,
    geometry: Scene,
    *,
    part: int,
    config: ModelConfig,
) -> Slope:
    """Returns the mean of `errors_at_index` and its derivative, by one pass forwards."""

    def mean(at: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.mean(errors_at_index(at, evidence, geometry, part=part, config=config))

    return Slope(*jax.jvp(mean, (index,), (jnp.ones_like(index),)))


LOWEST, HIGHEST = 1.01, 2.8
"""Indices that are believed: those of transparent bodies in air."""

# How steps change where the derivative keeps its sign, and where it does not (or the error grows).
_GROW, _SHRINK = 1.3, 0.4

# Half the width of the parabola that the error bar is taken from, and groups of views.
_APART = 0.01
_PARABOLA = (-_APART, 0.0, _APART)
_GROUPS = 10


@dataclasses.dataclass(frozen=True)
class IndexSearch:
    """How an index is looked for.

    Attributes:
      lowest: rung of the ladder.
      highest: rung of the ladder.
      spacing: of the rungs; more than half a valley misses it.
      descents: from how many of the best rungs to descend.
      step: length of a descent's first step.
      tolerance: length of the last one.
      most: steps of a descent.
    """

    lowest: float = 1.2
    highest: float = 2.5
    spacing: float = 0.05
    descents: int = 4
    step: float = 0.02
    tolerance: float = 2e-4
    most: int = 25

    def __post_init__(self) -> None:
        """Checks the ladder."""
        if not LOWEST <= self.lowest < self.highest <= HIGHEST:
            raise ReconstructionError(
                f"The index is looked for from {self.lowest} to {self.highest}. Look for it within "
                f"{LOWEST} and {HIGHEST}."
            )
        if min(self.spacing, self.step, self.tolerance) <= 0.0 or min(self.descents, self.most) < 1:
            raise ReconstructionError(
                "Spacing, steps and their numbers must be positive. Correct the search."
            )


class Descent(NamedTuple):
    """One way down.

    Attributes:
      indices: where it went, the start first and the lowest place last.
      errors: mean error there.
    """

    indices: tuple[float, ...]
    errors: tuple[float, ...]


class IndexEstimate(NamedTuple):
    """An index of refraction.

    Attributes:
      index: the best.
      deviation: one standard deviation; `inf` if the error has no valley there.
      error: mean error of the pixels there, sRGB.
      ladder: indices and errors that were looked at first.
      descents: from the best rungs, and from the user's start; the best one first.
    """

    index: float  # type: ignore[assignment]  # hides tuple.index
    deviation: float
    error: float
    ladder: Descent
    descents: tuple[Descent, ...]


def estimate_index(
    evidence: Evidence,
    geometry: Scene,
    views: Int[np.ndarray, " rays"],
    *,
    part: int,
    config: ModelConfig,
    search: IndexSearch = IndexSearch(),
    start: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> IndexEstimate:
    """Finds the index of refraction of one part with which its pixels are explained best.

    Args:
      evidence: pixels that see the part, and a field of what is behind it.
      geometry: of the scene; the part's own index is not used.
      views: the image of each ray, for the error bar.
      part: number of the part.
      config: of the field's model.
      search: how.
      start: an index that the user expects, from which to descend in any case.
      progress: told the rungs and steps done, and how many there may be.

    Raises:
      ReconstructionError: if there is no pixel, or no error is finite.
    """
    if not len(views):
        raise ReconstructionError("No pixel sees the body. Check the masks and the cameras.")
    rungs = _rungs(search)
    show = _counter(progress, most_looks(search, start=start))

    def errors(index: float) -> Float[np.ndarray, " rays"]:
        show()
        return _errors(index, evidence, geometry, part=part, config=config)

    def slope(index: float) -> tuple[float, float]:
        show()
        at = np.asarray(index, evidence.rgb.dtype)
        found = slope_at_index(at, evidence, geometry, part=part, config=config)
        return float(found.error), float(found.slope)

    heights = tuple(float(errors(rung).mean()) for rung in rungs)
    if not np.any(np.isfinite(heights)):
        raise ReconstructionError(
            "No error of a pixel is finite. Check the field that the pixels are compared with."
        )
    starts = [rungs[i] for i in _lowest_rungs(heights, search.descents)]
    starts += [] if start is None else [start]
    ways = [descend(slope, at, search) for at in starts]
    ways.sort(key=lambda way: way.errors[-1] if math.isfinite(way.errors[-1]) else math.inf)
    best = ways[0].indices[-1]
    triple = np.stack([errors(best + shift) for shift in _PARABOLA])
    deviation = scatter_of_bottoms(triple, views, _APART)
    return IndexEstimate(best, deviation, ways[0].errors[-1], Descent(rungs, heights), tuple(ways))


def most_looks(search: IndexSearch, *, start: float | None = None) -> int:
    """Returns how often the error of the pixels is looked at, at most."""
    descents = search.descents + (start is not None)
    return len(_rungs(search)) + search.most * descents + len(_PARABOLA)


def descend(
    slope: Callable[[float], tuple[float, float]], start: float, search: IndexSearch
) -> Descent:
    """Goes down from a start by the sign of the derivative.

    Args:
      slope: gives error and derivative at an index.
      start: an index; moved into what is believed.
      search: lengths of steps, and their number.
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
    """Returns the standard deviation of a valley's bottom, from those of groups of views.

    Args:
      errors: of each ray, `apart` below the bottom, there, and above.
      views: of each ray; those of a view are of one group.
      apart: in the index.
    """
    names, number = np.unique(views, return_inverse=True)
    groups = min(_GROUPS, len(names))
    counts = np.bincount(number % groups, minlength=groups)
    below, here, above = (np.bincount(number % groups, each) / counts for each in errors)
    whole = below.mean() + above.mean() - 2.0 * here.mean()
    if groups < 2 or not whole > 0.0:
        return math.inf
    # The curvature of all groups together, since that of one may be none.
    bottoms = -0.5 * apart * (above - below) / whole
    return float(bottoms.std(ddof=1) / math.sqrt(groups))


def _rungs(search: IndexSearch) -> tuple[float, ...]:
    count = math.ceil((search.highest - search.lowest) / search.spacing - 1e-9)
    return tuple(float(rung) for rung in np.linspace(search.lowest, search.highest, count + 1))


def _lowest_rungs(heights: Sequence[float], count: int) -> list[int]:
    """Returns the lowest rungs, of which no two are neighbours: these share their valley."""
    chosen: list[int] = []
    for rung in np.argsort(np.where(np.isfinite(heights), heights, np.inf), kind="stable"):
        if len(chosen) < count and all(abs(int(rung) - other) > 1 for other in chosen):
            chosen.append(int(rung))
    return chosen


def _errors(
    index: float, evidence: Evidence, geometry: Scene, *, part: int, config: ModelConfig
) -> Float[np.ndarray, " rays"]:
    at = np.asarray(index, evidence.rgb.dtype)
    found = errors_at_index(at, evidence, geometry, part=part, config=config)
    return np.asarray(found, np.float64)


def _counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[], None]:
    done = 0

    def show() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    return show
