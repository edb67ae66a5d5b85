"""Vessels of any shape: their two surfaces, and what light tells of the wall."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scipy.spatial import KDTree

from refref_jax.geometry.triangle_meshes import diameter, face_normals, make_mesh, volume
from refref_jax.reconstruct import (
    ReconstructionError,
    free_vessels,
    gauss_newton,
    interior_looks,
    photometry,
)
from refref_jax.reconstruct.contents import Interior
from refref_jax.reconstruct.free_vessels import FreeVessel
from refref_jax.reconstruct.interior_looks import FreeLook, inner_wall
from refref_jax.reconstruct.mesh_distance import distance_grid, signed_distance
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.photometry import Photographs
from refref_jax.reconstruct.shapes import mesh_of, vertex_normals_of
from tests.factories import bodies, lit_scenes, vessels
from tests.laws import posed_surfaces


@pytest.fixture(scope="module")
def mesh():
    """A pebble without an axis of revolution."""
    ball = bodies.icosphere(4)
    lobes = 1.0 + 0.08 * np.cos(3.0 * np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0]))
    return make_mesh(ball.vertices * lobes[:, None] * [1.1, 0.9, 1.0], ball.faces)


@pytest.fixture(scope="module")
def inside(mesh):
    """Distances on a grid that is coarse enough for a test."""
    return distances_to(mesh, 1.0 / 50.0)


def distances_to(mesh, spacing):
    size = diameter(mesh.vertices)
    return distance_grid(mesh, spacing=spacing * size, margin=interior_looks._MARGIN * size)


def vessel_with(mesh, interior, inside):
    return FreeVessel(mesh, inner_wall(mesh, interior, inside), interior)


def black_pixels():
    rays, views = lit_scenes.pixels(16, reach=0.6)
    return Photographs(jax.device_get(rays), np.zeros((16, 3)), views)


@pytest.fixture(scope="module")
def vessel(mesh, inside):
    return vessel_with(mesh, Interior("air", wall=0.12, base=0.3, stained=True), inside)


def test_the_inner_wall_is_at_its_distance_and_above_its_base(mesh, vessel):
    glass, air = vessel.solids(vessel.start())
    depth = -signed_distance(mesh)(air.mesh.vertices)
    low = mesh.vertices[:, 2].min()
    assert air.mesh.vertices[:, 2].min() == pytest.approx(low + 0.3, abs=0.01)
    assert depth.min() == pytest.approx(0.12, abs=0.01)
    above = air.mesh.vertices[:, 2] > low + 0.4
    np.testing.assert_allclose(depth[above], 0.12, atol=0.01)
    assert (glass.index, air.index, air.parent) == (1.5, 1.0, 0)
    assert volume(air.mesh.vertices, air.mesh.faces) > 0.0


@pytest.mark.slow
def test_a_rounded_edge_is_where_a_gaussian_puts_it():
    # With planes of the grid near those of the walls: between them, it cuts sharp edges.
    box = bodies.fine_box(1.0, spacing=0.25)
    distances = distances_to(box, 1.0 / 60.0)
    # The mean of the larger of two normal variates is `sigma / sqrt(pi)` above theirs.
    for rounding, edge in ((0.0, 0.7), (0.12, 0.7 - 0.12 / np.sqrt(np.pi))):
        inner = inner_wall(box, Interior("air", wall=0.3), distances, rounding=rounding)
        on = np.array([[0.7, 0.0, 0.0], [0.0, 0.0, -0.7], [edge, edge, 0.0], [0.0, -edge, edge]])
        np.testing.assert_allclose(signed_distance(inner)(on), 0.0, atol=0.01)


@pytest.mark.slow
def test_a_rounding_thickens_a_curved_wall():
    ball = bodies.icosphere(4)
    rounding = interior_looks._ROUNDINGS[-1] * diameter(ball.vertices)
    interior = Interior("air", wall=0.02)
    inner = inner_wall(ball, interior, distances_to(ball, 1.0 / 60.0), rounding=rounding)
    # The mean of a distance by a Gaussian is larger by half its Laplacian times the variance.
    radii = np.linalg.norm(inner.vertices, axis=-1)
    np.testing.assert_allclose(radii + rounding**2 / radii, 0.98, atol=0.003)


def test_distances_are_those_to_the_mesh_near_and_far(mesh, inside):
    points = np.random.default_rng(0).integers(0, inside.values.shape, (400, 3))
    found = inside.values[tuple(points.T)] / inside.spacing
    expected = signed_distance(mesh)(inside.low + inside.spacing * points) / inside.spacing
    near = np.abs(expected) < 3.9
    assert 20 < np.sum(near) < 380
    np.testing.assert_allclose(found[near], expected[near], atol=1e-9)
    np.testing.assert_allclose(found, expected, atol=0.05)


@pytest.mark.parametrize("rounding", [-0.1, np.nan, np.inf])
def test_what_is_no_rounding_is_refused(mesh, inside, rounding):
    with pytest.raises(ValueError, match="is no length"):
        inner_wall(mesh, Interior("air", wall=0.1), inside, rounding=rounding)


@pytest.mark.parametrize("fits", [True, False])
def test_the_wall_the_rounding_and_then_the_base_that_suit_best_are_taken(
    mesh, inside, monkeypatch, fits
):
    """Each kind of contents has its own."""
    size = diameter(mesh.vertices)
    walls, bases = interior_looks._WALLS, interior_looks._BASES
    roundings = interior_looks._ROUNDINGS
    best = {
        "air": np.array([walls[2], bases[1], roundings[1]]),
        "liquid": np.array([walls[0], bases[0], roundings[2]]),
    }
    # The wall that would suit the liquid best leaves next to nothing inside.
    possible = best | {"liquid": np.array([walls[1], bases[0], roundings[2]])}

    def wall(outer, interior, distances, *, rounding):
        if not fits or interior.wall == size * walls[-1]:
            raise ReconstructionError("no space")
        numbers = np.array([interior.wall, interior.base, rounding]) / size
        inside = 0.1 if interior.wall == size * walls[0] else 0.2
        return mesh._replace(vertices=inside * mesh.vertices, normals=numbers)

    monkeypatch.setattr(interior_looks, "inner_wall", wall)
    world, pixels = vessels.smooth_backdrop(), black_pixels()

    def grid(outer, *, spacing, margin):
        assert (spacing, margin) == (size / 150.0, 0.075 * size)
        return inside

    def colour(traced, surface, seen, clear, diameter):
        assert len(seen.views) == 7 and surface.mips[0] is not world.mips[0] and diameter == size
        error = float(np.abs(traced - best[clear.contents]).mean())
        return error, dataclasses.replace(clear, tint=(0.5, 0.6, 0.7))

    monkeypatch.setattr(interior_looks, "_PIXELS", 7)
    monkeypatch.setattr(interior_looks, "distance_grid", grid)
    monkeypatch.setattr(
        interior_looks, "_scenes", lambda outer, inner, kinds: [inner.normals] * len(kinds)
    )
    monkeypatch.setattr(interior_looks, "_best_colour", colour)
    kinds = [Interior("liquid"), Interior("air")]
    found = interior_looks.best_free_looks(mesh, kinds, world, pixels, seed=3)
    assert len(found) == 2 * fits
    for look, kind in zip(found, kinds, strict=False):
        at = look.interior
        assert (at.contents, at.tint) == (kind.contents, (0.5, 0.6, 0.7))
        numbers = np.array([at.wall, at.base, look.rounding]) / size
        np.testing.assert_allclose(numbers, possible[kind.contents])
        np.testing.assert_allclose(look.inner.normals, numbers)
        assert look.error == np.abs(look.inner.normals - best[kind.contents]).mean()


def test_specks_of_an_inside_are_left_out(mesh):
    specks = [bodies.icosphere(2, radius=radius, centre=(3.0, 0.0, 0.0)) for radius in (0.02, 0.2)]
    both = bodies.joined(specks[0], mesh, specks[1])
    found = interior_looks._without_specks(both, 0.1)
    assert len(found.faces) == len(mesh.faces) + len(specks[1].faces)
    expected = np.concatenate([mesh.vertices, specks[1].vertices])
    np.testing.assert_array_equal(np.unique(found.vertices, axis=0), np.unique(expected, axis=0))
    assert interior_looks._without_specks(mesh, 0.1) is mesh
    assert not len(interior_looks._without_specks(specks[0], 0.1).faces)


@pytest.mark.slow
def test_a_look_traces_the_light_of_the_vessel(mesh, inside):
    surface, (rays, _) = vessels.smooth_backdrop(), lit_scenes.pixels(400, reach=0.9)
    kinds = [Interior(each, wall=0.12, glass=1.48) for each in ("air", "liquid")]
    inner = inner_wall(mesh, kinds[0], inside)
    scenes = interior_looks._scenes(mesh, inner, kinds)
    for kind, traced in zip(kinds, scenes, strict=True):
        vessel = FreeVessel(mesh, inner, kind)
        exact = gauss_newton.traced_object(vessel.pose(vessel.start()))
        one, other = (photometry.predict(each, surface, rays).linear for each in (traced, exact))
        np.testing.assert_allclose(one, other, atol=2e-3)


def _photograph(vessel, surface, rays, views):
    traced = gauss_newton.traced_object(vessel.pose(vessel.start()))
    rgb = photometry.encode(photometry.predict(traced, surface, rays).linear)
    return Photographs(jax.device_get(rays), rgb, views)


@pytest.mark.slow
def test_the_wall_of_a_liquid_is_seen_by_its_absorption_alone(mesh, inside):
    """Of the same index as the glass, so that light goes straight on from one into the other."""
    surface, (rays, views) = vessels.smooth_backdrop(), lit_scenes.pixels(400, reach=0.9)
    size = diameter(mesh.vertices)
    true = np.array([interior_looks._DENSITIES[n] for n in (4, 1, 0)]) / size
    thin = Interior("liquid", glass=1.45, liquid=1.45, wall=0.1)
    brown = vessel_with(mesh, dataclasses.replace(thin, absorption=tuple(true.tolist())), inside)
    seen, errors = _photograph(brown, surface, rays, views), []
    for wall in (0.1, 0.3, 0.5):
        shape = dataclasses.replace(thin, wall=wall)
        vessel = vessel_with(mesh, shape, inside)
        traced = gauss_newton.traced_object(vessel.pose(vessel.start()))
        error, coloured = interior_looks._best_colour(traced, surface, seen, shape, size)
        errors.append(error)
        if wall == thin.wall:
            np.testing.assert_allclose(coloured.absorption, true)
            assert dataclasses.replace(coloured, absorption=shape.absorption) == shape
    clear = float(gauss_newton.errors_of(traced, surface, seen).mean())
    assert errors[0] < 0.5 * errors[1] < 0.5 * errors[2] < 0.5 * clear


@pytest.mark.slow
def test_stained_glass_is_looked_at_with_its_tint(mesh, inside):
    surface, (rays, views) = vessels.smooth_backdrop(), lit_scenes.pixels(400, reach=0.9)
    clear = Interior("air", wall=0.12, stained=True)
    true = np.exp([-interior_looks._STAINS[n] for n in (2, 0, 4)])
    green = vessel_with(mesh, dataclasses.replace(clear, glass_tint=tuple(true.tolist())), inside)
    seen, vessel = _photograph(green, surface, rays, views), vessel_with(mesh, clear, inside)
    traced = gauss_newton.traced_object(vessel.pose(vessel.start()))
    error, coloured = interior_looks._best_colour(traced, surface, seen, clear, 1.0)
    np.testing.assert_allclose(coloured.glass_tint, true)
    assert dataclasses.replace(coloured, glass_tint=clear.glass_tint) == clear
    assert error < 0.2 * float(gauss_newton.errors_of(traced, surface, seen).mean())


def test_distances_of_wrong_sign_are_no_crossing(vessel, monkeypatch):
    """Those to the corners of a face that is folded over may have it."""
    monkeypatch.setattr(free_vessels, "signed_distance", lambda mesh: lambda x: np.ones(len(x)))
    assert not vessel.surfaces_cross(vessel.start())


@pytest.mark.parametrize(
    ("share", "height", "most", "crosses"),
    [
        (0.0003, 1.0, 1000, False),
        (0.01, 1.0, 1000, True),
        (0.01, 1.0, 4, True),
        # By less than they are kept below, as in a crease.
        (0.005, 0.0018, 1000, False),
        (0.02, 0.0018, 1000, True),
        (0.01, 0.0025, 1000, True),
    ],
)
def test_a_few_vertices_beside_folds_and_in_creases_are_no_crossing(
    vessel, monkeypatch, share, height, most, crosses
):
    def with_some_outside(inner, outer, depth):
        del depth
        some, vertices = slice(0, None, round(1.0 / share)), inner.vertices.copy()
        nearest = KDTree(outer.vertices).query(vertices[some])[1]
        away = height * vessel.size * vertex_normals_of(outer)[nearest]
        vertices[some] = outer.vertices[nearest] + away
        return inner._replace(vertices=vertices)

    monkeypatch.setattr(free_vessels, "_MOST_SUSPECTS", most)
    monkeypatch.setattr(free_vessels, "_kept_below", with_some_outside)
    assert vessel.surfaces_cross(vessel.start()) == crosses


@pytest.mark.parametrize("number", [0, 1])
def test_derivatives_are_central_differences(vessel, number):
    posed_surfaces.assert_derivatives(
        posed_surfaces.PartOf(vessel, number), step=1e-6, tolerance=1e-5
    )


def test_the_prior_is_quadratic(vessel):
    posed_surfaces.assert_prior(vessel)


def test_the_inner_wall_follows_the_outer_one(vessel):
    x = vessel.start()
    x[vessel.layout.outer] = 0.05
    before, after = (vessel.pose(each).parts for each in (vessel.start(), x))
    for one, other in zip(before, after, strict=True):
        moved = np.linalg.norm(other.vertices - one.vertices, axis=-1)
        np.testing.assert_allclose(moved, 0.05, atol=1e-9)
    x[vessel.layout.inner] = -0.02
    thinner = vessel.pose(x).parts[1].vertices - before[1].vertices
    np.testing.assert_allclose(np.linalg.norm(thinner, axis=-1), 0.03, atol=1e-9)


@pytest.mark.slow
def test_a_finer_vessel_is_the_same_but_smoother_and_has_more_handles(vessel):
    x = vessel.start() + 0.001 * np.random.default_rng(0).normal(size=vessel.layout.count)
    finer = vessel.finer(x)
    for one, other in zip(vessel.solids(x), finer.solids(finer.start()), strict=True):
        moved = np.linalg.norm(other.mesh.vertices - one.mesh.vertices, axis=-1)
        assert np.median(moved) < 0.001 * vessel.size and moved.max() > 0.0005 * vessel.size
        volumes = [volume(each.mesh.vertices, each.mesh.faces) for each in (one, other)]
        np.testing.assert_allclose(volumes[1], volumes[0], rtol=1e-4)
        assert other.index == one.index
        np.testing.assert_allclose(other.tint, one.tint, rtol=1e-12)
    even, uneven, smoothed = (
        face_normals(wall.vertices[wall.faces])
        for made, at in ((vessel, vessel.start()), (vessel, x), (finer, finer.start()))
        for wall in made.pose(at).parts[:1]
    )
    assert np.linalg.norm(smoothed - even) < 0.95 * np.linalg.norm(uneven - even)
    counts = [
        [each.stop - each.start for each in (made.layout.outer, made.layout.inner)]
        for made in (vessel, finer)
    ]
    assert counts[1][0] > counts[0][0] and counts[1][1] > 2 * counts[0][1]
    # What the prior knew of the glass is not forgotten.
    x[vessel.layout.glass] += 0.05
    finer = vessel.finer(x)
    pulls = [
        made.prior(at)[1][made.layout.glass] for made, at in ((vessel, x), (finer, finer.start()))
    ]
    np.testing.assert_allclose(pulls[1], pulls[0])
    assert abs(pulls[0]) > 1.0


@pytest.mark.slow
def test_a_finer_vessel_has_no_more_unknowns_than_memory_allows(vessel, monkeypatch):
    many = vessel.finer(vessel.start()).layout.count
    monkeypatch.setattr(free_vessels, "_MOST", 0.8 * many)
    assert vessel.finer(vessel.start()).layout.count < many


def test_the_inner_wall_does_not_reach_the_outer_one(vessel):
    x = vessel.start()
    x[vessel.layout.inner] = 0.2
    assert not vessel.surfaces_cross(x)
    outer, inner = vessel.pose(x).parts
    depth = -signed_distance(mesh_of(outer))(inner.vertices)
    assert depth.min() > 0.0
    np.testing.assert_allclose(np.median(depth), 0.002 * vessel.size, atol=1e-3)
    # What follows the outer wall moves with it.
    further = x.copy()
    further[vessel.layout.outer] = 0.01
    moved = vessel.pose(further).parts[1].vertices - inner.vertices
    expected = (inner.by_vertices @ (further - x)).reshape(-1, 3)
    assert np.median(np.linalg.norm(moved - expected, axis=-1)) < 1e-3


def test_walls_that_cross_are_noticed(vessel, monkeypatch):
    x = vessel.start()
    assert not vessel.surfaces_cross(x)
    monkeypatch.setattr(free_vessels, "_kept_below", lambda inner, outer, depth: inner)
    x[vessel.layout.inner] = 0.2
    assert vessel.surfaces_cross(x)


@pytest.mark.parametrize(
    ("interior", "message"),
    [
        (Interior("liquid and air"), "liquid and air"),
        (Interior("air", mouth=True), "open"),
        (Interior("air", wall=1.2), "no space"),
        (Interior("air", wall=0.1, base=5.0), "no space"),
    ],
)
def test_what_it_cannot_be_is_refused(mesh, inside, interior, message):
    with pytest.raises(ReconstructionError, match=message):
        vessel_with(mesh, interior, inside)


@pytest.mark.parametrize(
    ("errors", "rounds", "crossing", "best"),
    [
        ((0.3, 0.4, 0.5, 0.2, 0.1), 1, (3, 4), 0),
        # Contents that are hardly worse at first get further steps, too.
        ((0.3, 0.32, 0.4, 0.2, 0.18, 0.1), 1, (), 5),
        # Each round of finest steps begins where the best one ended.
        ((0.3, 0.4, 0.5, 0.2, 0.1, 0.11, 0.08, 0.07), 4, (7,), 6),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ((0.3, 0.4, 0.5, 0.2, 0.1), 1, (), 4),
                ((0.3, 0.4, 0.5, 0.2, 0.25), 1, (), 3),
                ((0.3, 0.4, 0.5, 0.2, 0.1), 1, (4,), 3),
                ((0.3, 0.4, 0.5, 0.2, 0.1), 1, (0, 3, 4), 1),
                ((0.3, 0.4, 0.5, 0.2, 0.1), 1, (0, 1, 2, 3, 4), None),
                ((0.3, 0.32, 0.4, 0.2, 0.18, 0.19), 1, (), 4),
                ((0.32, 0.4, 0.3, 0.2, 0.18, 0.1), 1, (4, 5), 3),
                ((0.3, 0.4, 0.5, 0.2, 0.1, 0.09, 0.08, 0.07), 4, (), 7),
            )
        ),
    ],
)
def test_the_best_vessel_whose_walls_do_not_cross_is_kept(
    mesh, vessel, inside, monkeypatch, errors, rounds, crossing, best
):
    made, shares, begun = [], [], []

    def finer(self, x):
        begun.append(int(x[0]))
        return self

    def fit(model, x, *_, settings, progress, **options):
        progress(len(settings.blurs), gauss_newton.StepFacts(0, 1.0, 0.5, 0.0, True, 0.0))
        return gauss_newton.Fit(np.array([len(made)]), np.eye(1), ())

    def judged(name, model, fit, *_):
        made.append(Trial(name, model, fit, np.array([errors[len(made)]])))
        return made[-1]

    monkeypatch.setattr(free_vessels, "_FINEST", ((0,),) * rounds)
    monkeypatch.setattr(FreeVessel, "finer", finer)
    inner, at = mesh_of(vessel.pose(vessel.start()).parts[1]), vessel.interior_at_start
    looks = [
        FreeLook(0.5, dataclasses.replace(at, glass_tint=(tint,) * 3), 0.0, smaller)
        for tint, smaller in [
            (tint, inner._replace(vertices=tint * inner.vertices)) for tint in (0.9, 0.8, 0.7)
        ]
    ]

    def best_looks(outer, kinds, surface, pixels, *, seed):
        assert [each.contents for each in kinds] == ["air", "liquid", "liquid"]
        assert [each.liquid for each in kinds[1:]] == list(free_vessels._LIQUIDS)
        return looks

    monkeypatch.setattr(free_vessels, "best_free_looks", best_looks)
    monkeypatch.setattr(free_vessels, "judged", judged)
    monkeypatch.setattr(gauss_newton, "fit", fit)
    monkeypatch.setattr(
        free_vessels._Fitted, "surfaces_cross", lambda each: errors.index(each.error) in crossing
    )
    seen = black_pixels()
    found = free_vessels.fit_free_vessel(
        mesh,
        vessels.smooth_backdrop(),
        seen,
        seen,
        progress=lambda share, text: shares.append(share),
    )
    assert (None if found is None else errors.index(found.error)) == best
    # Each look is fitted, from its own wall and colour.
    for look, trial in zip(looks, made[:3], strict=True):
        start = trial.model.start()
        assert trial.model.interior(start).glass_tint == pytest.approx(look.interior.glass_tint)
        np.testing.assert_array_equal(
            trial.model.pose(start).parts[1].vertices, look.inner.vertices
        )
    # Where nothing may be kept, there are no finest steps.
    assert shares == sorted(shares) and len(made) == len(errors) - (best is None)
    assert best is None or shares[-1] == 1.0
    kept = [(error, n) for n, error in enumerate(errors) if n not in crossing]
    finest = range(len(errors) - rounds, len(errors)) if best is not None else ()
    assert begun == [min(each for each in kept if each[1] < n)[1] for n in finest]


@pytest.mark.slow
def test_light_finds_thickness_and_tint(mesh, inside):
    surface, tint = vessels.smooth_backdrop(), (0.9, 0.97, 0.85)
    truth = Interior("air", wall=0.12, glass=1.5, stained=True, glass_tint=tint)
    seen = vessels.photographs(vessel_with(mesh, truth, inside), surface, reach=0.7)
    start = vessel_with(mesh, Interior("air", wall=0.16, stained=True), inside)
    steps = gauss_newton.Steps((1, 1, *[0] * 6), 4096, 4096)
    fit = gauss_newton.fit(start, start.start(), surface, seen, settings=steps)
    found = start.interior(fit.x)
    assert found.glass_tint == pytest.approx(tint, abs=0.02)
    glass, air = start.solids(fit.x)
    depth = -signed_distance(glass.mesh)(air.mesh.vertices)
    # Thin walls shift light by thickness times (index - 1), nearly; 0.08 at the start.
    assert np.median(depth) * (found.glass - 1.0) == pytest.approx(0.06, rel=0.06)
    assert fit.steps[-1].after < 0.2 * fit.steps[0].before


@pytest.mark.slow
def test_a_vessel_that_is_far_worse_than_another_shape_gets_no_further_steps(
    mesh, inside, monkeypatch
):
    monkeypatch.setattr(interior_looks, "_WALLS", (0.05,))
    monkeypatch.setattr(interior_looks, "_BASES", (0.0,))
    small = {"_FIRST": (1,), "_OTHERS": (0,)}
    small |= {"_FINEST": ((0,),), "_FIRST_RAYS": 2000, "_RAYS": 2000, "_FINEST_RAYS": 2000}
    small |= {"_STEPS": dataclasses.replace(free_vessels._STEPS, judges=2000)}
    for name, value in small.items():
        monkeypatch.setattr(free_vessels, name, value)
    monkeypatch.setattr(interior_looks, "distance_grid", lambda mesh, **options: inside)
    surface = vessels.smooth_backdrop()
    truth = vessel_with(mesh, Interior("air", wall=0.12, stained=True), inside)
    seen = vessels.photographs(truth, surface, reach=0.7)
    told = []
    fit = functools.partial(
        free_vessels.fit_free_vessel, mesh, surface, seen, seen, progress=lambda *x: told.append(x)
    )
    given_up, steps = fit(rival=1e-6), len(told)
    followed = fit()
    assert len(told) - steps == steps + 2
    assert followed.error < given_up.error
