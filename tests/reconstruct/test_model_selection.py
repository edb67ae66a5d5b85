"""Families that are fitted to outlines alone: masks with wrong edges, and objects of no family."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.dataset.handheld import wobble
from refref_jax.reconstruct import model_selection
from refref_jax.reconstruct.families import Sphere, fit_sphere
from refref_jax.reconstruct.grids import find_isosurface
from refref_jax.reconstruct.masks import Views, carve, views_at
from refref_jax.reconstruct.mesh_distance import silhouette_overlap
from refref_jax.reconstruct.model_selection import OutlineTrial, fit_to_outlines
from refref_jax.reconstruct.shapes import FixedShape
from tests.factories import bodies

_CENTRE, _RADIUS = np.array([0.1, -0.05, 0.2]), 0.9


def _ball(points):
    return bodies.ball(points, radius=_RADIUS, centre=_CENTRE)


_TURN = Rotation.from_euler("xyz", [0.0, 0.0, 0.4]).as_matrix()
_CORNERS = np.array(list(itertools.product([-0.8, 0.8], [-0.6, 0.6], [-0.5, 0.5]))) @ _TURN.T


def _turned_box(points):
    return bodies.box(points @ _TURN, half=(0.8, 0.6, 0.5))


def _lump(points):
    """A ball with two knobs at its sides, which no family has."""
    knobs = [(0.95, 0.1, 0.35), (-0.1, 0.8, 0.3)]
    each = [bodies.ball(points, radius=0.4, centre=centre) for centre in knobs]
    return np.minimum.reduce([_ball(points), *each])


def _views_from_above(body, *, pixels, size=160):
    """Masks with wrong edges from cameras that are all above the object, as if on a table."""
    cameras = bodies.cameras_around(120, size=size, distance=3.2)
    low = (cameras.poses[:, 2, 3] > 0.9) & (cameras.poses[:, 2, 3] < 2.0)
    cameras = cameras._replace(poses=cameras.poses[low])
    exact = bodies.masks_of(body, cameras)
    masks = [wobble(mask, pixels=pixels, seed=i) for i, mask in enumerate(exact)]
    return Views(np.stack(masks), cameras)


def _carved(views, *, resolution=48):
    return find_isosurface(carve(*views, resolution=resolution))


@pytest.mark.slow
def test_a_small_ball_on_a_table_is_a_sphere(monkeypatch):
    """With the families of fewest unknowns only, which take little time."""
    near = lambda mesh, *, furthest: [fit_sphere(mesh, furthest=furthest), FixedShape(mesh)]
    monkeypatch.setattr(model_selection.families, "candidates", near)
    monkeypatch.setattr(model_selection, "_TOLERANCES", (4.0,))
    views = _views_from_above(_ball, pixels=0.7, size=64)
    told = []
    found = model_selection.shape_from_outlines(
        _carved(views, resolution=24), views, progress=lambda *x: told.append(x)
    )
    assert found is not None and found.name == "sphere"
    assert told[0][0] == 0 and told[-1] == (len(told), len(told), "sphere")
    away = np.linalg.norm(found.mesh.vertices - _CENTRE, axis=-1)
    assert away == pytest.approx(_RADIUS, rel=0.02)


@pytest.mark.slow
def test_a_ball_on_a_table_is_found_in_masks_whose_edges_are_wrong():
    views, exact = (_views_from_above(_ball, pixels=pixels) for pixels in (2.0, 0.0))
    carved = _carved(views)
    # No camera sees it from below, and wrong masks carve too much.
    assert carved.vertices[:, 2].min() < _CENTRE[2] - _RADIUS - 0.05
    assert silhouette_overlap(carved, *exact).mean() < 0.96
    found = model_selection.shape_from_outlines(carved, views)
    assert found is not None and found.name == "sphere"
    assert silhouette_overlap(found.mesh, *exact).mean() > 0.975
    away = np.linalg.norm(found.mesh.vertices - _CENTRE, axis=-1)
    assert away == pytest.approx(_RADIUS, rel=0.015)


@pytest.mark.slow
def test_a_box_on_a_table_has_its_six_planes():
    views = _views_from_above(_turned_box, pixels=2.0)
    found = model_selection.shape_from_outlines(_carved(views), views)
    assert found is not None and found.name == "polyhedron with right angles"
    corners = np.unique(np.round(found.mesh.vertices, 6), axis=0)
    assert len(corners) == 8
    away = np.linalg.norm(corners[:, None] - _CORNERS, axis=-1).min(axis=0)
    assert away.max() < 0.06  # a pixel is 0.027 there


@pytest.mark.slow
def test_an_object_of_no_family_stays_as_it_is():
    views = _views_from_above(_lump, pixels=0.5)
    assert model_selection.shape_from_outlines(_carved(views), views) is None


def _mug(points):
    """A cylinder with a handle."""
    turned = np.hypot(points[..., 0], points[..., 1]) - 0.6
    cup = np.maximum(turned, np.abs(points[..., 2]) - 0.7)
    ring = np.hypot(np.hypot(points[..., 0] - 0.6, points[..., 2]) - 0.4, points[..., 1]) - 0.1
    return np.minimum(cup, ring)


@pytest.mark.slow
def test_a_handle_is_no_noise():
    views = _views_from_above(_mug, pixels=1.5)
    found = model_selection.shape_from_outlines(_carved(views), views)
    assert found is None or np.ptp(found.mesh.vertices[:, 0]) > 1.5


def test_several_pieces_are_no_family():
    views = _views_from_above(_ball, pixels=0.0, size=64)
    two = bodies.joined(bodies.icosphere(), bodies.icosphere(radius=0.2, centre=(1.4, 0.0, 0.0)))
    assert model_selection.shape_from_outlines(two, views) is None


def test_full_masks_have_no_outline():
    cameras = bodies.cameras_around(8, size=24, distance=3.2)
    views = Views(np.ones((8, 24, 24), bool), cameras)
    assert model_selection.shape_from_outlines(bodies.icosphere(), views) is None


def test_one_view_cannot_judge():
    views = _views_from_above(_ball, pixels=0.5, size=64)
    one = views_at(views, np.array([0]))
    assert model_selection.shape_from_outlines(bodies.icosphere(), one) is None


@pytest.mark.slow
def test_a_sphere_far_from_the_outlines_comes_back_by_limited_steps():
    cameras = bodies.cameras_around(12, size=100, distance=3.2)
    views = Views(bodies.masks_of(_ball, cameras), cameras)
    x = fit_to_outlines(Sphere(_CENTRE + 0.04, 0.95 * _RADIUS), views)
    assert x[:3] == pytest.approx(_CENTRE, abs=3e-3)
    assert x[3] == pytest.approx(_RADIUS, rel=3e-3)


def test_a_mesh_has_no_unknowns_to_fit():
    cameras = bodies.cameras_around(2, size=32, distance=3.2)
    views = Views(bodies.masks_of(_ball, cameras), cameras)
    assert fit_to_outlines(FixedShape(bodies.icosphere()), views).shape == (0,)


def test_the_smallest_shape_that_views_do_not_reject_is_kept():
    mesh = FixedShape(bodies.icosphere())
    errors = np.array([0.04, 0.05, 0.06, 0.05])
    noise = 0.004 * np.array([1.0, -1.0, -1.0, 1.0])
    best = OutlineTrial(mesh, 900, errors, apart=1.0)
    as_good = OutlineTrial(mesh, 4, errors + 0.001 + noise, apart=1.0)
    worse = OutlineTrial(mesh, 3, errors + 0.01 + noise, apart=1.0)
    assert model_selection.choose([best, as_good, worse], level=0.0) is as_good
    assert model_selection.choose([best, as_good, worse], level=0.02) is worse
