"""Handles move a mesh, its normals with it, and nothing where they do not move."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.triangle_meshes import corner_normals, is_closed, volume
from refref_jax.reconstruct import ReconstructionError, light_refinement
from tests.factories import bodies


def _ball(level=3):
    return bodies.icosphere(level)


def _cube():
    return bodies.fine_box(spacing=2.0)


@pytest.mark.parametrize("mesh", [_ball(), _cube()], ids=["ball", "cube"])
def test_no_shift_changes_nothing(mesh):
    rig = light_refinement.build(mesh, handles=32)
    still = np.zeros((rig.neighbours.shape[0], 3))
    moved = light_refinement.moved_mesh(mesh, rig, still)
    np.testing.assert_allclose(moved.vertices, mesh.vertices, atol=1e-12)
    np.testing.assert_allclose(moved.normals, mesh.normals, atol=1e-6)
    np.testing.assert_array_equal(moved.faces, mesh.faces)


def test_one_shift_of_all_handles_moves_the_whole_body():
    mesh = _ball()
    rig = light_refinement.build(mesh, handles=32)
    shift = np.array([0.1, -0.2, 0.3])
    moved = light_refinement.moved_mesh(mesh, rig, np.tile(shift, (32, 1)))
    np.testing.assert_allclose(moved.vertices, mesh.vertices + shift, atol=1e-7)
    np.testing.assert_allclose(moved.normals, mesh.normals, atol=1e-6)


def test_normals_turn_as_those_of_the_moved_mesh():
    mesh = _ball(4)
    rig = light_refinement.build(mesh, handles=64)
    shifts = np.random.default_rng(0).normal(size=(64, 3)) * 0.01
    moved = light_refinement.moved_mesh(mesh, rig, shifts)
    expected = corner_normals(moved.vertices, moved.faces)
    cosine = np.sum(moved.normals * expected, axis=-1)
    turned = np.degrees(np.arccos(np.clip(np.sum(moved.normals * mesh.normals, axis=-1), -1, 1)))
    assert turned.mean() > 1.0
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean() < 0.1
    assert is_closed(moved.faces)
    assert volume(*moved[:2]) == pytest.approx(volume(*mesh[:2]), rel=0.02)


def test_the_corners_of_a_cube_are_its_handles_and_its_faces_stay_flat():
    mesh = _cube()
    rig = light_refinement.build(mesh)
    assert len(mesh.vertices) == 8 and rig.handles.shape == (8, 1)
    # The face at x = 0.8 is moved along x.
    shifts = np.where(mesh.vertices[:, :1] > 0.0, [[0.05, 0.0, 0.0]], 0.0)
    moved = light_refinement.moved_mesh(mesh, rig, shifts)
    np.testing.assert_allclose(np.ptp(moved.vertices, axis=0), [1.65, 1.6, 1.6])
    np.testing.assert_allclose(np.abs(moved.normals).max(axis=-1), 1.0, atol=1e-6)


def test_corners_have_the_gradient_of_their_shares():
    mesh = _ball(2)
    rig = light_refinement.build(mesh, handles=16)
    device = jax.device_put(rig)

    def total(shifts):
        corners = light_refinement.move(device, shifts).bvh.triangles
        return jnp.sum(corners[..., 0])

    slope = jax.grad(total)(jnp.zeros((16, 3)))
    # Each corner of each slot moves by the shares of its vertex.
    share = np.zeros(16)
    corner = mesh.faces[rig.primitive_faces].ravel()
    np.add.at(share, rig.handles[corner], rig.shares[corner])
    np.testing.assert_allclose(slope[:, 0], share, rtol=1e-4)
    np.testing.assert_allclose(slope[:, 1:], 0.0, atol=1e-6)


def test_normals_have_finite_gradients_at_degenerate_triangles():
    mesh = _ball(2)
    vertices = mesh.vertices.copy()
    vertices[mesh.faces[0, 1]] = vertices[mesh.faces[0, 0]]
    device = jax.device_put(light_refinement.build(mesh._replace(vertices=vertices), handles=16))

    def total(shifts):
        return jnp.sum(jnp.square(light_refinement.move(device, shifts).normals[..., 0]))

    value, slope = jax.value_and_grad(total)(jnp.zeros((16, 3)))
    assert np.isfinite(value) and np.all(np.isfinite(slope))


def test_unevenness_is_that_of_single_handles_alone():
    rig = jax.device_put(light_refinement.build(_ball(), handles=32))
    assert float(light_refinement.unevenness(rig, jnp.ones((32, 3)))) == 0.0
    one = jnp.zeros((32, 3)).at[4, 0].set(1.0)
    assert float(light_refinement.unevenness(rig, one)) > 1.0 / 32.0


@pytest.mark.parametrize("handles", [0, 3])
def test_too_few_handles_are_refused(handles):
    with pytest.raises(ReconstructionError, match="Pass 4 or more"):
        light_refinement.build(_ball(1), handles=handles)
