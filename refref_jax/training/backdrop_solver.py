"""Determines the radiance of a far field surface from training pixels, by linear least squares.

The pixels are linear functions of the surface (`render.backdrop`), so its radiance has one best
value, which is found without a learning rate: by conjugate gradients on the normal equations, with
a diagonal preconditioner on the levels of the pyramid. Nothing is stored but where light paths end.

The error that is minimised is that of sRGB colours. Every few iterations each pixel's equation gets
a new weight, such that its linear residual becomes the sRGB one (an iteratively reweighted
Gauss-Newton method); saturated pixels that are predicted brighter, and outliers, such as pixels on
outlines, lose their weight. A weak prior on the details of the pyramid determines vertices that no
pixel sees: they continue their surroundings smoothly.

A fraction of the pixels is held out; their error decides when to stop.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from refref_jax.choices import Space
from refref_jax.geometry import cameras as cameras_module
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays
from refref_jax.numerics import host_array
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.path_settings import PathSettings
from refref_jax.optics.scene import Scene
from refref_jax.render import backdrop, images, pixels
from refref_jax.render.backdrop import Lookups, Mips, Pyramid
from refref_jax.sampling.scene_bounds import Domain

# One error in this many determines their typical size.
_EVERY = 17

# One pixel in this many is held out.
_HELD_OUT = 50

# Linear value below which the slope of sRGB is taken to be constant, or noise in the dark would
# have most of the weight.
_DARK = 2e-3

# An 8-bit value at or above this one is saturated.
_SATURATED = 254.5 / 255.0

# Residuals, in units of their typical size, beyond which a pixel loses weight (Huber).
_TYPICAL = 3.0

# Smallest typical residual: the rounding of 8 bits.
_ROUNDING = 0.5 / 255.0

ROUND = 8
"""Number of iterations with the same weights of the pixels."""

PRIOR = 1e-3
"""Weight of the details of the pyramid."""

# A round that improves the held-out pixels by less, in dB, is the last.
_WORTH = 0.02

# Patches per edge of an image, and the mean sRGB error of a patch that does not fit.
_PATCHES, _MISFIT = 16, 0.05

MOST_MISFITS = 5e-3
"""Share of misfits beyond which the far field is not the surface; see `misfits`."""


_Arrays = TypeVar("_Arrays")
_Result = TypeVar("_Result")


class Block(NamedTuple):
    """The equations of some views.

    Attributes:
      lookups: points of the surface that the views' light paths end on.
      linear: linear RGB of the pixels.
      srgb: sRGB of the pixels.
      kept: 1 for pixels that are fitted, 0 for those that are held out.
    """

    lookups: Lookups
    linear: Float[Array, "pixels 3"]
    srgb: Float[Array, "pixels 3"]
    kept: Float[Array, " pixels"]


class Progress(NamedTuple):
    """State after an iteration.

    Attributes:
      step: number of iterations.
      pyramid: radiance of each level.
      fitted: PSNR of the fitted pixels, dB.
      held_out: PSNR of the held-out pixels, dB.
    """

    step: int
    pyramid: Pyramid
    fitted: float
    held_out: float


@functools.partial(jax.jit, static_argnames=("settings", "domain", "resolution", "most_taps"))
def _look(
    scene: Scene,
    rays: Rays,
    *,
    settings: PathSettings,
    domain: Domain,
    resolution: int,
    most_taps: int,
) -> Lookups:
    """Returns where the paths of rays end; their pixels are the indices of the rays."""
    traced = path_tracing.trace_ends(scene, rays, settings=settings, footprint="differential")
    ends = traced.ends
    throughput = jnp.where(light_paths.exists(ends)[:, None], ends.throughput, 0.0)
    ends = ends._replace(throughput=throughput)
    return backdrop.locate(domain, ends, ends.rays, resolution=resolution, most_taps=most_taps)


def read_equations(
    scene: Scene,
    cameras: Cameras,
    photographs: UInt8[np.ndarray, "views h w 3"],
    *,
    settings: PathSettings,
    domain: Domain,
    resolution: int,
    most_taps: int = 3,
    side: int = 1,
    blocks: int = 2,
    progress: Callable[[int, int], None] = lambda view, total: None,
) -> tuple[Block, ...]:
    """Traces the training pixels, and returns their equations.

    Args:
      scene: the scene.
      cameras: cameras of the views.
      photographs: training images, 8-bit sRGB.
      settings: path settings.
      domain: scene bounds; their `space` is the kind of the surface.
      resolution: number of cells per side of a face.
      most_taps: largest number of taps along each axis of a ray's footprint.
      side: number of rays along each edge of a pixel.
      blocks: number of blocks that the views are split into; they are traced and solved at once.
      progress: function called after each view, from several threads.
    """
    scene = jax.device_put(scene)
    shape = photographs.shape[1] * photographs.shape[2]
    group = max(1, images.TILE // (shape * side**2))
    done = itertools.count(1)

    def trace(views: Int[np.ndarray, " views"]) -> Block:
        lookups = []
        for start in range(0, len(views), group):
            rays, names = _rays(cameras, views[start : start + group], side)
            tile = images.size_for(names.size, most=images.TILE)
            for first in range(0, names.size, tile):
                part, _ = images.crop(rays, None, first, tile)
                seen = jax.device_get(
                    _look(
                        scene,
                        part,
                        settings=settings,
                        domain=domain,
                        resolution=resolution,
                        most_taps=most_taps,
                    )
                )
                # The last tile is filled up with rays that belong to no pixel.
                real = (seen.taps > 0) & (seen.pixels < names.size - first)
                seen = jax.tree.map(lambda x, real=real: x[real], seen)
                pixel = start * shape + names[first + seen.pixels]
                lookups.append(seen._replace(pixels=pixel.astype(np.int32)))
            for _ in views[start : start + group]:
                progress(next(done), len(photographs))
        joined = jax.tree.map(lambda *each: np.concatenate(each), *lookups)
        joined = joined._replace(throughput=joined.throughput / side**2)
        return _block(joined, photographs[views], seed=int(views[0]))

    split = np.array_split(np.arange(len(photographs)), min(blocks, len(photographs)))
    return tuple(jax.device_put(block) for block in _at_once(trace, split))


def _at_once(function: Callable[..., _Result], *each: Sequence[Any]) -> list[_Result]:
    """Returns the results of a function for each block; a CPU runs as many as it has cores."""
    with ThreadPoolExecutor(len(each[0])) as threads:
        return list(threads.map(function, *each))


def _rays(
    cameras: Cameras, views: Int[np.ndarray, " views"], side: int
) -> tuple[Rays, Int[np.ndarray, " rays"]]:
    """Returns all rays of some views, and the index of each ray's pixel."""
    fine = cameras_module.supersample(cameras, side)
    each = [cameras_module.image_rays(fine, int(view)) for view in views]
    rays = jax.tree.map(lambda *x: np.concatenate([y.reshape(-1, *y.shape[2:]) for y in x]), *each)
    pixel = cameras_module.strata(cameras, side)[..., 0].reshape(-1)
    shape = cameras.height * cameras.width
    return rays, np.concatenate([number * shape + pixel for number in range(len(views))])


def _block(lookups: Lookups, photographs: UInt8[np.ndarray, "views h w 3"], seed: int) -> Block:
    """Returns the equations of some views; the seed draws the pixels that are held out."""
    srgb = host_array(photographs.reshape(-1, 3).astype(np.float32) / 255.0)
    held_out = np.random.default_rng(seed).integers(_HELD_OUT, size=len(srgb)) == 0
    linear = pixels.srgb_to_linear(jax.device_put(srgb))
    return Block(lookups, linear, srgb, host_array(np.float32(~held_out)))


@jax.jit
def _weights(predicted: Array, block: Block, typical: float | Array) -> Float[Array, "pixels 3"]:
    """Returns the squared weight of each pixel and channel, which is 0 where it is held out."""
    slope = 1.055 / 2.4 * jnp.maximum(block.linear, _DARK) ** (1.0 / 2.4 - 1.0)
    residual = pixels.linear_to_srgb(predicted) - block.srgb
    difference = predicted - block.linear
    # The secant gives the sRGB residual exactly; near 0 it is the tangent.
    secant = jnp.where(jnp.abs(difference) > 1e-3, jnp.abs(residual / difference), slope)
    secant = jnp.minimum(secant, jnp.max(slope))
    huber = jnp.minimum(1.0, _TYPICAL * typical / jnp.maximum(jnp.abs(residual), 1e-6))
    bright = (block.srgb >= _SATURATED) & (predicted >= block.linear)
    return jnp.where(bright, 0.0, huber * jnp.square(secant)) * block.kept[:, None]


@functools.partial(jax.jit, static_argnames="space")
def _mipmap(pyramid: Pyramid, space: Space) -> Mips:
    return backdrop.mipmap(pyramid, space)


@functools.partial(jax.jit, static_argnames="space")
def _mipmap_transposed(mips: Mips, space: Space) -> Pyramid:
    """Returns the transpose of `mipmap`."""
    like = tuple(jnp.zeros_like(mip) for mip in mips[::-1])
    return jax.linear_transpose(lambda x: backdrop.mipmap(x, space), like)(mips)[0]


@jax.jit
def _predict(mips: Mips, block: Block) -> Float[Array, "pixels 3"]:
    return backdrop.colours(mips, block.lookups, pixels=block.srgb.shape[0])


@functools.partial(jax.jit, static_argnames="resolution")
def _transposed(slopes: Array, block: Block, *, resolution: int) -> Mips:
    return backdrop.transposed(slopes, block.lookups, resolution=resolution)


@jax.jit
def _residuals(block: Block, predicted: Array) -> tuple[Array, Array, Array]:
    """Returns the sums of squared sRGB errors of fitted and of held-out pixels; all errors."""
    error = jnp.clip(pixels.linear_to_srgb(predicted), 0.0, 1.0) - block.srgb
    squared = jnp.mean(jnp.square(error), axis=-1)
    return jnp.sum(squared * block.kept), jnp.sum(squared * (1.0 - block.kept)), jnp.abs(error)


def _dot(a: Pyramid, b: Pyramid) -> Array:
    """Returns the inner product of each channel."""
    products = [jnp.sum(x * y, axis=(0, 1, 2)) for x, y in zip(a, b, strict=True)]
    return functools.reduce(jnp.add, products)


def _sum(parts: Sequence[_Arrays]) -> _Arrays:
    return jax.tree.map(lambda *x: functools.reduce(jnp.add, x), *parts)


@jax.jit
def _add_scaled(a: _Arrays, scale: Float[Array, "3"], b: _Arrays) -> _Arrays:
    """Returns `a + scale b`, with a scale for each channel."""
    return jax.tree.map(lambda x, y: x + jnp.broadcast_to(scale, y.shape) * y, a, b)


@jax.jit
def _begin_search(residual: Pyramid, diagonal: Pyramid) -> tuple[Pyramid, Array]:
    direction = jax.tree.map(jnp.divide, residual, diagonal)
    return direction, _dot(residual, direction)


@jax.jit
def _advance(
    x: Pyramid, residual: Pyramid, direction: Pyramid, image: Pyramid, diagonal: Pyramid, rho: Array
) -> tuple[Pyramid, Pyramid, Pyramid, Array, Array]:
    """Takes one step of conjugate gradients; each channel is a system of its own."""
    curvature = _dot(direction, image)
    alpha = jnp.where(curvature > 0.0, rho / jnp.where(curvature > 0.0, curvature, 1.0), 0.0)
    x = _add_scaled(x, alpha, direction)
    residual = _add_scaled(residual, -alpha, image)
    scaled = jax.tree.map(jnp.divide, residual, diagonal)
    after = _dot(residual, scaled)
    beta = jnp.where(rho > 0.0, after / jnp.where(rho > 0.0, rho, 1.0), 0.0)
    direction = _add_scaled(scaled, beta, direction)
    return x, residual, direction, after, alpha


def solve(
    blocks: Sequence[Block],
    *,
    space: Space,
    resolution: int,
    iterations: int,
    start: tuple[int, Pyramid] | None = None,
    prior: float = PRIOR,
) -> Iterator[Progress]:
    """Yields the state after each iteration; it may stop earlier than asked.

    After every `ROUND` iterations the pixels get new weights, and the search starts again from the
    radiance alone: a run that is continued from there is the same as one without a pause.

    Args:
      blocks: equations of all views.
      space: kind of the surface.
      resolution: number of cells per side of a face.
      iterations: largest number of iterations.
      start: number of iterations, a multiple of `ROUND`, and radiance of an earlier run.
      prior: weight of the details of the pyramid, relative to a pixel's squared sRGB error.
    """
    mean = jnp.mean(jnp.stack([jnp.mean(block.linear, axis=0) for block in blocks]), axis=0)
    uniform = backdrop.init(resolution, radiance=mean)
    step, x = start or (0, uniform)
    priors = tuple(jnp.float32(prior if i else 1e-2 * prior) for i in range(len(x)))

    def look(block: Block, mips: Mips) -> Array:
        return jax.block_until_ready(_predict(mips, block))

    def spread(slopes: Array, block: Block) -> Mips:
        return jax.block_until_ready(_transposed(slopes, block, resolution=resolution))

    def transpose(slopes: list[Array]) -> Pyramid:
        parts = _at_once(spread, slopes, blocks)
        return _mipmap_transposed(_sum(parts), space)

    def predict(x: Pyramid) -> list[Array]:
        mips = _mipmap(x, space)
        return _at_once(look, blocks, [mips] * len(blocks))

    while step < iterations:
        seen, before, typical = predict(x), -math.inf, math.inf
        if step:
            _, before, typical = _measure(blocks, seen)
        expected = seen if step else [block.linear for block in blocks]
        weights = [_weights(e, b, typical) for e, b in zip(expected, blocks, strict=True)]
        diagonal = jax.tree.map(lambda ours, weight: ours + weight, transpose(weights), priors)
        gap = [w * (b.linear - s) for w, b, s in zip(weights, blocks, seen, strict=True)]
        # The prior of vertices that no pixel sees is the mean of all pixels.
        residual = jax.tree.map(
            lambda a, weight, b, c: a - weight * (b - c), transpose(gap), priors, x, uniform
        )
        direction, rho = _begin_search(residual, diagonal)
        for _ in range(min(ROUND, iterations - step)):
            moved = predict(direction)
            image = transpose([w * m for w, m in zip(weights, moved, strict=True)])
            image = jax.tree.map(lambda a, weight, b: a + weight * b, image, priors, direction)
            x, residual, direction, rho, alpha = _advance(
                x, residual, direction, image, diagonal, rho
            )
            seen = _add_scaled(seen, alpha, moved)
            step += 1
            fitted, held_out, _ = _measure(blocks, seen)
            yield Progress(step, x, fitted, held_out)
        if held_out < before + _WORTH:
            return


def misfits(
    blocks: Sequence[Block], pyramid: Pyramid, *, space: Space, shape: tuple[int, int]
) -> float:
    """Returns the share of patches of the images that see the surface directly, but differ from it.

    Errors at details of a texture average out over a patch. Those of something in front of the
    surface do not, nor those of a surface of another size: they have parallax.

    Args:
      blocks: equations of all views, with one ray per pixel.
      pyramid: radiance of each level.
      space: kind of the surface.
      shape: height and width of the images.

    Returns:
      The share among the patches whose rays all meet no object; 0 if there are none.
    """
    mips, (height, width) = _mipmap(pyramid, space), shape
    edge = max(1, min(shape) // _PATCHES)
    rows, columns = height // edge, width // edge
    patches = (-1, rows, edge, columns, edge)

    def averaged(values: np.ndarray) -> np.ndarray:
        images = values.reshape(-1, height, width, values.shape[-1])
        cropped = images[:, : rows * edge, : columns * edge]
        return cropped.reshape(*patches, values.shape[-1]).mean((2, 4))

    poor = total = 0
    for block in blocks:
        seen = np.asarray(pixels.linear_to_srgb(_predict(mips, block)))
        directly = np.zeros((len(seen), 1))
        unchanged = np.all(np.asarray(block.lookups.throughput) == 1.0, axis=-1)
        directly[np.asarray(block.lookups.pixels)[unchanged]] = 1.0
        error = np.abs(averaged(np.clip(seen, 0.0, 1.0) - np.asarray(block.srgb))).max(-1)
        judged = averaged(directly)[..., 0] == 1.0
        poor, total = poor + np.sum(error[judged] > _MISFIT), total + np.sum(judged)
    return float(poor / max(total, 1))


def _measure(blocks: Sequence[Block], seen: Sequence[Array]) -> tuple[float, float, float]:
    """Returns the PSNR of fitted and of held-out pixels, and the typical error of a pixel."""
    kept = float(sum(np.sum(np.asarray(block.kept)) for block in blocks))
    total = sum(block.kept.size for block in blocks)
    measured = [_residuals(b, s) for b, s in zip(blocks, seen, strict=True)]
    fitted = float(sum(m[0] for m in measured)) / kept
    held_out = float(sum(m[1] for m in measured)) / max(total - kept, 1.0)
    some = np.concatenate([np.asarray(m[2]).reshape(-1)[::_EVERY] for m in measured])
    typical = float(np.median(some))
    decibels = [-10.0 * np.log10(max(x, 1e-12)) for x in (fitted, held_out)]
    return decibels[0], decibels[1], max(1.4826 * typical, _ROUNDING)
