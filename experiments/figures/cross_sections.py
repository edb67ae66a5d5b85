"""Cross-sections of objects, and light paths in a horizontal plane through the origin.

A ray in the plane z = 0 stays there around an object that is symmetric about the plane, such as a
ball, so its drawing is exact. For other objects a drawing is a projection of the paths from above.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int

from refref_jax.data import SceneError
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.rays import Rays
from refref_jax.render.pixel_paths import PixelPaths

Outline = Float[np.ndarray, "points 2"]

# Slightly off z = 0, where meshes often have vertices.
_HEIGHT = 1e-3

# Decimals to which the coordinates of segments' ends are compared.
_DECIMALS = 6


class Line(NamedTuple):
    """One light path from above.

    Attributes:
      points: vertices of the polyline; the last one is at the edge of the figure.
      share: share of the pixel's light, mean over RGB.
    """

    points: Float[np.ndarray, "points 2"]
    share: float


class Panel(NamedTuple):
    """One figure of light paths.

    Attributes:
      title: title above the figure.
      paths: paths of each ray.
    """

    title: str
    paths: Sequence[PixelPaths]


def outlines_of(parts: Sequence[MeshPart]) -> list[Outline]:
    """Returns the outlines of all parts in the plane, world units.

    The outline of a closed mesh is closed, its last point next to the first; that of an open one
    goes from one end to the other.

    Raises:
      SceneError: if the plane intersects no part.
    """
    plane: dict[str, Any] = {"origin": (0.0, 0.0, _HEIGHT), "axes": ((1, 0, 0), (0, 1, 0))}
    found = [
        outline for part in parts for outline in outlines_in(part.vertices, part.faces, **plane)
    ]
    if not found:
        raise SceneError(
            "No mesh reaches the horizontal plane through the origin, which is drawn. Move the "
            "scene so that its object lies around the origin."
        )
    return found


def width_of(outlines: Sequence[Outline]) -> float:
    """Returns the largest distance of outlines from the x axis, world units."""
    return max(float(np.max(np.abs(outline[:, 1]))) for outline in outlines)


def rays_towards(distance: float, heights: Sequence[float]) -> list[Rays]:
    """Returns rays in the plane, from a camera on the negative x axis.

    Args:
      distance: distance of the camera from the origin, world units.
      heights: height at which each ray crosses the y axis, or would without objects.
    """
    origin = np.array([-distance, 0.0, 0.0], np.float32)
    targets = np.array([[0.0, height, 0.0] for height in heights], np.float32)
    directions = targets - origin
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return [Rays(origin, direction, np.float32(1e-3)) for direction in directions]


def lines_within(paths: PixelPaths, half: float) -> list[Line]:
    """Returns paths from above, cut at their last exit from the square of half edge `half`."""
    shares = paths.throughput.mean(axis=-1)
    return [
        Line(_cut(line[:, :2].astype(float), half), float(share))
        for line, share in zip(paths.polylines, shares, strict=True)
    ]


def _cut(points: Outline, half: float) -> Outline:
    """Returns a polyline whose last segment ends at the border of a square around the origin."""
    start, step = points[-2], points[-1] - points[-2]
    towards = np.where(step == 0.0, np.inf, (np.copysign(half, step) - start))
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = np.where(step == 0.0, np.inf, towards / step)
    return np.concatenate([points[:-1], (start + max(ways.min(), 0.0) * step)[None]])


def outlines_in(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    *,
    origin: Sequence[float],
    axes: Sequence[Sequence[float]],
) -> list[Outline]:
    """Returns the outlines of a mesh in a plane.

    Args:
      vertices: vertices.
      faces: triangles.
      origin: a point of the plane, from which outlines are measured, world units.
      axes: two directions in the plane, orthogonal and of length 1.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    segments = trimesh.intersections.mesh_plane(
        mesh, plane_normal=np.cross(*axes), plane_origin=origin
    )
    within = (np.asarray(segments, float).reshape(-1, 3) - origin) @ np.transpose(axes)
    ends = np.round(within, _DECIMALS)
    nodes, places = np.unique(ends, axis=0, return_inverse=True)
    near: list[list[int]] = [[] for _ in nodes]
    for first, second in places.reshape(-1, 2).tolist():
        near[first].append(second)
        near[second].append(first)
    loops, left = [], set(range(len(nodes)))
    for start in sorted(left, key=lambda node: len(near[node]) > 1):  # from an end, if there is
        if start not in left:
            continue
        left.remove(start)
        loop = [start]
        while further := [node for node in near[loop[-1]] if node in left]:
            loop.append(further[0])
            left.remove(further[0])
        loops.append(nodes[loop])
    return loops
