"""Equations of outlines: against central differences, and which way they pull."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import gauss_newton
from refref_jax.reconstruct import outlines as outlines_module
from refref_jax.reconstruct.families import Revolution, Sphere
from refref_jax.reconstruct.gauss_newton import Candidate, Equations, Rows
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.outlines import Outlines, fit_profile
from refref_jax.reconstruct.relief import Relief
from refref_jax.reconstruct.revolution import Axis, Profile
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, FreeSurface
from refref_jax.reconstruct.walls import without_ridges
from tests.factories import bodies

_ORIGIN = np.zeros(3)


@pytest.fixture(scope="module")
def views():
    cameras = bodies.cameras_around(8, size=120, distance=3.0)
    return Views(bodies.masks_of(bodies.ball, cameras), cameras)


@pytest.fixture(scope="module")
def outlines(views):
    return Outlines(views)


def _rows(outlines, shape, x=None):
    model = SingleObject(shape, 1.5)
    return outlines(model.pose(model.start() if x is None else x))


def test_a_ball_that_fits_has_small_errors(outlines):
    rows = _rows(outlines, Sphere(_ORIGIN, 1.0))
    assert 8 * 60 <= len(rows.errors) <= 8 * 100
    # A distance is off by less than a third of a pixel, which is the unit.
    assert np.sqrt(np.mean(rows.errors**2)) < 1.0 and abs(rows.errors.mean()) < 0.4
    assert np.all(rows.weights > 0.3) and np.all(rows.weights <= 1.0)


@pytest.mark.parametrize(("radius", "sign"), [(0.98, -1.0), (1.02, 1.0)])
def test_errors_say_which_way_the_surface_is_off(outlines, radius, sign):
    rows = _rows(outlines, Sphere(_ORIGIN, radius))
    # A point within the mask has a negative distance, and a larger radius takes it outwards.
    assert np.mean(sign * rows.errors > 0.0) > 0.9
    by_radius = rows.derivatives[:, 3]
    assert np.all(by_radius > 0.0)
    step = -(rows.weights * by_radius) @ rows.errors / ((rows.weights * by_radius) @ by_radius)
    assert radius + step == pytest.approx(1.0, abs=3e-3)


@pytest.mark.parametrize("free", [False, True], ids=["sphere", "free surface"])
def test_derivatives_are_central_differences(outlines, free, monkeypatch):
    """Of points that stay on the surface: a sliding rim moves along the line of sight."""
    ball = Sphere(_ORIGIN, 0.99)
    shape = FreeSurface(bodies.icosphere(3, radius=0.99), 0.3) if free else ball
    model = SingleObject(shape, 1.5)
    begin, rims, find = model.start(), {}, outlines_module._rim

    def keep(vertices, normals, edges, camera):
        return rims.setdefault(tuple(camera), find(vertices, normals, edges, camera))

    monkeypatch.setattr(outlines_module, "_rim", keep)
    direction = np.random.default_rng(2).normal(size=begin.size)
    step = 1e-6
    rows, *beside = (outlines(model.pose(begin + t * direction)) for t in (0.0, step, -step))
    slopes = (beside[0].errors - beside[1].errors) / (2.0 * step)
    # Distances are interpolated bilinearly: few points are at a kink.
    off = np.abs(rows.derivatives @ direction - slopes)
    assert np.quantile(off, 0.99) < 1e-4 * np.abs(slopes).max() and np.abs(slopes).max() > 10.0


def test_points_far_from_the_outline_are_of_another_edge(outlines):
    # A ball of half the size ends tens of pixels within the masks.
    rows = _rows(outlines, Sphere(_ORIGIN, 0.5))
    assert len(rows.errors) == 0 and rows.derivatives.shape == (0, 5)


def test_an_outline_without_unknowns_moves_nothing(outlines):
    rows = _rows(outlines, FixedShape(bodies.icosphere(3)))
    assert len(rows.errors) > 100 and rows.derivatives.shape == (len(rows.errors), 1)
    assert not rows.derivatives.toarray().any()


def test_a_common_error_is_eliminated_as_an_unknown_of_its_own():
    random = np.random.default_rng(3)
    errors, slopes, weights = random.normal(size=9), random.normal(size=(9, 4)), np.full(9, 0.7)
    nothing = Equations(np.eye(4), np.zeros(4), np.zeros((1, 4)), np.zeros((4, 4)))
    found = gauss_newton._with_rows(nothing, Rows(errors, slopes, weights, 2.0))
    wide = np.concatenate([slopes, np.ones((9, 1))], axis=1)
    whole = wide.T @ (weights[:, None] * wide) + np.diag([1.0, 1.0, 1.0, 1.0, 0.25])
    together = -np.linalg.solve(whole, wide.T @ (weights * errors))
    alone = -np.linalg.solve(found.matrix, found.gradient)
    np.testing.assert_allclose(alone, together[:4], rtol=1e-10)


def test_masks_that_are_all_too_wide_leave_the_size_to_the_light():
    cameras = bodies.cameras_around(8, size=120, distance=3.0)
    masks = binary_dilation(bodies.masks_of(bodies.ball, cameras), np.ones((1, 3, 3), bool))
    moved = []
    for common in (0.0, 0.5):
        rows = _rows(Outlines(Views(masks, cameras), common=common), Sphere(_ORIGIN, 1.0))
        nothing = Equations(np.zeros((5, 5)), np.zeros(5), np.zeros((1, 5)), np.zeros((5, 5)))
        found = gauss_newton._with_rows(nothing, rows)
        # Light that knows the radius to a thousandth.
        known = np.diag([1.0, 1.0, 1.0, 1e6, 1.0])
        moved.append(-np.linalg.solve(found.matrix + known, found.gradient)[3])
    assert moved[0] > 2e-3 and abs(moved[1]) < 0.02 * moved[0]


def test_inner_parts_have_no_outline(outlines):
    outer, inner = (
        SingleObject(Sphere(_ORIGIN, radius), 1.5).pose(np.array([0.0, 0.0, 0.0, radius, 1.5]))
        for radius in (1.0, 0.4)
    )
    both = Candidate(
        (*outer.parts, *inner.parts),
        nested([1.5, 1.3], [NO_PARENT, 0]),
        outer.by_indices,
        outer.by_tints,
    )
    np.testing.assert_array_equal(outlines(both).errors, outlines(outer).errors)


def _waisted(points):
    """Less than the distance from a body of revolution about z."""
    radius = np.hypot(points[..., 0], points[..., 1])
    return 0.6 * (np.hypot(radius, points[..., 2]) - 0.9 - 0.05 * np.cos(3.0 * points[..., 2]))


@pytest.mark.slow
def test_outlines_alone_determine_the_profile_of_a_body_of_revolution():
    cameras = bodies.cameras_around(24, size=120, distance=3.0)
    views = Views(bodies.masks_of(_waisted, cameras, steps=120), cameras)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 200)
    # Like a mesh from masks: too narrow, with waves, and off the axis.
    rough = 0.88 + 0.01 * np.cos(6.0 * angle)
    points = rough[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points[[0, -1], 0] = 0.0
    axis = Axis(np.array([0.01, -0.01, 0.0]), np.eye(3))
    outer = Revolution(axis, Profile(points, closed=False), 2.0)
    found = fit_profile(outer, views)
    np.testing.assert_allclose(found.axis.point[:2], 0.0, atol=2e-3)
    assert found.axis.frame[2, 2] == pytest.approx(1.0, abs=1e-4)
    off = _radial_errors(found.points + np.array([0.0, found.axis.point[2]]))
    assert np.abs(off).max() < 0.01 < 0.02 < np.abs(_radial_errors(outer.points)).max()
    assert np.sqrt(np.mean(off**2)) < 0.004


def _radial_errors(points):
    """Radial distances of points of a profile from the body of `_waisted`."""
    return np.linalg.norm(points, axis=-1) - 0.9 - 0.05 * np.cos(3.0 * points[:, 1])


@pytest.mark.slow
def test_a_ring_is_fitted_to_its_outlines():
    cameras = bodies.cameras_around(24, size=120, distance=3.0)
    views = Views(
        bodies.masks_of(lambda p: bodies.torus(p, large=0.7, small=0.3), cameras), cameras
    )
    angle = np.linspace(0.0, 2.0 * np.pi, 160, endpoint=False)
    points = [0.7, 0.0] + 0.28 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ring = Revolution(Axis(_ORIGIN, np.eye(3)), Profile(points, closed=True), 2.0)
    found = fit_profile(ring, views)
    assert found.closed
    tube = np.linalg.norm(found.points - [0.7, -found.axis.point[2]], axis=-1)
    # Its innermost part is no outline in most views.
    outside = found.points[:, 0] > 0.7
    assert np.abs(tube[outside] - 0.3).max() < 0.01


@pytest.mark.slow
def test_a_profile_far_from_all_outlines_stays_as_it_is(views):
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 200)
    points = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points[[0, -1], 0] = 0.0
    small = Revolution(Axis(_ORIGIN, np.eye(3)), Profile(points, closed=False), 1.0)
    found = fit_profile(small, views)
    np.testing.assert_allclose(np.linalg.norm(found.points, axis=-1), 0.5, atol=1e-3)


def test_a_single_view_fits_a_profile(views):
    cameras = views.cameras._replace(poses=views.cameras.poses[:1])
    found = fit_profile(_upright(_round(0.96)), Views(views.masks[:1], cameras))
    assert np.all(np.isfinite(found.points)) and found.points[:, 0].max() > 0.97


@pytest.mark.slow
def test_no_relief_is_tried_where_a_round_body_explains_the_masks(views, monkeypatch):
    tried = []
    monkeypatch.setattr(outlines_module, "_best_relief", lambda body, *_: tried.append(1) or body)
    monkeypatch.setattr(outlines_module, "_fitted_to_pixels", lambda body, _: body)
    bulge = Relief(-1.0, 0.1, 0.1 * np.cos(np.linspace(0.0, 4.0 * np.pi, 48))[None].repeat(20, 0))
    fit_profile(_upright(_round(0.99)), views, relief=bulge)
    assert not tried
    oval = bodies.masks_of(lambda p: bodies.ball(p / [1.0, 0.95, 1.0]), views.cameras)
    fit_profile(_upright(_round(0.97)), Views(oval, views.cameras), relief=bulge)
    assert len(tried) == 1


def _upright(points, **options):
    """A body of revolution about z with a profile."""
    points = np.array(points)
    points[[0, -1], 0] = 0.0
    return Revolution(Axis(_ORIGIN, np.eye(3)), Profile(points, closed=False), 2.0, **options)


def _round(radius):
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 400)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _rays_of(views):
    return outlines_module._pixels_beside(views, seed=0)[0].rays


@pytest.mark.parametrize("radius", [0.9, 1.02])
def test_depths_in_a_ball_are_those_of_its_nearest_point(views, radius):
    body, rays = _upright(_round(radius)), _rays_of(views)
    found = outlines_module._deepest(body, body.start(), rays)
    near = rays.origins - np.sum(rays.origins * rays.directions, axis=-1)[:, None] * rays.directions
    depths = (radius - np.linalg.norm(near, axis=-1)) / found.pixel
    np.testing.assert_allclose(found.depths, depths, atol=0.02)
    # A square of the solid angle of the pixel, at the distance of the outline.
    width = 3.0 / views.cameras.focal * (1.0 - radius**2 / 9.0) ** 1.25
    assert np.median(found.pixel) == pytest.approx(width, rel=0.05)


@pytest.mark.parametrize("knots", [36, 200])
def test_derivatives_of_depths_are_central_differences(views, knots):
    profile = _round(0.97) * np.linspace(0.9, 1.1, 400)[:, None]
    body, rays = _upright(profile, knots=knots), _rays_of(views)
    wave = np.cos(np.linspace(0.0, 9.0, knots))
    x, direction = (
        np.append([0.02, -0.03, 0.01, 0.02], 0.01 * wave),
        np.append(np.ones(4), wave[::-1]),
    )
    rows = outlines_module._depths_by_unknowns(body, x, outlines_module._deepest(body, x, rays))
    step = 1e-5
    up, down = (
        outlines_module._deepest(body, x + t * direction, rays).depths for t in (step, -step)
    )
    slopes = (up - down) / (2.0 * step)
    # The place on a ray is found to a few thousandths, where the depth is nearly level.
    off = np.abs(rows @ direction - slopes)
    assert np.quantile(off, 0.95) < 0.02 * np.abs(slopes).max() and np.abs(slopes).max() > 30.0


_RINGS = (-0.4, 0.0, 0.37)


def _ringed(points):
    """Less than the distance from a cylinder with three rings, two pixels wide."""
    height, radius = points[..., 2], np.hypot(points[..., 0], points[..., 1])
    wall = 0.5 + sum(0.025 * np.exp(-(((height - at) / 0.03) ** 2)) for at in _RINGS)
    return np.maximum(0.6 * (radius - wall), np.abs(height) - 0.8)


@pytest.mark.slow
def test_rings_as_narrow_as_pixels_are_found_in_masks(monkeypatch):
    monkeypatch.setattr(outlines_module, "_FITTED", 8000)
    monkeypatch.setattr(outlines_module, "_JUDGES", 4000)
    cameras = bodies.cameras_around(24, size=120, distance=3.0)
    views = Views(bodies.masks_of(_ringed, cameras, steps=120), cameras)
    height = np.linspace(-0.8, 0.8, 300)
    wall = np.stack([np.full(300, 0.49), height], axis=-1)
    lids = np.linspace(0.0, 0.49, 60)[:-1]
    bottom, top = (np.stack([lids, np.full(59, z)], axis=-1) for z in (-0.8, 0.8))
    outer = _upright(np.concatenate([bottom, wall, top[::-1]]))
    found = fit_profile(outer, views)
    assert found.knots > outer.knots
    heights = found.points[:, 1] + found.axis.point[2]
    base = without_ridges(Profile(found.points, closed=False), found.size).points
    for at in _RINGS:
        ring, beside = np.abs(heights - at) < 0.02, np.abs(np.abs(heights - at) - 0.12) < 0.04
        ridge = found.points[ring, 0].max() - np.median(found.points[beside, 0])
        assert 0.016 < ridge < 0.034
        # An inner wall follows less than half of them.
        inner = np.interp(heights, base[:, 1] + found.axis.point[2], base[:, 0])
        assert inner[ring].max() - np.median(inner[beside]) < 0.5 * ridge
    smooth = np.abs(heights) < 0.6
    for at in _RINGS:
        smooth &= np.abs(heights - at) > 0.08
    assert np.sqrt(np.mean((found.points[smooth, 0] - 0.5) ** 2)) < 0.006
