"""A slow path tree in float64 NumPy, written from the textbook rather than from the library.

At every hit light is split into a reflected and a transmitted share, both multiplied by the tint
of the interface. Vectorised over rays, all bends of one round together.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.oracles.reference_surfaces import Hits, Surfaces, face_normals, unit

ESCAPED, OUT_OF_BENDS, NOT_TRACED = 2, 3, 4
"""How a path ended."""


class Rule(NamedTuple):
    """Which light to follow; the terms are those of the library's path settings."""

    bends: int
    reflections: str
    min_throughput: float = 0.0


STRAIGHT = Rule(0, "none")
PAPER = Rule(10, "first")
TREE = Rule(24, "all", min_throughput=0.02)


class Live(NamedTuple):
    """Rays on their way: origin, direction, triangle left, camera ray, weight, bends made."""

    origins: np.ndarray
    directions: np.ndarray
    exclude_primitive: np.ndarray
    rays: np.ndarray
    throughput: np.ndarray
    num_bends: np.ndarray


class Ends(NamedTuple):
    """The last segments of all paths, and the number of casts that found them."""

    origins: np.ndarray
    directions: np.ndarray
    rays: np.ndarray
    throughput: np.ndarray
    num_bends: np.ndarray
    statuses: np.ndarray
    casts: int


class Split(NamedTuple):
    """What an interface makes of rays; `refracted` has no meaning in total reflection."""

    points: np.ndarray
    reflectance: np.ndarray
    reflected: np.ndarray
    refracted: np.ndarray


def trace(
    surfaces: Surfaces,
    cast: Callable[[np.ndarray, np.ndarray, np.ndarray], Hits],
    origins: np.ndarray,
    directions: np.ndarray,
    rule: Rule,
) -> Ends:
    """Follows camera rays until all paths have ended.

    Args:
      surfaces: the scene.
      cast: finds closest hits.
      origins: origins of rays.
      directions: unit directions of rays.
      rule: which light to follow.
    """
    count = len(origins)
    index = np.arange(count)
    none = np.full(count, -1)
    live = Live(origins, directions, none, index, np.ones_like(directions), np.zeros(count, int))
    ends, casts = [], 0
    if rule.bends == 0:
        ends, live = [(live, np.full(count, OUT_OF_BENDS))], _take(live, index[:0])
    while len(live.rays):
        hits = cast(live.origins, live.directions, live.exclude_primitive)
        casts += len(live.rays)
        met = hits.triangles >= 0
        over = ~met | (live.num_bends >= rule.bends)
        ends.append((_take(live, over), np.where(met, OUT_OF_BENDS, ESCAPED)[over]))
        live, hits = _take(live, ~over), Hits(*(x[~over] for x in hits))
        split = meet(surfaces, live.directions, hits)
        reflected, refracted = _children(surfaces, live, hits.triangles, split, rule)
        if rule.reflections == "first":
            first = (live.num_bends == 0) & (split.reflectance < 1.0)
            ends.append((_take(reflected, first), np.full(np.sum(first), NOT_TRACED)))
            reflected = _take(reflected, ~first)
        live = Live(*(np.concatenate(pair) for pair in zip(reflected, refracted, strict=True)))
        live = _take(live, live.throughput.max(-1) > 0.0)
    return _join(ends, casts)


def _take(live: Live, which: np.ndarray) -> Live:
    return Live(*(x[which] for x in live))


def _join(ends: list[tuple[Live, np.ndarray]], casts: int) -> Ends:
    lives, statuses = zip(*ends, strict=True)
    joined = Live(*(np.concatenate(x) for x in zip(*lives, strict=True)))
    return Ends(
        joined.origins,
        joined.directions,
        joined.rays,
        joined.throughput,
        joined.num_bends,
        np.concatenate(statuses),
        casts,
    )


def _children(
    surfaces: Surfaces, live: Live, triangles: np.ndarray, split: Split, rule: Rule
) -> tuple[Live, Live]:
    """Returns the two rays that leave each hit; those that are not followed have weight 0."""
    tinted = live.throughput * surfaces.tints[surfaces.parts[triangles]]
    followed = {
        "none": np.zeros(len(live.rays)),
        "first": np.where(live.num_bends == 0, split.reflectance, 0.0),
        "all": conserving_share(tinted.max(-1), split.reflectance, rule.min_throughput),
    }
    share = np.where(split.reflectance == 1.0, 1.0, followed[rule.reflections])
    share = share.astype(tinted.dtype)[:, None]

    def child(directions: np.ndarray, throughput: np.ndarray) -> Live:
        return Live(split.points, directions, triangles, live.rays, throughput, live.num_bends + 1)

    return child(split.reflected, tinted * share), child(split.refracted, tinted * (1.0 - share))


def conserving_share(
    throughput: np.ndarray, reflectance: np.ndarray, min_throughput: float
) -> np.ndarray:
    """Returns the share to reflect: a child below the threshold gives its light to its sibling.

    Where both are below it, the stronger takes all.
    """
    weak_reflected = throughput * reflectance < min_throughput
    weak_refracted = throughput * (1.0 - reflectance) < min_throughput
    stronger = np.where(reflectance > 0.5, 1.0, 0.0)
    share = np.where(weak_reflected, 0.0, np.where(weak_refracted, 1.0, reflectance))
    return np.where(weak_reflected & weak_refracted, stronger, share)


def meet(surfaces: Surfaces, directions: np.ndarray, hits: Hits) -> Split:
    """Bends rays at their hits.

    The triangle's own normal decides from which side a ray comes, and bends it where the shading
    normal points away from it. Rays that the shading normal would send to the wrong side of the
    triangle are turned until they just leave it, at a hundredth of the sine.
    """
    corners = surfaces.corners[hits.triangles]
    u, v = hits.barycentrics.T
    blend = np.stack([1.0 - u - v, u, v], axis=-1)
    geometric = face_normals(corners)
    shading = unit(np.einsum("ij,ijk->ik", blend, surfaces.normals[hits.triangles]))
    opposed = _dot(shading, geometric) <= 0.0
    shading = np.where(opposed, geometric, shading)
    entering = _dot(directions, geometric) < 0.0
    side = np.where(entering, 1.0, -1.0).astype(directions.dtype)
    part = surfaces.parts[hits.triangles][:, None]
    inside, outside = surfaces.inside[part], surfaces.outside[part]
    near, far = np.where(entering, outside, inside), np.where(entering, inside, outside)
    geometric, shading = side * geometric, side * shading
    normals = np.where(_dot(directions, shading) < 0.0, shading, geometric)
    reflectance, reflected, refracted = _bend(directions, normals, near, far)
    up, down = _dot(reflected, geometric), _dot(refracted, geometric)
    reflected = np.where(up < 0.0, unit(reflected - 1.01 * up * geometric), reflected)
    refracted = np.where(down > 0.0, unit(refracted - 1.01 * down * geometric), refracted)
    return Split(np.einsum("ij,ijk->ik", blend, corners), reflectance[:, 0], reflected, refracted)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)[..., None]


def _bend(directions: np.ndarray, normals: np.ndarray, near: np.ndarray, far: np.ndarray) -> tuple:
    """Returns reflectance, reflected and refracted direction (Born and Wolf, section 1.5)."""
    cosine = -_dot(directions, normals)
    tangent = directions + cosine * normals
    across = near / far * tangent
    squared = 1.0 - _dot(across, across)
    inner = np.sqrt(np.maximum(squared, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        perpendicular = (near * cosine - far * inner) / (near * cosine + far * inner)
        parallel = (far * cosine - near * inner) / (far * cosine + near * inner)
    reflectance = 0.5 * (perpendicular**2 + parallel**2)
    # Media of equal index are one, at every angle.
    reflectance = np.where(near == far, 0.0, np.where(squared <= 0.0, 1.0, reflectance))
    reflected = unit(directions + 2.0 * cosine * normals)
    return reflectance, reflected, unit(across - inner * normals)
