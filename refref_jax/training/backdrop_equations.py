"""Equations of training pixels for a far field surface: where light paths end, and colours.

The paths of all training views are traced once, and nothing is kept but their ends as points of
the surface (`backdrop.locate`), what learned tints read of them, and the pixels' colours. Rays that
meet no object are straight and are not traced. A fraction of the pixels is held out.

`System` is the function from the unknowns to the colours of all pixels, and its transpose.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from refref_jax.choices import Space
from refref_jax.compilation import at_once, jit_quickly
from refref_jax.geometry import cameras as cameras_module
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays
from refref_jax.numerics import host_array
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import STRAIGHT, PathSettings, Tally
from refref_jax.render import backdrop, images, learned_media, pixels
from refref_jax.render.backdrop import Lookups, Mips, Pyramid
from refref_jax.render.learned_media import LearnedTints
from refref_jax.render.pixels import BackdropEnds
from refref_jax.sampling.scene_bounds import Domain, OccupancyGrid

# One pixel in this many is held out.
_HELD_OUT = 50

# Seeds of draws begin with this number, which is no view's.
_DRAWS = 2**31

_Arrays = TypeVar("_Arrays")

Gains = Float[Array, "views 3"]
"""Logarithm of the gain of each image and channel."""


class Block(NamedTuple):
    """The equations of some views.

    Attributes:
      lookups: points of the surface that the views' light paths end on.
      crossings: hits and lengths per part (`learned_media.crossings`), if tints are learned.
      linear: linear RGB of the pixels.
      srgb: sRGB of the pixels.
      kept: weight of the pixels: 1 if they are fitted, 0 if they are held out.
      views: view of each pixel.
    """

    lookups: Lookups
    crossings: Float[Array, "paths unknowns"]
    linear: Float[Array, "pixels 3"]
    srgb: Float[Array, "pixels 3"]
    kept: Float[Array, " pixels"]
    views: Int[Array, " pixels"]


class Unknowns(NamedTuple):
    """What one system of equations determines.

    Attributes:
      levels: radiance of each level.
      gains: change of the logarithm of each image's gain, shaped like a level; without images if
        gains are fixed.
    """

    levels: Pyramid
    gains: Float[Array, "views 1 1 3"]


def read(
    scene: Scene,
    cameras: Cameras,
    photographs: UInt8[np.ndarray, "views h w 3"],
    *,
    settings: PathSettings,
    domain: Domain,
    resolution: int,
    most_taps: int = 3,
    axes: int = 0,
    side: int = 1,
    tally: Tally = "none",
    fields: tuple[int, ...] = (),
    blocks: int = 2,
    share: float = 1.0,
    draw: int = 0,
    among: Bool[np.ndarray, "views h w"] | None = None,
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
      axes: number of axes of the direction that the radiance depends on, 0 or 3.
      side: number of rays along each edge of a pixel.
      tally: `parts` if tints and absorption are learned.
      fields: parts whose inside is a field: pixels whose light crosses one, or ends on an opaque
        part, are left out.
      blocks: number of blocks that the views are split into; they are traced and solved at once.
      share: share of the pixels, drawn at random.
      draw: number of the draw; another one draws other pixels.
      among: mask of the pixels to read; all by default.
      progress: function called for each view, after the views that are traced with it; from several
        threads.
    """
    scene = jax.device_put(scene)
    rays_per_view = photographs.shape[1] * photographs.shape[2] * side**2
    group, done = max(1, images.RAYS_OF_A_BAND // rays_per_view), itertools.count(1)
    tile = images.tile_for(min(group, len(photographs)) * rays_per_view)

    look = functools.partial(
        images.backdrop_ends,
        scene,
        domain=domain,
        resolution=resolution,
        most_taps=most_taps,
        axes=axes,
        tally=tally,
        fields=fields,
        faint=backdrop.FAINT,
    )

    def trace(views: Int[np.ndarray, " views"]) -> Block:
        each: list[BackdropEnds] = []
        drawn = _drawn(len(views) * photographs[0, ..., 0].size, share, (draw, int(views[0])))
        drawn = drawn if among is None else drawn & among[views].reshape(-1)
        place = np.cumsum(drawn, dtype=np.int32) - 1
        for start in range(0, len(views), group):
            some = views[start : start + group]
            rays, names = cameras_module.rays_of_views(cameras, some, side)
            names = start * photographs[0, ..., 0].size + names
            kept = drawn[names]
            met = np.isfinite(images.find_first_surface(scene.surfaces, rays).distances)
            for which, bends in ((kept & ~met, STRAIGHT), (kept & met, settings)):
                chosen = jax.tree.map(lambda x, which=which: host_array(x[which]), rays)
                bent = functools.partial(look, settings=bends)
                each += _in_tiles(bent, chosen, place[names[which]], tile, side**2)
            for _ in some:
                progress(next(done), len(photographs))
        joined = jax.tree.map(lambda *parts: np.concatenate(parts), *each)
        block = _block(joined, photographs[views], views, drawn)
        if not np.any(joined.hidden):
            return block
        seen = np.setdiff1d(np.arange(len(block.srgb)), joined.lookups.pixels[joined.hidden])
        return of_pixels(block, seen)

    split = np.array_split(np.arange(len(photographs)), min(blocks, len(photographs)))
    return tuple(jax.device_put(block) for block in at_once(trace, split))


def warm_up(levels: Pyramid, space: Space) -> None:
    """Compiles the mipmap and its transpose, whose shapes do not depend on the pixels.

    XLA compiles a program on one core, so that this costs no time beside `read`.
    """
    jax.block_until_ready(_mipmap_transposed(images.mipmap(levels, space), space))


def meets(
    scene: Scene, cameras: Cameras, *, grid: OccupancyGrid | None = None
) -> Bool[np.ndarray, "views h w"]:
    """Returns which pixels' camera rays meet an object, or an occupied cell of a grid."""
    views, found = len(cameras.poses), []
    for view in range(views):
        rays, _ = cameras_module.rays_of_views(cameras, np.array([view]), 1)
        found.append(images.split_by_hit(scene.surfaces, rays, grid=grid)[0])
    return np.stack(found).reshape(views, cameras.height, cameras.width)


def _drawn(count: int, share: float, seed: tuple[int, int]) -> Bool[np.ndarray, " pixels"]:
    """Returns which pixels are drawn, independently of those that are held out."""
    if share >= 1.0:
        return np.ones(count, bool)
    return np.random.default_rng((_DRAWS, *seed)).random(count, np.float32) < share


def _in_tiles(
    look: Callable[[Rays], tuple[BackdropEnds, Array]],
    rays: Rays,
    names: Int[np.ndarray, " rays"],
    tile: int,
    rays_per_pixel: int,
) -> Iterator[BackdropEnds]:
    """Yields where the paths of rays end, tile by tile.

    Args:
      look: function of the rays of a tile, `images.backdrop_ends`.
      rays: camera rays.
      names: pixel of each ray.
      tile: number of rays per tile.
      rays_per_pixel: number of rays in each pixel, which share its light.
    """
    for first in range(0, names.size, tile):
        part, _ = images.crop(rays, None, first, tile)
        seen, _ = jax.device_get(look(part))
        # The last tile is filled up with rays that belong to no pixel.
        real = (seen.lookups.taps[:, 0] > 0) & (seen.lookups.pixels < names.size - first)
        seen = jax.tree.map(lambda x, real=real: x[real], seen)
        pixel = names[first + seen.lookups.pixels].astype(np.int32)
        throughput = seen.lookups.throughput / rays_per_pixel
        lookups = seen.lookups._replace(pixels=pixel, throughput=throughput)
        yield seen._replace(lookups=lookups)


def _block(
    seen: BackdropEnds,
    photographs: UInt8[np.ndarray, "views h w 3"],
    views: Int[np.ndarray, " views"],
    drawn: Bool[np.ndarray, " pixels"],
) -> Block:
    """Returns the equations of some views; the first one seeds which pixels are held out."""
    srgb = photographs.reshape(-1, 3)[drawn].astype(np.float32) / 255.0
    held_out = np.random.default_rng(int(views[0])).integers(_HELD_OUT, size=drawn.size) == 0
    kept, view = np.float32(~held_out[drawn]), np.repeat(views, drawn.size // len(views))[drawn]
    linear = pixels.srgb_to_linear(jax.device_put(host_array(srgb)))
    known = (srgb, kept, view.astype(np.int32))
    return Block(seen.lookups, seen.crossings, linear, *map(host_array, known))


def thinned(block: Block, one_in: int) -> Block:
    """Returns the equations of one pixel in `one_in`, drawn at random but always the same."""
    if one_in == 1:
        return block
    drawn = np.random.default_rng(0).integers(one_in, size=len(block.srgb)) == 0
    return of_pixels(block, np.flatnonzero(drawn))


def of_pixels(block: Block, chosen: Int[np.ndarray, " chosen"]) -> Block:
    """Returns the equations of some pixels, given by their indices."""
    pixel = np.asarray(block.lookups.pixels)
    place = np.full(len(block.srgb), -1, np.int32)
    place[chosen] = np.arange(len(chosen), dtype=np.int32)
    paths = place[pixel] >= 0
    lookups = jax.tree.map(lambda x: host_array(np.asarray(x)[paths]), block.lookups)
    lookups = lookups._replace(pixels=host_array(place[pixel[paths]]))
    colours = jax.tree.map(lambda x: host_array(np.asarray(x)[chosen]), block[2:])
    return Block(lookups, host_array(np.asarray(block.crossings)[paths]), *colours)


# ---- The function from the unknowns to the pixels ----


class System:
    """The function from the unknowns to the pixels: linear in the radiance, linearised in gains."""

    def __init__(
        self,
        blocks: Sequence[Block],
        space: Space,
        resolution: int,
        tints: LearnedTints | None,
        gains: Gains | None,
    ) -> None:
        """Sets up the function for present tints and gains."""
        dimmed = blocks if tints is None else [_attenuated(block, tints) for block in blocks]
        self.blocks = [exposed(block, gains) for block in dimmed]
        self._space, self._resolution = space, resolution
        self._gains = jnp.zeros((0, 3)) if gains is None else gains
        self._views = self._gains.shape[0]
        self._slopes: list[Array] = []

    def present(self, levels: Pyramid) -> Unknowns:
        """Returns unknowns that leave the gains as they are."""
        return Unknowns(levels, jnp.zeros((self._views, 1, 1, 3)))

    def usual(self, levels: Pyramid) -> Unknowns:
        """Returns unknowns that make all gains 1."""
        return Unknowns(levels, -self._gains[:, None, None])

    def gains(self, x: Unknowns) -> Gains:
        """Returns the logarithms of the gains after a change; their mean is 0."""
        return self._gains + _centred(x.gains)[:, 0, 0]

    def see(self, levels: Pyramid) -> list[Array]:
        """Returns the linear RGB of the pixels of each block, with the present gains."""
        mips = images.mipmap(levels, self._space)

        def look(block: Block) -> Array:
            return jax.block_until_ready(_predict(mips, block))

        return at_once(look, self.blocks)

    def linearise(self, seen: list[Array]) -> None:
        """Takes the colours of the pixels as their derivatives by the logarithm of the gains."""
        self._slopes = seen if self._views else []

    def change(self, x: Unknowns) -> list[Array]:
        """Returns how the linear RGB of the pixels changes with the unknowns."""
        moved = self.see(x.levels)
        if not self._slopes:
            return moved
        each = zip(moved, self.blocks, self._slopes, strict=True)
        return [m + _by_gain(b, s, x.gains) for m, b, s in each]

    def transpose(self, factors: list[Array]) -> Unknowns:
        """Returns what the pixels of all blocks add to each unknown."""
        levels = self._spread(factors, self.blocks)
        if not self._slopes:
            return self.present(levels)
        by_gain = [s * f for s, f in zip(self._slopes, factors, strict=True)]
        return Unknowns(levels, _centred(self._per_view(by_gain)))

    def diagonal(self, weights: list[Array]) -> Unknowns:
        """Returns the scales of the unknowns, from the weights of the pixels."""
        # Directions may be negative, scales may not.
        positive = [_with_positive_directions(block) for block in self.blocks]
        scales = self.present(self._spread(weights, positive))
        if not self._slopes:
            return scales
        squares = [jnp.square(s) * w for s, w in zip(self._slopes, weights, strict=True)]
        return scales._replace(gains=self._per_view(squares))

    def _spread(self, factors: list[Array], blocks: list[Block]) -> Pyramid:
        """Returns what pixels add to the levels."""

        def spread(factors: Array, block: Block) -> Mips:
            return jax.block_until_ready(_transposed(factors, block, resolution=self._resolution))

        return _mipmap_transposed(sum_of(at_once(spread, factors, blocks)), self._space)

    def _per_view(self, values: list[Array]) -> Float[Array, "views 1 1 3"]:
        """Returns the sums of values of pixels over each view."""
        each = zip(self.blocks, values, strict=True)
        return sum_of([_sum_views(b, x, self._views) for b, x in each])[:, None, None]


def exposed(block: Block, gains: Gains | None) -> Block:
    """Returns the equations with the throughput times the gain of the image."""
    return block if gains is None else _with_gains(block, gains)


@jit_quickly
def _with_gains(block: Block, gains: Gains) -> Block:
    gain = jnp.exp(gains)[block.views[block.lookups.pixels]]
    lookups = block.lookups._replace(throughput=block.lookups.throughput * gain)
    return block._replace(lookups=lookups)


def _with_positive_directions(block: Block) -> Block:
    lookups = block.lookups._replace(directions=jnp.abs(block.lookups.directions))
    return block._replace(lookups=lookups)


@jit_quickly
def _by_gain(
    block: Block, slopes: Array, gains: Float[Array, "views 1 1 3"]
) -> Float[Array, "pixels 3"]:
    """Returns how the pixels change with the logarithms of the gains, whose mean stays 0."""
    return slopes * _centred(gains)[block.views, 0, 0]


def _centred(gains: Float[Array, "views 1 1 3"]) -> Float[Array, "views 1 1 3"]:
    return gains - jnp.mean(gains, axis=0, keepdims=True)


@functools.partial(jit_quickly, static_argnames="views")
def _sum_views(block: Block, values: Array, views: int) -> Float[Array, "views 3"]:
    return jax.ops.segment_sum(values, block.views, num_segments=views)


@functools.partial(jit_quickly, static_argnames="space")
def _mipmap_transposed(mips: Mips, space: Space) -> Pyramid:
    """Returns the transpose of `mipmap`."""
    like = tuple(jnp.zeros_like(mip) for mip in mips[::-1])
    return jax.linear_transpose(lambda x: backdrop.mipmap(x, space), like)(mips)[0]


@jit_quickly
def _predict(mips: Mips, block: Block) -> Float[Array, "pixels 3"]:
    return backdrop.colours(mips, block.lookups, pixels=block.srgb.shape[0])


@functools.partial(jit_quickly, static_argnames="resolution")
def _transposed(slopes: Array, block: Block, *, resolution: int) -> Mips:
    return backdrop.transposed(slopes, block.lookups, resolution=resolution)


@jit_quickly
def _attenuated(block: Block, tints: LearnedTints) -> Block:
    """Returns the equations with the throughput that tints and absorption leave."""
    dimmed = learned_media.transmittance(tints, block.crossings)
    lookups = block.lookups._replace(throughput=block.lookups.throughput * dimmed)
    return block._replace(lookups=lookups)


@jit_quickly
def sum_of(parts: Sequence[_Arrays]) -> _Arrays:
    """Returns the sum of records of arrays."""
    return jax.tree.map(lambda *x: functools.reduce(jnp.add, x), *parts)
