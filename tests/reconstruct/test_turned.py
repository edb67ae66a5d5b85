"""Turned bodies of straight pieces: geometry, derivatives, and fits to noisy meshes."""

import numpy as np
import pytest

from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.families import candidates
from refref_jax.reconstruct.revolution import Axis, Profile
from refref_jax.reconstruct.shapes import frame_along, mesh_of
from refref_jax.reconstruct.turned import StraightTurned, rounded, sampled
from refref_jax.reconstruct.turned_fit import (
    even_samples,
    find_corners,
    fit_turned,
    straight_pieces,
)
from tests.factories import bodies, revolved
from tests.laws import posed_surfaces

_TURN = frame_along(np.array([0.3, -0.5, 0.81]))
_FAR = np.array([100.0, -50.0, 3.0])
_SCALE = 0.01
_ORIGIN = Axis(np.zeros(3), np.eye(3))

# Corners, fillets, and whether the profile is closed.
_BODIES = {
    "cylinder": ([[0, -1], [0.9, -1], [0.9, 1], [0, 1]], [0.06, 0.06], False),
    "cone": ([[0, -1], [1, -1], [0.5, 1], [0, 1]], [0.05, 0.1], False),
    "tip": ([[0, -1], [1, -1], [0, 1]], [0.05], False),
    "ring": ([[0.8, -0.3], [1.4, -0.3], [1.4, 0.3], [0.8, 0.3]], [0.05, 0.05, 0.1, 0.1], True),
    "bottle": (
        [[0, -1], [0.9, -1], [0.9, -0.3], [0.3, 0.5], [0.3, 1.2], [0, 1.2]],
        [0.1, 0.2, 0.1, 0.02],
        False,
    ),
}


def _parts(name):
    corners, fillets, closed = _BODIES[name]
    return np.array(corners, float), np.array(fillets), closed


def _shape(name):
    corners, fillets, closed = _parts(name)
    return StraightTurned(_ORIGIN, corners, fillets, 2.5, closed=closed)


def _mesh(name):
    corners, fillets, closed = _parts(name)
    points, _ = sampled(rounded(corners, fillets, closed), 2, 24)
    points = revolved.even(points, 160, closed=closed)
    return revolved.revolve(points, closed=closed, azimuths=96)


def _far(mesh):
    """The mesh noisy, small, turned and far from the origin."""
    return revolved.placed(revolved.noisy(mesh, 0.005), turn=_TURN, offset=_FAR, scale=_SCALE)


def test_a_fillet_by_hand():
    """A square corner with a fillet of 0.1: both lines lose 0.1, the arc is about (0.9, 0.1)."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.0, 2.0]])
    arcs = rounded(corners, np.array([0.1, 0.15]), False)
    assert np.allclose(arcs.lines[0], [[0.0, 0.0], [1.0, 0.1], [0.85, 2.0]], atol=1e-6)
    assert np.allclose(arcs.lines[1], [[0.9, 0.0], [1.0, 1.85], [0.0, 2.0]], atol=1e-6)
    points, normals = sampled(arcs, 1, 4)
    assert len(points) == 3 * 2 + 2 * 3
    assert np.allclose(points[2:5], [0.9, 0.1] + 0.1 * normals[2:5], atol=1e-6)
    angle = np.radians([-67.5, -45.0, -22.5])
    assert np.allclose(normals[2:5], np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    assert np.allclose(normals[[0, 5]], [[0.0, -1.0], [1.0, 0.0]])


def test_a_fillet_to_the_right():
    """Where the profile turns to the right, the centre of the arc is outside."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, -1.0], [0.0, -1.0]])
    points, normals = sampled(rounded(corners, np.array([0.1, 0.1]), False), 1, 4)
    assert np.allclose(points[2:5], [0.9, -0.1] - 0.1 * normals[2:5], atol=1e-6)


@pytest.mark.parametrize("closed", [False, True])
def test_fillets_that_are_too_large_do_not_overlap(closed):
    first = 1.0 if closed else 0.0
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) + np.array([first, 0.0])
    arcs = rounded(corners, np.full(4 if closed else 2, 5.0), closed)
    along = np.stack([-arcs.normals[:, 1], arcs.normals[:, 0]], axis=-1)
    assert np.sum((arcs.lines[1] - arcs.lines[0]) * along, axis=-1).min() >= 0.0
    assert np.all(arcs.radii <= 0.5 + 0.5 * (not closed)) and np.all(arcs.radii > 0.4)


def test_a_sharp_corner_has_normals():
    corners, _, _ = _parts("cylinder")
    points, normals = sampled(rounded(corners, np.zeros(2), False), 2, 8)
    assert np.all(np.isfinite(points)) and np.allclose(np.linalg.norm(normals, axis=-1), 1.0)
    assert np.allclose(points[3:10], [0.9, -1.0])
    shape = StraightTurned(_ORIGIN, corners, np.zeros(2), 2.5)
    at = shape.start()
    at[-2:] = -1.0
    posed = shape.pose(at)
    assert np.all(shape.fillets(at) >= 0.0) and np.all(shape.fillets(at) < 1e-30)
    for values in (posed.vertices, posed.by_vertices, posed.by_normals):
        assert np.all(np.isfinite(values))


@pytest.mark.parametrize("name", list(_BODIES))
def test_the_body_as_a_shape(name):
    shape = _shape(name)
    corners, fillets, closed = _parts(name)
    assert len(shape.start()) == 4 + 3 * len(corners) - (0 if closed else 4)
    assert np.allclose(shape.corners(shape.start()), corners)
    assert np.allclose(shape.fillets(shape.start()), fillets)
    posed_surfaces.assert_closed(shape.pose(shape.start()))
    posed_surfaces.assert_derivatives(shape, step=1e-4)
    posed_surfaces.assert_prior(shape)


def test_vertices_lie_on_the_cylinder():
    posed = _shape("cylinder").pose(_shape("cylinder").start())
    flat = np.stack([np.linalg.norm(posed.vertices[:, :2], axis=-1), posed.vertices[:, 2]], axis=-1)
    # The body is what is within 0.06 of a smaller cylinder.
    away = np.maximum(np.abs(flat) - [0.84, 0.94], 0.0)
    inside = np.max(np.abs(flat) - [0.84, 0.94], axis=-1)
    assert np.allclose(np.where(inside > 0.0, np.linalg.norm(away, axis=-1), inside), 0.06)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "bottle" else pytest.mark.slow) for name in _BODIES],
)
def test_a_body_is_found_under_noise(name):
    corners, fillets, closed = _parts(name)
    shape = fit_turned(_far(_mesh(name)))
    start = shape.start()
    assert shape.closed == closed and len(shape.corners(start)) == len(corners)
    direction = shape.axis.frame[:, 2]
    up = np.sign(direction @ _TURN[:, 2])
    assert np.degrees(np.arccos(min(abs(direction @ _TURN[:, 2]), 1.0))) < 0.03
    away = (shape.axis.point - _FAR) @ _TURN / _SCALE
    assert np.linalg.norm(away[:2]) < 5e-4
    found = shape.corners(start) / _SCALE
    found[:, 1] += up * away[2]
    assert up > 0.0
    if closed:
        found = np.roll(found, -np.argmin(np.linalg.norm(found - corners[0], axis=-1)), axis=0)
    # The corner of a cone on the axis is as uncertain as its slope.
    assert np.abs(found - corners).max() < (0.006 if name == "tip" else 0.0025)
    rounds = np.sort(shape.fillets(start) / _SCALE)
    assert np.abs(rounds - np.sort(fillets)).max() < 0.015
    posed_surfaces.assert_closed(shape.pose(start))


@pytest.mark.slow
def test_what_is_round_is_none():
    ball = bodies.icosphere(4, radius=1.3)
    vase = revolved.revolve(revolved.even(revolved.vase(), 160), azimuths=96)
    ring = revolved.revolve(revolved.ring(), closed=True, azimuths=96)
    for mesh in (ball, vase, ring):
        assert fit_turned(mesh) is None
        assert fit_turned(_far(mesh)) is None


def test_what_is_not_turned_is_none():
    assert fit_turned(bodies.fine_box(spacing=0.1)) is None


@pytest.mark.slow
def test_the_fit_is_equivariant():
    mesh = revolved.noisy(_mesh("cone"), 0.005)
    near, far = fit_turned(mesh), fit_turned(revolved.placed(mesh, offset=_FAR, scale=0.01))
    moved = far.pose(far.start()).vertices
    assert np.allclose((moved - _FAR) / 0.01, near.pose(near.start()).vertices, atol=1e-5)


@pytest.mark.slow
def test_candidates_prefer_straight_pieces():
    mesh = _mesh("cylinder")
    shapes = candidates(mesh)
    assert [shape.name for shape in shapes] == [
        "turned body of straight pieces",
        "surface of revolution",
        "free surface",
    ]
    assert len(mesh_of(shapes[0].pose(shapes[0].start())).faces) > 10_000


def test_straight_pieces_of_a_stadium():
    """Two lines with half circles between them."""
    right = revolved.arc((3.0, 0.0), 0.5, -90, 90, 60)
    left = revolved.arc((1.0, 0.0), 0.5, 90, 270, 60)
    samples = even_samples(Profile(np.concatenate([right, left]), True))
    lines = straight_pieces(samples, 0.001, 3.0)
    longest = sorted(lines, key=lambda line: line.first - line.last)[:2]
    assert np.allclose(np.abs([line.along for line in longest]), [[1.0, 0.0]] * 2, atol=1e-3)
    lengths = [np.linalg.norm(samples[line.last] - samples[line.first]) for line in longest]
    assert np.allclose(lengths, 2.0, atol=0.15)


def test_an_arc_that_turns_back_has_two_corners():
    wall = np.concatenate(
        [
            [[0.0, -1.0], [1.0, -1.0]],
            revolved.arc((0.9, 1.0), 0.1, 0, 180, 30),
            [[0.8, -0.8], [0.0, -0.8]],
        ]
    )
    found = find_corners(Profile(revolved.even(wall, 600), False), 0.001, 3.0)
    expected = [[0, -1], [1, -1], [1, 1.1], [0.8, 1.1], [0.8, -0.8], [0, -0.8]]
    assert np.allclose(found.points, expected, atol=0.03)


def test_lines_that_miss_the_axis_have_no_corners():
    half_ball = np.concatenate([[[0.0, 0.0]], revolved.arc((0.0, 0.0), 1.0, 0, 90, 60)])
    assert find_corners(Profile(revolved.even(half_ball, 600), False), 0.001, 2.0) is None


def test_an_inverted_mesh_is_refused():
    with pytest.raises(ReconstructionError, match="inwards"):
        fit_turned(bodies.inverted(bodies.icosphere(3)))
