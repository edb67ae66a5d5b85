"""Surfaces that depend on unknowns; the free surface."""

import time

import numpy as np
import pytest
import trimesh

from refref_jax.geometry.triangle_meshes import (
    Mesh,
    diameter,
    face_normals,
    is_degenerate,
    is_watertight,
    make_mesh,
    unit_vectors,
    volume,
    with_short_edges,
)
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.shapes import (
    FreeSurface,
    cloud_of,
    frame_along,
    mesh_of,
    robust_weights,
    tilt,
)
from tests.factories import bodies, revolved
from tests.laws import posed_surfaces


@pytest.fixture(scope="module")
def ball():
    return bodies.icosphere(5)


@pytest.fixture(scope="module")
def free(ball):
    return FreeSurface(ball)


def test_at_rest_it_is_the_mesh(ball, free):
    posed = free.pose(free.start())
    assert np.array_equal(posed.vertices, ball.vertices)
    assert np.array_equal(posed.faces, ball.faces)
    posed_surfaces.assert_closed(posed)


def test_normals_are_exact_on_a_ball(ball, free):
    """Max (1999): if the vertices lie on a ball, so are the normals those of the ball."""
    normals = mesh_of(free.pose(free.start())).normals
    assert np.allclose(normals, ball.vertices[ball.faces], atol=1e-12)


def test_equal_displacements_make_a_larger_ball(free):
    posed = free.pose(np.full(len(free.start()), 0.1))
    assert np.allclose(np.linalg.norm(posed.vertices, axis=-1), 1.1, atol=1e-9)


def test_its_derivatives_are_differences(free):
    posed_surfaces.assert_derivatives(free)


def test_derivatives_at_creases_and_of_a_box():
    box = FreeSurface(bodies.fine_box(spacing=0.2))
    posed_surfaces.assert_derivatives(box)
    posed = box.pose(box.start())
    # Three normals at each of the eight corners: nothing is averaged across the edges.
    at_corner = np.all(np.abs(posed.vertices[posed.faces]) > 0.79, axis=-1)
    assert len(np.unique(posed.normal_ids[at_corner])) == 24


def test_handles_are_spread(ball, free):
    assert 1500 <= len(free.handles) <= 3000
    places = ball.vertices[free.handles]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(len(places))
    spacing = diameter(ball.vertices) / 44.0
    assert apart.min() > 0.8 * spacing and apart.min(axis=1).max() < 2.0 * spacing
    assert np.array_equal(free.handles, FreeSurface(ball).handles)


def test_weights_sum_to_one_and_are_local(ball, free):
    assert np.allclose(free.weights.sum(axis=1), 1.0)
    assert np.diff(free.weights.indptr).max() == 6
    one = np.eye(1, len(free.handles))[0]
    moved = np.flatnonzero(free.weights @ one > 0.0)
    away = np.linalg.norm(ball.vertices[moved] - ball.vertices[free.handles[0]], axis=-1)
    assert away.max() < 4.0 * diameter(ball.vertices) / 44.0


def test_the_two_sides_of_a_thin_wall_move_apart():
    plate = bodies.fine_box(half=0.8, spacing=0.05)
    thin = make_mesh(plate.vertices * [1.0, 1.0, 0.02], plate.faces)
    shape = FreeSurface(thin, 0.1)
    upper = thin.vertices[shape.handles, 2] > 0.0
    inner = np.all(np.abs(thin.vertices[:, :2]) < 0.6, axis=1)
    shifts = shape.weights @ np.where(upper, 1.0, -1.0)
    assert np.allclose(shifts[inner], np.sign(thin.vertices[inner, 2]), atol=1e-6)


def test_its_prior(free):
    posed_surfaces.assert_prior(free)
    size = diameter(free.mesh.vertices) / 2.6
    even = np.full(len(free.start()), 0.01)
    precision, _ = free.prior(even)
    # Only the sizes of even displacements count: the sum of (0.01 / rho)^2.
    assert even @ precision @ even == pytest.approx(len(even) * (0.01 / (0.02 * size)) ** 2)
    one = np.eye(1, len(even))[0]
    _, gradient = free.prior(one)
    around = np.count_nonzero(gradient)
    assert 7 <= around < 60
    assert gradient[0] > (1.0 / (0.002 * size)) ** 2


def test_it_is_equivariant(ball):
    few = bodies.icosphere(3)
    far = FreeSurface(revolved.placed(few, offset=100.0, scale=0.01))
    near = FreeSurface(few)
    shifts = 0.01 * np.random.default_rng(2).normal(size=len(near.start()))
    assert np.array_equal(far.handles, near.handles)
    moved = far.pose(0.01 * shifts)
    assert np.allclose((moved.vertices - 100.0) / 0.01, near.pose(shifts).vertices, atol=1e-8)
    # Of handles equally far, either may be the seventh, whose weight fades to a millionth.
    assert np.allclose(moved.normals, near.pose(shifts).normals, atol=1e-6)


def test_degenerate_faces_keep_their_normals():
    sliver = bodies.icosphere(1)
    vertices = np.concatenate([sliver.vertices, sliver.vertices[sliver.faces[0, :1]]])
    first = sliver.faces[0]
    # The vertex is doubled: an edge is split at its end by two faces without area.
    faces = np.concatenate([sliver.faces, [[first[0], first[1], len(vertices) - 1]]])
    posed = FreeSurface(make_mesh(vertices, faces)).pose(np.zeros(len(vertices) - 1))
    assert np.all(np.isfinite(posed.normals)) and np.all(np.isfinite(posed.by_normals.data))


def test_building_takes_little_time():
    fine = bodies.icosphere(6)
    start = time.process_time()
    FreeSurface(fine)
    assert time.process_time() - start < 4.0


def test_given_normals_are_kept_at_rest_where_edges_are_divided():
    """The long faces around a cylinder are divided; its shading is still that of a cone."""
    cylinder = bodies.as_mesh(trimesh.creation.cylinder(radius=1.0, height=1.0, sections=64))
    up = np.array([0.0, 0.0, 0.2]) * _is_side(cylinder)[..., None]
    fine = with_short_edges(
        cylinder._replace(normals=unit_vectors(cylinder.normals + up)), longest=0.1
    )
    shape = FreeSurface(fine, 0.2)
    found = mesh_of(shape.pose(shape.start()))
    assert np.allclose(found.normals, fine.normals, atol=1e-12)
    cone = unit_vectors(fine.vertices[fine.faces] * [1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 0.2])
    expected = np.where(_is_side(fine)[..., None], unit_vectors(cone), fine.normals)
    assert np.linalg.norm(found.normals - expected, axis=-1).max() < np.radians(0.2)
    assert is_watertight(fine.faces)
    assert len(fine.faces) > 5 * len(cylinder.faces)


def _is_side(mesh):
    return np.abs(face_normals(mesh.vertices[mesh.faces])[:, 2:]) < 0.5


def test_normals_that_are_not_given_are_those_of_the_mesh(ball):
    lost = ball._replace(normals=np.where(ball.faces[..., None] == 7, 0.0, ball.normals))
    found = mesh_of(FreeSurface(lost).pose(np.zeros(len(FreeSurface(lost).handles))))
    np.testing.assert_allclose(found.normals, ball.normals, atol=1e-12)


def test_dividing_edges_keeps_a_mesh_with_a_degenerate_face_closed():
    """The face has three corners on one line, and no normal."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]], float)
    faces = np.array([[0, 2, 1], [0, 4, 3], [4, 1, 3], [0, 1, 4], [0, 3, 2], [1, 2, 3]])
    for size in (1e-7, 1.0, 1e7):
        mesh = make_mesh(size * vertices, faces)
        fine = with_short_edges(mesh, 0.3 * size)
        assert is_watertight(fine.faces) and np.all(np.isfinite(fine.normals))
        np.testing.assert_allclose(volume(*fine[:2]), size**3 / 6.0, rtol=1e-12)
        kept = ~is_degenerate(fine.vertices[fine.faces])
        flat = face_normals(fine.vertices[fine.faces])[kept, None]
        np.testing.assert_allclose(np.sum(fine.normals[kept] * flat, axis=-1), 1.0, atol=1e-9)


def test_derivatives_of_given_normals():
    ball = bodies.icosphere(3)
    random = np.random.default_rng(4).normal(scale=0.1, size=ball.vertices.shape)
    rough = ball._replace(normals=unit_vectors(ball.normals + random[ball.faces]))
    posed_surfaces.assert_derivatives(FreeSurface(rough, 0.4))


def test_samples_of_a_coarse_box_are_within_its_faces():
    cloud = cloud_of(bodies.fine_box(spacing=10.0))
    assert len(cloud.points) > 1000 and cloud.areas.sum() == pytest.approx(1.0)
    assert np.allclose(np.abs(cloud.points).max(axis=1), 0.8)


def test_degenerate_meshes_are_refused(ball):
    inverted = Mesh(ball.vertices, ball.faces[:, ::-1], -ball.normals)
    flat = Mesh(ball.vertices * [1.0, 1.0, 0.0], ball.faces, ball.normals)
    broken = Mesh(np.where(ball.vertices > 0.99, np.nan, ball.vertices), ball.faces, ball.normals)
    empty = Mesh(ball.vertices[:0], ball.faces[:0], ball.normals[:0])
    for mesh, says in (
        (inverted, "inwards"),
        (flat, "flat"),
        (broken, "not finite"),
        (empty, "0 faces"),
    ):
        with pytest.raises(ReconstructionError, match=says):
            FreeSurface(mesh)
    with pytest.raises(ReconstructionError, match="leaves 1 handles"):
        FreeSurface(ball, 10.0)


def test_robust_weights_by_hand():
    # The median is 1: the scale is 1.5, and an error of 1.5 has a weight of a quarter.
    assert np.allclose(robust_weights(np.array([1.0, 1.0, 1.0, 0.0, 1.5]))[3:], [1.0, 0.25])
    assert np.array_equal(robust_weights(np.zeros(3)), np.ones(3))


def test_a_tilt_turns_the_axis():
    rotation, by_first, by_second = tilt(np.array([0.3, 0.0]))
    assert np.allclose(rotation[:, 2], [0.0, -np.sin(0.3), np.cos(0.3)])
    assert np.allclose(rotation @ rotation.T, np.eye(3))
    assert np.allclose(by_first[:, 2], [0.0, -np.cos(0.3), -np.sin(0.3)])
    assert np.allclose(by_second[:, 2], [1.0, 0.0, 0.0])


def test_a_frame_is_right_handed():
    frame = frame_along(np.array([1.0, -2.0, 2.0]))
    assert np.allclose(frame[:, 2], np.array([1.0, -2.0, 2.0]) / 3.0)
    assert np.linalg.det(frame) == pytest.approx(1.0)
