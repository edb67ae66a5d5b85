"""Opaque caps and feet of bodies of revolution, found by the colours of their pixels.

A place on a matt surface has the same colour in every photograph. Through glass, each photograph
shows another part of the backdrop there. So pixels are sorted by the place where they first meet
the surface; where their colours vary far less than those of the backdrop behind them, the surface
is opaque. Only its two ends are looked at: `clear_part` returns the glass between them.

Labels and rings around glass are not found, and shiny plastic is not opaque. A very dark liquid at
an end may pass as opaque.

Source: ours; photo-consistency is that of Seitz and Dyer: Photorealistic Scene Reconstruction by
Voxel Coloring (1997).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from refref_jax.choices import Colour
from refref_jax.data import image_files
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.media import INDEX_OF_AIR
from refref_jax.reconstruct import gauss_newton, photometry, walls
from refref_jax.reconstruct.families import Revolution, place
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.revolution import Profile, even, lathe, profile_normals
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, mesh_of
from refref_jax.reconstruct.turned import Turned
from refref_jax.reconstruct.walls import Outline, Stretch
from refref_jax.render.images import find_first_surface

# Rows of places along the axis and sectors around it, and number of pixels that are sorted.
_ROWS, _SECTORS, _PIXELS = 128, 12, 32_768

# Fewest pixels of a place, and fewest independent numbers of a row.
_MIN_PIXELS, _MIN_FREEDOM = 4, 60

# Variation of the colours of opaque places, as a share of that of the backdrop behind them, and the
# least variation of a backdrop that tells anything, sRGB.
_MAX_VARIATION, _MIN_BACKDROP_VARIATION = 0.35, 0.04

# Least share of the rows that an end takes, and largest share of all ends together.
_MIN_SHARE, _MAX_SHARE = 0.03, 0.7

# Rows beside an end whose pixels count as its own.
_MARGIN = 1.5

# Distance between the glass and an opaque end, as a share of the height.
_APART = 0.002

# Points of the profile of an end, half-planes of its mesh, and points of the glass's profile.
_POINTS, _AZIMUTHS, _PROFILE_POINTS = 96, 96, 600


class OpaquePart(NamedTuple):
    """The opaque part of a body below or above a height.

    Attributes:
      low: lower end of the part, along the axis from its point, world units.
      high: upper end.
      colour: mean linear RGB radiance.
    """

    low: float
    high: float
    colour: Colour

    def is_cap(self, outer: Revolution) -> bool:
        """Returns whether it is the upper end of a body, not the lower one."""
        return self.low + self.high > sum(_extent(outer))


def find_opaque_parts(
    outer: Revolution, surface: Backdrop, pixels: Photographs, *, seed: int = 0
) -> tuple[OpaquePart, ...]:
    """Finds opaque caps and feet.

    Args:
      outer: outer surface of the whole body.
      surface: backdrop.
      pixels: pixels that see it, of several photographs.
      seed: seed of the draw.

    Returns:
      The opaque ends, the lower one first; none if the backdrop is too plain to tell, or most of
      the body is opaque.
    """
    if outer.closed:
        return ()
    some = pixels.drawn(np.random.default_rng(seed), _PIXELS)
    behind = SingleObject(FixedShape(outer.mesh()), INDEX_OF_AIR, deviation=1.0)
    traced = gauss_newton.traced_object(behind.pose(behind.start()))
    straight = photometry.encode(photometry.predict(traced, surface, some.rays).linear)
    rows, cells = _places(outer, some.rays)
    seen, known = _variations(cells, some.rgb)
    shown, _ = _variations(cells, straight)
    known &= shown > _MIN_BACKDROP_VARIATION
    opaque = known & (seen < _MAX_VARIATION * shown)
    found, (bottom, top) = [], _extent(outer)
    for first, last in _runs_at_ends(opaque, known):
        inside = (rows >= first) & (rows < last)
        linear = image_files.srgb_to_linear(some.rgb[inside].astype(np.float64)).mean(axis=0)
        low, high = (bottom + (top - bottom) * row / _ROWS for row in (first, last))
        found.append(OpaquePart(low, high, (float(linear[0]), float(linear[1]), float(linear[2]))))
    return tuple(found)


def _extent(outer: Revolution) -> tuple[float, float]:
    """Returns the lower and the upper end of a surface, along its axis."""
    return float(outer.points[:, 1].min()), float(outer.points[:, 1].max())


def _first_points(outer: Revolution, rays: Rays) -> Float[np.ndarray, "rays 3"]:
    """Returns where rays first meet a surface, in the frame of its axis; NaN where they do not."""
    distances = np.asarray(find_first_surface(pack_meshes([outer.mesh()]), rays).distances)
    reach = np.where(np.isfinite(distances), distances, np.nan)[:, None]
    points = np.asarray(rays.origins) + reach * np.asarray(rays.directions)
    return (points - outer.axis.point) @ outer.axis.frame


def _places(
    outer: Revolution, rays: Rays
) -> tuple[Int[np.ndarray, " rays"], Int[np.ndarray, " rays"]]:
    """Returns the row and the cell that rays meet first, -1 without any."""
    points, (low, high) = _first_points(outer, rays), _extent(outer)
    missed = np.isnan(points[:, 2])
    x, y, z = np.where(missed, 0.0, points.T)
    row = np.clip((_ROWS * (z - low) / (high - low)).astype(np.int64), 0, _ROWS - 1)
    turn = np.arctan2(y, x) / (2.0 * np.pi) + 0.5
    sector = np.minimum((_SECTORS * turn).astype(np.int64), _SECTORS - 1)
    return np.where(missed, -1, row), np.where(missed, -1, _SECTORS * row + sector)


def _variations(
    cells: Int[np.ndarray, " rays"], rgb: Float[np.ndarray, "rays 3"]
) -> tuple[Float[np.ndarray, " rows"], Bool[np.ndarray, " rows"]]:
    """Returns the standard deviation of colours within the places of each row, if it is known."""
    count = _ROWS * _SECTORS
    kept = cells >= 0
    at, values = cells[kept], rgb[kept].astype(np.float64)
    numbers = np.bincount(at, minlength=count)
    usable = numbers >= _MIN_PIXELS
    total = np.zeros(count)
    for channel in values.T:
        mean = np.bincount(at, channel, count) / np.maximum(numbers, 1)
        total += np.bincount(at, (channel - mean[at]) ** 2, count)
    freedom = np.where(usable, 3.0 * (numbers - 1), 0.0).reshape(_ROWS, _SECTORS).sum(axis=1)
    squares = np.where(usable, total, 0.0).reshape(_ROWS, _SECTORS).sum(axis=1)
    return np.sqrt(squares / np.maximum(freedom, 1.0)), freedom > _MIN_FREEDOM


def _runs_at_ends(
    opaque: Bool[np.ndarray, " rows"], known: Bool[np.ndarray, " rows"]
) -> list[tuple[int, int]]:
    """Returns the first row and the one after the last of opaque rows at both ends.

    Rows of which nothing is known do not end a run, but nor do they begin one.
    """
    count, clear, dark = len(opaque), np.flatnonzero(known & ~opaque), np.flatnonzero(opaque)
    if not len(clear) or not len(dark):
        return []
    below, above = dark[dark < clear[0]], dark[dark > clear[-1]]
    runs = [(0, int(below[-1]) + 1)] if len(below) else []
    runs += [(int(above[0]), count)] if len(above) else []
    runs = [run for run in runs if run[1] - run[0] >= _MIN_SHARE * count]
    return runs if sum(last - first for first, last in runs) <= _MAX_SHARE * count else []


def seen_by(
    outer: Revolution, ends: Sequence[OpaquePart], pixels: Photographs
) -> Bool[np.ndarray, " rays"]:
    """Returns which pixels see an opaque end first, or miss the surface."""
    heights, (low, high) = _first_points(outer, pixels.rays)[:, 2], _extent(outer)
    margin = _MARGIN * (high - low) / _ROWS
    found = np.isnan(heights)
    for end in ends:
        found |= (heights > end.low - margin) & (heights < end.high + margin)
    return found


def colours_seen(
    outer: Revolution, ends: Sequence[OpaquePart], rays: Rays
) -> Float[np.ndarray, "rays 3"]:
    """Returns the linear RGB of the opaque end that each ray meets first, NaN without any."""
    heights = _first_points(outer, rays)[:, 2]
    found = np.full((len(heights), 3), np.nan)
    for end in ends:
        found[heights > end.low if end.is_cap(outer) else heights < end.high] = end.colour
    return found


def clear_part(outer: Revolution, ends: Sequence[OpaquePart]) -> Revolution:
    """Returns the body between its opaque ends, with flat ends where they were."""
    points, (low, high) = outer.points, _limits(outer, ends)
    kept, (bottom, top) = points, _extent(outer)
    if high < top:
        last = int(np.argmax(kept[:, 1] >= high))
        rim = _at_height(kept[last - 1], kept[last], high)
        kept = np.concatenate([kept[:last], rim, [[0.0, high]]])
    if low > bottom:
        # After the last point below: a hollow under a foot may begin above its rim.
        first = int(np.flatnonzero(kept[:, 1] <= low)[-1]) + 1
        rim = _at_height(kept[first - 1], kept[first], low)
        kept = np.concatenate([[[0.0, low]], rim, kept[first:]])
    profile = Profile(even(kept, _PROFILE_POINTS), closed=False)
    size = float(max(2.0 * kept[:, 0].max(), np.ptp(kept[:, 1])))
    return Revolution(outer.axis, profile, size, outer.relief, knots=outer.knots)


def _limits(outer: Revolution, ends: Sequence[OpaquePart]) -> tuple[float, float]:
    """Returns the heights between which the body is clear."""
    low, high = _extent(outer)
    apart = _APART * (high - low)
    for end in ends:
        if end.is_cap(outer):
            high = end.low - apart
        else:
            low = end.high + apart
    return low, high


def _at_height(
    one: Float[np.ndarray, "2"], other: Float[np.ndarray, "2"], height: float
) -> Float[np.ndarray, "1 2"]:
    """Returns the point between two others at a height."""
    share = (height - one[1]) / (other[1] - one[1])
    return (one + share * (other - one))[None]


def mesh_of_part(outer: Revolution, end: OpaquePart) -> Mesh:
    """Returns an opaque end as a closed mesh; hollows in the flat faces of the body are filled."""
    lowest, highest = (find(outer.points[:, 1]) for find in (np.argmin, np.argmax))
    points = outer.points[lowest : highest + 1]
    inside = points[(points[:, 1] > end.low) & (points[:, 1] < end.high)]
    rims = np.stack([[inside[0, 0], end.low], [inside[-1, 0], end.high]])
    side = even(np.concatenate([rims[:1], inside, rims[1:]]), _POINTS)
    normals = profile_normals(Profile(side, closed=False))
    still = np.zeros((len(side), 2, 0))
    stretch = Stretch(Turned(side, still, normals, still))
    nothing = np.zeros(0)
    bottom = walls.disc(stretch.first(), float(side[0, 1]), nothing).reversed()
    top = walls.disc(stretch.last(), float(side[-1, 1]), nothing)
    outline: Outline = walls.joined([bottom, stretch, top])
    connected = lathe(outline.poles, outline.segments, outline.ends, _AZIMUTHS)
    return mesh_of(
        place(outline.turned, connected, _AZIMUTHS, outer.axis, np.zeros(5), relief=outer.relief)
    )
