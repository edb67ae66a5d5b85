"""Vessels that are turned only in part: feet with six sides, spouts and flutes."""

import numpy as np
import pytest
import scipy.sparse
import trimesh

from refref_jax.geometry.triangle_meshes import (
    face_normals,
    face_vectors,
    make_mesh,
    unit_vectors,
)
from refref_jax.reconstruct import outlines as outlines_module
from refref_jax.reconstruct.contents import Detail, Interior
from refref_jax.reconstruct.families import Revolution, fit_revolution
from refref_jax.reconstruct.interior_search import refined
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.mesh_distance import signed_distance
from refref_jax.reconstruct.outlines import Outlines, fit_profile
from refref_jax.reconstruct.relief import (
    KNOTS,
    Relief,
    _solve_banded,
    fitted_to_outlines,
    measure_relief,
    precision,
)
from refref_jax.reconstruct.revolution import Axis, Profile
from tests.factories import bodies, revolved, vessels
from tests.laws import posed_surfaces

_UPRIGHT = Axis(np.zeros(3), np.eye(3))


def _six_sided(points, *, below=-0.4):
    """Factors that give a body of revolution about z a foot with six rounded sides."""
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    foot = 0.5 - 0.5 * np.tanh((points[..., 2] - below) / 0.1)
    factor = 1.0 + 0.08 * foot * np.cos(6.0 * azimuth)
    return np.stack([factor, factor, np.ones_like(factor)], axis=-1)


def _stretched(mesh):
    return make_mesh(mesh.vertices * _six_sided(mesh.vertices), mesh.faces)


@pytest.fixture(scope="module")
def foot():
    """A cylinder whose foot has six sides, as a mesh with the noise of masks."""
    profile = revolved.even(revolved.cylinder(), 160)
    return revolved.noisy(_stretched(revolved.revolve(profile, azimuths=128)), 0.001)


@pytest.fixture(scope="module")
def relief(foot):
    return measure_relief(foot, _UPRIGHT)


@pytest.fixture(scope="module")
def outer(foot, relief):
    return fit_revolution(foot, furthest=0.05).with_relief(relief)


def test_the_relief_of_a_foot_with_six_sides_is_measured(foot, relief):
    heights = relief.low + relief.step * np.arange(len(relief.factors))
    azimuth = 2.0 * np.pi * np.arange(relief.factors.shape[1]) / relief.factors.shape[1]
    around = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), heights[:, None]), -1)
    expected = _six_sided(around)[..., 0] - 1.0
    middle = np.abs(heights) < 0.85
    np.testing.assert_allclose(relief.factors[middle], expected[middle], atol=0.006)
    assert not relief.factors[np.abs(heights - 0.3) < 0.5].any(), "round sections stay round"


def test_a_round_mesh_has_no_relief():
    mesh = revolved.noisy(revolved.revolve(revolved.even(revolved.vase(), 200)), 0.001)
    assert measure_relief(mesh, _UPRIGHT) is None


def test_walls_towards_the_axis_have_no_radius_of_their_own():
    # A cogwheel of eight teeth: their sides are at azimuths that are looked at.
    corners = np.tile([0.7, 1.0, 1.0, 0.7], 4)
    angle = np.repeat(2.0 * np.pi * np.arange(8) / 8.0, 2)
    ring = corners[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    wheel = trimesh.creation.extrude_triangulation(*_fan(ring), height=1.0)
    wheel.apply_translation([0.0, 0.0, -0.5])
    found = measure_relief(make_mesh(wheel.vertices, wheel.faces), _UPRIGHT)
    radii = 1.0 + found.factors[60]
    assert np.isfinite(found.factors).all()
    assert radii.max() / radii.min() == pytest.approx(1.0 / (0.7 * np.cos(np.pi / 8.0)), rel=0.02)


def _fan(ring):
    """Triangles from the middle to a star-shaped polygon."""
    first = np.arange(len(ring))
    faces = np.stack([np.full(len(ring), len(ring)), first, np.roll(first, -1)], axis=-1)
    return np.concatenate([ring, [[0.0, 0.0]]]), faces


def test_a_moved_and_scaled_mesh_has_the_same_relief(foot, relief):
    moved = revolved.placed(foot, offset=np.array([1e3, -2e3, 5e2]), scale=10.0)
    axis = Axis(np.array([1e3, -2e3, 5e2]), np.eye(3))
    found = measure_relief(moved, axis)
    np.testing.assert_allclose(found.factors, relief.factors, atol=1e-9)
    assert found.step == pytest.approx(10.0 * relief.step)


def test_the_jacobian_is_that_of_the_stretched_points(relief):
    points = np.random.default_rng(0).uniform(-0.8, 0.8, size=(200, 3))
    found, step = relief.stretch(points), 1e-6
    for axis, change in enumerate(step * np.eye(3)):
        after, before = relief.stretch(points + change), relief.stretch(points - change)
        slope = (after.points - before.points) / (2.0 * step)
        np.testing.assert_allclose(found.jacobian[..., axis], slope, atol=1e-6)


def test_points_on_the_axis_and_beyond_both_ends_stay_finite(relief):
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -50.0], [1e-300, 0.0, 9.0], [1e6, 0.0, 0.0]])
    found = relief.stretch(points)
    assert np.isfinite(found.points).all() and np.isfinite(found.jacobian).all()
    np.testing.assert_array_equal(found.points[:2], points[:2])


def test_normals_are_perpendicular_to_the_stretched_surface(outer):
    posed = outer.pose(outer.start())
    corners = posed.vertices[posed.faces]
    flat = face_normals(corners)
    large = np.linalg.norm(face_vectors(posed.vertices, posed.faces), axis=-1) > 1e-6
    smooth = unit_vectors(posed.normals[posed.normal_ids].mean(axis=1))
    angle = np.degrees(np.arccos(np.clip(np.sum(flat * smooth, axis=-1), -1.0, 1.0)))[large]
    # Half-planes are 2.8 degrees apart, and the normals of the foot turn four times as fast.
    assert np.median(angle) < 0.8 and np.quantile(angle, 0.99) < 3.5


def test_vertices_move_as_their_derivatives_say(outer):
    generator, x = np.random.default_rng(1), outer.start()
    step = 1e-6 * generator.normal(size=len(x))
    after, before, now = outer.pose(x + step), outer.pose(x - step), outer.pose(x)
    moved = 0.5 * (after.vertices - before.vertices).ravel()
    np.testing.assert_allclose(moved, now.by_vertices @ step, atol=1e-3 * np.abs(moved).max())
    turned = 0.5 * (after.normals - before.normals).ravel()
    wrong = np.linalg.norm(turned - now.by_normals @ step) / np.linalg.norm(turned)
    assert wrong < 0.1


@pytest.mark.slow
def test_parts_of_a_vessel_with_a_relief_are_closed_and_nested(relief):
    body = vessels.bottle()
    body = body.with_relief(Relief(-1.0, 2.0 / (len(relief.factors) - 1), relief.factors))
    detail = Detail(outer=48, inner=64, azimuths=48)
    for mouth in (False, True):
        interior = Interior("liquid and air", mouth=mouth, wall=0.12, level=-0.2, gap=0.05)
        vessel = Vessel(body, interior, detail)
        for part in vessel.pose(vessel.start()).parts[: 2 if mouth else 3]:
            posed_surfaces.assert_closed(part)
        solids = vessel.solids(vessel.start())
        liquid = solids[1].mesh
        assert signed_distance(solids[0].mesh)(liquid.vertices).max() < 0.0
        round_one = Vessel(body.with_relief(None), interior, detail)
        plain = round_one.solids(round_one.start())[1].mesh
        assert np.ptp(liquid.vertices - plain.vertices) > 0.01
        np.testing.assert_array_equal(liquid.vertices[:, 2], plain.vertices[:, 2])


@pytest.mark.parametrize("mouth", [pytest.param(False, marks=pytest.mark.slow), True])
def test_offsets_of_a_relief_move_all_parts_as_their_derivatives_say(relief, mouth):
    body = vessels.bottle().with_relief(Relief(-1.0, 0.05, relief.factors))
    detail = Detail(outer=48, ridges=0, inner=64, azimuths=48)
    interior = Interior("liquid and air", mouth=mouth, wall=0.12, level=-0.2, gap=0.05)
    vessel, generator = Vessel(body, interior, detail), np.random.default_rng(2)
    where = vessel.layout.relief
    assert where.stop - where.start == np.prod(KNOTS)
    x, step = vessel.start(), np.zeros(vessel.layout.count)
    x[where] = 0.01 * generator.normal(size=where.stop - where.start)
    step[where] = 1e-6 * generator.normal(size=where.stop - where.start)
    parts = [vessel.pose(each).parts for each in (x + step, x - step, x)]
    for after, before, now in list(zip(*parts, strict=True))[: 2 if mouth else 3]:
        moved = 0.5 * (after.vertices - before.vertices).ravel()
        turned = 0.5 * (after.normals - before.normals).ravel()
        assert np.abs(moved).max() > 1e-7
        np.testing.assert_allclose(now.by_vertices @ step, moved, atol=1e-4 * np.abs(moved).max())
        np.testing.assert_allclose(now.by_normals @ step, turned, atol=1e-4 * np.abs(turned).max())


def test_other_unknowns_move_a_vessel_alike_with_and_without_offsets_of_its_relief(relief):
    body = vessels.bottle().with_relief(Relief(-1.0, 0.05, relief.factors))
    detail = Detail(outer=48, ridges=0, inner=64, azimuths=48)
    with_offsets, without = (
        Vessel(body, Interior(wall=0.12, level=-0.2), detail._replace(fine=unknown))
        for unknown in (True, False)
    )
    count = without.layout.count
    x = 0.01 * np.random.default_rng(3).normal(size=with_offsets.layout.count)
    x[with_offsets.layout.relief] = 0.0
    x = x + with_offsets.start()
    pairs = zip(with_offsets.pose(x).parts, without.pose(x[:count]).parts, strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-12)
        for name in ("by_vertices", "by_normals"):
            expected = getattr(other, name)
            found = getattr(one, name).toarray()[:, :count]
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("mouth", [False, True])
def test_a_vessel_with_more_unknowns_has_the_same_shape(relief, mouth):
    body = vessels.bottle().with_relief(Relief(-1.0, 0.05, relief.factors)).with_knots(80)
    interior = Interior("liquid and air", mouth=mouth, wall=0.12, level=-0.2, gap=0.05)
    detail = Detail(outer=48, ridges=100, inner=64, azimuths=48)
    vessel = Vessel(body, interior, detail._replace(fine=False))
    x = vessel.start()
    x[: vessel.layout.profile] += 0.01 * np.random.default_rng(8).normal(size=vessel.layout.profile)
    other, y = refined(vessel, x, detail)
    assert len(y) == len(x) + 80 - 36 + np.prod(KNOTS)
    assert other.interior(y) == vessel.interior(x)
    moved, still = (vessel.pose(each).parts[0].vertices for each in (x, vessel.start()))
    found = other.pose(y).parts[0].vertices
    assert np.abs(found - moved).max() < 0.05 * np.abs(moved - still).max()


def test_the_mesh_of_a_body_is_that_of_its_pose(relief):
    for body in (vessels.bottle(), vessels.bottle().with_relief(relief)):
        found, posed = body.mesh(), body.pose(body.start())
        np.testing.assert_allclose(found.vertices, posed.vertices, atol=1e-12)
        np.testing.assert_array_equal(found.faces, posed.faces)


def test_a_raised_relief_is_that_of_its_offsets(relief):
    offsets = 0.02 * np.random.default_rng(4).normal(size=KNOTS)
    points = np.random.default_rng(5).uniform(-0.8, 0.8, size=(200, 3))
    found = relief.raised(offsets).stretch(points).points
    np.testing.assert_allclose(
        found, relief.with_offsets(offsets).stretch(points).points, atol=1e-4
    )


def test_shrinking_inverts_stretching_with_offsets_too(relief):
    offset = relief.with_offsets(0.02 * np.random.default_rng(6).normal(size=KNOTS))
    points = np.random.default_rng(7).uniform(-0.8, 0.8, size=(200, 3))
    np.testing.assert_allclose(offset.shrink(offset.stretch(points).points), points, atol=1e-12)


def test_slopes_by_offsets_stay_finite_on_the_axis_and_beyond_both_ends(relief):
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -50.0], [1e-300, 0.0, 9.0], [1e6, 0.0, 0.0]])
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    offsets = 0.02 * np.random.default_rng(8).normal(size=KNOTS)
    for slopes in relief.slopes(points, normals, np.arange(4), offsets):
        assert np.isfinite(slopes.data).all()
    by_points, _ = relief.slopes(points, normals, np.arange(4), offsets)
    assert not by_points[:6].toarray().any(), "points on the axis stay there"
    np.testing.assert_allclose(by_points[9].sum(), 1e6)  # the splines sum to 1


def test_the_precision_of_offsets_prefers_smooth_ones():
    matrix = precision()
    np.linalg.cholesky(matrix)
    height, azimuth = np.meshgrid(np.arange(KNOTS[0]), np.arange(KNOTS[1]), indexing="ij")
    smooth = np.cos(2.0 * np.pi * azimuth / KNOTS[1]).ravel()
    rough = np.cos(np.pi * (azimuth + height)).ravel()
    assert smooth @ matrix @ smooth < 0.1 * (rough @ matrix @ rough)


@pytest.mark.slow
def test_the_sides_of_a_block_become_flat_in_its_outlines():
    half, cameras = 0.8, bodies.cameras_around(14, size=80, distance=4.0)
    views = Views(bodies.masks_of(bodies.box, cameras, steps=120), cameras)
    mesh = revolved.noisy(bodies.fine_box(half, spacing=0.05), 0.006)
    relief = measure_relief(mesh, _UPRIGHT)
    median = half / np.cos(np.pi / 8.0)
    points = revolved.even(revolved.cylinder(radius=median, half=half), 200)
    profile = Profile(points, closed=False)
    body = Revolution(_UPRIGHT, profile, 2.0 * half).with_relief(relief)
    outlines = Outlines(views, seed=0)
    fitted = body.with_relief(fitted_to_outlines(relief, body.raised, outlines.of_surface))
    wrong = []
    for each in (body, fitted):
        posed = each.pose(each.start())
        corners = posed.vertices[posed.faces]
        middle = corners.mean(axis=1)
        side = (np.abs(middle[:, 2]) < 0.5) & (np.abs(middle[:, 1]) < 0.5) & (middle[:, 0] > 0.0)
        normals = face_normals(corners[side])
        wrong.append(np.degrees(np.arccos(np.clip(normals[:, 0], -1.0, 1.0))).mean())
    assert wrong[1] < 1.0 and wrong[1] < 0.2 * wrong[0]
    # Corners reach further from the axis than the profile.
    assert (
        outlines_module._judged(fitted, outlines_module._pixels_beside(views, seed=0)[1])[0] < 0.1
    )


@pytest.mark.slow
def test_outlines_decide_about_the_relief():
    cameras = bodies.cameras_around(24, size=120, distance=3.0)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 200)
    points = 0.88 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points[[0, -1], 0] = 0.0
    outer = Revolution(_UPRIGHT, Profile(points, closed=False), 1.8)
    mesh = _stretched(revolved.revolve(points / 0.88 * 0.9, azimuths=128))
    relief = measure_relief(mesh, _UPRIGHT)
    six_sided, ball = (
        Views(bodies.masks_of(solid, cameras, steps=120), cameras)
        for solid in (_ball_with_six_sides, lambda p: bodies.ball(p, radius=0.9))
    )
    found = [fit_profile(outer, six_sided, relief=each) for each in (None, relief)]
    assert found[0].relief is None and found[1].relief is not None
    wrong = []
    for body in found:
        vertices = body.pose(body.start()).vertices
        foot = vertices[(vertices[:, 2] > -0.8) & (vertices[:, 2] < -0.4)]
        wrong.append(np.sqrt(np.mean(_ball_with_six_sides(foot) ** 2)) / 0.6)
    assert wrong[1] < 0.25 * wrong[0]
    assert fit_profile(outer, ball, relief=relief).relief is None


@pytest.mark.parametrize("width", [0, 2, 7])
def test_banded_equations_are_solved(width):
    generator = np.random.default_rng(0)
    away = np.abs(np.subtract.outer(np.arange(8), np.arange(8)))
    lower = np.tril(generator.normal(size=(8, 8)) * (away <= width)) + 4.0 * np.eye(8)
    matrix, solution = lower @ lower.T, generator.normal(size=8)
    found = _solve_banded(scipy.sparse.csc_array(matrix), matrix @ solution)
    np.testing.assert_allclose(found, solution, rtol=1e-10)


def _ball_with_six_sides(points):
    """Less than the distance from a ball of radius 0.9 whose foot has six sides."""
    return 0.6 * (np.linalg.norm(points / _six_sided(points), axis=-1) - 0.9)
