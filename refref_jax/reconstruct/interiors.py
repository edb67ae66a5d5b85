"""Vessels of glass with liquid and air inside: bodies of revolution, as unknowns of a fit.

A vessel has an outer and an inner wall, both profiles around an upright axis that move along their
normals (`walls`), and may have a relief. What is inside is cut by horizontal surfaces: liquid up to
a level, glass of a small height (the *gap*), and air above. The mouth may be open; then the glass
ends at a rim, and the air inside is that outside. `Vessel` is a `gauss_newton.Model`;
`interior_search` finds out what is inside.

What this cannot represent: handles; a tilted level, or its rise at the wall; drops and
bubbles; liquid in a ring around a raised bottom that is higher than the level; tilted vessels;
walls that reach into each other; a stopper of another material.

Source: ours. Kim, Reshetouski, Ghosh: Acquiring Axially-Symmetric Transparent Objects Using
Single-View Transmission Imaging (2017), for outer and inner profiles from refracted light.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import Interfaces
from refref_jax.reconstruct import ReconstructionError, relief, walls
from refref_jax.reconstruct.contents import (
    FINE,
    Colour,
    Detail,
    Interior,
    Layout,
    Solid,
    interfaces_of,
    media_of,
)
from refref_jax.reconstruct.families import Revolution, place, place_raised
from refref_jax.reconstruct.gauss_newton import Candidate
from refref_jax.reconstruct.revolution import Curve, Profile, lathe
from refref_jax.reconstruct.shapes import LARGEST_STEP, LARGEST_TURN, Matrix, Posed, mesh_of
from refref_jax.reconstruct.turned import Outline, Stretch, joined
from refref_jax.reconstruct.walls import Limits, Moved, Wall

# Knots of the offsets of the outer and of the inner wall.
_KNOTS, _INNER_KNOTS = 36, 28

# Standard deviations of the priors, as shares of the diameter: shift of the axis; offsets of the
# outer wall and their second differences, also with the knots of a fine profile; the same of the
# inner wall; level; gap. Angles are in radians.
_ANGLE, _SHIFT = 0.02, 0.01
_OFFSET, _BEND, _FINE_BEND = 0.008, 0.004, 0.0003
_INNER_OFFSET, _INNER_BEND = 0.03, 0.012
_LEVEL, _GAP = 0.12, 0.04

# Ends of the outer wall may be hollow, which masks do not show: where its normal has at least this
# share along the axis, deviations are larger by this factor.
_LEVELLED, _LOOSER = 0.9, 5.0

# The same of the index of a liquid, of the logarithm of a tint, and of absorption along the
# diameter.
_LIQUID, _TINT, _ABSORPTION, _KEPT = 0.1, 1.0, 5.0, 1e-9

# Largest changes in a step: of level and gap, as a share of the diameter, of an index, of the
# logarithm of a tint, and of absorption along the diameter. The inner wall, which no mask shows,
# moves further than the outer one.
_LEVEL_STEP, _INDEX_STEP, _TINT_STEP, _ABSORPTION_STEP = 0.015, 0.02, 0.3, 1.0
_INNER_STEPS = 2.0

# Least thickness of a wall and of its gap, as a share of the diameter, and of the wall at rest.
_THINNEST, _LEAST_GAP, _LEAST_SHARE = 0.002, 0.001, 0.25

# Share of the distance from the axis that an inner wall may move inwards.
_INWARDS = 0.7

# Offsets fade into their limits over this share of them.
_FADE = 0.1

# Fewest points of a piece of the inner wall.
_FEWEST = 20

# Height by which the inner wall of an open vessel continues above it, as a share of the diameter;
# depth of its rim, as a share of the wall.
_ABOVE, _RIM = 0.05, 0.25


class Vessel:
    """A vessel as a `gauss_newton.Model`.

    The unknowns (`layout`) are the tilt and the shift of the axis, offsets of the outer and of the
    inner wall along their normals at rest, the level, the gap, the indices of glass and liquid, the
    logarithms of the tints, the absorption of the liquid, and offsets of the relief, if there is
    one. The connectivity does not depend on them.

    Example:
      >>> vessel = Vessel(fit_revolution(mesh), Interior("liquid and air", wall=0.1, level=-0.2))
      >>> fit = gauss_newton.fit(vessel, vessel.start(), surface, pixels)
      >>> vessel.interior(fit.x).level

    Attributes:
      outer: outer surface at rest.
      interior_at_start: contents at the start.
      layout: places of the unknowns.
      outer_wall: outer wall, without offsets.
      size: diameter, world units.
    """

    def __init__(self, outer: Revolution, interior: Interior, detail: Detail = FINE) -> None:
        """Takes the outer surface and what is inside.

        Raises:
          ReconstructionError: if the object is a ring, or its wall leaves no space inside.
        """
        if outer.closed:
            raise ReconstructionError("A ring has no inside that the axis meets. Pass a vessel.")
        self.outer, self.interior_at_start, self.detail = outer, interior, detail
        profile = walls.with_punt(Profile(outer.points, closed=False), interior.punt)
        self.size = _size(outer.points)
        knots = max(_KNOTS, outer.knots) if detail.fine else _KNOTS
        points = detail.outer + (detail.ridges if outer.knots > _KNOTS else 0)
        self.outer_wall = Wall(profile, points=points, knots=knots)
        self._looseness = self._find_looseness()
        raised = math.prod(relief.KNOTS) if detail.fine and outer.relief is not None else 0
        self.layout = Layout(interior, knots, _INNER_KNOTS, relief=raised)
        if interior.contents != "none":
            ends = {"base": interior.base, "lid": interior.lid}
            space = walls.inset(self._outside(profile), interior.wall, self.size, **ends)
            if space is None:
                raise ReconstructionError(
                    f"A wall of {interior.wall:g}, a base of {interior.base:g} and a lid of "
                    f"{interior.lid:g} leave no space inside. Pass thinner ones."
                )
            self._inner = Wall(space, points=detail.inner, knots=_INNER_KNOTS)
            if interior.mouth:
                self._rim = self._find_rim()
            self._rest = self._limits()
            self._range = self._heights()
        self._plan = self._shares()

    def _outside(self, profile: Profile) -> Profile:
        """Returns what an inner wall follows: no ridges, and straight up above a mouth."""
        found = profile
        if self.interior_at_start.mouth:
            found = walls.with_open_top(found, _ABOVE * self.size + self.interior_at_start.wall)
        return walls.without_ridges(found, self.size) if self.outer.knots > _KNOTS else found

    def _find_looseness(self) -> Float[np.ndarray, " knots"]:
        """Returns factors of the deviations of the outer wall's knots, larger at its two ends."""
        at_knots = self.outer_wall.directions[np.argmax(self.outer_wall.hats, axis=0), 1]
        count = len(at_knots)
        first, last = np.flatnonzero(at_knots > -_LEVELLED), np.flatnonzero(at_knots < _LEVELLED)
        bottom, top = first[0] if len(first) else 0, last[-1] + 1 if len(last) else count
        number = np.arange(count)
        return np.where((number < bottom) | (number >= top), _LOOSER, 1.0)

    def _limits(self) -> tuple[Limits, Int[np.ndarray, " points"]]:
        """Returns the limits of the inner wall at rest, and the nearest points of the outer one."""
        points, directions = self._inner.points, self._inner.directions
        end = self._rim[0] if self.interior_at_start.mouth else self.outer_wall.length
        dense, outer, _ = self._outer_at_rest(end)
        away, nearest = KDTree(outer).query(points)
        least = np.minimum(_LEAST_SHARE * away, _THINNEST * self.size)
        half = 0.5 * (points[:, 1].max() - points[:, 1].min())
        across = points[:, 0] / np.maximum(np.abs(directions[:, 0]), 1e-9)
        upright = np.where(np.abs(directions[:, 0]) > 0.1, across, half)
        inward = -_INWARDS * np.clip(upright, 2.0 * _THINNEST * self.size, half)
        outward = away - least
        width = _FADE * np.minimum(outward, -inward)
        rows = np.clip(
            np.searchsorted(self.outer_wall.at, dense[nearest]), 0, len(self.outer_wall.at) - 1
        )
        return Limits(inward, outward, np.zeros((len(points), 0)), width), rows

    def _heights(self) -> tuple[float, float]:
        """Returns the lowest level, and the highest place where the air may begin."""
        heights, margin = self._inner.points[:, 1], 4.0 * _THINNEST * self.size
        highest = float(heights.max())
        if self.interior_at_start.mouth:
            highest = float(np.interp(self._rim[1], self._inner.at, heights))
        return float(heights.min()) + margin, highest - margin

    def _find_rim(self) -> tuple[float, float]:
        """Returns the lengths at which the outer and the inner wall end at the mouth.

        The inner wall ends just before it leaves the outer one.
        """
        lengths, points, normals = self._outer_at_rest(self.outer_wall.length)
        at = np.linspace(0.0, self._inner.length, 8 * len(self._inner.at))
        inner = self._inner.piece(self._still(self._inner), at, np.zeros((len(at), 0))).points
        nearest = KDTree(points).query(inner)[1]
        height = np.sum((inner - points[nearest]) * normals[nearest], axis=-1)
        inside = np.flatnonzero(height < -_RIM * self.interior_at_start.wall)
        last = int(inside[-1]) if len(inside) else 0
        if last in (0, len(at) - 1) or points[nearest[last], 0] <= _LEAST_GAP * self.size:
            raise ReconstructionError("The vessel has no mouth at its top. Pass mouth=False.")
        return float(lengths[nearest[last]]), float(at[last])

    def _outer_at_rest(self, end: float) -> tuple[np.ndarray, Curve, Curve]:
        """Returns lengths along the outer wall up to one, and its points and normals there."""
        dense = np.linspace(0.0, end, 8 * len(self.outer_wall.at))
        found = self.outer_wall.piece(
            self._still(self.outer_wall), dense, np.zeros((len(dense), 0))
        )
        return dense, found.points, found.normals

    @staticmethod
    def _still(wall: Wall) -> Moved:
        """Returns a wall at rest, without unknowns."""
        return Moved(wall.points, np.zeros((len(wall.points), 2, 0)))

    def _shares(self) -> list[Float[np.ndarray, " points"]]:
        """Returns where points are: shares of the outer wall, of the liquid's and of the air's."""
        interior, outer = self.interior_at_start, self.outer_wall
        end = self._rim[0] if interior.mouth else outer.length
        found = [walls.shares(outer.at, 0.0, end, len(outer.at))]
        if interior.contents == "none":
            return found
        inner = self._inner
        count, cut = len(inner.at), inner.length
        if interior.level_unknown:
            cut, _ = inner.reach(
                self._still(inner), float(np.clip(interior.level, *self._range)), np.zeros(0)
            )
            # The number of points below depends on the level at rest; that of all does not.
            count = int(np.clip(np.searchsorted(inner.at, cut), _FEWEST, count - _FEWEST))
        found.append(walls.shares(inner.at, 0.0, cut, count))
        end = self._rim[1] if interior.mouth else inner.length
        begin = cut if interior.level_unknown else 0.0
        rest = len(inner.at) - count if interior.level_unknown else count
        return [*found, walls.shares(inner.at, begin, end, rest)]

    def start(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the unknowns at rest."""
        x, interior, layout = np.zeros(self.layout.count), self.interior_at_start, self.layout
        x[layout.level], x[layout.gap] = interior.level, interior.gap
        x[layout.glass], x[layout.liquid] = interior.glass, interior.liquid
        for where, tint in ((layout.tint, interior.tint), (layout.glass_tint, interior.glass_tint)):
            if where.stop > where.start:
                x[where] = np.log(tint)
        if interior.filled:
            x[layout.absorption] = interior.absorption
        return x

    def interior(self, x: Float[np.ndarray, " unknowns"]) -> Interior:
        """Returns what is inside at given unknowns; the wall is the mean one."""
        layout, rest = self.layout, self.interior_at_start
        numbers = {"level": rest.level, "gap": rest.gap, "glass": rest.glass, "liquid": rest.liquid}
        for name in numbers:
            values = x[getattr(layout, name)]
            if len(values):
                numbers[name] = float(values[0])
        if rest.level_unknown:
            least, (low, high) = _LEAST_GAP * self.size, self._range
            numbers["level"] = float(np.clip(numbers["level"], low, high - least))
            numbers["gap"] = float(np.clip(numbers["gap"], least, high - numbers["level"]))

        def colour(where: slice, of: Callable[..., Any], otherwise: Colour) -> Colour:
            if where.stop == where.start:
                return otherwise
            red, green, blue = of(x[where])
            return float(red), float(green), float(blue)

        return dataclasses.replace(
            rest,
            level=numbers["level"],
            gap=numbers["gap"],
            glass=numbers["glass"],
            liquid=numbers["liquid"],
            tint=colour(layout.tint, np.exp, rest.tint),
            absorption=colour(layout.absorption, lambda x: np.maximum(x, 0.0), rest.absorption),
            glass_tint=colour(layout.glass_tint, np.exp, rest.glass_tint),
        )

    def pose(self, x: Float[np.ndarray, " unknowns"]) -> Candidate:
        """Returns the vessel at given unknowns."""
        media = media_of(self.interior(x), self.layout)
        return Candidate(
            tuple(self._surfaces(x)),
            interfaces_of(media),
            _selected([medium.index_at for medium in media], 1, len(x)),
            _selected([medium.tint_at for medium in media], 3, len(x)),
            _selected([medium.absorption_at for medium in media], 3, len(x)),
        )

    def interfaces(self, x: Float[np.ndarray, " unknowns"]) -> Interfaces:
        """Returns the interfaces of the parts at given unknowns."""
        return interfaces_of(media_of(self.interior(x), self.layout))

    def _surfaces(self, x: Float[np.ndarray, " unknowns"]) -> list[Posed]:
        """Returns the surfaces of the parts, with columns for all unknowns."""
        return [self.posed(outline, x) for outline in self._pieces(x)]

    def _unfolded(self, x: Float[np.ndarray, " unknowns"]) -> list[Posed]:
        """Returns the surfaces of the parts without the folds of profiles."""
        return [self.posed(walls.without_loops(each), x) for each in self._pieces(x)]

    def posed(self, outline: Outline, x: Float[np.ndarray, " unknowns"]) -> Posed:
        """Returns a profile turned around the axis, with columns for all unknowns."""
        shift, azimuths, layout = np.append(x[:4], 0.0), self.detail.azimuths, self.layout
        connected = lathe(outline.poles, outline.segments, outline.ends, azimuths)
        at, axis, raised = (outline.turned, connected, azimuths), self.outer.axis, self.outer.relief
        unknown = layout.relief.stop > layout.relief.start
        if raised is not None and unknown:
            offsets = x[layout.relief].reshape(relief.KNOTS)
            posed = place_raised(*at, axis, shift, raised, offsets)
        else:
            posed = place(*at, axis, shift, relief=raised)
        last = 5 + layout.profile
        zeros = layout.relief.start - last + 1

        def columns(matrix: Matrix) -> Matrix:
            # A shift along the axis is an offset of the profile.
            nothing = np.zeros((matrix.shape[0], zeros))
            if not unknown:
                return np.concatenate([matrix[:, :4], matrix[:, 5:], nothing], axis=1)
            kept = (
                matrix[:, :4],
                matrix[:, 5:last],
                scipy.sparse.csr_array(nothing),
                matrix[:, last:],
            )
            return scipy.sparse.hstack(kept).tocsr()

        return posed._replace(
            by_vertices=columns(posed.by_vertices), by_normals=columns(posed.by_normals)
        )

    def _pieces(self, x: Float[np.ndarray, " unknowns"]) -> list[Outline]:
        """Returns the closed profiles of the parts."""
        interior, layout = self.interior_at_start, self.layout
        by = np.eye(len(x))[:, 4 : 4 + layout.profile]
        outer = self.outer_wall.curve(x[layout.outer], by[layout.outer])
        still = np.zeros(layout.profile)
        whole = walls.between(self.outer_wall, outer, self._plan[0], (0.0, still), (None, still))
        if interior.contents == "none":
            return [joined([whole])]
        inner = self._inner_wall(x, by)
        if interior.level_unknown:
            levels = self._levels(x, by)
            inside = self._cut(inner, levels, still)
            bottom = self._inner.reach(inner, *levels[1])
        else:
            full = walls.between(self._inner, inner, self._plan[1], (0.0, still), (None, still))
            inside, bottom = [joined([full])], (0.0, still)
        if not interior.mouth:
            return [joined([whole]), *inside]
        glass = self._open(outer, inner, bottom, still)
        if interior.level_unknown:
            glass.append(walls.disc(glass[-1].last(), *levels[1]))
        return [joined(glass), *inside[: interior.filled]]

    def _inner_wall(
        self, x: Float[np.ndarray, " unknowns"], by: Float[np.ndarray, "unknowns m"]
    ) -> Moved:
        """Returns the inner wall, which the outer one limits."""
        rest, rows = self._rest
        hats, where = self.outer_wall.hats[rows], self.layout.outer
        limits = rest._replace(outward=rest.outward + hats @ x[where], by_outward=hats @ by[where])
        return self._inner.curve(x[self.layout.inner], by[self.layout.inner], limits)

    def _levels(
        self, x: Float[np.ndarray, " unknowns"], by: Float[np.ndarray, "unknowns m"]
    ) -> list[tuple[float, Float[np.ndarray, " m"]]]:
        """Returns the heights of the liquid's surface and of the lower end of the air."""
        layout, now = self.layout, self.interior(x)
        by_level = by[layout.level][0] * (now.level == x[layout.level][0])
        free = now.gap == x[layout.gap][0]
        by_top = by_level * (now.gap >= x[layout.gap][0]) + by[layout.gap][0] * free
        return [(now.level, by_level), (now.level + now.gap, by_top)]

    def _cut(
        self,
        inner: Moved,
        levels: list[tuple[float, Float[np.ndarray, " m"]]],
        still: Float[np.ndarray, " m"],
    ) -> list[Outline]:
        """Returns the liquid and the air."""
        low, high = (self._inner.reach(inner, *level) for level in levels)
        below = walls.between(self._inner, inner, self._plan[1], (0.0, still), low)
        above = walls.between(self._inner, inner, self._plan[2], high, (None, still))
        surface = walls.disc(below.last(), *levels[0])
        return [
            joined([below, surface]),
            joined([walls.disc(above.first(), *levels[1]).reversed(), above]),
        ]

    def _open(
        self,
        outer: Moved,
        inner: Moved,
        bottom: tuple[float, Float[np.ndarray, " m"]],
        still: Float[np.ndarray, " m"],
    ) -> list[Stretch]:
        """Returns the glass of an open vessel: outside up to the rim, and inside down again."""
        ends = [(end, still) for end in self._rim]
        outside = walls.between(self.outer_wall, outer, self._plan[0], (0.0, still), ends[0])
        down = walls.between(self._inner, inner, self._plan[2], bottom, ends[1]).reversed()
        return [outside, walls.bridge(outside, down), down]

    def index_of(self, x: Float[np.ndarray, " unknowns"]) -> float:
        """Returns the index of refraction of the glass."""
        return float(self.interior(x).glass)

    def solids(self, x: Float[np.ndarray, " unknowns"]) -> list[Solid]:
        """Returns the parts of the vessel, as those of an ordinary scene.

        The part `glass` contains the others. Folds of the walls are cut off.
        """
        found: list[Solid] = []
        media = media_of(self.interior(x), self.layout)
        parts = zip(self.interior_at_start.materials, self._unfolded(x), strict=True)
        for medium, (name, part) in zip(media, parts, strict=True):
            parent = 0 if found else NO_PARENT
            found.append(
                Solid(name, mesh_of(part), medium.index, parent, medium.tint, medium.absorption)
            )
        return found

    def prior(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """Returns the prior: near the start, and smooth walls. Deviations: see the constants."""
        layout, size = self.layout, self.size
        deviations = np.full(layout.count, _TINT)
        for where, deviation in (
            (layout.axis, np.array([_ANGLE, _ANGLE, _SHIFT * size, _SHIFT * size])),
            (layout.outer, _OFFSET * size * self._looseness),
            (layout.inner, _INNER_OFFSET * size),
            (layout.level, _LEVEL * size),
            (layout.gap, _GAP * size),
            *self._deviations_of_media(),
        ):
            deviations[where] = deviation
        precision = np.diag(deviations**-2.0)
        for where, bend in ((layout.outer, _BEND), (layout.inner, _INNER_BEND)):
            count = where.stop - where.start
            if where == layout.outer and count > _KNOTS:
                bend = _FINE_BEND
            if count:
                bends = np.diff(np.eye(count), 2, axis=0)
                if where == layout.outer:
                    bends /= np.maximum(self._looseness[:-2], self._looseness[2:])[:, None]
                precision[where, where] += bends.T @ bends / (bend * size) ** 2
        if layout.relief.stop > layout.relief.start:
            precision[layout.relief, layout.relief] = relief.precision()
        return precision, precision @ self._away(x)

    def _deviations_of_media(self) -> list[tuple[slice, float]]:
        """Returns the standard deviations of indices and absorption."""
        at = self.layout
        glass = self.interior_at_start.glass_deviation or _KEPT
        absorbs = (at.absorption, _ABSORPTION / self.size)
        return [(at.glass, glass), (at.liquid, _LIQUID), absorbs]

    def _away(self, x: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " unknowns"]:
        """Returns how far unknowns are from those that the prior expects: clear media."""
        away = x - self.start()
        for clear in (self.layout.tint, self.layout.absorption, self.layout.glass_tint):
            away[clear] = x[clear]
        return away

    def scales(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the largest change of each unknown in one step."""
        layout, size = self.layout, self.size
        found = np.full(layout.count, LARGEST_STEP * size)
        found[layout.axis][:2] = LARGEST_TURN
        found[layout.inner] *= _INNER_STEPS
        found[layout.level] = found[layout.gap] = _LEVEL_STEP * size
        found[layout.glass] = found[layout.liquid] = _INDEX_STEP
        found[layout.tint] = found[layout.glass_tint] = _TINT_STEP
        found[layout.absorption] = _ABSORPTION_STEP / size
        found[layout.relief] = relief.LARGEST_STEP
        return found


def _selected(places: Sequence[slice], each: int, count: int) -> scipy.sparse.csr_array:
    """Returns the derivatives of `each` numbers of every part, which are unknowns or fixed."""
    chosen = [range(*at.indices(count)) for at in places]
    rows = [each * part + place for part, at in enumerate(chosen) for place in range(len(at))]
    columns = [column for at in chosen for column in at]
    entries = (np.ones(len(rows)), (rows, columns))
    return scipy.sparse.csr_array(entries, shape=(each * len(places), count))


def _size(points: Curve) -> float:
    """Returns the diameter of a body of revolution: its width or its height."""
    across, height = 2.0 * points[:, 0].max(), points[:, 1].max() - points[:, 1].min()
    return float(max(across, height))
