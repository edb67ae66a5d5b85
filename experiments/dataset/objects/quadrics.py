"""Round objects in closed form: ball, cylinder, torus (NumPy only).

A vertex normal is the mean over the vertex's faces. Where a curved surface meets a flat one, the
flat one therefore begins with a narrow ring of faces, so that normals are inexact only on this
ring.
"""

from functools import partial

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull

from experiments.dataset.objects.isosurface import Surface
from experiments.dataset.parts import Object, ObjectPart
from refref_jax.choices import CLEAR, Colour

BLUE: Colour = (0.72, 0.86, 1.0)
AMBER: Colour = (1.0, 0.85, 0.58)
VIOLET: Colour = (0.86, 0.74, 1.0)

BALL_RADIUS = 1.4

CYLINDER_RADIUS, CYLINDER_HALF_HEIGHT, CYLINDER_FILLET = 0.95, 1.2, 0.08

TORUS_RADIUS, TORUS_THICKNESS = 1.25, 0.5

# At detail 1: subdivisions of an icosahedron's edge, segments per turn, and segments of a fillet.
_BALL_PIECES, _SECTIONS, _FILLET_SEGMENTS = 48, 192, 12

# Width of a support ring, and its share of the distance to the next one.
_SUPPORT = 0.01


def ball(detail: float, *, tint: Colour = CLEAR) -> list[ObjectPart]:
    """A ball of 20 n^2 triangles of similar size."""
    pieces = max(2, round(_BALL_PIECES * detail))
    rough = trimesh.creation.icosahedron()
    corners = np.asarray(rough.vertices)[rough.faces]
    shares = [(i, j, pieces - i - j) for i in range(pieces + 1) for j in range(pieces + 1 - i)]
    points = np.einsum("sc,fcx->fsx", np.array(shares) / pieces, corners).reshape(-1, 3)
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    # Points of an edge occur once from either side.
    _, first = np.unique(np.round(points, 9) + 0.0, axis=0, return_index=True)
    vertices = BALL_RADIUS * points[np.sort(first)]
    # For points on a sphere, the convex hull is the best triangulation.
    return [_smooth(_outward_hull(vertices), tint)]


def cylinder(detail: float, *, tint: Colour = CLEAR) -> list[ObjectPart]:
    """An upright cylinder whose edges are rounded."""
    half, inner = CYLINDER_HALF_HEIGHT, CYLINDER_RADIUS - CYLINDER_FILLET
    segments = max(3, round(_FILLET_SEGMENTS * detail))
    angle = np.linspace(-0.5 * np.pi, 0.0, segments + 1)
    fillet = [
        inner + CYLINDER_FILLET * np.cos(angle),
        -half + CYLINDER_FILLET * (1.0 + np.sin(angle)),
    ]
    flat = np.array([[r, -half] for r in (inner / 3.0, inner / 1.5, inner - _SUPPORT)])
    heights = _supported(half - CYLINDER_FILLET)
    side = np.stack([np.full(len(heights), CYLINDER_RADIUS), heights], axis=-1)
    lower = np.concatenate([flat, np.stack(fillet, axis=-1)])
    profile = np.concatenate([lower, side, lower[::-1] * [1.0, -1.0]])
    sections = max(12, round(_SECTIONS * detail))
    return [_smooth(_turned(profile, sections, (-half, half)), tint)]


def torus(detail: float, *, tint: Colour = CLEAR) -> list[ObjectPart]:
    """A horizontal ring."""
    sections = max(12, round(_SECTIONS * detail))
    around = max(8, round(_SECTIONS * detail * TORUS_THICKNESS / TORUS_RADIUS))
    angle = 2.0 * np.pi * np.arange(around) / around
    profile = np.stack(
        [TORUS_RADIUS + TORUS_THICKNESS * np.cos(angle), TORUS_THICKNESS * np.sin(angle)], axis=-1
    )
    grid = np.arange(around * sections).reshape(around, sections)
    faces = _quads(np.concatenate([grid, grid[:1]]))
    return [_smooth(Surface(_points(profile, sections), faces), tint)]


def _smooth(surface: Surface, tint: Colour) -> ObjectPart:
    return ObjectPart("body", "glass", surface.vertices, surface.faces, tint=tint)


def _supported(half: float) -> Float[np.ndarray, " heights"]:
    """Returns heights between two ends (excluded), dense near the ends and sparse between them."""
    inner = half - _SUPPORT
    return np.concatenate([[-inner], np.linspace(-inner, inner, 6)[1:-1], [inner]])


def _outward_hull(vertices: Float[np.ndarray, "vertices 3"]) -> Surface:
    hull = ConvexHull(vertices)
    a, b, c = np.moveaxis(vertices[hull.simplices], 1, 0)
    inward = np.einsum("fc,fc->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return Surface(vertices, faces.astype(np.int64))


def _turned(
    profile: Float[np.ndarray, "rings 2"], sections: int, ends: tuple[float, float]
) -> Surface:
    """Revolves a profile around the z axis, from bottom to top, and closes it at both ends."""
    grid = np.arange(len(profile) * sections).reshape(len(profile), sections)
    low, high = grid.size, grid.size + 1
    after = np.roll(np.arange(sections), -1)
    caps = [
        [face for i in range(sections) for face in [[low, grid[0, after[i]], grid[0, i]]]],
        [face for i in range(sections) for face in [[high, grid[-1, i], grid[-1, after[i]]]]],
    ]
    vertices = [_points(profile, sections), [[0.0, 0.0, ends[0]], [0.0, 0.0, ends[1]]]]
    faces = np.concatenate([_quads(grid), *map(np.array, caps)])
    return Surface(np.concatenate(vertices), faces)


def _points(profile: Float[np.ndarray, "rings 2"], sections: int) -> Float[np.ndarray, "n 3"]:
    angle = 2.0 * np.pi * np.arange(sections) / sections
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    wide = profile[:, None, :1] * circle
    high = np.broadcast_to(profile[:, None, 1:], (*wide.shape[:2], 1))
    return np.concatenate([wide, high], axis=-1).reshape(-1, 3)


def _quads(grid: np.ndarray) -> np.ndarray:
    """Returns two triangles for every cell between rings of vertices."""
    below, above = grid[:-1], grid[1:]
    right_below, right_above = np.roll(below, -1, axis=1), np.roll(above, -1, axis=1)
    first = np.stack([below, right_below, right_above], axis=-1)
    second = np.stack([below, right_above, above], axis=-1)
    return np.stack([first, second], axis=2).reshape(-1, 3)


OBJECTS = (
    Object("ball", "smcvx", ball),
    Object("ball_coloured", "smcvx", partial(ball, tint=BLUE)),
    Object("cylinder", "smcvx", cylinder),
    Object("cylinder_coloured", "smcvx", partial(cylinder, tint=AMBER)),
    Object("torus", "smncvx", torus),
    Object("torus_coloured", "smncvx", partial(torus, tint=VIOLET)),
)
