import dataclasses
import functools
import itertools

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion

from refref_jax.geometry.cameras import project
from refref_jax.geometry.triangle_meshes import face_normals, is_closed
from refref_jax.reconstruct import ReconstructionError, convex, polytope_fit
from refref_jax.reconstruct.grids import find_isosurface
from refref_jax.reconstruct.masks import Views, carve
from refref_jax.reconstruct.mesh_distance import silhouette_overlap
from refref_jax.reconstruct.polytope_fit import fit_corners
from refref_jax.reconstruct.refinement import Refinement, refine
from tests.factories import bodies
from tests.factories.scenes import volume_of

pytestmark = pytest.mark.computing

_TURN = trimesh.transformations.euler_matrix(0.3, 0.2, 0.1)[:3, :3]
_PLATE = (0.8, 0.8, 0.12)

# All but the stage that is tested, which is fast and changes the hull little.
_LITTLE = Refinement(denoising=0.0, convex_depth=0.2)

_SQUARE = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [0.0, 30.0]])


def _turned_box(points, half=(0.8, 0.8, 0.8)):
    return bodies.box(points @ _TURN, half=half)


@functools.cache
def _views(body, views=24):
    cameras = bodies.cameras_around(views)
    return Views(bodies.masks_of(body, cameras), cameras)


def _plate(points):
    return _turned_box(points, _PLATE)


def _carved(views, **options):
    return find_isosurface(carve(*views, resolution=40, **options))


@functools.cache
def _box_hull():
    return _carved(_views(_turned_box))


def _refined(mesh, views, settings=_LITTLE):
    stage = refine(mesh, settings, views=views)[-1]
    assert stage.name == "corners"
    return stage


def _assert_is_box(mesh, atol=0.015):
    assert len(mesh.vertices) == 8 and is_closed(mesh.faces)
    assert np.allclose(np.abs(mesh.vertices @ _TURN), 0.8, atol=atol)


def test_a_point_is_seen_where_its_ray_passes_and_slopes_are_differences():
    cameras = bodies.cameras_around(3)
    point = np.array([[0.3, -0.2, 0.5]])
    pose = cameras.poses[1]
    seen = project(point, pose, cameras)
    slopes = polytope_fit.projection_slopes(seen, pose, cameras)
    column, row = seen.pixels[0]
    x, y = (column - 32.0) / cameras.focal, (32.0 - row) / cameras.focal
    on_ray = pose[:, 3] + seen.depths[0] * pose[:, :3] @ [x, y, -1.0]
    assert np.allclose(on_ray, point[0])
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        ends = (project(point + sign * step, pose, cameras).pixels for sign in (1, -1))
        after, before = ends
        assert np.allclose(slopes[0, :, axis], (after - before)[0] / 2e-6, rtol=1e-5)


def test_a_square_is_known_by_hand():
    order = polytope_fit.polygon(np.concatenate([_SQUARE, [[10.0, 12.0]]]))
    assert sorted(order) == [0, 1, 2, 3]
    square = _SQUARE[order]
    points = np.array([[15.0, 15.0], [15.0, 35.0], [-3.0, 4.0]])
    assert np.allclose(polytope_fit.excess(square, points), [-15.0, 5.0, 3.0])
    assert np.allclose(polytope_fit.heights(square), 15.0 * np.sqrt(2.0))


def test_points_lie_on_edges_a_pixel_apart_and_away_from_corners():
    samples = polytope_fit.along_edges(_SQUARE, margin=3.0)
    assert len(samples.pixels) == 4 * 24
    ends = np.stack([1.0 - samples.shares, samples.shares], axis=-1)
    corners = _SQUARE[np.stack([samples.first, samples.second], axis=-1)]
    assert np.allclose(np.einsum("ne,nec->nc", ends, corners), samples.pixels)
    away = np.linalg.norm(samples.pixels[:, None] - _SQUARE, axis=-1)
    assert away.min() == pytest.approx(3.5)
    assert np.allclose(polytope_fit.excess(_SQUARE, samples.pixels), 0.0)


@pytest.mark.slow
def test_overlap_of_corners_is_what_the_tracer_finds():
    views = _views(_turned_box)
    mesh = bodies.as_mesh(trimesh.creation.box((1.4, 1.7, 1.6)))
    expected = silhouette_overlap(mesh, *views).mean()
    assert 0.7 < expected < 0.95
    assert polytope_fit.outline_overlaps(mesh.vertices, views).mean() == pytest.approx(
        expected, abs=1e-3
    )


@pytest.mark.slow
def test_a_box_gets_its_corners_and_overlaps_with_views_it_was_not_made_from():
    hull = _box_hull()
    stage = _refined(hull, _views(_turned_box))
    assert not stage.refused
    _assert_is_box(stage.mesh)
    assert (
        volume_of(stage.mesh) == pytest.approx(1.6**3, rel=0.01) and volume_of(hull) > 1.03 * 1.6**3
    )
    others = _views(_turned_box, views=7)
    assert silhouette_overlap(stage.mesh, *others).mean() > 0.985


@pytest.mark.slow
def test_every_stage_by_its_default_gives_the_box_too():
    # At so few pixels the hull bulges by more than the default takes for noise.
    settings = Refinement(convex_depth=0.2)
    _assert_is_box(_refined(_box_hull(), _views(_turned_box), settings).mesh)


@pytest.mark.slow
@pytest.mark.parametrize(
    "bad",
    [
        "floater",
        "shifted",
        "hole",
        "half",
        "full",
    ],
)
def test_one_bad_mask_moves_no_corner_far(bad):
    masks, cameras = _views(_turned_box)
    masks = masks.copy()
    if bad == "shifted":
        masks[7] = np.roll(masks[7], 12, axis=1)
    elif bad == "floater":
        masks[7, 3:9, 3:9] = True
    elif bad == "hole":
        masks[7, 28:36, 28:36] = False
    elif bad == "half":
        masks[7, :32] = False
    else:
        masks[7] = True
    views = Views(masks, cameras)
    stage = _refined(_carved(views, outliers=1), views)
    assert not stage.refused
    truth = 0.8 * np.array(list(itertools.product((-1.0, 1.0), repeat=3))) @ _TURN.T
    away = np.linalg.norm(stage.mesh.vertices[:, None] - truth, axis=-1).min(axis=0)
    assert away.max() < 4.0 / cameras.focal
    assert volume_of(stage.mesh) == pytest.approx(1.6**3, rel=0.03)
    assert (
        polytope_fit.outline_overlaps(stage.mesh.vertices, _views(_turned_box, views=7)).mean()
        > 0.98
    )


@pytest.mark.slow
def test_masks_eroded_by_a_pixel_shrink_the_box_by_a_pixel():
    masks, cameras = _views(_turned_box)
    views = Views(np.stack([binary_erosion(mask) for mask in masks]), cameras)
    found = _refined(_carved(views), views).mesh
    pixel = 4.0 / cameras.focal
    assert len(found.vertices) == 8
    assert 0.8 - 1.5 * pixel < np.cbrt(volume_of(found)) / 2.0 < 0.8 - 0.5 * pixel


@pytest.mark.slow
def test_a_thin_wall_stays_one():
    carved = _carved(_views(_plate))
    body = fit_corners(convex.hull(carved), carved, _views(_plate))
    meshes = [stage.mesh for stage in refine(carved, _LITTLE, views=_views(_plate))]
    for mesh in (*meshes, body):
        assert is_closed(mesh.faces) and np.all(np.isfinite(mesh.vertices))
        assert 0.8 < volume_of(mesh) / (8.0 * np.prod(_PLATE)) < 1.35
    assert len(body.vertices) < 20


def test_a_ball_is_left_round_and_the_reason_told():
    views = _views(bodies.ball, views=10)
    mesh = bodies.icosphere(3)
    found = _refined(mesh, views, dataclasses.replace(_LITTLE, corners=30))
    assert "overlap with the masks by" in found.refused
    assert len(found.mesh.vertices) == len(mesh.vertices)


def test_a_body_with_a_hole_is_left_alone():
    mesh = _carved(_views(bodies.torus))
    found = _refined(mesh, _views(bodies.torus))
    assert len(found.mesh.faces) == len(mesh.faces) and not found.refused


def test_what_cannot_be_fitted_is_an_error_that_says_why():
    masks, cameras = _views(_turned_box)
    hull = convex.hull(_box_hull())
    two = Views(masks[:2], cameras._replace(poses=cameras.poses[:2]))
    with pytest.raises(ReconstructionError, match="2 views show the complete object"):
        fit_corners(hull, hull, two)
    inside = cameras._replace(poses=cameras.poses * [1.0, 1.0, 1.0, 0.1])
    with pytest.raises(ReconstructionError, match="0 views show the complete object"):
        fit_corners(hull, hull, Views(masks, inside))
    with pytest.raises(ReconstructionError, match="Pass one mask for each camera"):
        refine(hull, _LITTLE, views=Views(masks[1:], cameras))


def test_facets_keep_flat_normals_beside_a_bevel_and_round_ones_bend():
    angle = np.arange(24) * 2.0 * np.pi / 24
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = [
        np.c_[radius * ring, np.full(24, height)]
        for radius, height in ((0.9, 1.0), (0.96, 0.985), (0.99, 0.95), (1.0, 0.9), (1.0, -1.0))
    ]
    mesh = convex.weigh_facets(convex.of_points(np.concatenate(rings)))
    flat = face_normals(mesh.vertices[mesh.faces])
    lid = flat[:, 2] > 0.999
    assert np.all(mesh.normals[lid][..., 2] > np.cos(np.radians(3.0)))
    side = np.abs(flat[:, 2]) < 1e-6
    outward = mesh.vertices[mesh.faces][side] * [1.0, 1.0, 0.0]
    assert np.all(np.sum(mesh.normals[side] * outward, axis=-1) > np.cos(np.radians(5.0)))
    assert np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0)
    box = convex.of_points(np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T * 1.0)
    sharp = convex.weigh_facets(box)
    assert np.allclose(sharp.normals, face_normals(box.vertices[box.faces])[:, None])


def test_only_a_hull_is_convex():
    assert convex.is_convex(bodies.icosphere(2))
    assert not convex.is_convex(_carved(_views(bodies.torus)))


@pytest.mark.slow
def test_a_ball_of_masks_that_err_by_a_pixel_gets_no_facets():
    masks, cameras = _views(bodies.ball)
    changes = (binary_erosion, binary_dilation)
    uneven = np.stack([changes[i % 2](mask) for i, mask in enumerate(masks)])
    views = Views(uneven, cameras)
    stage = _refined(_carved(views), views)
    assert "Keep the mesh" in stage.refused


def test_where_hardly_a_face_is_off_the_edges_the_hull_stands_in():
    few = bodies.as_mesh(trimesh.creation.icosahedron())
    found = convex.from_tangents(few, crease_angle=0.1)
    assert found.vertices.shape == (12, 3) and is_closed(found.faces)
