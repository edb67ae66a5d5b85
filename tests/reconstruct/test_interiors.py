"""Vessels with liquid and air inside: their unknowns, and what light tells of them."""

import dataclasses
import types

import numpy as np
import pytest

from refref_jax.data.mesh_queries import winding_number
from refref_jax.geometry.triangle_meshes import is_watertight, volume
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.reconstruct import (
    ReconstructionError,
    gauss_newton,
    interior_looks,
    interior_search,
    photometry,
    walls,
)
from refref_jax.reconstruct.contents import Detail, Interior
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.interior_looks import Look, SearchSettings, hypotheses, look
from refref_jax.reconstruct.interior_search import (
    Few,
    Finding,
    _better,
    _finding,
    _looked_again,
    _simplest,
    _with_each_mouth,
    _with_further_steps,
    _with_other_levels,
)
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.mesh_distance import signed_distance
from refref_jax.reconstruct.revolution import Axis, Profile
from refref_jax.reconstruct.shapes import mesh_of
from refref_jax.reconstruct.turned import Outline, Turned
from refref_jax.reconstruct.walls import (
    inset,
    with_open_top,
    with_punt,
    without_loops,
    without_ridges,
)
from tests.factories import revolved, vessels
from tests.laws import posed_surfaces

_TINY = Detail(outer=40, inner=56, azimuths=12)
_SMALL = Detail(outer=48, inner=64, azimuths=48)
_FLASK = Interior(wall=0.12, level=-0.2, gap=0.1, tint=(0.5, 0.8, 0.95))
_INTERIORS = {
    each.name: each
    for each in (
        Interior("none"),
        Interior("air", stained=True),
        Interior("liquid"),
        Interior("liquid and air", level=-0.2, gap=0.1),
        Interior("air", mouth=True),
        Interior("liquid and air", mouth=True, level=-0.2, gap=0.02),
    )
}


@pytest.fixture(scope="module")
def body():
    return vessels.bottle()


@pytest.fixture(scope="module", params=list(_INTERIORS))
def vessel(request, body):
    return Vessel(body, _INTERIORS[request.param], _TINY)


def _moved(vessel, seed, *, by=0.15):
    scales = vessel.scales()
    return vessel.start() + by * scales * np.random.default_rng(seed).normal(size=len(scales))


def test_derivatives_are_central_differences(vessel):
    for number in range(len(vessel.pose(vessel.start()).parts)):
        posed_surfaces.assert_derivatives(
            posed_surfaces.PartOf(vessel, number), step=1e-6, tolerance=1e-5
        )


def test_the_prior_is_quadratic(vessel):
    posed_surfaces.assert_prior(vessel)


@pytest.mark.parametrize("seed", range(3))
def test_parts_are_closed_nested_and_apart(vessel, seed):
    x = _moved(vessel, seed)
    solids = vessel.solids(x)
    for posed in vessel.pose(x).parts:
        posed_surfaces.assert_closed(posed)
    glass = solids[0]
    assert glass.parent == NO_PARENT
    outside = signed_distance(glass.mesh)
    for each in solids[1:]:
        assert each.parent == 0
        assert outside(each.mesh.vertices).max() < 0.0
    if len(solids) == 3:
        liquid, air = (each.mesh.vertices @ vessel.outer.axis.frame[:, 2] for each in solids[1:])
        assert liquid.max() < air.min()


def test_a_profile_loses_its_loops():
    points = [[0, 0], [1, 0], [1, 1], [1.2, 1.2], [1.2, 0.8], [0.9, 1.0], [0.9, 6], [0, 6]]
    points = np.array(points, float)
    numbers = np.arange(len(points) - 1)
    normals = np.array([[np.cos(a), np.sin(a)] for a in np.arange(2 * len(numbers))])
    still = np.zeros((len(points), 2, 0))
    outline = Outline(
        Turned(points, still, normals, np.zeros((len(normals), 2, 0))),
        np.isin(np.arange(len(points)), (0, len(points) - 1)),
        np.stack([numbers, numbers + 1], axis=-1),
        2 * numbers[:, None] + np.arange(2),
    )
    found = without_loops(outline)
    crossing = [1.0, 0.8 + 0.2 * 2.0 / 3.0]
    expected = [[0, 0], [1, 0], crossing, [0.9, 1.0], [0.9, 6], [0, 6]]
    np.testing.assert_allclose(found.turned.points, expected, atol=1e-12)
    assert found.segments.tolist() == [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]
    # The two segments that meet at the crossing keep the normals of their outer ends.
    assert found.ends.tolist() == [[0, 1], [2, 2], [9, 9], [10, 11], [12, 13]]
    assert found.poles.tolist() == [True, False, False, False, False, True]
    assert without_loops(found) is found


def test_a_large_loop_is_no_fold():
    points = np.array([[0, 0], [1, 0], [1, 1], [4, 1], [4, 0.5], [0.5, 0.5], [0.5, 2], [0, 2]])
    assert walls._find_loops(points) == []


@pytest.mark.slow
def test_solids_have_no_folds(body):
    vessel = Vessel(body, Interior("none"), _SMALL)
    x = vessel.start()
    wall = vessel.outer_wall
    at_knots = wall.points[np.argmax(wall.hats, axis=0)]
    # The bottom edge has a radius of 0.15.
    edge = np.linalg.norm(at_knots - [0.86, wall.points[:, 1].min() + 0.04], axis=-1) < 0.12
    x[vessel.layout.outer] = np.where(edge, -0.35, 0.0)
    folded, (solid,) = mesh_of(vessel.pose(x).parts[0]), vessel.solids(x)
    random = np.random.default_rng(0)
    low, high = folded.vertices.min(axis=0), folded.vertices.max(axis=0)
    places = random.uniform(low, high, (4000, 3))
    turns = [
        {round(number) for number in winding_number(mesh, places)} for mesh in (folded, solid.mesh)
    ]
    assert turns[0] - {0, 1} and turns[1] == {0, 1}
    assert is_watertight(solid.mesh.faces)


def test_walls_never_cross_however_far_they_move(body):
    vessel = Vessel(body, Interior("air", wall=0.1), _TINY)
    for offset in (-3.0, 3.0):
        x = vessel.start()
        x[vessel.layout.inner] = offset
        glass, air = vessel.solids(x)
        assert signed_distance(glass.mesh)(air.mesh.vertices).max() < 0.0
        assert volume(air.mesh.vertices, air.mesh.faces) > 0.0


def test_the_number_of_faces_does_not_depend_on_the_level(body):
    counts = {
        sum(len(part.faces) for part in vessel.pose(vessel.start()).parts)
        for level in (-1.0, -0.3, 0.4, 1.0)
        for vessel in [Vessel(body, dataclasses.replace(_FLASK, level=level), _TINY)]
    }
    assert len(counts) == 1


@pytest.mark.slow
@pytest.mark.parametrize("deviation", [0.0, 0.03])
def test_a_given_index_is_kept(body, surface, deviation):
    seen = vessels.photographs(Vessel(body, Interior("air", wall=0.15), _SMALL), surface)
    start = Interior("air", wall=0.15, glass=1.45, glass_deviation=deviation)
    vessel = Vessel(body, start, _SMALL)
    steps = gauss_newton.Steps((0, 0), 2048, 2048)
    fit = gauss_newton.fit(vessel, vessel.start(), surface, seen, settings=steps)
    assert (abs(vessel.interior(fit.x).glass - 1.45) < 1e-8) == (deviation == 0.0)
    assert np.all(np.isfinite(fit.covariance))


def test_levels_are_horizontal_where_they_should_be(body):
    vessel = Vessel(body, _FLASK, _TINY)
    _, liquid, air = vessel.solids(vessel.start())
    up, height = vessel.outer.axis.frame[:, 2], vessel.outer.axis.point[2]
    assert (liquid.mesh.vertices @ up).max() == pytest.approx(height - 0.2, abs=1e-6)
    assert (air.mesh.vertices @ up).min() == pytest.approx(height - 0.1, abs=1e-6)
    assert (liquid.name, liquid.index, liquid.tint) == ("liquid", 1.36, (0.5, 0.8, 0.95))


def test_a_liquid_never_adds_light(body):
    vessel = Vessel(body, _FLASK, _TINY)
    x = vessel.start()
    x[vessel.layout.absorption] = [-0.7, 0.0, 40.0]
    assert vessel.interior(x).absorption == (0.0, 0.0, 40.0)
    found = vessel.pose(x)
    np.testing.assert_array_equal(found.interfaces.absorption[1], [0.0, 0.0, 40.0])
    assert not np.any(found.interfaces.absorption[[0, 2]])
    # The derivative stays, so that a fit can leave zero again.
    by = found.by_absorptions.toarray()[:, vessel.layout.absorption]
    np.testing.assert_array_equal(by[3:6], np.eye(3))
    assert not np.any(by[[0, 1, 2, 6, 7, 8]])


def test_an_inset_of_a_cylinder_is_a_smaller_one():
    found = inset(Profile(revolved.even(revolved.cylinder(), 200), closed=False), 0.3, 2.0)
    assert found.points[:, 0].max() == pytest.approx(0.7, abs=2e-3)
    assert found.points[:, 1].max() == pytest.approx(0.7, abs=2e-3)
    assert np.all(np.diff(found.points[:, 1]) > -2e-3)
    assert inset(Profile(revolved.cylinder(), closed=False), 1.2, 2.0) is None


def test_an_inset_keeps_away_from_both_ends():
    profile = Profile(revolved.even(revolved.cylinder(), 200), closed=False)
    found = inset(profile, 0.2, 2.0, base=0.7, lid=0.4)
    assert found.points[:, 1].min() == pytest.approx(-0.3, abs=5e-3)
    assert found.points[:, 1].max() == pytest.approx(0.6, abs=5e-3)
    assert found.points[:, 0].max() == pytest.approx(0.8, abs=2e-3)
    assert inset(profile, 0.2, 2.0, base=1.2, lid=0.9) is None


def test_an_inset_follows_a_punt():
    profile = Profile(revolved.even(revolved.cylinder(), 400), closed=False)
    found = inset(with_punt(profile, 0.4), 0.1, 2.0).points
    assert found[0, 1] == pytest.approx(-0.5, abs=0.02)
    assert found[:, 1].min() < -0.8


def test_a_punt_is_a_hollow_under_the_bottom_alone():
    profile = Profile(revolved.even(revolved.cylinder(), 400), closed=False)
    found = with_punt(profile, 0.15).points
    assert found[0] == pytest.approx([0.0, -0.85])
    outer = found[:, 0] > 0.93
    np.testing.assert_array_equal(found[outer], profile.points[outer])
    assert found[:, 1].min() == -1.0  # it still stands on its rim
    np.testing.assert_array_equal(with_punt(profile, 0.0).points, profile.points)
    ball = np.stack([np.sin(np.linspace(0, np.pi, 99)), -np.cos(np.linspace(0, np.pi, 99))], -1)
    assert np.abs(with_punt(Profile(ball, closed=False), 0.1).points - ball).max() <= 0.1


def _beaker(flare=0.3):
    """A beaker whose lip flares out by as much as it is high."""
    corners = [(0.0, -1.0), (0.5, -1.0), (0.5, 0.7), (0.5 + flare, 0.7 + flare), (0.0, 0.7 + flare)]
    return Profile(revolved.even(np.array(corners), 600), closed=False)


def test_the_rim_of_an_open_vessel_continues_straight_up():
    found = with_open_top(_beaker(), 0.2).points
    above = found[found[:, 1] > 1.01]
    assert found[:, 1].max() == pytest.approx(1.2)
    np.testing.assert_allclose(above[:-1, 0], 0.8, atol=0.01)
    np.testing.assert_array_equal(found[-1], [0.0, found[:, 1].max()])
    below = found[found[:, 1] < 0.9]
    assert np.abs(np.interp(0.0, below[20:, 1], below[20:, 0]) - 0.5) < 1e-6


def test_the_inner_wall_of_an_open_vessel_follows_a_flared_lip():
    outer = Revolution(Axis(np.zeros(3), np.eye(3)), _beaker(), 2.0)
    vessel = Vessel(outer, Interior("air", mouth=True, wall=0.08))
    glass = vessel.solids(vessel.start())[0].mesh
    radius = np.linalg.norm(glass.vertices[:, :2], axis=-1)
    inside = (glass.vertices[:, 2] > 0.8) & (glass.vertices[:, 2] < 0.95)
    inner = radius[inside] < glass.vertices[inside, 2] - 0.24  # nearer to the axis than the middle
    thickness = glass.vertices[inside, 2] - 0.2 - radius[inside]
    assert inner.any()
    np.testing.assert_allclose(thickness[inner] / np.sqrt(2.0), 0.08, atol=0.025)


def test_a_vessel_without_an_upper_side_has_no_mouth():
    spindle = np.array([(0.0, -1.0), (0.3, 0.0), (0.0, 1.0)])
    profile = Profile(revolved.even(spindle, 600), closed=False)
    outer = Revolution(Axis(np.zeros(3), np.eye(3)), profile, 2.0)
    with pytest.raises(ReconstructionError, match="mouth=False"):
        Vessel(outer, Interior("air", mouth=True, wall=0.05))


def test_rings_are_no_part_of_what_an_inner_wall_follows():
    points = revolved.even(np.array([(0.0, -1.0), (0.5, -1.0), (0.5, 1.0), (0.0, 1.0)]), 600)
    raised = points.copy()
    for height in (-0.5, 0.0, 0.5):
        on = (points[:, 0] > 0.499) & (np.abs(points[:, 1] - height) < 0.04)
        raised[on, 0] += 0.03
    found = without_ridges(Profile(raised, closed=False), 2.0).points
    middle = np.abs(found[:, 1]) < 0.8
    np.testing.assert_allclose(found[middle, 0], 0.5, atol=0.006)


def test_what_can_not_be_a_vessel_is_refused(body):
    with pytest.raises(ReconstructionError, match="thinner"):
        Vessel(body, Interior("air", wall=1.0), _TINY)
    ring = Revolution(body.axis, Profile(revolved.ring(), closed=True), 2.0)
    with pytest.raises(ReconstructionError, match="ring"):
        Vessel(ring, Interior("air"), _TINY)


def test_hypotheses_begin_with_the_simplest(body):
    found = hypotheses(body, settings=SearchSettings(levels=3, thicknesses=(0.05, 0.1)))
    names = list(dict.fromkeys(each.name for each in found))
    assert names == ["none", "air", "liquid", "liquid and air"]
    assert [sum(each.name == name for each in found) for name in names] == [1, 2, 2, 6]
    counts = [len(Vessel(body, each, _TINY).start()) for each in found]
    assert counts == sorted(counts)


@pytest.fixture(scope="module")
def surface():
    return vessels.smooth_backdrop()


@pytest.fixture(scope="module")
def photographs(body, surface):
    """Pixels of the flask, without noise."""
    return vessels.photographs(Vessel(body, _FLASK, _SMALL), surface)


@pytest.mark.slow
def test_a_look_finds_the_tint_and_prefers_the_truth(body, surface, photographs):
    clear = dataclasses.replace(_FLASK, tint=(1.0, 1.0, 1.0))
    others = (dataclasses.replace(clear, level=0.3), Interior("liquid", wall=0.12))
    best, *worse = (look(body, at, surface, photographs, detail=_SMALL) for at in (clear, *others))
    assert best.interior.tint == pytest.approx(_FLASK.tint, abs=0.03)
    assert best.error < 0.01
    assert all(each.error > 2.0 * best.error for each in worse)


@pytest.mark.slow
def test_level_index_and_tint_are_recovered(body, surface, photographs):
    start = dataclasses.replace(_FLASK, level=-0.18, gap=0.09, liquid=1.35, tint=(0.55, 0.8, 0.92))
    vessel = Vessel(body, start, _SMALL)
    layout = vessel.layout
    few = Few(vessel, vessel.start(), np.eye(layout.count)[:, layout.inner.stop :])
    steps = gauss_newton.Steps((2, 1, *[0] * 6), 4096, 4096)
    fit = gauss_newton.fit(few, few.start(), surface, photographs, settings=steps)
    found = vessel.interior(few.whole(fit.x))
    assert found.level == pytest.approx(_FLASK.level, abs=0.01)
    assert found.gap == pytest.approx(_FLASK.gap, abs=0.01)
    assert found.liquid == pytest.approx(1.36, abs=0.003)
    assert found.glass == pytest.approx(1.5, abs=0.003)
    assert found.tint == pytest.approx(_FLASK.tint, abs=0.02)


@pytest.mark.slow
def test_an_absorbing_liquid_is_told_from_a_tinted_surface(body, surface):
    wine = dataclasses.replace(_FLASK, tint=(1.0, 1.0, 1.0), absorption=(0.1, 1.2, 0.8))
    seen = vessels.photographs(Vessel(body, wine, _SMALL), surface)
    vessel = Vessel(body, dataclasses.replace(_FLASK, tint=(0.9, 0.5, 0.6)), _SMALL)
    layout = vessel.layout
    few = Few(vessel, vessel.start(), np.eye(layout.count)[:, layout.tint.start :])
    steps = gauss_newton.Steps((1, *[0] * 6), 4096, 4096)
    fit = gauss_newton.fit(few, few.start(), surface, seen, settings=steps)
    found = vessel.interior(few.whole(fit.x))
    assert found.absorption == pytest.approx(wine.absorption, abs=0.05)
    assert found.tint == pytest.approx(wine.tint, abs=0.04)
    solids = vessel.solids(few.whole(fit.x))
    assert [each.absorption for each in solids] == [(0.0,) * 3, found.absorption, (0.0,) * 3]


@pytest.mark.slow
def test_the_simplest_of_equally_good_findings_is_kept(body, surface, photographs):
    def finding(interior):
        vessel = Vessel(body, interior, _SMALL)
        x = vessel.start()
        return _finding(vessel, gauss_newton.Fit(x, np.eye(len(x)), ()), surface, photographs)

    simple, stained = finding(_FLASK), finding(dataclasses.replace(_FLASK, stained=True))
    wrong = finding(Interior("liquid", wall=0.12))
    assert _simplest([wrong, simple, stained]) is simple


def test_the_best_finding_is_fitted_once_more_from_other_levels(body):
    vessel = Vessel(body, dataclasses.replace(_FLASK, wall=0.1), _TINY)
    x = vessel.start()
    x[vessel.layout.level] += 0.03
    x[vessel.layout.inner] -= 0.02
    trial = types.SimpleNamespace(fit=gauss_newton.Fit(x, np.eye(len(x)), ()), error=0.1)
    finding = Finding(vessel, trial)
    found = _with_other_levels(finding, SearchSettings(level_shifts=(0.04, -0.04, 0.0)))
    levels = [each.interior_at_start.level - _FLASK.level for each in found]
    np.testing.assert_allclose(levels, 0.03 + 2.6 * np.array([0.04, -0.04, 0.0]), atol=0.01)
    walls = [each.interior_at_start.wall for each in found]
    np.testing.assert_allclose(walls, 0.12)
    assert {each.detail for each in found} == {_TINY}
    solid = Vessel(body, Interior("liquid", wall=0.1), _TINY)
    fit = gauss_newton.Fit(solid.start(), np.eye(solid.layout.count), ())
    other = Finding(solid, types.SimpleNamespace(fit=fit, error=0.05))
    assert _with_other_levels(other, SearchSettings()) == []
    assert _better(finding, other) is other  # of another kind
    worse = Finding(vessel, types.SimpleNamespace(fit=finding.trial.fit, error=0.2))
    assert _better(worse, finding) is _better(finding, worse) is finding


def test_only_findings_near_the_best_one_take_further_steps(body):
    vessel, said, shares = Vessel(body, _FLASK, _TINY), [], []

    def say(share, text):
        shares.append(share)
        said.append(text)

    def finding(error):
        x = vessel.start()
        fit = gauss_newton.Fit(x, np.eye(len(x)), ())
        return Finding(vessel, types.SimpleNamespace(fit=fit, error=error))

    def fitted(settings, its_vessel, x, blurs):
        assert its_vessel is vessel and len(x) == vessel.layout.count and blurs == (1, 0)
        return finding(0.05)

    findings = [finding(0.3), finding(0.1), finding(0.104)]
    settings = SearchSettings(last=(1, 0), close=1.05)
    found = _with_further_steps(findings, fitted, settings, say)
    assert [each.error for each in found] == [0.3, 0.05, 0.05] and found[0] is findings[0]
    assert said == ["liquid and air: further steps, error 0.0500"] * 2
    np.testing.assert_allclose(shares, [0.8, 0.85])
    none = SearchSettings(last=())
    assert _with_further_steps(findings, fitted, none, say) == findings


def test_the_better_of_two_mouths_is_looked_at_again_with_both(body):
    def finding(interior, error):
        vessel = Vessel(body, interior, _TINY)
        x = vessel.start()
        fit = gauss_newton.Fit(x, np.eye(len(x)), ())
        return Finding(vessel, types.SimpleNamespace(fit=fit, error=error))

    closed = finding(_FLASK, 0.2)
    opened = finding(dataclasses.replace(_FLASK, level=-0.3, mouth=True), 0.1)
    full = finding(Interior("liquid", wall=0.12), 0.3)
    found = _with_each_mouth([closed, opened, full], SearchSettings())
    assert [each.name for each in found] == ["liquid and air", "liquid and air, open", "liquid"]
    np.testing.assert_allclose([each.level for each in found[:2]], -0.3, atol=1e-9)
    (only,) = _with_each_mouth([closed], SearchSettings(mouths=(False,)))
    assert (only.mouth, only.level) == (False, _FLASK.level)
    (only,) = _with_each_mouth([closed, opened], SearchSettings(mouths=()))
    assert only.mouth


def test_the_best_tint_of_each_channel_is_found():
    generator = np.random.default_rng(0)
    linear = generator.uniform(0.2, 0.9, (60, 3))
    crossings = generator.uniform(0.0, 4.0, (60, 3))
    log_tint = interior_looks._LOG_TINTS[[3, 20, 70]]
    rgb = photometry.encode(linear * np.exp(log_tint * crossings))
    np.testing.assert_array_equal(interior_looks._best_tint(linear, crossings, rgb), log_tint)
    # Pixels that something else explains have no say beyond the cap.
    rgb[:10] = 1.0
    np.testing.assert_array_equal(interior_looks._best_tint(linear, crossings, rgb), log_tint)


@pytest.mark.slow
def test_levels_are_looked_at_again_with_both_mouths(body, surface, photographs, monkeypatch):
    levels_and_gaps = interior_search._VARIANTS[:2]
    monkeypatch.setattr(interior_search, "_VARIANTS", levels_and_gaps)
    monkeypatch.setattr(interior_search, "_SHIFTS", (0.05, -0.05, -0.08))
    monkeypatch.setattr(interior_search, "_GAPS", (0.008, 0.04))
    off = dataclasses.replace(_FLASK, level=_FLASK.level + 0.16, gap=0.02)
    vessel = Vessel(body, off, _SMALL)
    x = vessel.start()
    fit = gauss_newton.Fit(x, np.eye(len(x)), ())
    far = _finding(vessel, fit, surface, photographs)
    settings = SearchSettings(pixels=600)
    closed, opened = _looked_again(body, [far], surface, photographs, settings)
    assert (closed.mouth, opened.mouth) == (False, True)
    assert closed.level == pytest.approx(_FLASK.level, abs=0.05)
    assert abs(closed.gap - _FLASK.gap) < abs(off.gap - _FLASK.gap)
    never = dataclasses.replace(settings, mouths=(False,))
    monkeypatch.setattr(interior_search, "_VARIANTS", levels_and_gaps[:1])
    (closed,) = _looked_again(body, [far], surface, photographs, never)
    assert not closed.mouth


@pytest.mark.slow
def test_bases_lids_and_punts_are_looked_at(body, surface):
    truth = Interior("air", wall=0.08, base=0.72, lid=0.3, punt=0.08)
    seen = vessels.photographs(Vessel(body, truth, _SMALL), surface, reach=1.4)
    vessel = Vessel(body, Interior("air", wall=0.08), _SMALL)
    fit = gauss_newton.Fit(vessel.start(), np.eye(vessel.layout.count), ())
    plain = _finding(vessel, fit, surface, seen)
    settings = SearchSettings(pixels=1200, mouths=(False,))
    (found,) = _looked_again(body, [plain], surface, seen, settings)
    assert found.base == pytest.approx(truth.base, abs=0.12)
    assert found.lid == pytest.approx(truth.lid, abs=0.12)
    assert found.punt == pytest.approx(truth.punt, abs=0.045)


@pytest.mark.slow
def test_looks_leave_out_walls_that_fill_the_vessel(body, surface, photographs):
    settings = SearchSettings((0.05, 0.4), 1, (0.04,), (1.36,), mouths=(False,))
    found = interior_looks.looks_at_all(body, surface, photographs, settings)
    assert [each.error for each in found] == sorted(each.error for each in found)
    assert all(each.interior.wall == pytest.approx(0.13, abs=0.01) for each in found)


@pytest.mark.slow
@pytest.mark.parametrize("tint", [(1.0, 1.0, 1.0), (0.9, 0.97, 0.8)])
def test_stained_glass_is_looked_at_where_it_pays(body, surface, tint):
    truth = Interior("air", wall=0.13, stained=True, glass_tint=tint)
    seen = vessels.photographs(Vessel(body, truth, _SMALL), surface)
    settings = SearchSettings((0.05,), 1, (0.04,), (1.36,), mouths=(False,), blur=1, pixels=800)
    looks = interior_looks.looks_at_all(body, surface, seen, settings)
    best = looks[0].interior
    assert (best.contents, best.stained) == ("air", tint != (1.0, 1.0, 1.0))
    assert best.glass_tint == pytest.approx(tint, abs=0.02)
    assert any(each.interior.stained for each in looks) == best.stained


@pytest.mark.slow
def test_looks_tell_coloured_solid_glass_from_a_vessel(body, surface):
    solid = Interior("none", stained=True, glass_tint=(0.7, 0.9, 0.8))
    seen = vessels.photographs(Vessel(body, solid, _SMALL), surface)
    settings = SearchSettings((0.05,), 1, (0.04,), (1.36,), mouths=(False,), blur=1, pixels=800)
    looks = interior_looks.looks_at_all(body, surface, seen, settings)
    assert looks[0].interior.contents == "none"


@pytest.mark.slow
def test_the_finest_steps_find_a_ridge_and_are_reported(body, surface, monkeypatch):
    monkeypatch.setattr(interior_search, "_VARIANTS", ())
    fine, detail = body.with_knots(80), Detail(outer=48, ridges=60, inner=64, azimuths=48)
    truth = Vessel(fine, _FLASK, detail)
    raised = truth.start()
    raised[truth.layout.outer][38:42] += 0.01
    monkeypatch.setattr(truth, "start", lambda: raised)
    seen, told = vessels.photographs(truth, surface, reach=1.4), []
    settings = SearchSettings(
        few=(1,), all=(0,), last=(), finest=(0, 0, 0), rays=2000, last_rays=2000, mouths=(False,)
    )
    options = {"detail": detail, "looks": [Look(_FLASK, 0.1)]}
    found = interior_search.search(
        fine,
        surface,
        seen,
        seen,
        settings=settings,
        progress=lambda share, text: told.append(share),
        **options,
    )
    settings = dataclasses.replace(settings, finest=())
    plain = interior_search.search(fine, surface, seen, seen, settings=settings, **options)
    assert len(found.best.x) == len(plain.best.x) + 80 - 36
    assert found.best.error < 0.7 * plain.best.error
    assert found.findings == [found.best]
    assert told == sorted(told)
    assert told[-1] == 1.0
