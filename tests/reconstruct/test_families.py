"""Spheres, tori, surfaces of revolution and polyhedra, found in noisy meshes."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from trimesh.convex import convex_hull
from trimesh.creation import torus as trimesh_torus

from refref_jax.geometry.triangle_meshes import diameter, face_normals, make_mesh, volume
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.families import (
    Revolution,
    candidates,
    fit_revolution,
    fit_sphere,
    fit_torus,
)
from refref_jax.reconstruct.polyhedra import fit_polyhedron, with_right_angles
from refref_jax.reconstruct.revolution import (
    Axis,
    Profile,
    axis_of_inertia,
    find_axis,
    lathe,
    outline,
    section,
    sweep,
)
from refref_jax.reconstruct.shapes import cloud_of, frame_along, mesh_of
from tests.factories import bodies, revolved
from tests.laws import posed_surfaces

_TURN = frame_along(np.array([0.3, -0.5, 0.81]))
_AXIS = _TURN[:, 2]
_FAR = np.array([100.0, -50.0, 3.0])
_SCALE = 0.01


def _far(mesh):
    """The mesh small, turned and far from the origin."""
    return revolved.placed(mesh, turn=_TURN, offset=_FAR, scale=_SCALE)


def _from_far(points):
    return (points - _FAR) @ _TURN / _SCALE


def _angle(direction):
    return np.degrees(np.arccos(min(abs(float(direction @ _AXIS)), 1.0)))


def _body(name):
    profile, closed = {
        "cylinder": (revolved.cylinder(), False),
        "vase": (revolved.vase(), False),
        "cup": (revolved.cup(), False),
        "ring": (revolved.ring(), True),
    }[name]
    points = revolved.even(profile, 160, closed=closed)
    return revolved.revolve(points, closed=closed, azimuths=96), profile, closed


@pytest.fixture(scope="module")
def ball():
    return bodies.icosphere(5, radius=1.3)


@pytest.fixture(scope="module")
def torus():
    return bodies.as_mesh(trimesh_torus(1.1, 0.5, major_sections=128, minor_sections=64))


@pytest.fixture(
    scope="module",
    params=[
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("cylinder", "ring", "vase")),
        "cup",
    ],
)
def fitted(request):
    mesh, profile, closed = _body(request.param)
    shape = fit_revolution(_far(revolved.noisy(mesh, 0.005)))
    return request.param, shape, profile, closed


def test_a_ball_is_found_under_noise(ball):
    centre, radius = np.split(fit_sphere(_far(revolved.noisy(ball, 0.01))).start(), [3])
    assert np.linalg.norm(centre - _FAR) < 5e-4 * _SCALE
    assert radius[0] == pytest.approx(1.3 * _SCALE, abs=5e-4 * _SCALE)


def test_a_ball_without_noise_is_exact(ball):
    start = fit_sphere(revolved.placed(ball, offset=2.0)).start()
    assert np.allclose(start, [2.0, 2.0, 2.0, 1.3], atol=1e-9)


def test_the_ball_as_a_shape(ball):
    shape = fit_sphere(ball)
    posed = shape.pose(np.array([1.0, 2.0, 3.0, 0.5]))
    assert len(posed.faces) >= 20_000
    assert np.allclose(np.linalg.norm(posed.vertices - [1.0, 2.0, 3.0], axis=-1), 0.5)
    posed_surfaces.assert_closed(posed)
    posed_surfaces.assert_derivatives(shape)
    posed_surfaces.assert_prior(shape)


def test_a_torus_is_found_under_noise(torus):
    shape = fit_torus(_far(revolved.noisy(torus, 0.01)))
    assert _angle(shape.axis.frame[:, 2]) < 0.05
    assert np.linalg.norm(shape.axis.point - _FAR) < 1e-3 * _SCALE
    assert np.allclose(shape.start()[5:] / _SCALE, [1.1, 0.5], atol=2e-3)


def test_the_torus_as_a_shape(torus):
    shape = fit_torus(torus)
    posed = shape.pose(shape.start())
    assert len(posed.faces) >= 30_000
    distance = bodies.torus(posed.vertices, large=1.1, small=0.5)
    assert np.abs(distance).max() < 1e-4
    posed_surfaces.assert_closed(posed)
    posed_surfaces.assert_derivatives(_shape_far(fit_torus, torus), step=1e-3, tolerance=1e-5)
    posed_surfaces.assert_derivatives(shape)
    posed_surfaces.assert_prior(shape)


def _shape_far(fit, mesh):
    return fit(_far(mesh))


def test_the_axis_of_revolution(fitted):
    _, shape, _, _ = fitted
    assert _angle(shape.axis.frame[:, 2]) < 0.06
    away = shape.axis.point - _FAR
    assert np.linalg.norm(away - (away @ _AXIS) * _AXIS) < 5e-4 * _SCALE


def test_the_profile_of_revolution(fitted):
    """Noise of 0.005 leaves 0.001 of it, and normals off by half a degree (median)."""
    name, shape, profile, closed = fitted
    assert shape.closed == closed
    posed = shape.pose(shape.start())
    local = _from_far(posed.vertices)
    flat = np.stack([np.linalg.norm(local[:, :2], axis=-1), local[:, 2]], axis=-1)
    true = revolved.even(profile, 4000, closed=closed)
    away, _ = KDTree(true).query(flat)
    assert np.sqrt(np.mean(away**2)) < 0.002
    assert away.max() < (0.01 if name == "cup" else 0.005)
    # Steps are up to 0.055 long where the profile is straight.
    assert KDTree(flat).query(true)[0].max() < 0.03
    posed_surfaces.assert_closed(posed)


@pytest.mark.slow
def test_flat_lids_stay_flat_and_rims_stay_narrow():
    mesh, _, _ = _body("cylinder")
    posed = fit_revolution(revolved.noisy(mesh, 0.005)).pose(np.zeros(40))
    radius = np.linalg.norm(posed.vertices[:, :2], axis=-1)
    normals = np.zeros_like(posed.vertices)
    normals[posed.faces] = posed.normals[posed.normal_ids]
    # The rim is from 0.92 to 1. What is lost is confined to a few hundredths around it.
    lid = radius < 0.88
    assert np.degrees(np.arccos(np.abs(normals[lid, 2]))).mean() < 1.0
    assert np.abs(np.abs(posed.vertices[lid, 2]) - 1.0).max() < 0.004
    side = np.abs(posed.vertices[:, 2]) < 0.85
    assert np.degrees(np.arcsin(np.abs(normals[side, 2]))).mean() < 1.2


@pytest.mark.slow
def test_a_sharp_rim_becomes_as_round_as_the_smoothing():
    corners = np.array([[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]])
    mesh = revolved.revolve(revolved.even(corners, 160), azimuths=96)
    posed = fit_revolution(mesh).pose(np.zeros(40))
    away = np.abs(
        bodies.box(
            np.stack([*_flat(posed.vertices).T, 0.0 * posed.vertices[:, 0]], -1),
            half=(1.0, 1.0, 9.0),
        )
    )
    assert away.max() < 0.006 * diameter(mesh.vertices)
    near = np.hypot(_flat(posed.vertices)[:, 0] - 1.0, np.abs(posed.vertices[:, 2]) - 1.0)
    assert away[near > 0.06].max() < 0.0015


def _flat(vertices):
    return np.stack([np.linalg.norm(vertices[:, :2], axis=-1), vertices[:, 2]], axis=-1)


@pytest.fixture(scope="module")
def vase():
    return fit_revolution(_body("vase")[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vase", "ring"])
def test_revolution_as_a_shape(name, vase):
    shape = vase if name == "vase" else fit_revolution(_body(name)[0])
    assert len(shape.start()) == 40
    posed_surfaces.assert_derivatives(shape)
    posed_surfaces.assert_prior(shape)


def test_an_even_offset_moves_the_profile_along_its_normals(vase):
    grown = vase.profile(np.append(np.zeros(4), np.full(36, 0.01)))
    assert np.allclose(grown.points, vase.points + 0.01 * vase.directions, atol=1e-12)
    # The poles stay on the axis, and the normals there along it.
    assert np.allclose(grown.points[[0, -1], 0], 0.0, atol=1e-12)
    assert np.allclose(grown.normals[[0, -1]], [[0.0, -1.0], [0.0, 1.0]], atol=1e-12)


def test_waves_between_knots_are_smoothed():
    """A ball whose profile has waves of a third of the distance between knots."""
    angle = np.linspace(0.0, np.pi, 801)
    radius = 1.0 + 0.003 * np.cos(100.0 * angle)
    points = np.stack([radius * np.sin(angle), -radius * np.cos(angle)], axis=-1)
    points[[0, -1], 0] = 0.0
    shape = Revolution(Axis(np.zeros(3), np.eye(3)), Profile(points, False), 2.0)
    away = np.linalg.norm(shape.points, axis=-1) - 1.0
    # The ends of a spline follow the last wave.
    assert np.abs(away[4:-4]).max() < 0.001
    assert np.sqrt(np.mean(away**2)) < 0.0005


@pytest.mark.slow
def test_the_fit_is_equivariant():
    mesh = revolved.noisy(_body("vase")[0], 0.005)
    near, far = fit_revolution(mesh), fit_revolution(revolved.placed(mesh, offset=_FAR, scale=0.01))
    moved = far.pose(far.start()).vertices
    assert np.allclose((moved - _FAR) / 0.01, near.pose(near.start()).vertices, atol=1e-6)


def test_the_axis_of_a_cone_by_hand():
    cone = revolved.revolve(revolved.even([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]], 60))
    axis = find_axis(cloud_of(revolved.placed(cone, offset=np.array([1.0, 2.0, 3.0]))))
    assert np.allclose(axis.frame[:, 2], [0.0, 0.0, 1.0], atol=1e-6)
    assert np.allclose(axis.point[:2], [1.0, 2.0], atol=1e-6)


def _bottle(*, sides, ridges, lump=0.0):
    """A bottle with ridges along its sides, and a lump on one of them; the axis is z."""
    profile = [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.4, 2.4], [0.4, 3.0], [0.0, 3.0]]
    round_one = revolved.revolve(revolved.even(profile, 150))
    x, y, z = round_one.vertices.T
    azimuth = np.arctan2(y, x)
    factor = 1.0 + ridges * np.cos(sides * azimuth) * np.clip((2.6 - z) / 0.6, 0.0, 1.0)
    factor += lump * np.exp(-((azimuth / 0.3) ** 2) - ((z - 1.5) / 0.3) ** 2)
    vertices = np.stack([factor * x, factor * y, z], axis=-1)
    return revolved.noisy(make_mesh(vertices, round_one.faces), 0.005)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sides", "ridges", "lump", "furthest"),
    [
        (5, 0.3, 0.0, 0.04),
        (5, 0.3, 0.3, 0.04),
        (5, 0.1, 0.3, 0.03),
        (3, 0.2, 0.0, 0.03),
    ],
)
def test_the_axis_of_a_bottle_with_ridges(sides, ridges, lump, furthest):
    mesh = _bottle(sides=sides, ridges=ridges, lump=lump)
    axis = fit_revolution(mesh, furthest=furthest).axis
    assert np.degrees(np.arccos(axis.frame[2, 2])) < 0.8
    middle = axis.point + axis.frame[:, 2] * (1.5 - axis.point[2]) / axis.frame[2, 2]
    assert np.hypot(*middle[:2]) < 0.04


def test_the_axis_of_inertia_far_from_the_origin():
    bottle = _bottle(sides=5, ridges=0.3)
    near, far = axis_of_inertia(bottle), axis_of_inertia(_far(bottle))
    np.testing.assert_allclose(far.frame[:, 2] @ _TURN, near.frame[:, 2], atol=1e-9)
    np.testing.assert_allclose(_from_far(far.point), near.point, atol=1e-9)
    with pytest.raises(ReconstructionError, match="inwards"):
        axis_of_inertia(bottle._replace(faces=bottle.faces[:, ::-1]))


def test_a_section_measures_shares_of_circles():
    """The circle of radius 1.2 is inside a square of half-width 1 for 1 - 8 acos(1/1.2) / 2 pi."""
    box = bodies.fine_box(half=1.0, spacing=0.1)
    axis = find_axis(cloud_of(box))._replace(point=np.zeros(3), frame=np.eye(3))
    found = section(box, axis, diameter(box.vertices))
    row = found.shares[len(found.shares) // 2]
    radius = found.cell * (np.arange(len(row)) + 0.5)
    assert np.interp(0.5, radius, row) == pytest.approx(1.0, abs=1e-9)
    inside = 1.0 - 8.0 * np.arccos(1.0 / 1.2) / (2.0 * np.pi)
    assert np.interp(1.2, radius, row) == pytest.approx(inside, abs=0.01)
    assert np.interp(1.5, radius, row) == pytest.approx(0.0, abs=1e-9)
    profile = outline(found)
    assert not profile.closed and np.all(profile.points[[0, -1], 0] == 0.0)
    # Half of a circle is inside up to the radius 1 / cos(pi / 8).
    assert profile.points[:, 0].max() == pytest.approx(1.0 / np.cos(np.pi / 8.0), abs=0.01)


def test_creases_have_two_normals():
    """A cylinder of three segments: its volume, and normals that stay with their segment."""
    profile = np.array([[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]])
    segments = np.array([[0, 1], [1, 2], [2, 3]])
    normals, ends = (
        np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0]]),
        np.array([[0, 0], [1, 1], [2, 2]]),
    )
    connected = lathe(profile[:, 0] == 0.0, segments, ends, 64)
    vertices, _ = sweep(profile, np.zeros((4, 2, 0)), np.eye(3), 64)
    swept, _ = sweep(normals, np.zeros((3, 2, 0)), np.eye(3), 64)
    vertices = vertices[connected.rows]
    assert len(vertices) == 2 + 2 * 64 and len(connected.faces) == 4 * 64
    area = 32.0 * np.sin(2.0 * np.pi / 64)
    assert volume(vertices, connected.faces) == pytest.approx(2.0 * area)
    flat = face_normals(vertices[connected.faces])
    at_corners = np.sum(swept[connected.normal_ids] * flat[:, None], axis=-1)
    assert at_corners.min() > np.cos(np.pi / 64) - 1e-9


def _icosahedron():
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    ends = [[0.0, s, t * golden] for s in (-1.0, 1.0) for t in (-1.0, 1.0)]
    return bodies.as_mesh(convex_hull(np.concatenate([np.roll(ends, i, axis=1) for i in range(3)])))


def test_a_noisy_box_is_a_polyhedron():
    box = bodies.fine_box(spacing=0.05)
    shape = fit_polyhedron(_far(revolved.noisy(box, 0.005)))
    posed = shape.pose(shape.start())
    corners = _from_far(posed.vertices)
    assert len(corners) == 8 and len(posed.faces) == 12
    assert np.abs(np.abs(corners) - 0.8).max() < 0.002
    posed_surfaces.assert_closed(posed)


def test_corners_where_five_planes_meet():
    mesh = _icosahedron()
    shape = fit_polyhedron(mesh)
    posed = shape.pose(shape.start())
    assert len(posed.vertices) == 12 and len(shape.start()) == 60
    assert KDTree(mesh.vertices).query(posed.vertices)[0].max() < 1e-9
    posed_surfaces.assert_closed(posed)
    posed_surfaces.assert_derivatives(shape)
    posed_surfaces.assert_prior(shape)


def _prism(sides, *, warp=0.0):
    """A prism with as many sides; the top of one with five is cut at an angle.

    A projective map keeps its faces flat, but not their angles.
    """
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    top = 0.7 + (0.3 * ring[:, :1] if sides == 5 else np.zeros((sides, 1)))
    low, high = np.append(ring, np.full((sides, 1), -0.7), axis=1), np.append(ring, top, axis=1)
    points = np.concatenate([low, high]) @ _TURN.T
    return bodies.as_mesh(convex_hull(points / (1.0 + points @ (warp * np.ones((3, 1))))))


# A box has a turn and six distances. A prism with n sides has the direction of its axis, as many
# azimuths as pairs of sides, and n + 2 distances; with five sides each has its azimuth, and the top
# has its tilt.
@pytest.mark.slow
@pytest.mark.parametrize(("sides", "unknowns"), [(4, 9), (6, 13), (5, 16)])
def test_nearly_right_angles_become_right(sides, unknowns):
    warped = fit_polyhedron(_prism(sides, warp=0.004))
    shape = with_right_angles(warped)
    assert len(shape.start()) == unknowns
    off, true = (each.planes[:, :3] for each in (warped, fit_polyhedron(_prism(sides))))
    true = true[np.argmax(off @ true.T, axis=1)]
    exact, off = true @ true.T, off @ off.T
    right = (np.abs(exact) < 1e-9) | (exact < -1.0 + 1e-9)
    assert np.abs(off - exact)[right].max() > 2e-3
    found = shape.pose(shape.start())
    np.testing.assert_allclose((found.normals @ found.normals.T)[right], exact[right], atol=1e-9)
    posed_surfaces.assert_closed(found)
    posed_surfaces.assert_derivatives(shape)
    posed_surfaces.assert_prior(shape)
    # A step of half a degree keeps them, to first order.
    moved = shape.pose(np.random.default_rng(0).normal(0.0, 0.3, unknowns)).normals
    np.testing.assert_allclose((moved @ moved.T)[right], exact[right], atol=1e-3)


# Neighbouring sides of the narrower one are within 3 degrees of perpendicular; those of the wider
# one are not, whose top and bottom are parallel.
@pytest.mark.parametrize(("top", "unknowns"), [(0.5, 16), (0.7, None), (0.8, None)])
def test_a_frustum_is_no_prism(top, unknowns):
    square = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    low, high = (
        np.append(square, -np.ones((4, 1)), axis=1),
        np.append(top * square, np.ones((4, 1)), axis=1),
    )
    frustum = fit_polyhedron(bodies.as_mesh(convex_hull(np.concatenate([low, high]) @ _TURN.T)))
    shape = with_right_angles(frustum)
    assert (shape and len(shape.start())) == unknowns
    if shape is not None:
        np.testing.assert_allclose(
            shape.pose(shape.start()).normals, frustum.planes[:, :3], atol=1e-9
        )


def _tetrahedron():
    return bodies.as_mesh(convex_hull(np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])))


def test_a_polyhedron_without_right_angles_has_none():
    assert with_right_angles(fit_polyhedron(_tetrahedron())) is None


@pytest.mark.slow
def test_what_is_far_from_a_family_is_none(ball):
    blob, box = _far(revolved.blob(ball)), bodies.fine_box(spacing=0.1)
    assert fit_sphere(box) is None and fit_torus(box) is None and fit_revolution(box) is None
    for fit in (fit_sphere, fit_torus, fit_revolution, fit_polyhedron):
        assert fit(blob) is None
    assert fit_polyhedron(ball) is None and fit_torus(ball) is None
    assert fit_polyhedron(_body("cylinder")[0]) is None


def test_a_dented_box_is_no_convex_polyhedron():
    box = bodies.fine_box(spacing=0.05)
    notch = np.all(box.vertices > 0.2, axis=1)
    dented = make_mesh(np.where(notch[:, None], 0.2, box.vertices), box.faces)
    assert fit_polyhedron(dented) is None


@pytest.mark.slow
def test_candidates_are_ordered_and_near(ball, torus):
    shapes = candidates(ball)
    assert [shape.name for shape in shapes] == ["sphere", "surface of revolution", "free surface"]
    for shape in shapes:
        mesh = mesh_of(shape.pose(shape.start()))
        assert np.abs(np.linalg.norm(mesh.vertices, axis=-1) - 1.3).max() < 0.002
    names = [shape.name for shape in candidates(torus)]
    assert names == ["torus", "surface of revolution", "free surface"]
    assert [shape.name for shape in candidates(bodies.fine_box())] == ["polyhedron", "free surface"]


def test_an_inverted_mesh_is_refused(ball):
    for fit in (fit_sphere, fit_torus, fit_revolution, fit_polyhedron):
        with pytest.raises(ReconstructionError, match="inwards"):
            fit(bodies.inverted(ball))


@pytest.mark.parametrize("name", ["line", "arc"])
def test_curvature_does_not_change_along_lines_and_arcs(name):
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 400)
    ball = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    cone = np.array([(0.0, -1.0), (0.9, -1.0), (0.4, 1.0), (0.0, 1.0)])
    profile = Profile(ball if name == "arc" else revolved.even(cone, 400), closed=False)
    body = Revolution(Axis(np.zeros(3), np.eye(3)), profile, 2.0, knots=200)
    changes, by_offsets = body.curvature_changes()
    # The corners of the cone are where second differences change.
    smooth = slice(20, -20) if name == "arc" else slice(80, 130)
    assert np.abs(changes[smooth]).max() < 1e-6
    assert name == "arc" or np.abs(changes).max() > 1e-3
    wave = np.cos(np.pi * np.arange(200))
    assert np.abs(by_offsets @ wave).min() == pytest.approx(8.0)
