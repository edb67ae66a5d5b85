"""Images of Gaussians: lists of tiles, colours and distances.

Every tile of an image has a list of the Gaussians whose boxes touch it, ordered by the depth of
their means. On a CPU, native loops count the entries of every tile, then put each into its place;
elsewhere, all entries are sorted by tile. Both keep the order by depth, so they agree.

A pixel's median distance is that of the mean of the Gaussian at which its transmittance falls to
one half, along its ray. Colours are sRGB, and so is the blending, as in all programs for splats.
This is one of the modules that call `jax.jit`.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.choices import SplatFilter
from refref_jax.compilation import (
    chosen_by_platform,
    native_loop,
    record,
    runs_on_cpu,
    with_record,
)
from refref_jax.geometry.cameras import Cameras, planar_depth_to_distance
from refref_jax.splats import gaussians as splats
from refref_jax.splats import rasterizer
from refref_jax.splats.gaussians import Gaussians, Projected, View
from refref_jax.splats.rasterizer import Blended, Grid, Lists

# Edge of a tile in pixels, on CPUs and elsewhere.
_CPU_TILE, _TILE = 8, 16

# Capacities of lists are powers of this number, so that few programs are compiled; an entry takes
# four bytes.
_RUNG = 2.0

# Background of images, sRGB, where Gaussians are transparent.
_GREY = 0.5

_State = TypeVar("_State")


def grid_of(width: int, height: int) -> Grid:
    """Returns the division of an image that is fast on this process's devices."""
    return Grid(width, height, _CPU_TILE if runs_on_cpu() else _TILE)


class _Boxes(NamedTuple):
    """Tiles that a Gaussian's box touches.

    Attributes:
      low: column and row of the first tile.
      size: number of columns and rows; 0 if the Gaussian is not visible.
    """

    low: Int[Array, "gaussians 2"]
    size: Int[Array, "gaussians 2"]


def _boxes(
    means: Float[Array, "gaussians 2"], radii: Float[Array, "gaussians 2"], grid: Grid
) -> _Boxes:
    most = jnp.asarray([[grid.columns, grid.rows]], means.dtype)
    low = jnp.clip(jnp.floor((means - radii) / grid.tile), 0, most).astype(jnp.int32)
    high = jnp.clip(jnp.ceil((means + radii) / grid.tile), 0, most).astype(jnp.int32)
    visible = jnp.all(radii > 0.0, axis=-1, keepdims=True)
    return _Boxes(low, jnp.where(visible, high - low, 0))


def count_entries(projected: Projected, grid: Grid) -> Int[Array, ""]:
    """Returns the number of entries of the lists of an image."""
    return _count(_boxes(projected.means, projected.radii, grid))


def _count(boxes: _Boxes) -> Int[Array, ""]:
    """Returns the number of entries, or the largest integer if there are more than that."""
    most = jnp.iinfo(jnp.int32).max
    fits = jnp.sum(jnp.prod(boxes.size.astype(jnp.float32), axis=1)) < 0.999 * most
    return jnp.where(fits, jnp.sum(jnp.prod(boxes.size, axis=1), dtype=jnp.int32), most)


def make_lists(projected: Projected, grid: Grid, *, capacity: int) -> Lists:
    """Returns the lists of an image; of Gaussians at equal depths, the first is in front.

    Args:
      projected: Gaussians in the image.
      grid: tiles of the image.
      capacity: capacity of all lists together, at least 1.
    """
    projected = rasterizer.at_least_two(jax.lax.stop_gradient(projected))
    boxes = _boxes(projected.means, projected.radii, grid)
    visible = boxes.size[:, 0] > 0
    order = jnp.argsort(jnp.where(visible, projected.depths, jnp.inf), stable=True)
    order, boxes = order.astype(jnp.int32), jax.tree.map(lambda x: x[order], boxes)
    return _listed(order, boxes, grid=grid, capacity=capacity)


def _sorted_lists(
    order: Int[Array, " gaussians"], boxes: _Boxes, *, grid: Grid, capacity: int
) -> Lists:
    """Returns the lists by a stable sort of all entries by their tiles."""
    counts = boxes.size[:, 0] * boxes.size[:, 1]
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    place = jnp.arange(capacity, dtype=jnp.int32)
    owner = jnp.repeat(
        jnp.arange(order.size, dtype=jnp.int32), counts, total_repeat_length=capacity
    )
    within = place - (ends - counts)[owner]
    columns = jnp.maximum(boxes.size[owner, 0], 1)
    rows = boxes.low[owner, 1] + within // columns
    tile = rows * grid.columns + boxes.low[owner, 0] + within % columns
    tile = jnp.where(place < ends[-1], tile, grid.tiles)
    tile, owner = jax.lax.sort_key_val(tile, owner, is_stable=True)
    offsets = jnp.searchsorted(tile, jnp.arange(grid.tiles + 1, dtype=jnp.int32))
    return Lists(order[owner], offsets.astype(jnp.int32), _count(boxes))


def _filled_lists(
    order: Int[Array, " gaussians"], boxes: _Boxes, *, grid: Grid, capacity: int
) -> Lists:
    """Returns the same lists by native loops: entries are counted, then put in their places."""

    @native_loop
    def count(boxes: _Boxes, counts: Array) -> Array:
        def add(tile: Array, counts: Array, _: Array) -> Array:
            return with_record(counts, tile, record(counts, tile) + 1)

        return _over_entries(boxes, counts, add, grid)

    @native_loop
    def fill(order: Array, boxes: _Boxes, places: Array, entries: Array) -> Array:
        def put(tile: Array, state: tuple[Array, Array], owner: Array) -> tuple[Array, Array]:
            places, entries = state
            place = record(places, tile)
            entries = with_record(entries, jnp.minimum(place, capacity), record(order, owner))
            return with_record(places, tile, place + 1), entries

        return _over_entries(boxes, (places, entries), put, grid)[1]

    counts = count(boxes, jnp.zeros(grid.tiles, jnp.int32))
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    # Entries past the capacity all go to one more place, which is left out.
    entries = fill(order, boxes, ends - counts, jnp.zeros(capacity + 1, jnp.int32))
    offsets = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.minimum(ends, capacity)])
    return Lists(entries[:capacity], offsets, _count(boxes))


def _over_entries(
    boxes: _Boxes, state: _State, visit: Callable[[Array, _State, Array], _State], grid: Grid
) -> _State:
    """Calls a function for every tile of every box, in order."""

    def one(owner: Array, state: _State) -> _State:
        low, size = record(boxes, owner)

        def at_row(row: Array, state: _State) -> _State:
            first = (low[1] + row) * grid.columns + low[0]
            return jax.lax.fori_loop(
                0, size[0], lambda column, state: visit(first + column, state, owner), state
            )

        return jax.lax.fori_loop(0, size[1], at_row, state)

    return jax.lax.fori_loop(0, boxes.low.shape[0], one, state)


_listed = chosen_by_platform(
    "tile_lists", cpu=_filled_lists, default=_sorted_lists, like=_sorted_lists
)


class SplatImage(NamedTuple):
    """An image of Gaussians.

    Attributes:
      rgb: sRGB colours in front of a grey background, not clipped above.
      distance: median distance along each pixel's ray, world units.
      mean_distance: weighted mean of the depths along each pixel's ray, world units.
      accumulation: 1 less the transmittance.
    """

    rgb: Float[np.ndarray, "h w 3"]
    distance: Float[np.ndarray, "h w"]
    mean_distance: Float[np.ndarray, "h w"]
    accumulation: Float[np.ndarray, "h w"]


def capacity_for(entries: float | int) -> int:
    """Returns a capacity for lists with a number of entries; few numbers are returned at all."""
    rung = math.ceil(math.log(max(entries, 1)) / math.log(_RUNG))
    return math.ceil(_RUNG**rung) + 1


@functools.partial(jax.jit, static_argnames=("grid", "kernel"))
def survey(gaussians: Gaussians, view: View, *, grid: Grid, kernel: SplatFilter) -> Array:
    """Returns the number of entries of the lists of one view."""
    size = {"width": grid.width, "height": grid.height}
    projected = splats.project_all(gaussians, view, **size, kernel=kernel, degree=0)
    return count_entries(projected, grid)


def blend(
    gaussians: Gaussians,
    view: View,
    *,
    grid: Grid,
    capacity: int,
    kernel: SplatFilter,
    degree: Float[Array, ""] | int = 3,
) -> tuple[Blended, Int[Array, ""]]:
    """Returns the image of one view, and the number of entries that its lists need.

    The image is wrong if that number is above the capacity. Differentiable, see `rasterizer`.
    """
    size = {"width": grid.width, "height": grid.height}
    projected = splats.project_all(gaussians, view, **size, kernel=kernel, degree=degree)
    lists = make_lists(projected, grid, capacity=capacity)
    return rasterizer.rasterize(projected, lists, grid), lists.total


@functools.partial(jax.jit, static_argnames=("grid", "capacity", "kernel"))
def _blend(
    gaussians: Gaussians, view: View, *, grid: Grid, capacity: int, kernel: SplatFilter
) -> Blended:
    return blend(gaussians, view, grid=grid, capacity=capacity, kernel=kernel)[0]


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    number: int,
    *,
    kernel: SplatFilter,
    beyond: Float[np.ndarray, "h w"],
) -> SplatImage:
    """Renders the image of one camera.

    Args:
      gaussians: the Gaussians.
      cameras: cameras with the resolution of the image.
      number: index of the camera.
      kernel: treatment of opacity, see `gaussians.project`.
      beyond: distance of the background along each pixel's ray, for pixels whose transmittance
        stays above one half, world units.
    """
    grid = grid_of(cameras.width, cameras.height)
    view = View(*(x[number] for x in splats.views_of(cameras)))
    entries = int(survey(gaussians, view, grid=grid, kernel=kernel))
    capacity = capacity_for(entries)
    seen = jax.device_get(_blend(gaussians, view, grid=grid, capacity=capacity, kernel=kernel))
    left, covered = seen.transmittance, 1.0 - seen.transmittance
    mean = seen.depths / np.maximum(covered, 1e-6)
    median, mean = (planar_depth_to_distance(cameras, z) for z in (seen.median_depths, mean))
    return SplatImage(
        seen.colours + left[..., None] * np.float32(_GREY),
        np.where(seen.median_depths > 0.0, median, beyond).astype(np.float32),
        np.where(covered > 0.0, mean, beyond).astype(np.float32),
        covered,
    )
