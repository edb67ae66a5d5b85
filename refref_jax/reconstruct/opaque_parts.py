"""Opaque caps, feet and labels of bodies of revolution, found by the colours of their pixels.

A place on a matt surface has the same colour in every photograph. Through glass, each photograph
shows another part of the backdrop there. So pixels are sorted by the place where they first meet
the surface; where their colours vary far less than those of the backdrop behind them, the surface
is opaque. `clear_part` returns the glass between a foot and a cap; a label is a ring around it.

Labels that do not go all the way round are not found, nor are those of many colours, and shiny
plastic is not opaque. A very dark liquid may pass as opaque.

Source: ours; photo-consistency is that of Seitz and Dyer: Photorealistic Scene Reconstruction by
Voxel Coloring (1997).
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
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
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.revolution import (
    Curve,
    Profile,
    even,
    lathe,
    profile_normals,
    turn_right,
)
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, mesh_of
from refref_jax.reconstruct.turned import Outline, Stretch, Turned, joined
from refref_jax.render.images import find_first_surface

# Rows of places along the axis and sectors around it, and number of pixels that are sorted.
_ROWS, _SECTORS, _PIXELS = 128, 12, 32_768

# Fewest pixels of a place, and fewest independent numbers of a row.
_MIN_PIXELS, _MIN_FREEDOM = 4, 60

# Largest variation of the colours of opaque ends and of labels, as a share of that of the backdrop
# behind them, and the least variation of a backdrop that tells anything, sRGB.
_MAX_END_VARIATION, _MAX_LABEL_VARIATION, _MIN_BACKDROP_VARIATION = 0.35, 0.25, 0.04

# Least share of the rows that an end and a label take, and largest share of all parts together.
_MIN_END_SHARE, _MIN_LABEL_SHARE, _MAX_SHARE = 0.03, 0.05, 0.7

# Most rows within or at the end of a part of which nothing is known, and most rows within a label
# that vary too much, such as those of a line of print.
_MOST_UNKNOWN, _MOST_PRINTED = 8, 2

# Rows beside a part whose pixels count as its own.
_MARGIN = 1.5

# Distance between the glass and an opaque part, and thickness of a label, as shares of the height
# for ends, and of the diameter for labels.
_APART, _THICKNESS = 0.002, 0.004

# Points of the profile of a part and half-planes of its mesh, and points of the glass's profile.
_POINTS, _AZIMUTHS, _PROFILE_POINTS = 96, 96, 600


Kind = Literal["cap", "foot", "label"]
"""Where an opaque part is."""


class OpaquePart(NamedTuple):
    """The opaque part of a body between two heights: a foot, a cap, or a label around it.

    Attributes:
      low: lower end of the part, along the axis from its point, world units.
      high: upper end.
      colour: mean linear RGB radiance.
    """

    low: float
    high: float
    colour: Colour

    def kind(self, outer: Revolution) -> Kind:
        """Returns whether it is the upper end of a body, the lower one, or around it."""
        bottom, top = _extent(outer)
        almost = 0.5 * (top - bottom) / _ROWS
        if self.high >= top - almost:
            return "cap"
        return "foot" if self.low <= bottom + almost else "label"


def find_opaque_parts(
    outer: Revolution, surface: Backdrop, pixels: Photographs, *, seed: int = 0
) -> tuple[OpaquePart, ...]:
    """Finds opaque caps, feet and labels.

    Args:
      outer: outer surface of the whole body.
      surface: backdrop.
      pixels: pixels that see it, of several photographs.
      seed: seed of the draw.

    Returns:
      The opaque parts, from the lowest to the highest; none if the backdrop is too plain to tell,
      or most of the body is opaque.
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
    found, (bottom, top) = [], _extent(outer)
    for first, last in _opaque_rows(np.where(known, seen / np.maximum(shown, 1e-9), np.nan)):
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


def _opaque_rows(ratios: Float[np.ndarray, " rows"]) -> list[tuple[int, int]]:
    """Returns the first row and the one after the last of each opaque part.

    Args:
      ratios: variation of the colours of each row, as a share of that of the backdrop behind it;
        NaN where it is not known.
    """
    count = len(ratios)
    found = _runs(ratios, _MAX_END_VARIATION, _MIN_END_SHARE)
    ends = [run for run in found if run[0] == 0 or run[1] == count]
    labels = [
        (first, last)
        for first, last in _runs(ratios, _MAX_LABEL_VARIATION, _MIN_LABEL_SHARE, _MOST_PRINTED)
        if all(last <= begin or first >= end for begin, end in ends)
    ]
    for parts in (sorted(ends + labels), ends):
        if sum(last - first for first, last in parts) <= _MAX_SHARE * count:
            return parts
    return []


def _runs(
    ratios: Float[np.ndarray, " rows"], most: float, share: float, bridged: int = 0
) -> list[tuple[int, int]]:
    """Returns the first row and the one after the last of each run of rows that vary little.

    Args:
      ratios: variation of each row; NaN where it is not known.
      most: largest variation.
      share: least share of the rows that are known to vary little.
      bridged: most rows of a gap in a run that vary more.
    """
    count, found = len(ratios), list[list[int]]()
    known = np.flatnonzero(~np.isnan(ratios))
    for row in np.flatnonzero(ratios < most):
        between = ratios[found[-1][-1] + 1 : row] if found else np.zeros(0)
        varied = int(np.sum(between >= most))
        near = varied <= bridged and len(between) - varied <= _MOST_UNKNOWN
        if found and near:
            found[-1].append(int(row))
        else:
            found.append([int(row)])
    runs = []
    for rows in found:
        first, last = rows[0], rows[-1] + 1
        if first == known[0] and first <= _MOST_UNKNOWN:
            first = 0
        if last == known[-1] + 1 and count - last <= _MOST_UNKNOWN:
            last = count
        if len(rows) >= share * count:
            runs.append((first, last))
    return runs


def seen_by(
    outer: Revolution, opaque: Sequence[OpaquePart], pixels: Photographs
) -> Bool[np.ndarray, " rays"]:
    """Returns which pixels miss the surface, or see an opaque part: first, or behind the glass.

    Behind the glass is where a straight ray leaves the surface.
    """
    heights, (low, high) = _first_points(outer, pixels.rays)[:, 2], _extent(outer)
    behind = _first_points(outer, _reversed(outer, pixels.rays))[:, 2]
    margin = _MARGIN * (high - low) / _ROWS
    found = np.isnan(heights)
    for part in opaque:
        for each in (heights, behind):
            found |= (each > part.low - margin) & (each < part.high + margin)
    return found


def _reversed(outer: Revolution, rays: Rays) -> Rays:
    """Returns rays from beyond a surface back to their origins."""
    origins, directions = jnp.asarray(rays.origins), jnp.asarray(rays.directions)
    middle = jnp.asarray(outer.axis.point, jnp.float32)[None]
    reach = jnp.linalg.norm(origins - middle, axis=-1, keepdims=True) + 2.0 * outer.size
    return rays._replace(origins=origins + reach * directions, directions=-directions)


def colours_seen(
    outer: Revolution, opaque: Sequence[OpaquePart], rays: Rays
) -> Float[np.ndarray, "rays 3"]:
    """Returns the linear RGB of the opaque part that each ray meets first, NaN without any."""
    heights = _first_points(outer, rays)[:, 2]
    found = np.full((len(heights), 3), np.nan)
    for part in opaque:
        kind = part.kind(outer)
        above = (heights > part.low) | (kind == "foot")
        below = (heights < part.high) | (kind == "cap")
        found[above & below & ~np.isnan(heights)] = part.colour
    return found


def clear_part(outer: Revolution, opaque: Sequence[OpaquePart]) -> Revolution:
    """Returns the body between its opaque foot and cap, with flat ends where they were."""
    points, (low, high) = outer.points, _limits(outer, opaque)
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


def _limits(outer: Revolution, opaque: Sequence[OpaquePart]) -> tuple[float, float]:
    """Returns the heights between which the body is clear."""
    low, high = _extent(outer)
    apart = _APART * (high - low)
    for part in opaque:
        if part.kind(outer) == "cap":
            high = part.low - apart
        elif part.kind(outer) == "foot":
            low = part.high + apart
    return low, high


def _at_height(
    one: Float[np.ndarray, "2"], other: Float[np.ndarray, "2"], height: float
) -> Float[np.ndarray, "1 2"]:
    """Returns the point between two others at a height."""
    share = (height - one[1]) / (other[1] - one[1])
    return (one + share * (other - one))[None]


def mesh_of_end(outer: Revolution, part: OpaquePart) -> Mesh:
    """Returns a cap or a foot as a closed mesh; hollows in flat faces of the body are filled."""
    lowest, highest = (find(outer.points[:, 1]) for find in (np.argmin, np.argmax))
    points = outer.points[lowest : highest + 1]
    inside = points[(points[:, 1] > part.low) & (points[:, 1] < part.high)]
    rims = np.stack([[inside[0, 0], part.low], [inside[-1, 0], part.high]])
    side = even(np.concatenate([rims[:1], inside, rims[1:]]), _POINTS)
    normals = profile_normals(Profile(side, closed=False))
    still = np.zeros((len(side), 2, 0))
    stretch = Stretch(Turned(side, still, normals, still))
    nothing = np.zeros(0)
    bottom = walls.disc(stretch.first(), float(side[0, 1]), nothing).reversed()
    top = walls.disc(stretch.last(), float(side[-1, 1]), nothing)
    outline: Outline = joined([bottom, stretch, top])
    connected = lathe(outline.poles, outline.segments, outline.ends, _AZIMUTHS)
    return mesh_of(
        place(outline.turned, connected, _AZIMUTHS, outer.axis, np.zeros(5), relief=outer.relief)
    )


def mesh_of_label(vessel: Vessel, x: Float[np.ndarray, " unknowns"], part: OpaquePart) -> Mesh:
    """Returns a label as a closed mesh: a thin ring around the outer wall of a vessel.

    It bridges grooves, as paper does, so that it never folds.

    Args:
      vessel: model of the vessel.
      x: its unknowns.
      part: the label.
    """
    wall, still = vessel.outer_wall, np.zeros((_POINTS, vessel.layout.profile))
    by_knots = np.zeros((len(wall.knots), vessel.layout.profile))
    # A place on the glass: the wall may have moved away from the height that it had at first.
    rest = wall.curve(np.zeros(len(wall.knots)), by_knots)
    low, high = (wall.reach(rest, at, still[0])[0] for at in (part.low, part.high))
    moved = wall.curve(x[vessel.layout.outer], by_knots)
    side = _tight(wall.piece(moved, np.linspace(low, high, _POINTS), still).points)
    along = np.gradient(side, axis=0)
    normals = turn_right(along) / np.linalg.norm(along, axis=-1, keepdims=True)
    by_points = np.zeros((*side.shape, vessel.layout.profile))
    back, front = (
        Stretch(Turned(side + away * vessel.size * normals, by_points, normals, by_points))
        for away in (_APART, _APART + _THICKNESS)
    )
    back = back.reversed()
    outline = _loop([front, _edge(front, back), back, _edge(back, front)])
    return mesh_of(vessel.posed(outline, x))


def _tight(points: Curve) -> Float[np.ndarray, "even 2"]:
    """Returns the convex curve around a piece of a profile, from its lower end to its upper."""
    kept: list[np.ndarray] = []
    for point in points[np.argsort(points[:, 1], kind="stable")]:
        while len(kept) > 1:
            last, whole = kept[-1] - kept[-2], point - kept[-2]
            if last[0] * whole[1] > whole[0] * last[1]:
                break
            kept.pop()
        kept.append(point)
    return even(np.stack(kept), _POINTS)


def _edge(before: Stretch, after: Stretch) -> Stretch:
    """Returns the straight stretch between two others, with creases at both ends."""
    (point, by_point), (there, by_there) = before.last(), after.first()
    points, by_points = np.stack([point, there]), np.stack([by_point, by_there])
    along = np.diff(points, axis=0)
    normals = np.repeat(turn_right(along) / np.linalg.norm(along), 2, axis=0)
    return Stretch(Turned(points, by_points, normals, np.zeros_like(by_points)))


def _loop(stretches: Sequence[Stretch]) -> Outline:
    """Joins stretches of which the last ends where the first begins, away from the axis."""
    found = joined(stretches)
    count = len(found.poles) - 1
    points, by_points, normals, by_normals = found.turned
    turned = Turned(points[:count], by_points[:count], normals, by_normals)
    return Outline(turned, np.zeros(count, bool), found.segments % count, found.ends)
