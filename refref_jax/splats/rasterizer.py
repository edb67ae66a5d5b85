"""Rasterizes projected Gaussians: lists of tiles, front-to-back blending, and its derivative.

The image is divided into square tiles. Every tile has a list of the Gaussians whose boxes touch it,
ordered by the depth of their means. A Gaussian's opacity at a pixel is
`alpha = min(0.999, o exp(-q / 2))`, where `q` is the squared Mahalanobis distance, or nothing below
1/255. From front to back, a pixel adds up `alpha T c`, where `T` is the product of `1 - alpha` of
those before, and it ends before the Gaussian that would bring `T` to 1e-4.

The derivative is computed front to back too, from the colour `C` and the transmittance `T_N` that
the image ended with: `dL/dalpha_i = T_i (c_i . g) - (S - P_i) / (1 - alpha_i)`, where `g` and `g_T`
are the derivatives with respect to `C` and `T_N`, `S = C . g + T_N g_T`, and `P_i` is the sum of
`alpha_j T_j c_j . g` up to and including `i`. So nothing is stored for each entry of a list, and
nothing is divided by a vanishing transmittance. Distances have no derivative.

On a CPU, lists and blending are native loops over tiles, entries, and vectors of pixels; elsewhere
all tiles blend their next entries at once, in chunks. Lists have a static capacity: `Lists.total`
is the number of entries that they need. If it is above the capacity, the image is wrong, and
callers must repeat it with a larger one. The capacity changes nothing else.

Sources: Kerbl et al. (2023), section 6; Zwicker et al., EWA Splatting (2002); the limits of gsplat.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from refref_jax.compilation import (
    chosen_by_platform,
    native_loop,
    record,
    with_record,
)
from refref_jax.splats.gaussians import LEAST_ALPHA, Projected

# Largest opacity at a pixel, and the transmittance at which a pixel ends.
_MOST_ALPHA, _OPAQUE = 0.999, 1e-4

# Transmittance at the median distance.
_HALF = 0.5

# Number of entries of each tile that are blended at once, but on CPUs.
_CHUNK = 32

# Numbers of a Gaussian that blending reads: mean, conic, opacity, colour and depth; all but the
# depth have a derivative.
_FEATURES, _DIFFERENTIABLE = 10, 9


class Grid(NamedTuple):
    """Division of an image into tiles.

    Attributes:
      width: width of the image, pixels.
      height: height of the image, pixels.
      tile: edge of a tile, pixels.
    """

    width: int
    height: int
    tile: int

    @property
    def columns(self) -> int:
        """Number of tiles along the width."""
        return -(-self.width // self.tile)

    @property
    def rows(self) -> int:
        """Number of tiles along the height."""
        return -(-self.height // self.tile)

    @property
    def tiles(self) -> int:
        """Number of tiles, of which the second may be beyond the image (`at_least_two`)."""
        return max(2, self.columns * self.rows)


class Lists(NamedTuple):
    """The Gaussians of every tile, front to back, one tile after the other.

    Attributes:
      entries: index of the Gaussian of each entry; those past the last offset mean nothing.
      offsets: first entry of each tile, and the end of the last one.
      total: number of entries that the lists need, which may exceed their capacity.
    """

    entries: Int[Array, " capacity"]
    offsets: Int[Array, " tiles_and_end"]
    total: Int[Array, ""]


class Blended(NamedTuple):
    """An image of Gaussians, without background.

    Attributes:
      colours: sRGB colours, weighted by opacity.
      transmittance: share of the background.
      depths: sum of the weighted depths of the means, world units.
      median_depths: depth of the mean of the Gaussian at which the transmittance falls to one half;
        0 if it does not.
    """

    colours: Float[Array, "*pixels 3"]
    transmittance: Float[Array, "*pixels"]
    depths: Float[Array, "*pixels"]
    median_depths: Float[Array, "*pixels"]


def at_least_two(projected: Projected) -> Projected:
    """Returns no fewer than two Gaussians, of which those that were added are not visible.

    XLA aborts (JAX 0.10.2) if a native loop reads from a list of one, and loops cannot read from an
    empty one.
    """
    missing = max(0, 2 - projected.depths.size)
    return jax.tree.map(
        lambda x: jnp.concatenate([x, jnp.zeros((missing, *x.shape[1:]), x.dtype)]), projected
    )


def rasterize(projected: Projected, lists: Lists, grid: Grid) -> Blended:
    """Blends the Gaussians of an image; colours and transmittance are differentiable.

    Args:
      projected: Gaussians in the image.
      lists: their lists, from `images.make_lists`.
      grid: tiles of the image.
    """
    projected = at_least_two(projected)
    features = jnp.concatenate(
        [
            *(projected.means, projected.conics, projected.opacities[:, None]),
            *(projected.colours, jax.lax.stop_gradient(projected.depths)[:, None]),
        ],
        axis=-1,
    )
    sums = _blend(features, lists, grid)
    image = sums[: grid.rows * grid.columns]
    image = image.reshape(grid.rows, grid.columns, 6, grid.tile, grid.tile)
    image = image.transpose(0, 3, 1, 4, 2)
    image = image.reshape(grid.rows * grid.tile, grid.columns * grid.tile, 6)
    image = image[: grid.height, : grid.width]
    return Blended(image[..., :3], *(image[..., n] for n in (3, 4, 5)))


class _AtPixels(NamedTuple):
    """One or several Gaussians at the pixels of a tile.

    Attributes:
      along: pixels from the mean along the width.
      across: pixels from the mean along the height.
      falloff: opacity relative to that at the centre.
      raw: opacity before its limits.
      alpha: opacity, 0 if it is below 1/255.
    """

    along: Float[Array, "*pixels"]
    across: Float[Array, "*pixels"]
    falloff: Float[Array, "*pixels"]
    raw: Float[Array, "*pixels"]
    alpha: Float[Array, "*pixels"]


def _at_pixels(
    feature: Float[Array, "10"], x: Float[Array, " pixels"], y: Float[Array, " pixels"]
) -> _AtPixels:
    """Returns one Gaussian at pixels, whose centres are `x` and `y`."""
    along, across = x - feature[0], y - feature[1]
    power = 0.5 * (feature[2] * along * along + feature[4] * across * across)
    power = power + feature[3] * along * across
    falloff = jnp.exp(-power)
    raw = feature[5] * falloff
    alpha = jnp.where((power >= 0.0) & (raw >= LEAST_ALPHA), jnp.minimum(raw, _MOST_ALPHA), 0.0)
    return _AtPixels(along, across, falloff, raw, alpha)


def _centres(
    tile: Int[Array, ""], grid: Grid, dtype: DTypeLike
) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
    """Returns the columns and rows of the centres of a tile's pixels."""
    pixel = jnp.arange(grid.tile**2, dtype=jnp.int32)
    x = (tile % grid.columns) * grid.tile + pixel % grid.tile
    y = (tile // grid.columns) * grid.tile + pixel // grid.tile
    return x.astype(dtype) + 0.5, y.astype(dtype) + 0.5


class _Front(NamedTuple):
    """What the pixels of a tile have added up so far, in blending.

    Attributes:
      entry: next entry of the list, or next chunk of all lists.
      passing: product of `1 - alpha` of all entries before.
      sums: sums of red, green, blue, transmittance of the blended ones, and both depths.
    """

    entry: Int[Array, ""]
    passing: Float[Array, "*tiles pixels"]
    sums: tuple[Float[Array, "*tiles pixels"], ...]


def _blend_native(
    features: Float[Array, "gaussians 10"], lists: Lists, *, grid: Grid
) -> Float[Array, "tiles 6 pixels"]:
    """Blends tile by tile, entry by entry."""

    @native_loop
    def run(features: Array, entries: Array, offsets: Array, blank: Array) -> Array:
        def one(tile: Array, out: Array) -> Array:
            x, y = _centres(tile, grid, features.dtype)
            end = record(offsets, tile + 1)

            def more(front: _Front) -> Array:
                return (front.entry < end) & (jnp.max(front.passing) > _OPAQUE)

            def add(front: _Front) -> _Front:
                feature = record(features, record(entries, front.entry))
                alpha = _at_pixels(feature, x, y).alpha
                after = front.passing * (1.0 - alpha)
                counted = after > _OPAQUE
                weight = jnp.where(counted, alpha * front.passing, 0.0)
                *colour, left, depth, median = front.sums
                middle = counted & (front.passing > _HALF) & (after <= _HALF)
                sums = (
                    *(each + weight * feature[6 + n] for n, each in enumerate(colour)),
                    jnp.where(counted, after, left),
                    depth + weight * feature[9],
                    jnp.where(middle, feature[9], median),
                )
                return _Front(front.entry + 1, after, sums)

            full, none = jnp.ones_like(x), jnp.zeros_like(x)
            begun = _Front(record(offsets, tile), full, (none, none, none, full, none, none))
            found = jax.lax.while_loop(more, add, begun)
            return with_record(out, tile, jnp.stack(found.sums))

        return jax.lax.fori_loop(0, grid.tiles, one, blank)

    blank = jnp.zeros((grid.tiles, 6, grid.tile**2), features.dtype)
    return run(features, lists.entries, lists.offsets, blank)


def _blend_chunks(
    features: Float[Array, "gaussians 10"], lists: Lists, *, grid: Grid
) -> Float[Array, "tiles 6 pixels"]:
    """Blends the next chunk of entries of all tiles at once."""
    x, y = _all_centres(grid, features.dtype)

    def add(front: _Front) -> _Front:
        chunk, _, _ = _next_chunk(features, lists, front.entry)
        _, before, after, weight = _chunk(chunk, x, y, front.passing)
        *colour, left, depth, median = front.sums
        depths = chunk[:, None, :, 9]
        counted = after > _OPAQUE
        middle = counted & (before > _HALF) & (after <= _HALF)
        remaining = jnp.min(jnp.where(counted, after, 1.0), axis=-1)
        sums = (
            *(
                each + jnp.sum(weight * chunk[:, None, :, 6 + n], axis=-1)
                for n, each in enumerate(colour)
            ),
            jnp.minimum(left, remaining),
            depth + jnp.sum(weight * depths, axis=-1),
            median + jnp.sum(jnp.where(middle, depths, 0.0), axis=-1),
        )
        return _Front(front.entry + 1, after[..., -1], sums)

    full, none = jnp.ones_like(x), jnp.zeros_like(x)
    begun = _Front(jnp.int32(0), full, (none, none, none, full, none, none))
    found = jax.lax.while_loop(lambda front: _is_unfinished(lists, front), add, begun)
    return jnp.stack(found.sums, axis=1)


def _all_centres(
    grid: Grid, dtype: DTypeLike
) -> tuple[Float[Array, "tiles pixels"], Float[Array, "tiles pixels"]]:
    tiles = jnp.arange(grid.tiles, dtype=jnp.int32)
    return jax.vmap(lambda tile: _centres(tile, grid, dtype))(tiles)


def _is_unfinished(lists: Lists, front: "_Front | _Back") -> Bool[Array, ""]:
    """Returns whether any tile has entries left, and a pixel that light still passes through."""
    left = lists.offsets[:-1] + front.entry * _CHUNK < lists.offsets[1:]
    return jnp.any(left & (jnp.max(front.passing, axis=-1) > _OPAQUE))


def _next_chunk(
    features: Float[Array, "gaussians 10"], lists: Lists, number: Int[Array, ""]
) -> tuple[Float[Array, "tiles chunk 10"], Int[Array, "tiles chunk"], Bool[Array, "tiles chunk"]]:
    """Returns the features of a chunk of each list, their Gaussians, and which of them exist."""
    first = lists.offsets[:-1, None] + number * _CHUNK
    place = first + jnp.arange(_CHUNK, dtype=jnp.int32)[None]
    exists = place < lists.offsets[1:, None]
    owners = lists.entries[jnp.minimum(place, lists.entries.size - 1)]
    # A Gaussian without opacity is nowhere.
    return jnp.where(exists[..., None], features[owners], 0.0), owners, exists


def _chunk(
    chunk: Float[Array, "tiles chunk 10"],
    x: Float[Array, "tiles pixels"],
    y: Float[Array, "tiles pixels"],
    passing: Float[Array, "tiles pixels"],
) -> tuple[_AtPixels, Array, Array, Array]:
    """Returns a chunk at the pixels, the transmittance before and after each, and its weight."""
    by_entry = jax.vmap(_at_pixels, in_axes=(0, None, None), out_axes=-1)
    seen = jax.vmap(by_entry)(chunk, x, y)
    after = passing[..., None] * jnp.cumprod(1.0 - seen.alpha, axis=-1)
    before = jnp.concatenate([passing[..., None], after[..., :-1]], axis=-1)
    return seen, before, after, jnp.where(after > _OPAQUE, seen.alpha * before, 0.0)


class _Back(NamedTuple):
    """State of the derivative of blending.

    Attributes:
      entry: next entry of the list, or next chunk of all lists.
      passing: product of `1 - alpha` of all entries before.
      prefix: sum of the derivatives of the weighted colours before.
      slopes: derivatives with respect to the features.
    """

    entry: Int[Array, ""]
    passing: Float[Array, "*tiles pixels"]
    prefix: Float[Array, "*tiles pixels"]
    slopes: Float[Array, "gaussians 9"]


class _Derivatives(NamedTuple):
    """Derivatives of the loss with respect to the result of each pixel.

    Attributes:
      colours: derivatives with respect to red, green and blue.
      total: `S` of the module's docstring.
    """

    colours: Float[Array, "tiles 3 pixels"]
    total: Float[Array, "tiles pixels"]


def _slopes(
    feature: Float[Array, "10"],
    seen: _AtPixels,
    by_alpha: Float[Array, " pixels"],
    weight: Float[Array, " pixels"],
    by_colour: Float[Array, "3 pixels"],
) -> Float[Array, "9"]:
    """Returns the derivative with respect to the features of one Gaussian, from those of pixels."""
    by_alpha = jnp.where((seen.alpha > 0.0) & (seen.raw < _MOST_ALPHA), by_alpha, 0.0)
    by_power = -by_alpha * seen.raw
    along = feature[2] * seen.along + feature[3] * seen.across
    across = feature[4] * seen.across + feature[3] * seen.along
    return jnp.stack(
        [
            -jnp.sum(by_power * along),
            -jnp.sum(by_power * across),
            0.5 * jnp.sum(by_power * seen.along * seen.along),
            jnp.sum(by_power * seen.along * seen.across),
            0.5 * jnp.sum(by_power * seen.across * seen.across),
            jnp.sum(by_alpha * seen.falloff),
            *(jnp.sum(weight * by_colour[n]) for n in range(3)),
        ]
    )


def _differentiate_native(
    features: Float[Array, "gaussians 10"], lists: Lists, given: _Derivatives, *, grid: Grid
) -> Float[Array, "gaussians 9"]:
    """Differentiates tile by tile, entry by entry."""

    @native_loop
    def run(
        features: Array, entries: Array, offsets: Array, given: _Derivatives, blank: Array
    ) -> Array:
        def one(tile: Array, slopes: Array) -> Array:
            x, y = _centres(tile, grid, features.dtype)
            end, (colours, total) = record(offsets, tile + 1), record(given, tile)

            def more(back: _Back) -> Array:
                return (back.entry < end) & (jnp.max(back.passing) > _OPAQUE)

            def add(back: _Back) -> _Back:
                owner = record(entries, back.entry)
                feature = record(features, owner)
                seen = _at_pixels(feature, x, y)
                after = back.passing * (1.0 - seen.alpha)
                counted = after > _OPAQUE
                weight = jnp.where(counted, seen.alpha * back.passing, 0.0)
                colour = sum(colours[n] * feature[6 + n] for n in range(3))
                prefix = back.prefix + weight * colour
                by_alpha = back.passing * colour - (total - prefix) / (1.0 - seen.alpha)
                by_alpha = jnp.where(counted, by_alpha, 0.0)
                slope = _slopes(feature, seen, by_alpha, weight, colours)
                slopes = with_record(back.slopes, owner, record(back.slopes, owner) + slope)
                return _Back(back.entry + 1, after, prefix, slopes)

            begun = _Back(record(offsets, tile), jnp.ones_like(x), jnp.zeros_like(x), slopes)
            return jax.lax.while_loop(more, add, begun).slopes

        return jax.lax.fori_loop(0, grid.tiles, one, blank)

    blank = jnp.zeros((features.shape[0], _DIFFERENTIABLE), features.dtype)
    return run(features, lists.entries, lists.offsets, given, blank)


def _differentiate_chunks(
    features: Float[Array, "gaussians 10"], lists: Lists, given: _Derivatives, *, grid: Grid
) -> Float[Array, "gaussians 9"]:
    """Differentiates the next chunk of entries of all tiles at once."""
    x, y = _all_centres(grid, features.dtype)
    by_entry = jax.vmap(_slopes, in_axes=(0, -1, -1, -1, None))

    def add(back: _Back) -> _Back:
        chunk, owners, exists = _next_chunk(features, lists, back.entry)
        seen, before, after, weight = _chunk(chunk, x, y, back.passing)
        colour = sum(given.colours[:, n, :, None] * chunk[:, None, :, 6 + n] for n in range(3))
        prefix = back.prefix[..., None] + jnp.cumsum(weight * colour, axis=-1)
        by_alpha = before * colour - (given.total[..., None] - prefix) / (1.0 - seen.alpha)
        by_alpha = jnp.where(after > _OPAQUE, by_alpha, 0.0)
        slopes = jax.vmap(by_entry)(chunk, seen, by_alpha, weight, given.colours)
        slopes = jnp.where(exists[..., None], slopes, 0.0)
        slopes = back.slopes.at[owners].add(slopes)
        return _Back(back.entry + 1, after[..., -1], prefix[..., -1], slopes)

    blank = jnp.zeros((features.shape[0], _DIFFERENTIABLE), features.dtype)
    begun = _Back(jnp.int32(0), jnp.ones_like(x), jnp.zeros_like(x), blank)
    return jax.lax.while_loop(lambda back: _is_unfinished(lists, back), add, begun).slopes


_forward = chosen_by_platform(
    "blend_splats", cpu=_blend_native, default=_blend_chunks, like=_blend_chunks
)
_backward = chosen_by_platform(
    "differentiate_splats",
    cpu=_differentiate_native,
    default=_differentiate_chunks,
    like=_differentiate_chunks,
)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _blend(
    features: Float[Array, "gaussians 10"], lists: Lists, grid: Grid
) -> Float[Array, "tiles 6 pixels"]:
    return _forward(features, lists, grid=grid)


_Kept = tuple[Array, Lists, Array]


def _blend_forward(features: Array, lists: Lists, grid: Grid) -> tuple[Array, _Kept]:
    sums = _forward(features, lists, grid=grid)
    return sums, (features, lists, sums)


def _blend_backward(grid: Grid, kept: _Kept, given: Array) -> tuple[Array, None]:
    features, lists, sums = kept
    total = jnp.sum(given[:, :4] * sums[:, :4], axis=1)
    slopes = _backward(features, lists, _Derivatives(given[:, :3], total), grid=grid)
    return jnp.pad(slopes, ((0, 0), (0, _FEATURES - _DIFFERENTIABLE))), None


_blend.defvjp(_blend_forward, _blend_backward)
