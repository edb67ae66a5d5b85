"""Surfaces of revolution, also with a radius that depends on the angle (NumPy only).

A *section* is the shape perpendicular to the axis: a factor of the radius at each angle. A *warp*
maps a point (r, z) of the profile and an angle to a radius; it keeps the axis, and increases with
r, so that nested shapes remain nested.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from experiments.dataset.objects.profiles import Curve, Sampling, resampled

Values = Float[np.ndarray, "*shape"]
Section = Callable[[Values], Values]
Warp = Callable[[Values, Values, Values], Values]

_TAU = 2.0 * np.pi

# A quadrilateral is cut along its other diagonal only if that is shorter by more than rounding.
_SHORTER = 1.0 - 1e-6


class Turned(NamedTuple):
    """Parameters that turn a profile into a surface.

    Attributes:
      angles: angles of the meridians, ascending, in radians over less than a full turn.
      warp: radius of each point of the profile at an angle.
      twist: rotation of the surface around its axis, radians per world unit of height.
    """

    angles: Float[np.ndarray, " segments"]
    warp: Warp | None = None
    twist: float = 0.0


def round_about(cut: Sampling) -> Turned:
    """Returns the parameters of a plain surface of revolution."""
    return Turned(even_angles(cut))


def even_angles(cut: Sampling, *, lobes: int = 1, each: int = 8) -> Float[np.ndarray, " segments"]:
    """Returns evenly spaced angles.

    Args:
      cut: sampling of the surface; a round object has one angle per segment.
      lobes: number of lobes of the section, each with as many angles.
      each: edges per lobe if a round object has 96 edges in total; at least 6 are used.
    """
    share = max(cut.segments / lobes, each * cut.segments / 96.0, 6.0)
    count = lobes * int(np.ceil(share))
    return np.arange(count) * (_TAU / count)


def faded(section: Section, share: Callable[[Values, Values], Values]) -> Warp:
    """Returns the warp that applies a section to a degree, 0 to 1, which depends on (r, z)."""
    return lambda angle, r, z: r * (1.0 + share(r, z) * (section(angle) - 1.0))


def ramp(value: Values, low: float, high: float) -> Values:
    """Returns 0 below a range, 1 above it, and a smooth step between."""
    share = np.clip((value - low) / (high - low), 0.0, 1.0)
    return share * share * share * (10.0 - 15.0 * share + 6.0 * share * share)


def within(value: Values, low: float, high: float, *, soft: float) -> Values:
    """Returns 1 in a range, 0 outside, and smooth steps of a given length inside its ends."""
    return ramp(value, low, low + soft) * (1.0 - ramp(value, high - soft, high))


def polygon(sides: int, corner: float) -> Section:
    """Returns the section of a regular polygon with rounded corners: 1 at the middles of its sides.

    Args:
      sides: number of sides; the normal of the first has angle 0.
      corner: radius of the corners, where the sides' distance from the axis is 1.
    """
    half = np.pi / sides
    # The corner's arc, seen from the axis: its middle angle, and the angle where it begins.
    centre = (1.0 - corner) / np.cos(half)
    begin = np.arctan2((1.0 - corner) * np.tan(half), 1.0)

    def factor(angle: Values) -> Values:
        off = np.abs(np.mod(angle + half, 2.0 * half) - half)
        off_corner = half - off
        inside = np.maximum(corner**2 - (centre * np.sin(off_corner)) ** 2, 0.0)
        arc = centre * np.cos(off_corner) + np.sqrt(inside)
        return np.where(off <= begin, 1.0 / np.cos(off), arc)

    return factor


def waves(count: int, depth: float, *, sharpness: float = 0.0) -> Section:
    """Returns a section with lobes: 1 at the ridges, one of which is at angle 0.

    Args:
      count: number of lobes.
      depth: depth of the valleys, as a share of the radius.
      sharpness: shape of the ridges: 0 is a cosine; towards 1 they become narrow and the valleys
        wide, towards -1 the other way round.
    """

    def factor(angle: Values) -> Values:
        wave = 0.5 * (1.0 - np.cos(count * angle))
        bent = wave * (1.0 + sharpness) / (1.0 + sharpness * (2.0 * wave - 1.0))
        return 1.0 - depth * bent

    return factor


def stretched(section: Section, ratio: float) -> Section:
    """Returns a section widened across angle 0 by a ratio, or narrowed by a ratio below 1."""

    def factor(angle: Values) -> Values:
        along, across = np.cos(angle), np.sin(angle) / ratio
        return section(np.arctan2(across, along)) / np.hypot(along, across)

    return factor


def section_angles(section: Section, cut: Sampling) -> Float[np.ndarray, " segments"]:
    """Returns angles adapted to a section: dense where its curvature is high."""
    angles = np.linspace(0.0, _TAU, 4097)
    curve = section(angles)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    curve[-1] = curve[0]
    # A round section gets as many meridians as a surface of revolution.
    spaced = cut._replace(edge=_TAU / cut.segments, turn=min(1.5 * _TAU / cut.segments, 0.5))
    points = resampled(curve, spaced)[:-1]
    return np.unwrap(np.arctan2(points[:, 1], points[:, 0]))


def revolve(
    profile: Curve, turned: Turned
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns a closed surface around the object on the left of a profile.

    Ends on the axis become poles with a fan of triangles; a profile that ends where it begins gives
    a ring.

    Raises:
      ValueError: if the profile touches the axis between its ends, or ends off the axis.
    """
    loop = bool(np.all(profile[0] == profile[-1]))
    middle = profile[:-1] if loop else profile[1:-1]
    if np.any(middle[:, 0] <= 0.0) or not (loop or np.all(profile[[0, -1], 0] == 0.0)):
        raise ValueError(
            "A profile touches the axis between its ends, or ends off the axis. Let both ends be "
            "at r = 0, or at the same point, and no other point at r = 0."
        )
    count = len(turned.angles)
    vertices = _rings(middle, turned).reshape(-1, 3)
    lattice = np.arange(len(vertices)).reshape(len(middle), count)
    faces = [_quads(vertices, np.concatenate([lattice, lattice[:1]]) if loop else lattice)]
    if not loop:
        poles = np.stack([[0.0, 0.0, z] for z in profile[[0, -1], 1]])
        bottom, last = len(vertices), len(vertices) + 1
        first, final = lattice[0], lattice[-1]
        faces += [
            np.stack([np.full(count, bottom), np.roll(first, -1), first], axis=1),
            np.stack([np.full(count, last), final, np.roll(final, -1)], axis=1),
        ]
        vertices = np.concatenate([vertices, poles])
    return vertices, np.concatenate(faces)


def _rings(middle: Curve, turned: Turned) -> Float[np.ndarray, "rings segments 3"]:
    angle, r, z = np.broadcast_arrays(turned.angles[None], middle[:, :1], middle[:, 1:])
    radius = r if turned.warp is None else turned.warp(angle, r, z)
    around = angle + turned.twist * z
    return np.stack([radius * np.cos(around), radius * np.sin(around), z], axis=-1)


def _quads(
    vertices: Float[np.ndarray, "vertices 3"], lattice: Int[np.ndarray, "rings segments"]
) -> Int[np.ndarray, "faces 3"]:
    """Returns the triangles between rings: quadrilaterals, each cut along its shorter diagonal."""
    a, d = lattice[:-1], lattice[1:]
    b, c = np.roll(a, -1, axis=1), np.roll(d, -1, axis=1)
    ac = np.linalg.norm(vertices[a] - vertices[c], axis=-1)
    bd = np.linalg.norm(vertices[b] - vertices[d], axis=-1)
    other = (bd < _SHORTER * ac)[..., None]
    one = np.where(other, np.stack([a, b, d], axis=-1), np.stack([a, b, c], axis=-1))
    two = np.where(other, np.stack([b, c, d], axis=-1), np.stack([a, c, d], axis=-1))
    return np.concatenate([one.reshape(-1, 3), two.reshape(-1, 3)])
