"""Turned bodies whose profile has straight pieces and rounded corners (NumPy only).

A cylinder with lids and rounded rims is one, so are a cone, a bowl of straight walls and a ring of
square section. A dozen numbers describe each exactly, where a spline of many knots stays wavy.

Source: ours.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import bsr_array, csr_array, hstack, kron

from refref_jax.reconstruct.relief import Offsets, Relief
from refref_jax.reconstruct.revolution import Axis, Curve, Lathe, lathe, sweep
from refref_jax.reconstruct.shapes import (
    LARGEST_STEP,
    LARGEST_TURN,
    Frame,
    Matrix,
    Posed,
    Unknowns,
    independent_prior,
    tilt,
)

# Standard deviations of the prior: tilt in radians; shift, corners and fillets as shares of the
# diameter.
_ANGLE, _SHIFT, _CORNER = 0.02, 0.01, 0.02

# A fillet is `softplus`, whose bend has this width, as a share of the diameter.
_SOFT = 0.003

# Steps of each straight piece and of each arc, and half-planes of the mesh.
_ALONG_LINE, _ALONG_ARC, _AROUND = 4, 16, 160

# Fillets fade into the bound of their straight pieces with this power.
_POWER = 8

# Derivatives below this share of the largest one are left out of sparse matrices.
_NEGLIGIBLE = 1e-7

# Step of central differences, as a share of the diameter.
_DIFFERENCE = 1e-6


class Turned(NamedTuple):
    """A profile and its derivatives by m unknowns.

    Attributes:
      points: radius and height.
      by_points: derivatives of the points.
      normals: outward unit normals at the points.
      by_normals: derivatives of the normals.
    """

    points: Float[np.ndarray, "points 2"]
    by_points: Float[np.ndarray, "points 2 m"]
    normals: Float[np.ndarray, "points 2"]
    by_normals: Float[np.ndarray, "points 2 m"]


Point = tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 m"]]
"""A point of the half-plane and its derivatives."""


class Stretch(NamedTuple):
    """Part of a profile without creases.

    Attributes:
      turned: its points and normals, at least two.
    """

    turned: Turned

    def reversed(self) -> "Stretch":
        """Returns the same from the end to the beginning, of a solid on the other side."""
        points, by_points, normals, by_normals = (each[::-1] for each in self.turned)
        return Stretch(Turned(points, by_points, -normals, -by_normals))

    def first(self) -> Point:
        """Returns the first point and its derivatives."""
        return self.turned.points[0], self.turned.by_points[0]

    def last(self) -> Point:
        """Returns the last point and its derivatives."""
        return self.turned.points[-1], self.turned.by_points[-1]


class Outline(NamedTuple):
    """A profile of several stretches, with creases between them.

    Attributes:
      turned: its points and normals; the stretches that meet at a point have two normals there.
      poles: points on the axis.
      segments: the two points of each segment.
      ends: the two normals of each segment.
    """

    turned: Turned
    poles: Bool[np.ndarray, " points"]
    segments: Int[np.ndarray, "segments 2"]
    ends: Int[np.ndarray, "segments 2"]


def joined(stretches: Sequence[Stretch]) -> Outline:
    """Joins stretches from a point of the axis to another, each from the end of the one before."""
    counts = [len(each.turned.points) for each in stretches]
    kept = [each.turned.points[number > 0 :] for number, each in enumerate(stretches)]
    slopes = [each.turned.by_points[number > 0 :] for number, each in enumerate(stretches)]
    points, by_points = np.concatenate(kept), np.concatenate(slopes)
    poles = np.zeros(len(points), bool)
    poles[[0, -1]] = True
    steps = np.arange(len(points) - 1)
    first = np.concatenate(
        [np.arange(n - 1) + s for n, s in zip(counts, _starts(counts), strict=True)]
    )
    return Outline(
        Turned(
            points,
            by_points,
            np.concatenate([each.turned.normals for each in stretches]),
            np.concatenate([each.turned.by_normals for each in stretches]),
        ),
        poles,
        np.stack([steps, steps + 1], axis=-1),
        np.stack([first, first + 1], axis=-1),
    )


def _starts(counts: Sequence[int]) -> Int[np.ndarray, " stretches"]:
    return np.cumsum(counts) - counts


def without_unknowns(turned: Turned) -> Turned:
    """Returns a profile that does not depend on unknowns."""
    return turned._replace(
        by_points=turned.by_points[..., :0], by_normals=turned.by_normals[..., :0]
    )


def place(
    turned: Turned,
    connected: Lathe,
    azimuths: int,
    axis: Axis,
    pose: Float[np.ndarray, "5"],
    *,
    relief: Relief | None = None,
) -> Posed:
    """Turns a profile around an axis that is tilted and shifted.

    Args:
      turned: profile relative to the point of the axis.
      connected: connectivity.
      azimuths: number of half-planes.
      axis: axis at rest.
      pose: two angles of the tilt, and the shift in the frame of the axis.
      relief: relief of the surface, which moves with the axis.

    Returns:
      The surface; unknowns are the pose and then those of the profile.
    """
    rotations = [axis.frame @ rotation for rotation in tilt(pose[:2])]
    points = sweep(turned.points, turned.by_points, rotations[0], azimuths)
    directions = sweep(turned.normals, turned.by_normals, rotations[0], azimuths)
    if relief is not None:
        at_normals = _rows_at_normals(connected, len(directions[0]), azimuths)
        found = _raised(points[0], directions[0], at_normals, rotations[0], relief)
        points = (found.points, found.by_points @ points[1])
        directions = (found.normals, found.by_normals @ directions[1])

    def turn(swept: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = swept @ rotations[0]
        tilted = np.stack([local @ rotation.T for rotation in rotations[1:]], axis=-1)
        return swept, np.concatenate([tilted, np.zeros((*swept.shape, 3)), moved], axis=-1)

    vertices, by_vertices = turn(*points)
    by_vertices[..., 2:5] = axis.frame
    normals, by_normals = turn(*directions)
    rows = connected.rows
    return Posed(
        axis.point + axis.frame @ pose[2:] + vertices[rows],
        connected.faces,
        normals,
        connected.normal_ids,
        by_vertices[rows].reshape(3 * len(rows), -1),
        by_normals.reshape(3 * len(normals), -1),
    )


def place_raised(
    turned: Turned,
    connected: Lathe,
    azimuths: int,
    axis: Axis,
    pose: Float[np.ndarray, "5"],
    relief: Relief,
    offsets: Offsets,
) -> Posed:
    """Does what `place` does if offsets of the relief are unknowns as well, after all others.

    Derivatives are sparse.
    """
    still, raising = without_unknowns(turned), relief.with_offsets(offsets)
    posed = place(still, connected, azimuths, axis, pose, relief=raising)
    frame, rows = axis.frame @ tilt(pose[:2])[0], connected.rows
    points, normals = (
        sweep(*of, frame, azimuths)[0]
        for of in ((turned.points, still.by_points), (turned.normals, still.by_normals))
    )
    at_normals = _rows_at_normals(connected, len(normals), azimuths)
    found = _raised(points, normals, at_normals, frame, raising)
    raised = relief.slopes(points @ frame, normals @ frame, at_normals, offsets)
    slopes = []
    for by_itself, of_profile, by_relief, by_pose in (
        (found.by_points, turned.by_points, raised[0], posed.by_vertices),
        (found.by_normals, turned.by_normals, raised[1], posed.by_normals),
    ):
        rotation = np.broadcast_to(frame, by_itself.shape)
        blocks = _block_diagonal(by_itself) @ _swept(of_profile, frame, azimuths)
        more = hstack([blocks, _block_diagonal(rotation) @ by_relief]).tocsr()
        if by_pose is posed.by_vertices:
            more = more[(3 * rows[:, None] + np.arange(3)).ravel()]
        slopes.append(hstack([csr_array(by_pose), more]).tocsr())
    return posed._replace(by_vertices=slopes[0], by_normals=slopes[1])


def _swept(slopes: Float[np.ndarray, "k 2 m"], frame: Frame, azimuths: int) -> csr_array:
    """Returns the derivatives that `sweep` returns, `[3 k azimuths, m]`, as a sparse matrix."""
    around, along = np.split(sweep(np.eye(2), np.zeros((2, 2, 0)), frame, azimuths)[0], 2)
    least = _NEGLIGIBLE * np.abs(slopes).max(initial=0.0)
    radial, axial = (
        csr_array(np.where(np.abs(x) > least, x, 0.0)) for x in (slopes[:, 0], slopes[:, 1])
    )
    return (kron(radial, around.reshape(-1, 1)) + kron(axial, along.reshape(-1, 1))).tocsr()


def _block_diagonal(blocks: Float[np.ndarray, "n 3 3"]) -> csr_array:
    count = len(blocks)
    entries = (blocks, np.arange(count), np.arange(count + 1))
    return bsr_array(entries, shape=(3 * count, 3 * count)).tocsr()


def _rows_at_normals(connected: Lathe, count: int, azimuths: int) -> Int[np.ndarray, " normals"]:
    """Returns the row of the swept points at which each normal is."""
    found = np.zeros(count, np.int64)
    found[connected.normal_ids] = connected.rows[connected.faces]
    # A pole is a vertex only once, but has normals of all azimuths.
    return azimuths * (found // azimuths) + np.arange(count) % azimuths


class _Raised(NamedTuple):
    """Points and normals with a relief, and their derivatives by those without it.

    That the stretching at a normal changes with the unknowns is left out.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "normals 3"]
    by_points: Float[np.ndarray, "points 3 3"]
    by_normals: Float[np.ndarray, "normals 3 3"]


def _raised(
    points: Float[np.ndarray, "points 3"],
    normals: Float[np.ndarray, "normals 3"],
    at_normals: Int[np.ndarray, " normals"],
    frame: Frame,
    relief: Relief,
) -> _Raised:
    """Returns points and normals with a relief; normals turn as those of a stretched surface."""
    stretched = relief.stretch(points @ frame)
    jacobian = frame @ stretched.jacobian @ frame.T
    turn = np.linalg.inv(jacobian)[at_normals].swapaxes(1, 2)
    turned = np.einsum("nij,nj->ni", turn, normals)
    length = np.linalg.norm(turned, axis=-1)[:, None]
    unit, by_normals = turned / length, turn / length[..., None]
    by_normals -= unit[..., None] * (unit[:, None] @ by_normals)
    return _Raised(stretched.points @ frame.T, unit, jacobian, by_normals)


def place_on_axis(
    turned: Turned,
    connected: Lathe,
    azimuths: int,
    axis: Axis,
    pose: Float[np.ndarray, "4"],
    *,
    relief: Relief | None = None,
) -> Posed:
    """Does what `place` does if the unknowns of the profile shift it along the axis already.

    Its pose is two angles, and the shift along the two directions across the axis.
    """
    posed = place(turned, connected, azimuths, axis, np.append(pose, 0.0), relief=relief)
    return posed._replace(
        by_vertices=np.delete(posed.by_vertices, 4, axis=1),
        by_normals=np.delete(posed.by_normals, 4, axis=1),
    )


class StraightTurned:
    """A turned body of straight pieces: the profile is a polyline with rounded corners.

    The unknowns are two angles that tilt the axis, the shift of its point along the two directions
    across it, the corners of the profile (radius and height; of a corner on the axis only the
    height), and a number per corner off the axis whose softplus is the radius of its fillet.
    Corners on the axis are sharp. Where fillets would overlap, they are smaller. Normals are exact.

    Attributes:
      name: kind of the shape.
      axis: axis of the fit.
      closed: whether the profile is closed; otherwise it begins and ends on the axis.
    """

    name = "turned body of straight pieces"

    def __init__(
        self,
        axis: Axis,
        corners: Curve,
        fillets: Float[np.ndarray, " rounded"],
        size: float,
        *,
        closed: bool = False,
    ) -> None:
        """Takes the axis, the profile relative to its point, and the diameter of the body.

        Args:
          axis: axis of the fit.
          corners: corners of the profile, world units, with the body on its left.
          fillets: radius of each corner that is not on the axis, world units.
          size: diameter of the body.
          closed: whether the profile is closed; otherwise its first and last corner are on the
            axis.
        """
        self.axis, self.closed, self._size = axis, closed, size
        self._rounded = len(fillets)
        soft = _SOFT * size
        radii = np.maximum(fillets, 0.3 * soft) / soft
        inverse = soft * (radii + np.log(-np.expm1(-radii)))
        places = corners.ravel() if closed else np.append(corners.ravel()[1:-2], corners[-1, 1])
        self._start = np.concatenate([np.zeros(4), places, inverse])
        count = len(self._curve(self._start[4:], _ALONG_LINE, _ALONG_ARC)[0])
        number = np.arange(count if closed else count - 1)
        segments = np.stack([number, (number + 1) % count], axis=-1)
        poles = np.zeros(count, bool)
        poles[[0, -1]] = not closed
        self._lathe = lathe(poles, segments, segments, _AROUND)

    def start(self) -> Unknowns:
        """Returns the unknowns of the fit."""
        return self._start.copy()

    def corners(self, unknowns: Unknowns) -> Curve:
        """Returns the corners of the profile, world units, relative to the point of the axis."""
        places = unknowns[4 : len(unknowns) - self._rounded]
        if not self.closed:
            places = np.concatenate([[0.0], places[:-1], [0.0], places[-1:]])
        return places.reshape(-1, 2)

    def fillets(self, unknowns: Unknowns) -> Float[np.ndarray, " rounded"]:
        """Returns the radii of the corners off the axis, world units, before they are bounded."""
        soft = _SOFT * self._size
        return soft * np.logaddexp(0.0, unknowns[len(unknowns) - self._rounded :] / soft)

    def straight_share(self, unknowns: Unknowns) -> float:
        """Returns the share of the length of the profile that is straight."""
        arcs = rounded(self.corners(unknowns), self.fillets(unknowns), self.closed)
        straight = np.linalg.norm(arcs.lines[1] - arcs.lines[0], axis=-1).sum()
        return float(straight / (straight + np.abs(arcs.radii * arcs.turns).sum()))

    def profile(
        self, unknowns: Unknowns, along_line: int = _ALONG_LINE, along_arc: int = _ALONG_ARC
    ) -> Turned:
        """Returns points and normals of the profile, and derivatives by its own unknowns.

        Args:
          unknowns: unknowns, as those of `pose`.
          along_line: steps of each straight piece.
          along_arc: steps of each arc.
        """
        at, step = unknowns[4:], _DIFFERENCE * self._size
        points, normals = self._curve(at, along_line, along_arc)
        slopes = []
        for change in step * np.eye(len(at)):
            after = self._curve(at + change, along_line, along_arc)
            before = self._curve(at - change, along_line, along_arc)
            slopes.append([(a - b) / (2.0 * step) for a, b in zip(after, before, strict=True)])
        by_points, by_normals = np.moveaxis(np.array(slopes), 0, -1)
        return Turned(points, by_points, normals, by_normals)

    def _curve(self, at: Unknowns, along_line: int, along_arc: int) -> tuple[Curve, Curve]:
        """Returns points and normals of the profile."""
        unknowns = np.append(np.zeros(4), at)
        arcs = rounded(self.corners(unknowns), self.fillets(unknowns), self.closed)
        return sampled(arcs, along_line, along_arc)

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the body; its vertices lie on it."""
        turned = self.profile(unknowns)
        return place_on_axis(turned, self._lathe, _AROUND, self.axis, unknowns[:4])

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the prior: unknowns are near those of the fit.

        Standard deviations are 0.02 radians and 1 % of the diameter for the axis, and 2 % for
        corners and fillets.
        """
        deviations = [_ANGLE, _SHIFT * self._size, _CORNER * self._size]
        each = np.repeat(deviations, [2, 2, len(unknowns) - 4])
        return independent_prior(each, unknowns - self._start)

    def scales(self) -> Unknowns:
        """Returns 0.02 radians and 0.77 % of the diameter."""
        counts = [2, len(self._start) - 2]
        return np.repeat([LARGEST_TURN, LARGEST_STEP * self._size], counts)


class Rounded(NamedTuple):
    """A polyline with rounded corners.

    Attributes:
      lines: first and last points of its straight pieces, in order.
      normals: outward normal of each straight piece.
      radii: radius of the arc after each straight piece that has one, negative where the profile
        turns to the right.
      turns: its angle, with the same sign.
    """

    lines: Float[np.ndarray, "2 lines 2"]
    normals: Float[np.ndarray, "lines 2"]
    radii: Float[np.ndarray, " arcs"]
    turns: Float[np.ndarray, " arcs"]


def rounded(corners: Curve, fillets: Float[np.ndarray, " rounded"], closed: bool) -> Rounded:
    """Rounds the corners of a polyline by arcs.

    A fillet of radius r at a turn of t begins and ends `r tan(|t| / 2)` before and after the
    corner. If it and its neighbours would need the shares x and y of the two pieces that meet
    there, it shrinks by `(1 + x^8 + y^8)^(-1/8)`, so that fillets never overlap.

    Args:
      corners: corners of the polyline.
      fillets: radii of all corners of a closed polyline, or of all but the first and the last.
      closed: whether the polyline is closed.
    """
    steps = np.roll(corners, -1, axis=0) - corners if closed else np.diff(corners, axis=0)
    lengths = np.maximum(np.linalg.norm(steps, axis=-1), 1e-300)
    along = steps / lengths[:, None]
    # The arc after piece i is at the end of it; the last of a closed polyline is at corner 0.
    after = np.roll(along, -1, axis=0) if closed else along[1:]
    before = along if closed else along[:-1]
    cosine = np.sum(before * after, axis=-1)
    sine = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    at_end = np.roll(fillets, -1) if closed else fillets
    needed = at_end * np.abs(sine) / np.maximum(1.0 + cosine, 1e-9)
    none = [] if closed else [0.0]
    ends = np.append(needed, none)
    starts = np.roll(needed, 1) if closed else np.append(none, needed)
    shares = ((starts + ends) / lengths) ** _POWER
    both = shares + np.roll(shares, -1) if closed else shares[:-1] + shares[1:]
    shrink = (1.0 + both) ** (-1.0 / _POWER)
    ends = np.append(needed * shrink, none)
    starts = np.roll(ends, 1)
    lines = np.stack(
        [
            corners[: len(along)] + starts[:, None] * along,
            corners[: len(along)] + (lengths - ends)[:, None] * along,
        ]
    )
    normals = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    return Rounded(lines, normals, at_end * shrink * np.sign(sine), np.arctan2(sine, cosine))


def sampled(arcs: Rounded, along_line: int, along_arc: int) -> tuple[Curve, Curve]:
    """Returns points and normals of a rounded polyline, a fixed number on each piece.

    The ends of a straight piece belong to it and not to the arcs.
    """
    share = np.linspace(0.0, 1.0, along_line + 1)[:, None]
    first, last = arcs.lines[:, :, None]
    straight = (1.0 - share) * first + share * last
    normals = np.broadcast_to(arcs.normals[:, None], straight.shape)
    count = len(arcs.turns)
    angle = arcs.turns[:, None] * np.linspace(0.0, 1.0, along_arc + 1)[1:-1]
    c, s = np.cos(angle), np.sin(angle)
    x, y = arcs.normals[:count, None].transpose(2, 0, 1)
    turned = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    bent = arcs.lines[1, :count, None] + arcs.radii[:, None, None] * (turned - normals[:count, :1])
    pieces = []
    for parts in ((straight, bent), (normals, turned)):
        joined = np.concatenate([parts[0][:count], parts[1]], axis=1).reshape(-1, 2)
        pieces.append(np.concatenate([joined, parts[0][count:].reshape(-1, 2)]))
    return pieces[0], pieces[1]
