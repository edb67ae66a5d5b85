"""Claim: vertex normals are exact on a ball, and no worse at bevels than weighted by angle.

    python -m benchmarks.vertex_normals [--spacing=0.05] [--points=50000]

Bodies with known normals are meshed by marching cubes, aligned with the grid and turned, with
vertices moved onto the true surface, and as bodies turned on a lathe or as convex hulls. The table
compares averages of face normals weighted by area, by angle, with Max's weights alone, and the
library's rule, which keeps large flat pieces flat. Angles to the true normals, in degrees, are
those at the vertices and those of interpolated shading normals at random points of the surface.

The edges of `rounded` bodies are arcs, which a mesh shows as four bevels; those of the `bevelled`
cylinder are three bevels, so the normals of the truth jump and no interpolation is exact. Asserted
are vertices of the ball, the torus, and the mean over the surface of all bodies with bevels.

The vertices of the `shaken` ball are moved by noise of a hundredth of a cell. Max's weights favour
small triangles, whose normals suffer most: then weights by area are best.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh
from absl import app, flags
from scipy.spatial import ConvexHull

from refref_jax.geometry.triangle_meshes import (
    average_normals,
    corner_angles,
    corner_normals,
    corner_weights,
    face_normals,
    face_vectors,
    smooth_groups,
    unit_vectors,
)
from refref_jax.reconstruct.grids import march

_SPACING = flags.DEFINE_float("spacing", 0.05, "Edge of a cell of the grid, world units.", 0.01)
_POINTS = flags.DEFINE_integer("points", 50000, "Points of each surface.", lower_bound=1)

_SEGMENTS = 64

# Half the edge of the grid, world units, and steps that move its vertices onto the surface.
_REACH = 1.4
_STEPS = 30

# Radii of the torus.
_RING, _TUBE = 0.88, 0.36

# Radius and half the height of the cylinder, and half the edge of the cube.
_RADIUS, _HALF = 0.9, 0.6
_CUBE = 0.8

# Cells of the torus's fine grid, as a share of the others.
_FINE = 0.4

# Standard deviation of the shaken ball's vertices, as a share of a cell.
_NOISE = 0.01

# Widths of edges: narrow ones, as of machined parts, and wide ones.
_NARROW, _WIDE = 0.05, 0.3

# Largest error at a vertex of the ball, degrees, and mean error at vertices of the torus by a fine
# grid, as a share of that by angle.
_EXACT = 1e-3
_SHARE = 0.42

_RULES = ("area", "angle", "Max", "library")


class Errors(NamedTuple):
    """Angles to the true normals, in degrees: mean, 99 % quantile and largest.

    Attributes:
      vertices: errors of normals at the corners of the faces.
      surface: errors of interpolated normals at random points.
    """

    vertices: tuple[float, float, float]
    surface: tuple[float, float, float]


class Case(NamedTuple):
    """A true surface, and a mesh of it.

    Attributes:
      name: name of the body, then of the mesh.
      field: function of points, zero on the surface and positive outside.
      vertices, faces: the mesh.
      smooth: whether the true normals at vertices are known.
    """

    name: tuple[str, str]
    field: Callable[[np.ndarray], np.ndarray]
    vertices: np.ndarray
    faces: np.ndarray
    smooth: bool = True


def main(arguments: list[str]) -> None:
    del arguments
    columns = [f"{at}_{what}" for at in ("vertices", "surface") for what in ("mean", "99", "most")]
    print(",".join(["body", "mesh", "faces", "weights", *columns]))
    found = {case.name: _measure(case) for case in _cases()}
    for (name, mesh), errors in found.items():
        ours, angle = errors["library"], errors["angle"]
        if name == "ball":
            assert ours.vertices[-1] < _EXACT, f"ball, {mesh}: {ours.vertices[-1]:.2g} degrees"
        elif "rounded" in name or "bevelled" in name:
            assert ours.surface[0] < angle.surface[0], f"{name}, {mesh}: worse than by angle"
    errors = found["torus", "fine grid"]
    mean, by_angle = (errors[rule].vertices[0] for rule in ("library", "angle"))
    assert mean < _SHARE * by_angle, f"torus: {mean:.3f} degrees, by angle {by_angle:.3f}"


def _measure(case: Case) -> dict[str, Errors]:
    """Prints the rows of a mesh, and returns its errors by rule."""
    generator = np.random.default_rng(0)
    areas = np.linalg.norm(face_vectors(case.vertices, case.faces), axis=-1)
    face = generator.choice(len(areas), _POINTS.value, p=areas / areas.sum())
    shares = generator.dirichlet(np.ones(3), _POINTS.value)
    points = np.einsum("pk,pki->pi", shares, case.vertices[case.faces[face]])
    expected = _slopes(case.field, _onto(case.field, points))
    at_vertices = _slopes(case.field, case.vertices)[case.faces]
    errors = {}
    for rule in _RULES:
        normals = _average(rule, case)
        shaded = unit_vectors(np.einsum("pk,pki->pi", shares, normals[face]))
        errors[rule] = Errors(_spread(normals, at_vertices), _spread(shaded, expected))
        known = errors[rule].vertices if case.smooth else (math.nan,) * 3
        figures = [f"{x:.3f}" for x in (*known, *errors[rule].surface)]
        print(",".join([*case.name, str(len(case.faces)), rule, *figures]), flush=True)
    return errors


def _average(rule: str, case: Case) -> np.ndarray:
    """Returns normals at corners by a rule."""
    if rule == "library":
        return corner_normals(case.vertices, case.faces)
    corners = case.vertices[case.faces]
    areas = np.linalg.norm(face_vectors(case.vertices, case.faces), axis=-1)
    weights = {
        "area": np.repeat(areas[:, None], 3, axis=1),
        "angle": corner_angles(corners),
        "Max": corner_weights(corners),
    }[rule]
    return average_normals(face_normals(corners), smooth_groups(case.vertices, case.faces), weights)


def _spread(normals: np.ndarray, expected: np.ndarray) -> tuple[float, float, float]:
    """Returns the mean, the 99 % quantile and the largest of the angles between unit vectors."""
    half = np.minimum(0.5 * np.linalg.norm(normals - expected, axis=-1), 1.0)
    angles = np.degrees(2.0 * np.arcsin(half))
    return float(angles.mean()), float(np.quantile(angles, 0.99)), float(angles.max())


def _cases() -> list[Case]:
    """Returns all bodies and meshes: the grid's first, then those of a lathe, then hulls."""
    turn = trimesh.transformations.euler_matrix(0.3, 0.2, 0.1)[:3, :3]
    cases = [Case((name, "grid"), field, *_grid(field, turn)) for name, field in _FIELDS.items()]
    for name, field in _FIELDS.items():
        if "cylinder" in name or "cube" in name:
            cases.append(Case((name, "aligned grid"), field, *_grid(field)))
    vertices, faces = _grid(_ball, turn)
    noise = np.random.default_rng(0).normal(size=vertices.shape)
    shaken = vertices + _NOISE * _SPACING.value * noise
    cases.append(Case(("shaken ball", "grid"), _ball, shaken, faces))
    fine = _grid(_torus, turn, spacing=_FINE * _SPACING.value)
    cases.append(Case(("torus", "fine grid"), _torus, *fine))
    torus = trimesh.creation.torus(_RING, _TUBE, major_sections=_SEGMENTS, minor_sections=32)
    cases.append(Case(("torus", "lathe"), _torus, np.array(torus.vertices), np.array(torus.faces)))
    for name, profile in _profiles().items():
        cases.append(Case((name, "lathe"), _FIELDS[name], *_lathe(profile)))
    for name, width in (("rounded cube", _NARROW), ("wide rounded cube", _WIDE)):
        cases.append(Case((name, "hull"), _FIELDS[name], *_hull(width)))
    return [case._replace(smooth="bevelled" not in case.name[0]) for case in cases]


def _ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=-1) - 1.0


def _torus(points: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(points[..., 0], points[..., 1]) - _RING, points[..., 2]) - _TUBE


def _flask(points: np.ndarray) -> np.ndarray:
    return np.sum(points[..., :2] ** 2, axis=-1) - _squared_radius(points[..., 2])


def _squared_radius(z: np.ndarray) -> np.ndarray:
    """Returns the squared radius of the flask, a belly with a neck, at a height from -1 to 1."""
    return (1.0 - z**2) * (0.08 + 0.6 * np.exp(-(((z + 0.45) / 0.4) ** 2)))


def _rounded(sides: np.ndarray, radius: float) -> np.ndarray:
    """Returns the distance to a body with rounded edges, from those to the planes of its sides."""
    beyond = sides + radius
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return outside + np.minimum(beyond.max(axis=-1), 0.0) - radius


def _cylinder_sides(points: np.ndarray) -> np.ndarray:
    radial = np.hypot(points[..., 0], points[..., 1])
    return np.stack([radial - _RADIUS, np.abs(points[..., 2]) - _HALF], axis=-1)


def _bevelled_cylinder(points: np.ndarray) -> np.ndarray:
    normals, corners = _bevels()
    sides = _cylinder_sides(points) + np.array([_RADIUS, _HALF])
    return np.max(sides @ normals.T - np.sum(normals * corners, axis=-1), axis=-1)


def _bevels() -> tuple[np.ndarray, np.ndarray]:
    """Returns the normals (r, z) of lid, bevels and side, and the upper end of each but the lid."""
    angles = np.linspace(0.0, 0.5 * np.pi, 5)
    normals = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    along = _NARROW * np.stack([np.cos(angles), -np.sin(angles)], axis=-1)[1:-1]
    corners = np.cumsum(np.concatenate([[[0.0, 0.0]], along]), axis=0)
    corners += [_RADIUS - corners[-1, 0], _HALF]
    return normals, np.concatenate([corners[:1], corners])


_FIELDS = {
    "ball": _ball,
    "torus": _torus,
    "flask": _flask,
    "rounded cylinder": lambda p: _rounded(_cylinder_sides(p), _NARROW),
    "wide rounded cylinder": lambda p: _rounded(_cylinder_sides(p), _WIDE),
    "bevelled cylinder": _bevelled_cylinder,
    "rounded cube": lambda p: _rounded(np.abs(p) - _CUBE, _NARROW),
    "wide rounded cube": lambda p: _rounded(np.abs(p) - _CUBE, _WIDE),
}


def _slopes(field: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Returns the unit gradients of a field by central differences."""
    return unit_vectors(_gradient(field, points))


def _gradient(field: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    steps = 1e-6 * np.eye(3)
    return np.stack([(field(points + s) - field(points - s)) / 2e-6 for s in steps], axis=-1)


def _onto(field: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Returns points moved along the gradient to where a field is zero."""
    for _ in range(_STEPS):
        slope = _gradient(field, points)
        points = points - (field(points) / np.sum(slope**2, axis=-1))[:, None] * slope
    return points


def _grid(
    field: Callable[[np.ndarray], np.ndarray],
    turn: np.ndarray | None = None,
    *,
    spacing: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a surface by marching cubes on a grid that is turned against the body."""
    turn = np.eye(3) if turn is None else turn
    spacing = spacing or _SPACING.value
    ticks = np.arange(-_REACH, _REACH, spacing) + 0.2 * spacing
    at = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1)
    vertices, faces = march(field(at @ turn), spacing)
    return _onto(field, (vertices + ticks[0]) @ turn), faces


def _profiles() -> dict[str, np.ndarray]:
    """Returns profiles (r, z) from pole to pole, from below."""
    turns = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 33)
    heights = np.sin(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 49))
    radii = np.sqrt(np.maximum(_squared_radius(heights), 0.0))
    ball = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    ball[[0, -1], 0] = radii[[0, -1]] = 0.0
    upper = {"bevelled cylinder": _bevels()[1][1:]}
    for name, radius in (("rounded cylinder", _NARROW), ("wide rounded cylinder", _WIDE)):
        angle = np.linspace(0.0, 0.5 * np.pi, 5)[:, None]
        circle = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
        upper[name] = np.array([_RADIUS, _HALF]) - radius * (1.0 - circle)
    return {"ball": ball, "flask": np.stack([radii, heights], axis=-1)} | {
        name: np.concatenate([[[0.0, -_HALF]], rim * [1.0, -1.0], rim[::-1], [[0.0, _HALF]]])
        for name, rim in upper.items()
    }


def _lathe(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turned = trimesh.creation.revolve(profile, sections=_SEGMENTS)
    return np.array(turned.vertices), np.array(turned.faces)


def _hull(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns a cube with rounded edges as the convex hull of points on its corners."""
    polar, around = np.meshgrid(*[np.linspace(0.0, 0.5 * np.pi, 5)] * 2)
    flat = np.sin(polar)
    octant = np.stack([flat * np.cos(around), flat * np.sin(around), np.cos(polar)], axis=-1)
    corner = _CUBE - radius + radius * octant.reshape(-1, 3)
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 1, 3)
    points = np.unique((signs * corner).reshape(-1, 3).round(12), axis=0)
    found = ConvexHull(points, qhull_options="Qt")
    outward = face_vectors(points, found.simplices) * found.equations[:, :3]
    faces = np.where(outward.sum(axis=-1)[:, None] > 0.0, found.simplices, found.simplices[:, ::-1])
    used, numbers = np.unique(faces, return_inverse=True)
    return points[used], numbers.reshape(-1, 3)


if __name__ == "__main__":
    app.run(main)
