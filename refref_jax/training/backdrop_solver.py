"""Determines the radiance of a far field surface from training pixels, by linear least squares.

The pixels are linear functions of the surface (`render.backdrop`), so its radiance has one best
value, which is found without a learning rate: by conjugate gradients on the normal equations, with
a diagonal preconditioner on the levels of the pyramid. Nothing is stored but where light paths end.

The error that is minimised is that of sRGB colours. Every few iterations each pixel's equation gets
a new weight, such that its linear residual becomes the sRGB one (an iteratively reweighted
Gauss-Newton method); saturated pixels that are predicted brighter, and outliers, such as pixels on
outlines, lose their weight. A weak prior on the details of the pyramid determines vertices that no
pixel sees: they continue their surroundings smoothly.

A fraction of the pixels is held out; their error tells when to stop.

Learned tints and absorption take turns with the radiance: each round begins with Gauss-Newton steps
of non-negative densities. The first round uses only pixels that see the surface directly.

If the images differ in exposure or white balance, their gains are unknowns of the same system: a
pixel is linearised by the radiance and by the logarithm of its image's gain. The mean of these
logarithms is 0.
"""

import functools
import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import SATURATED, Space
from refref_jax.compilation import jit_quickly
from refref_jax.render import backdrop, images, learned_media, pixels
from refref_jax.render.backdrop import Mips, Pyramid
from refref_jax.render.learned_media import LearnedTints
from refref_jax.training import backdrop_equations
from refref_jax.training.backdrop_equations import (
    Block,
    Gains,
    System,
    Unknowns,
    exposed,
    sum_of,
)

# One error in this many determines their typical size.
_EVERY = 17

# Linear value below which sRGB has a constant slope here, or dark noise would weigh most.
_DARK = 2e-3

# Residuals, in units of their typical size, beyond which a pixel loses weight (Huber), and the
# smallest typical residual: the rounding of 8 bits.
_TYPICAL, _ROUNDING = 3.0, 0.5 / 255.0

ROUND = 8
"""Number of iterations with the same weights of the pixels."""

# Weight of the logarithm of a gain, relative to that of the details: images of separate parts of
# the surface have no common scale.
_GAIN_PRIOR = 10.0

# Weight of the derivatives of the radiance by the direction, relative to that of the details.
_VIEW_PRIOR = 10.0

# First rounds take at least this many pixels, also of a coarse surface.
_FEWEST_PIXELS = 200_000

# Factor by which the weight of the pixels of earlier rounds falls in every round.
_FADES = 0.5

# Most Gauss-Newton steps of the tints in a round, and the change of a density that ends them; most
# pixels of a block that determine them.
_TINT_STEPS, _TINT_CHANGE, _MOST_TINTED = 8, 1e-4, 200_000


_Arrays = TypeVar("_Arrays")


class Progress(NamedTuple):
    """State after an iteration.

    Attributes:
      step: number of iterations.
      pyramid: radiance of each level.
      tints: learned tints and absorption, if any.
      gains: logarithm of the gain of each image and channel, if they are learned.
      held: weight with which the next round keeps to the radiance, if rounds have other pixels.
      fitted: PSNR of the fitted pixels, dB.
      held_out: PSNR of the held-out pixels, dB.
    """

    step: int
    pyramid: Pyramid
    tints: LearnedTints | None
    gains: Gains | None
    held: Pyramid | None
    fitted: float
    held_out: float


@jax.jit
def _weights(predicted: Array, block: Block, typical: float | Array) -> Float[Array, "pixels 3"]:
    """Returns the squared weight of each pixel and channel, which is 0 where it is held out."""
    slope = 1.055 / 2.4 * jnp.maximum(block.linear, _DARK) ** (1.0 / 2.4 - 1.0)
    residual = pixels.linear_to_srgb(predicted) - block.srgb
    difference = predicted - block.linear
    # The secant gives the sRGB residual exactly; near 0 it is the tangent.
    secant = jnp.where(jnp.abs(difference) > 1e-3, jnp.abs(residual / difference), slope)
    secant = jnp.minimum(secant, jnp.max(slope, initial=0.0))
    huber = jnp.minimum(1.0, _TYPICAL * typical / jnp.maximum(jnp.abs(residual), 1e-6))
    bright = (block.srgb >= SATURATED) & (predicted >= block.linear)
    return jnp.where(bright, 0.0, huber * jnp.square(secant)) * block.kept[:, None]


@jit_quickly
def _residuals(block: Block, predicted: Array) -> tuple[Array, Array, Array]:
    """Returns the sums of squared sRGB errors of fitted and of held-out pixels; all errors."""
    error = jnp.clip(pixels.linear_to_srgb(predicted), 0.0, 1.0) - block.srgb
    squared = jnp.mean(jnp.square(error), axis=-1)
    return jnp.sum(squared * block.kept), jnp.sum(squared * (1.0 - block.kept)), jnp.abs(error)


def _dot(a: Unknowns, b: Unknowns) -> Array:
    """Returns the inner product of each channel."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    products = [jnp.sum(x * y, axis=(0, 1, 2)).reshape(-1, 3) for x, y in pairs]
    return functools.reduce(jnp.add, [jnp.sum(each, axis=0) for each in products])


@jax.jit
def _add_scaled(a: _Arrays, scale: Float[Array, "3"], b: _Arrays) -> _Arrays:
    """Returns `a + scale b`, with a scale for each channel."""

    def add(x: Array, y: Array) -> Array:
        return x + jnp.broadcast_to(jnp.tile(scale, y.shape[-1] // 3), y.shape) * y

    return jax.tree.map(add, a, b)


class _Priors(NamedTuple):
    """What is known of the unknowns without the pixels.

    Attributes:
      weights: weight of the difference from `usual`.
      usual: value of unknowns that no pixel sees: the mean of all pixels, and gains of 1.
      held: weight of the difference from the start, for pixels of earlier rounds; 0 without them.
    """

    weights: Unknowns
    usual: Unknowns
    held: Unknowns


class _Search(NamedTuple):
    """State of conjugate gradients: `rho` is the residual's product with itself over the diagonal.

    Each channel is a system of its own.
    """

    x: Unknowns
    residual: Unknowns
    direction: Unknowns
    rho: Float[Array, "3"]


@jit_quickly
def _begin_search(
    x: Unknowns, gradient: Unknowns, scales: Unknowns, priors: _Priors
) -> tuple[_Search, Unknowns, Unknowns]:
    """Returns the state before the first step, the weights of the priors, and the diagonal.

    The pixels add their negative gradient and the scales of the unknowns.
    """
    ridge = jax.tree.map(jnp.add, priors.weights, priors.held)
    diagonal = jax.tree.map(jnp.add, scales, ridge)
    residual = jax.tree.map(
        lambda a, weight, b, c: a - weight * (b - c), gradient, priors.weights, x, priors.usual
    )
    direction = jax.tree.map(jnp.divide, residual, diagonal)
    return _Search(x, residual, direction, _dot(residual, direction)), ridge, diagonal


@jit_quickly
def _advance(
    state: _Search, image: Unknowns, ridge: Unknowns, diagonal: Unknowns
) -> tuple[_Search, Float[Array, "3"]]:
    """Takes one step, given what the pixels make of its direction; returns its length, too."""
    x, residual, direction, rho = state
    image = jax.tree.map(lambda a, weight, b: a + weight * b, image, ridge, direction)
    curvature = _dot(direction, image)
    alpha = jnp.where(curvature > 0.0, rho / jnp.where(curvature > 0.0, curvature, 1.0), 0.0)
    x = _add_scaled(x, alpha, direction)
    residual = _add_scaled(residual, -alpha, image)
    scaled = jax.tree.map(jnp.divide, residual, diagonal)
    after = _dot(residual, scaled)
    beta = jnp.where(rho > 0.0, after / jnp.where(rho > 0.0, rho, 1.0), 0.0)
    direction = _add_scaled(scaled, beta, direction)
    return _Search(x, residual, direction, after), alpha


def solve(
    blocks: Sequence[Block] | Callable[[int], Sequence[Block]],
    *,
    space: Space,
    resolution: int,
    iterations: int,
    start: tuple[int, Pyramid] | None = None,
    tints: LearnedTints | None = None,
    gains: Gains | None = None,
    held: Pyramid | None = None,
    uniform: Pyramid | None = None,
    prior: float = 1e-3,
    tint_decay: float = 0.0,
    thinned_rounds: int = 2,
) -> Iterator[Progress]:
    """Yields the state after each iteration.

    Each `ROUND` of iterations depends only on the radiance, tints and gains at its start: a run
    that is continued from there is the same as one without a pause.

    Args:
      blocks: equations of all views; or a function of the number of a round to its equations, where
        all of them do not fit in memory. A round then also keeps to its start, the more so the more
        pixels of earlier rounds have seen a vertex.
      space: kind of the surface.
      resolution: number of cells per side of a face.
      iterations: number of iterations.
      start: number of iterations, a multiple of `ROUND`, and radiance of an earlier run.
      tints: tints and absorption to begin with, if they are learned.
      gains: logarithm of the gain of each image to begin with, if they are learned.
      held: weight with which the radiance of an earlier run with other pixels is kept.
      uniform: radiance of vertices that no pixel sees, which must be given with a function; by
        default that of a surface with the mean colour of the pixels.
      prior: weight of the details of the pyramid, relative to a pixel's squared sRGB error.
      tint_decay: weight of the optical density of tints and absorption, relative to the mean
        squared sRGB error.
      thinned_rounds: number of first rounds that take only as many pixels as there are vertices.

    Raises:
      ValueError: if `blocks` is a function, and `uniform` is not given.
    """
    if callable(blocks):
        if uniform is None:
            raise ValueError("Equations of each round need the radiance `uniform`. Give it.")
        draw, tinted, thinned_rounds = blocks, None, 0
    else:
        every, mean = blocks, _mean_colour(blocks)
        axes = blocks[0].lookups.directions.shape[1]
        uniform = uniform or backdrop.init(resolution, radiance=mean, axes=axes)
        fewer = _thinned(blocks, uniform[-1][..., 0].size) if thinned_rounds else blocks
        draw = functools.partial(_first_fewer, every, fewer, thinned_rounds)
        tinted = None if tints is None else [_tinted(block) for block in blocks]
    streams, known = callable(blocks), _Known(space, resolution, uniform, prior, tint_decay)
    del blocks
    step, levels = start or (0, uniform)
    state = Progress(step, levels, tints, gains, held, math.nan, math.nan)
    while state.step < iterations:
        number, count = state.step // ROUND, min(ROUND, iterations - state.step)
        # Nothing here refers to the equations of a round: they are freed before the next ones.
        state = yield from _round(draw(number), tinted, known, state, count, streams)


class _Known(NamedTuple):
    """What is the same in all rounds; see `solve`."""

    space: Space
    resolution: int
    uniform: Pyramid
    prior: float
    tint_decay: float


def _mean_colour(blocks: Sequence[Block]) -> Float[Array, "3"]:
    return jnp.mean(jnp.stack([jnp.mean(block.linear, axis=0) for block in blocks]), axis=0)


def _first_fewer(
    every: Sequence[Block], fewer: Sequence[Block], rounds: int, number: int
) -> Sequence[Block]:
    """Returns the equations of a round, fewer in the first ones."""
    return fewer if number < rounds else every


def _round(
    blocks: Sequence[Block],
    tinted: Sequence[Block] | None,
    known: _Known,
    state: Progress,
    count: int,
    streams: bool,
) -> Generator[Progress, None, Progress]:
    """Takes a round of iterations, with the same weights of the pixels.

    Args:
      blocks: equations of the round.
      tinted: equations that tints are learned from; by default those of the round.
      known: values that are the same in all rounds.
      state: state at the start.
      count: number of iterations.
      streams: whether the next round has other equations.

    Returns:
      The last state.
    """
    space, resolution, step = known.space, known.resolution, state.step
    tints, gains, held, levels = state.tints, state.gains, state.held, state.pyramid
    typical = math.inf
    if step:
        seen = System(blocks, space, resolution, tints, gains).see(levels)
        _, _, typical = _measure(blocks, seen)
        if tints is not None:
            behind = tinted or [_tinted(block) for block in blocks]
            brightened, mips = [exposed(b, gains) for b in behind], images.mipmap(levels, space)
            decay = known.tint_decay
            tints = _fit_tints(brightened, mips, tints, typical=typical, decay=decay)
    system = System(blocks, space, resolution, tints, gains)
    seen = system.see(levels)
    expected = seen if step else [block.linear for block in blocks]
    weights = [_weights(e, b, typical) for e, b in zip(expected, blocks, strict=True)]
    if tints is not None and not step:
        weights = [w * _is_direct(b) for w, b in zip(weights, blocks, strict=True)]
    if step:  # the radiance is no longer uniform, and explains most of the images
        system.linearise(seen)
    priors = _priors(system, known.uniform, known.prior, held)
    steps = _search(system, levels, weights, seen, priors)
    if streams:
        held = _add_seen(held, system.diagonal(weights).levels)
    for x, found in itertools.islice(steps, count):
        fitted, held_out, _ = _measure(blocks, found)
        changed = None if gains is None else system.gains(x)
        state = Progress(state.step + 1, x.levels, tints, changed, held, fitted, held_out)
        yield state
    return state


def _priors(system: System, uniform: Pyramid, prior: float, held: Pyramid | None) -> _Priors:
    each = [prior if i else 1e-2 * prior for i in range(len(uniform))]
    extra = uniform[0].shape[-1] - 3
    by_channel = [_VIEW_PRIOR * prior] * extra
    weights = Unknowns(
        tuple(jnp.array([[[[w] * 3 + by_channel]]] if extra else w, jnp.float32) for w in each),
        jnp.float32(_GAIN_PRIOR * prior),
    )
    nothing = jnp.zeros(())
    return _Priors(
        weights,
        system.usual(uniform),
        Unknowns(held or (nothing,) * len(uniform), nothing),
    )


def _add_seen(held: Pyramid | None, seen: Pyramid) -> Pyramid:
    """Returns the weight with which the next round keeps to the radiance of earlier ones."""
    if held is None:
        return jax.tree.map(lambda x: _FADES * x, seen)
    return jax.tree.map(lambda x, y: _FADES * (x + y), held, seen)


def _search(
    system: System, levels: Pyramid, weights: list[Array], seen: list[Array], priors: _Priors
) -> Iterator[tuple[Unknowns, list[Array]]]:
    """Yields the unknowns, and the colours of the pixels, after each step of conjugate gradients.

    Args:
      system: linear function from the unknowns to the pixels.
      levels: radiance at the start.
      weights: squared weight of each pixel and channel.
      seen: colours of the pixels at the start.
      priors: priors of the unknowns.
    """
    blocks, x = system.blocks, system.present(levels)
    gap = [w * (b.linear - s) for w, b, s in zip(weights, blocks, seen, strict=True)]
    gradient, scales = system.transpose(gap), system.diagonal(weights)
    state, ridge, diagonal = _begin_search(x, gradient, scales, priors)
    while True:
        moved = system.change(state.direction)
        image = system.transpose([w * m for w, m in zip(weights, moved, strict=True)])
        state, alpha = _advance(state, image, ridge, diagonal)
        seen = _add_scaled(seen, alpha, moved)
        yield state.x, seen


def _thinned(blocks: Sequence[Block], vertices: int) -> Sequence[Block]:
    """Returns the equations of as many pixels as there are finest vertices, or all of them."""
    total = sum(len(block.srgb) for block in blocks)
    one_in = max(1, total // max(vertices, _FEWEST_PIXELS))
    return blocks if one_in == 1 else [backdrop_equations.thinned(b, one_in) for b in blocks]


def coverage(
    blocks: Sequence[Block], *, space: Space, resolution: int, tints: LearnedTints | None = None
) -> Float[Array, "6 side side"]:
    """Returns how many fitted pixels see each vertex: the sum of its weights in all of them.

    The weights of a pixel add up to the throughput of its paths, the mean of the channels. A vertex
    with 0 was never seen: it continues its surroundings. If pixels have independent errors of
    deviation `sigma`, in linear light, a vertex has a standard error of at least
    `sigma / sqrt(coverage)`, since no weight exceeds 1.

    Args:
      blocks: equations of all views.
      space: kind of the surface.
      resolution: number of cells per side of a face.
      tints: tints and absorption, if they are learned.
    """
    kept = [jnp.broadcast_to(block.kept[:, None], block.srgb.shape) for block in blocks]
    finest = System(blocks, space, resolution, tints, None).transpose(kept).levels[-1]
    return jnp.mean(finest[..., :3], axis=-1)


# ---- Learned tints ----


@jit_quickly
def _is_direct(block: Block) -> Float[Array, "pixels 1"]:
    """Returns 1 for pixels none of whose light has met a part, else 0."""
    met = jnp.max(block.crossings, axis=-1, initial=0.0)
    most = jax.ops.segment_max(met, block.lookups.pixels, num_segments=block.srgb.shape[0])
    return (most <= 0.0).astype(met.dtype)[:, None]


def _tinted(block: Block) -> Block:
    """Returns the equations of the pixels behind parts; of some, if there are very many."""
    behind = np.flatnonzero(np.asarray(_is_direct(block))[:, 0] == 0.0)
    chosen = behind[:: max(1, len(behind) // _MOST_TINTED)]
    return backdrop_equations.of_pixels(block, chosen)


def _fit_tints(
    blocks: Sequence[Block], mips: Mips, tints: LearnedTints, *, typical: float, decay: float
) -> LearnedTints:
    """Returns the non-negative densities that fit best behind a surface of given radiance."""
    seen = [_radiance(mips, block) for block in blocks]
    densities = np.asarray(learned_media.densities(tints), np.float64)
    penalty = decay * sum(len(block.srgb) for block in blocks) / len(densities)
    for _ in range(_TINT_STEPS):
        now = jax.device_put(densities.astype(np.float32))
        found = [_tint_equations(now, s, b, typical) for s, b in zip(seen, blocks, strict=True)]
        normal, right = (np.asarray(x, np.float64) for x in sum_of(found))
        right = right + np.einsum("ckl,lc->ck", normal, densities) - penalty
        before = densities
        densities = np.stack(
            [learned_media.non_negative(*pair) for pair in zip(normal, right, strict=True)], 1
        )
        if np.max(np.abs(densities - before)) < _TINT_CHANGE:
            break
    return learned_media.of_densities(jax.device_put(densities.astype(np.float32)))


@jit_quickly
def _radiance(mips: Mips, block: Block) -> Float[Array, "paths 3"]:
    return backdrop.radiance(mips, block.lookups)


@jit_quickly
def _tint_equations(
    densities: Float[Array, "unknowns 3"],
    seen: Float[Array, "paths 3"],
    block: Block,
    typical: float | Array,
) -> tuple[Float[Array, "3 unknowns unknowns"], Float[Array, "3 unknowns"]]:
    """Returns normal matrix and right-hand side of a Gauss-Newton step, for each channel."""
    light = block.lookups.throughput * jnp.exp(numerics.product(-block.crossings, densities)) * seen

    def summed(light: Array) -> Array:
        return jax.ops.segment_sum(light, block.lookups.pixels, num_segments=block.srgb.shape[0])

    predicted = summed(light)
    weights = _weights(predicted, block, typical)
    slopes = jax.lax.map(lambda each: -summed(each[:, None] * light), block.crossings.T)
    exact = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    normal = exact("kpc,lpc->ckl", weights[None] * slopes, slopes)
    return normal, exact("kpc,pc->ck", slopes, weights * (block.linear - predicted))


def _measure(blocks: Sequence[Block], seen: Sequence[Array]) -> tuple[float, float, float]:
    """Returns the PSNR of fitted and of held-out pixels, and the typical error of a pixel."""
    kept = float(sum(np.sum(np.asarray(block.kept)) for block in blocks))
    total = sum(block.kept.size for block in blocks)
    measured = [_residuals(b, s) for b, s in zip(blocks, seen, strict=True)]
    fitted = float(sum(m[0] for m in measured)) / kept
    # Without held-out pixels, their error is unknown.
    held_out = float(sum(m[1] for m in measured)) / (total - kept) if total > kept else math.nan
    some = np.concatenate([np.asarray(m[2]).reshape(-1)[::_EVERY] for m in measured])
    typical = float(np.median(some))
    decibels = [float(-10.0 * np.log10(np.maximum(x, 1e-12))) for x in (fitted, held_out)]
    return decibels[0], decibels[1], max(1.4826 * typical, _ROUNDING)
