import numpy as np
import pytest
import trimesh

from experiments.dataset.objects import distance_fields as fields
from experiments.dataset.objects import formed, isosurface
from experiments.dataset.objects.field_operations import offset, subtraction, union
from refref_jax.geometry.triangle_meshes import is_degenerate

_BLEND = union(
    fields.sphere((0, 0, 0), 1.0),
    fields.sphere((1.0, 0.1, 0), 0.6),
    fields.tube(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.7)]), np.array([0.5, 0.2])),
    blend=0.3,
)

_SOLIDS = {
    "sphere": (fields.sphere((0.1, 0, 0), 1.3), 4.0 / 3.0 * np.pi * 1.3**3, 2),
    "torus": (fields.torus(1.2, 0.4), 2.0 * np.pi**2 * 1.2 * 0.4**2, 0),
    "hollow": (
        subtraction(fields.sphere((0, 0, 0), 1.3), fields.sphere((0, 0, 0), 1.0)),
        4.0 / 3.0 * np.pi * (1.3**3 - 1.0),
        4,
    ),
    "blend": (_BLEND, None, 2),
}


def _mesh(surface):
    return trimesh.Trimesh(*surface, process=False)


@pytest.mark.parametrize("name", _SOLIDS)
def test_surfaces_are_closed_outward_and_on_the_zero_set(name):
    field, volume, characteristic = _SOLIDS[name]
    surface = isosurface.isosurface(field, spacing=0.07)
    mesh = _mesh(surface)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == characteristic
    assert np.max(np.abs(field(surface.vertices))) < 1e-9
    if volume is not None:
        assert mesh.volume == pytest.approx(volume, rel=5e-3) and mesh.volume < volume
    corners = surface.vertices[surface.faces]
    assert not np.any(is_degenerate(corners))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slopes = fields.gradient(field, corners.mean(axis=1))
    assert np.all(np.sum(normals * slopes, axis=-1) > 0.0)


def test_grid_points_on_the_surface_leave_no_degenerate_faces():
    # Its faces, edges and corners lie exactly on points of the grid.
    surface = isosurface.isosurface(fields.box((0.5, 0.5, 0.5)), spacing=0.1, half_extent=1.0)
    assert _mesh(surface).is_watertight
    assert not np.any(is_degenerate(surface.vertices[surface.faces]))


def test_samples_near_the_surface_are_exact_and_all_signs_are_right():
    values, low = isosurface.sample(_BLEND, spacing=0.1, half_extent=2.4)
    points = low + 0.1 * np.argwhere(np.ones(values.shape, bool))
    exact = _BLEND(points).reshape(values.shape)
    near = np.abs(exact) < 0.2
    np.testing.assert_array_equal(values[near], exact[near])
    np.testing.assert_array_equal(values < 0.0, exact < 0.0)


@pytest.mark.parametrize("centre, radius", [((0, 0, 0), 3.0), ((2.4, 0, 0), 0.5), ((9, 0, 0), 1.0)])
def test_a_surface_that_is_not_within_the_cube_is_refused(centre, radius):
    with pytest.raises(ValueError, match="No closed surface"):
        isosurface.isosurface(fields.sphere(centre, radius), spacing=0.2)


def test_the_largest_piece_is_kept():
    two = union(fields.sphere((-0.8, 0, 0), 0.7), fields.sphere((1.0, 0, 0), 0.4))
    kept = isosurface.largest_piece(isosurface.isosurface(two, spacing=0.1))
    assert _mesh(kept).is_watertight
    assert np.max(kept.vertices[:, 0]) < 0.0
    assert len(np.unique(kept.faces)) == len(kept.vertices)


def test_a_core_leaves_at_least_its_wall_everywhere():
    body = formed.softened(_BLEND)
    core = formed.core(body, 0.15)
    surface = isosurface.isosurface(core, spacing=0.1)
    assert np.max(offset(body, -0.15)(surface.vertices)) < 1e-6
    assert np.min(body(surface.vertices)) < -0.15
