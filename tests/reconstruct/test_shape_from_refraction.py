"""Shape and index from refracted light: before a known backdrop, against closed forms of a ball."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import trimesh

from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.triangle_meshes import make_mesh, unit_vectors
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import (
    ReconstructionError,
    families,
    gauss_newton,
    photometry,
    shape_from_refraction,
)
from refref_jax.reconstruct.families import Sphere
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Steps
from refref_jax.reconstruct.model_selection import (
    Trial,
    choose,
    compare,
    index_deviation,
    normal_deviations,
)
from refref_jax.reconstruct.photometry import Photographs, make_backdrop
from refref_jax.reconstruct.refractive_index import IndexSearch
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, FreeSurface, Posed, mesh_of
from refref_jax.render import backdrop
from refref_jax.sampling.scene_bounds import Domain
from tests.factories import bodies

pytestmark = pytest.mark.longest

_SIDE = 64
_INDEX = 1.5
_ORIGIN = np.zeros(3)
_CENTRE = (0.1, -0.2, 0.15)


def _pyramid(seed=0):
    """Radiance of waves a few tenths of a face long, without seams, between 0.04 and 0.76."""
    random = np.random.default_rng(seed)
    row, column = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, _SIDE + 1)], indexing="ij")
    points = np.empty((6, _SIDE + 1, _SIDE + 1, 3))
    for face, grid in enumerate(points):
        axis, positive = divmod(face, 2)
        grid[..., axis] = 2.0 * positive - 1.0
        grid[..., (axis + 1) % 3], grid[..., (axis + 2) % 3] = column, row
    waves = [points @ random.normal(size=(3, 3), scale=4.0) for _ in range(6)]
    phases = random.uniform(0.0, 2.0 * np.pi, size=6)
    fine = 0.4 + 0.06 * sum(np.sin(wave + phase) for wave, phase in zip(waves, phases, strict=True))
    coarse = [np.zeros((6, side + 1, side + 1, 3)) for side in backdrop.sides(_SIDE)[:-1]]
    return tuple(jnp.asarray(level, jnp.float32) for level in (*coarse, fine))


def _world(space="bounded", pyramid=None):
    pyramid = _pyramid() if pyramid is None else pyramid
    seen = np.full((6, _SIDE + 1, _SIDE + 1), 9.0, np.float32)
    return make_backdrop(Domain(3.0, space, _CENTRE), pyramid, seen)


@pytest.fixture(scope="module")
def world():
    return _world()


def _look_up(surface, origins, directions):
    """The radiance of a backdrop by code of its own: NumPy, bilinear, no footprints."""
    space, radius, centre = surface.domain.space, surface.domain.radius, surface.domain.centre
    at = origins - np.array(centre)
    if space == "bounded":
        away = np.min((radius * np.sign(directions) - at) / directions, axis=-1, keepdims=True)
        towards = at + away * directions
    elif space == "spherical":
        along = np.sum(at * directions, axis=-1, keepdims=True)
        beyond = np.sum(at**2, axis=-1, keepdims=True) - radius**2
        towards = at + (np.sqrt(along**2 - beyond) - along) * directions
    else:
        towards = directions
    rows = np.arange(len(towards))
    axis = np.argmax(np.abs(towards), axis=-1)
    major = towards[rows, axis]
    place = np.stack([towards[rows, (axis + n) % 3] / np.abs(major) for n in (1, 2)], axis=-1)
    place = place if space == "bounded" else 4.0 / np.pi * np.arctan(place)
    grid = np.asarray(surface.mips[0], np.float64)[2 * axis + (major > 0.0)]
    column, row = np.clip(0.5 * _SIDE * (place + 1.0), 0.0, _SIDE).T
    left, low = (np.minimum(x.astype(int), _SIDE - 1) for x in (column, row))
    right, up = (column - left)[:, None], (row - low)[:, None]
    corner = lambda i, j: grid[rows, low + i, left + j]
    below = (1.0 - right) * corner(0, 0) + right * corner(0, 1)
    above = (1.0 - right) * corner(1, 0) + right * corner(1, 1)
    return (1.0 - up) * below + up * above


def _bend(directions, normals, ratio):
    cosine = -np.sum(directions * normals, axis=-1, keepdims=True)
    root = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
    return ratio * directions + (ratio * cosine - root) * normals


def _see_ball(surface, rays, *, radius=1.0, index=_INDEX):
    """The linear RGB of rays that meet a ball of glass, in closed form."""
    origins, directions = (np.asarray(x, np.float64) for x in rays[:2])
    along = -np.sum(origins * directions, axis=-1, keepdims=True)
    chord = np.sqrt(along**2 - np.sum(origins**2, axis=-1, keepdims=True) + radius**2)
    points = origins + (along - chord) * directions
    normals = points / radius
    cosine = -np.sum(directions * normals, axis=-1, keepdims=True)
    inner = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    senkrecht = ((cosine - index * inner) / (cosine + index * inner)) ** 2
    parallel = ((index * cosine - inner) / (index * cosine + inner)) ** 2
    share = 0.5 * (senkrecht + parallel)
    light = share * _look_up(surface, points, directions + 2.0 * cosine * normals)
    inside, weight = _bend(directions, normals, 1.0 / index), 1.0 - share
    for _ in range(12):
        points = points + 2.0 * radius * inner * inside
        normals = points / radius
        light += weight * (1.0 - share) * _look_up(surface, points, _bend(inside, -normals, index))
        inside = inside - 2.0 * inner * normals
        weight = weight * share
    return light


def _rays(views, *, reach=0.93, size=40, radius=1.0):
    """Rays of cameras that meet a ball around the origin, but not its rim, and their views.

    They are so thin that a footprint is a point, as in the closed form.
    """
    cameras = bodies.cameras_around(views, size=size, distance=2.3)
    every = [image_rays(cameras, view) for view in range(views)]
    rays = Rays(
        *(
            np.concatenate([x.reshape(-1, *x.shape[2:]) for x in field])
            for field in zip(*(ray[:3] for ray in every), strict=True)
        )
    )
    origins, directions = np.asarray(rays.origins), np.asarray(rays.directions)
    impact = np.linalg.norm(np.cross(origins, directions), axis=-1)
    near = np.flatnonzero(impact < reach * radius)
    return Rays(*(x[near] for x in rays[:2]), 1e-2 * rays.radii[near]), near // size**2


def _photographs(surface, views, **ball):
    rays, view = _rays(views)
    return Photographs(rays, photometry.encode(_see_ball(surface, rays, **ball)), view)


@pytest.fixture(scope="module")
def seen(world):
    return _photographs(world, 10)


@pytest.fixture(scope="module")
def judges(world):
    return _photographs(world, 7)


@pytest.fixture(scope="module")
def ball():
    """A fine icosphere, whose vertices lie on the ball."""
    return Sphere(_ORIGIN, 1.0)


@pytest.fixture(scope="module")
def glass(ball):
    return SingleObject(ball, _INDEX)


def _ball_mesh(ball):
    return mesh_of(ball.pose(ball.start()))


@pytest.mark.parametrize(
    "space",
    [
        "bounded",
        pytest.param("spherical", marks=pytest.mark.slow),
        pytest.param("unbounded", marks=pytest.mark.slow),
    ],
)
def test_predictions_are_those_of_a_ball_in_closed_form(glass, space):
    surface = _world(space)
    rays, _ = _rays(4)
    found = photometry.predict(gauss_newton.traced_object(glass.pose(glass.start())), surface, rays)
    away = np.abs(found.linear - _see_ball(surface, rays)).max(axis=-1)
    assert np.median(away) < 0.003 and np.quantile(away, 0.97) < 0.02
    np.testing.assert_allclose(found.dropped, 0.0, atol=1e-6)


def test_a_blur_averages_and_keeps_the_mean(world):
    sharp, soft = (np.asarray(photometry.blurred(world, n).mips[0]) for n in (0, 3))
    assert soft.shape == sharp.shape and soft.std() < 0.9 * sharp.std()
    np.testing.assert_allclose(soft.mean(), sharp.mean(), rtol=0.02)
    assert photometry.blurred(world, 0) is world
    # More than there are levels is the coarsest.
    most = photometry.blurred(world, 99).mips[0]
    np.testing.assert_array_equal(most, photometry.blurred(world, len(world.mips) - 1).mips[0])


# How a ball changes with one unknown, `t`: smooth displacements, turns of the normals, the index,
# a tint that is not grey.
_SHARES = np.array([1.0, -0.5, 0.3])


def _bumps(normals):
    return np.sin(3.0 * normals[:, 0] + 1.0) * np.cos(2.0 * normals[:, 1]) + normals[:, 2] ** 2


def _sideways(normals):
    along = np.stack([np.sin(2.0 * normals[:, 1]), np.cos(3.0 * normals[:, 2]), normals[:, 0]], -1)
    return along - np.sum(along * normals, axis=-1, keepdims=True) * normals


def _changed(ball, kind, t):
    posed = ball.pose(ball.start())
    normals, nothing = posed.normals, np.zeros((3 * len(posed.normals), 1))
    vertices, index, tint = posed.vertices, _INDEX, np.ones(3)
    by_vertices, by_normals = nothing, nothing
    by_index, by_tint, by_absorption = np.zeros((1, 1)), np.zeros((3, 1)), np.zeros((3, 1))
    absorption = np.zeros(3)
    if kind == "vertices":
        shift = _bumps(normals)[:, None] * normals
        vertices, by_vertices = vertices + t * shift, shift.reshape(-1, 1)
    elif kind == "normals":
        by_normals = _sideways(posed.normals).reshape(-1, 1)
        normals = unit_vectors(normals + t * _sideways(normals))
    elif kind == "index":
        index, by_index = index + t, np.ones((1, 1))
    elif kind == "tint":
        tint, by_tint = np.exp(t * _SHARES), _SHARES[:, None]
    else:
        absorption, by_absorption = (0.3 + t) * _SHARES, _SHARES[:, None]
    part = Posed(
        vertices,
        posed.faces,
        normals,
        posed.normal_ids,
        *map(scipy.sparse.csr_array, (by_vertices, by_normals)),
    )
    interfaces = nested(
        [index], [NO_PARENT], tints=[tint.tolist()], absorptions=[absorption.tolist()]
    )
    changes = (by_index, by_tint, by_absorption)
    return Candidate((part,), interfaces, *map(scipy.sparse.csr_array, changes))


def _slopes_of(candidate, surface, rays):
    """The derivatives of the pixels' linear RGB, and where they are to be used."""
    body = gauss_newton.traced_object(candidate)
    predicted = photometry.predict(body, surface, rays)
    found = photometry.sensitivities(body, surface, rays, predicted)
    coordinates = gauss_newton._by_unknowns(candidate, body, found)
    slopes = gauss_newton._block_diagonal(np.swapaxes(found.slopes, 1, 2)) @ coordinates
    by_channels = functools.partial(gauss_newton._by_channels, found.light)
    slopes = slopes.toarray() + by_channels(found.crossings) @ candidate.by_tints
    slopes = slopes - by_channels(found.lengths) @ candidate.by_absorptions
    return np.asarray(slopes).reshape(-1, 3), found


@pytest.mark.parametrize(
    ("kind", "step", "off"),
    [
        ("vertices", 2e-3, 0.05),
        ("normals", 2e-3, 0.05),
        ("index", 2e-3, 0.05),
        # The main path alone is differentiated by a tint; a tenth of the light takes other ways.
        ("tint", 1e-2, 0.12),
        ("absorption", 1e-2, 0.12),
    ],
)
def test_sensitivities_are_central_differences_of_predictions(world, ball, kind, step, off):
    rays, _ = _rays(4, reach=0.85)
    slopes, found = _slopes_of(_changed(ball, kind, 0.0), world, rays)
    assert found.usable.mean() > 0.99 and np.all(found.crossings[found.usable] == 2)
    np.testing.assert_allclose(found.coverage, 9.0, rtol=1e-5)
    there, here = (
        photometry.predict(gauss_newton.traced_object(_changed(ball, kind, t)), world, rays).linear
        for t in (step, -step)
    )
    expected = (there - here)[found.usable].ravel() / (2.0 * step)
    slopes = slopes[found.usable].ravel()
    assert np.corrcoef(slopes, expected)[0, 1] > 0.95
    assert slopes @ expected / (slopes @ slopes) == pytest.approx(1.0, abs=off)


def test_a_sample_of_the_unknowns_tells_how_much_errors_of_a_view_are_alike(monkeypatch):
    count, random = 60, np.random.default_rng(0)
    by_view, rows = 8.0 * random.normal(size=(30, count)), random.normal(size=(200, count))
    pixels = rows.T @ rows
    light = gauss_newton.Equations(pixels, by_view.sum(axis=0), by_view, pixels)
    prior = np.eye(count)
    all_of_them = gauss_newton._covariance(light, prior)
    monkeypatch.setattr(gauss_newton, "_MANY", 7)
    some = gauss_newton._covariance(light, prior)
    np.testing.assert_allclose(some, all_of_them, rtol=0.3)
    assert np.all(np.diag(some) > 2.0 * np.diag(np.linalg.inv(pixels + prior)))


@pytest.mark.slow
@pytest.mark.parametrize("absorption", [0.0, 0.5, 1e6])
def test_lengths_of_main_paths_are_chords_and_finite_in_the_dark(world, ball, absorption):
    part = ball.pose(ball.start())
    interfaces = nested([_INDEX], [NO_PARENT], absorptions=[[absorption] * 3])
    nothing = [scipy.sparse.csr_array((n, 1)) for n in (1, 3, 3)]
    body = gauss_newton.traced_object(Candidate((part,), interfaces, *nothing))
    rays, _ = _rays(2, reach=0.85)
    found = photometry.sensitivities(body, world, rays, photometry.predict(body, world, rays))
    assert all(np.all(np.isfinite(each)) for each in found)
    away = np.linalg.norm(np.cross(rays.origins, rays.directions), axis=-1)
    chords = 2.0 * np.sqrt(1.0 - (away / _INDEX) ** 2)
    if absorption < 1e3:
        np.testing.assert_allclose(found.lengths[:, 0], chords, rtol=3e-3)


@pytest.mark.slow
def test_handles_of_a_free_surface_have_the_slopes_of_predictions(world, ball):
    model = SingleObject(FreeSurface(_ball_mesh(ball), 0.25), _INDEX)
    rays, _ = _rays(4, reach=0.85)
    random = np.random.default_rng(5).normal(size=len(model.start()))
    random[-1] = 0.0
    candidate = model.pose(model.start())
    body = gauss_newton.traced_object(candidate)
    found = photometry.sensitivities(body, world, rays, photometry.predict(body, world, rays))
    coordinates = gauss_newton._by_unknowns(candidate, body, found) @ random
    slopes = np.einsum("rkc,rk->rc", found.slopes, coordinates.reshape(-1, 3))[found.usable]
    step = 5e-4
    there, here = (
        photometry.predict(
            gauss_newton.traced_object(model.pose(model.start() + t * random)), world, rays
        ).linear[found.usable]
        for t in (step, -step)
    )
    expected = (there - here) / (2.0 * step)
    assert np.corrcoef(slopes.ravel(), expected.ravel())[0, 1] > 0.95
    assert np.sum(slopes * expected) / np.sum(slopes**2) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("true", [1.5, 1.62])
def test_the_index_is_found_from_a_wrong_start(world, ball, true):
    search = IndexSearch(1.3, 1.8, spacing=0.1, descents=1)
    told = []
    found = shape_from_refraction.find_index(
        _ball_mesh(ball),
        world,
        _photographs(world, 10, index=true),
        search=search,
        start=1.41,
        progress=lambda done, total: told.append((done, total)),
    )
    assert found.index == pytest.approx(true, abs=2e-3)
    assert 0.0 < found.deviation < 2e-3
    assert [way.indices[0] for way in found.descents].count(1.41) == 1
    assert found.error == min(way.errors[-1] for way in found.descents)
    most = shape_from_refraction.most_looks_at_backdrop(search, start=1.41)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1] == (most, most)


@pytest.mark.slow
def test_a_ball_that_is_a_little_off_returns(world):
    off = Sphere(np.array([0.01, -0.006, 0.008]), 1.01)
    model = SingleObject(off, 1.48)
    steps = []
    found = gauss_newton.fit(
        model,
        model.start(),
        world,
        _photographs(world, 4),
        settings=Steps(blurs=(1, 0, 0, 0, 0)),
        progress=lambda number, facts: steps.append((number, facts)),
    )
    np.testing.assert_allclose(found.x[:3], 0.0, atol=1e-3)
    assert found.x[3] == pytest.approx(1.0, abs=1e-3)
    assert model.index_of(found.x) == pytest.approx(_INDEX, abs=2e-3)
    assert [number for number, _ in steps] == list(range(1, len(found.steps) + 1))
    assert found.taken >= 2 and tuple(facts for _, facts in steps) == found.steps
    assert all(facts.after < facts.before for facts in found.steps if facts.taken)
    # The deviations are of the size of the errors that are left.
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0.0)
    assert np.all(np.sqrt(np.diag(found.covariance)) < 2e-3)


@pytest.mark.slow
def test_fewer_pixels_know_less(world, glass, seen):
    some = np.random.default_rng(1).permutation(len(seen.views))[:400]
    few, many = (
        gauss_newton.fit(glass, glass.start(), world, pixels, settings=Steps(blurs=(0,)))
        for pixels in (seen.chosen(some), seen)
    )
    assert np.all(np.diag(many.covariance) > 0.0)
    assert np.all(np.diag(few.covariance) > 2.0 * np.diag(many.covariance))
    # Nothing is known worse than before light was seen.
    prior, _ = glass.prior(glass.start())
    assert np.all(np.diag(many.covariance) < 1.0 / np.diag(prior))


def _dented(ball):
    """The ball with a dent of 3 degrees within its outlines, in the directions of both poles."""
    posed = ball.pose(ball.start())
    depth = sum(
        0.02 * np.exp(-((np.arccos(np.clip(posed.normals @ towards, -1.0, 1.0)) / 0.35) ** 2))
        for towards in (np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0]))
    )
    return make_mesh(posed.vertices - depth[:, None] * posed.normals, posed.faces)


def _turned(mesh):
    """The angle between the normals of a mesh and those of a ball, in degrees: rms."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    cosine = np.sum(unit_vectors(corners) * mesh.normals.reshape(-1, 3), axis=-1)
    return np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2)))


@pytest.mark.slow
def test_a_free_surface_loses_a_dent_that_no_outline_shows(world, ball, seen, judges):
    mesh = _dented(ball)
    model = SingleObject(FreeSurface(mesh, 0.16), _INDEX)
    found = gauss_newton.fit(
        model, model.start(), world, seen, settings=Steps(blurs=(1, 0, 0, 0, 0))
    )
    before, after = _turned(mesh), _turned(model.mesh(found.x))
    assert before > 0.5 and after < 0.4 * before
    errors = [
        gauss_newton.errors_of(gauss_newton.traced_object(model.pose(x)), world, judges).mean()
        for x in (model.start(), found.x)
    ]
    assert errors[1] < 0.5 * errors[0]
    trial = Trial("free surface", model, found, np.array(errors))
    deviations = normal_deviations(trial)
    assert np.all(np.isfinite(deviations)) and 0.0 < np.median(deviations) < 1.0


@pytest.mark.slow
def test_a_wide_scale_weighs_a_fault_that_few_pixels_see(world, glass, seen):
    few = np.zeros(len(seen.views), bool)
    few[::20] = True
    other = _see_ball(world, seen.rays, index=_INDEX + 0.08)
    rgb = np.where(few[:, None], photometry.encode(other), seen.rgb)
    candidate = glass.pose(glass.start())
    body = gauss_newton.traced_object(candidate)
    narrow, wide = (
        gauss_newton.linearise(
            candidate, body, world, seen._replace(rgb=rgb), Steps(), least_scale=scale
        )
        for scale in (0.0, 0.5)
    )
    steps = [-each.gradient[-1] / each.matrix[-1, -1] for each in (narrow, wide)]
    assert 0.0 < 3.0 * steps[0] < steps[1] < 0.02


@pytest.mark.slow
def test_a_fit_ends_after_two_steps_that_gain_little(world, glass, seen):
    settings = Steps(blurs=(1, 0, 0, 0, 0), rays=2048, judges=1024, gain=0.9, least=0.0)
    assert len(gauss_newton.fit(glass, glass.start(), world, seen, settings=settings).steps) == 3


@pytest.mark.slow
@pytest.mark.parametrize("limit, steps", [(1.0, 5), (1e-6, 3)])
def test_a_fit_is_given_up_where_it_falls_behind_after_two_steps(world, glass, seen, limit, steps):
    settings = Steps((1, 0, 0, 0, 0), 2048, 1024, least=0.0, limits=(limit,) * 5)
    fit = gauss_newton.fit(glass, glass.start(), world, seen, settings=settings)
    assert len(fit.steps) == steps


class _Line:
    """A body that does not change with its unknown, whose steps are 1 long, and at most 10."""

    def __init__(self, body):
        self.body, self.at = body, 0.0

    def start(self):
        return np.zeros(1)

    def pose(self, x):
        self.at = x[0]
        return self.body

    def prior(self, x):
        return np.ones((1, 1)), -np.ones(1)

    def scales(self):
        return np.full(1, 10.0)


@pytest.mark.parametrize("gain, reached", [(0.1, 8.0), (0.006, 8.0), (0.004, 1.0)])
def test_a_step_is_doubled_where_it_explains_half_a_percent(
    world, glass, seen, monkeypatch, gain, reached
):
    line, none, square = _Line(glass.pose(glass.start())), np.zeros(1), np.zeros((1, 1))
    nothing = gauss_newton.Equations(square, none, by_view=square, of_pixels=square)
    monkeypatch.setattr(gauss_newton, "linearise", lambda *_, **__: nothing)
    monkeypatch.setattr(gauss_newton, "errors_of", lambda *_: np.exp([-gain * line.at]))
    fit = gauss_newton.fit(line, line.start(), world, seen, settings=Steps(blurs=(0,)))
    assert fit.x == pytest.approx(reached, rel=2e-3)  # the damping is 1e-3


def test_scenes_of_few_parts_have_the_same_shapes_on_the_device(ball):
    part = ball.pose(ball.start())
    shapes = {}
    for count in (1, 2, 4, 5, 16):
        indices, parents = [_INDEX] + [1.0] * (count - 1), [NO_PARENT] + [0] * (count - 1)
        body = gauss_newton.traced_object(
            Candidate((part,) * count, nested(indices, parents), *2 * [np.zeros((count, 1))])
        )
        assert body.parts == count
        kept = np.asarray(body.scene.interfaces.index_inside)[:count]
        np.testing.assert_allclose(kept, indices)
        other = body.with_interfaces(nested(indices, parents))
        shapes[count] = jax.tree.map(np.shape, other.scene.interfaces)
        assert shapes[count] == jax.tree.map(np.shape, body.scene.interfaces)
    assert shapes[1] == shapes[2] == shapes[4] != shapes[5] == shapes[16]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3])
def test_derivatives_of_few_rays_are_rows_of_those_of_many(world, glass, seen, count):
    candidate = glass.pose(glass.start())
    body = gauss_newton.traced_object(candidate)
    predicted = photometry.predict(body, world, seen.rays)
    many = photometry.sensitivities(body, world, seen.rays, predicted)
    few = jax.tree.map(lambda x: x[:count], many)
    assert many.by_indices.shape[-1] == many.crossings.shape[-1] == many.lengths.shape[-1] == 1
    rows = [np.asarray(_dense(gauss_newton._by_unknowns(candidate, body, x))) for x in (few, many)]
    np.testing.assert_array_equal(rows[0], rows[1][: 3 * count])


def _dense(matrix):
    return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix


@pytest.mark.slow
@pytest.mark.parametrize("gain, fits", [(0.02, 2), (0.005, 1)])
def test_a_free_surface_that_gains_nothing_on_a_family_ends(
    world, ball, seen, judges, monkeypatch, gain, fits
):
    """If no step of the first group gains 1 %, the second group is left out."""
    steps = tuple(
        gauss_newton.StepFacts(0, 0.04, (1.0 - each) * 0.04, 1.0, each > 0.0, 0.1)
        for each in (-0.03, gain)
    )
    count = []

    def fit(model, x, *_, **__):
        count.append(len(x))
        return gauss_newton.Fit(x, np.eye(len(x)), steps)

    monkeypatch.setattr(gauss_newton, "fit", fit)
    from_family = shape_from_refraction.FreeSurfaceSettings((0.0, 0.0), (10, 3), (0.3, 0.0))
    shape_from_refraction.fit_free_surface(
        _ball_mesh(ball), _INDEX, world, seen, judges, settings=from_family
    )
    assert len(count) == fits and count[0] > 500


@pytest.mark.slow
def test_a_free_surface_that_explains_all_of_a_black_world_ends(ball, seen, judges, monkeypatch):
    monkeypatch.setattr(
        shape_from_refraction, "FreeSurface", functools.partial(FreeSurface, spacing=0.5)
    )
    black = _world(pyramid=backdrop.init(_SIDE, radiance=0.0))
    dark, others = (each._replace(rgb=np.zeros_like(each.rgb)) for each in (seen, judges))
    settings = shape_from_refraction.FreeSurfaceSettings((0.0,), (2,), (0.0,))
    trial = shape_from_refraction.fit_free_surface(
        _ball_mesh(ball), _INDEX, black, dark, others, settings=settings
    )
    assert trial.error == 0.0


def _one_family(monkeypatch, shape, mesh):
    """Leaves one family and a coarse free surface, which are fitted in seconds."""
    coarse = functools.partial(FreeSurface, spacing=0.25)
    monkeypatch.setattr(shape_from_refraction, "FreeSurface", coarse)
    monkeypatch.setattr(families, "candidates", lambda _: [shape, coarse(mesh)])


@pytest.mark.slow
def test_a_family_is_chosen_where_it_explains_the_judges(world, ball, seen, judges, monkeypatch):
    mesh, told = _dented(ball), []
    _one_family(monkeypatch, Sphere(np.array([0.004, 0.0, -0.005]), 0.995), mesh)
    trials = shape_from_refraction.fit_shapes(
        mesh, 1.49, world, seen, judges, progress=lambda share, text: told.append(share)
    )
    assert [trial.name for trial in trials] == ["masks", "sphere", "free surface"]
    chosen = choose(trials)
    assert chosen.name == "sphere" and chosen.error < 0.3 * trials[0].error
    assert chosen.outer_index == pytest.approx(_INDEX, abs=2e-3)
    assert 0.0 < chosen.index_deviation < 2e-3
    assert _turned(chosen.mesh) < 0.2
    assert trials[2].error < 0.5 * trials[0].error
    assert told == sorted(told) and told[-1] == 1.0 and 0.0 < told[0] < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("blur", [0, 4])
def test_a_family_that_explains_nothing_is_given_up_without_blur(
    world, ball, seen, judges, monkeypatch, blur
):
    mesh, limits = _dented(ball), []

    def fit(model, x, *_, settings, **options):
        limits.append(settings.limits)
        return Fit(x, np.eye(len(x)), ())

    monkeypatch.setattr(gauss_newton, "fit", fit)
    monkeypatch.setattr(shape_from_refraction, "first_blur", lambda *_: blur)
    _one_family(monkeypatch, Sphere(_ORIGIN, 1.0), mesh)
    options = {"is_enough": lambda trials: True}
    shape_from_refraction.fit_shapes(mesh, _INDEX, world, seen, judges, **options)
    assert limits == [(np.inf,) * blur + (0.1,) * 4]


@pytest.mark.slow
def test_before_a_grey_wall_the_body_stays_as_it_is(ball, seen, judges, monkeypatch):
    grey = _world(pyramid=backdrop.init(_SIDE, radiance=0.4))
    pixels, others = (
        each._replace(rgb=photometry.encode(_see_ball(grey, each.rays))) for each in (seen, judges)
    )
    mesh = _dented(ball)
    _one_family(monkeypatch, Sphere(_ORIGIN, 1.0), mesh)
    trials = shape_from_refraction.fit_shapes(mesh, _INDEX, grey, pixels, others)
    chosen = choose(trials)
    assert chosen is trials[0] and chosen.mesh.vertices is mesh.vertices
    assert chosen.outer_index == _INDEX
    for trial in trials:
        assert np.all(np.isfinite(trial.fit.x)) and np.all(np.isfinite(trial.fit.covariance))
        assert np.all(np.isfinite(trial.by_view)) and np.all(np.isfinite(trial.mesh.vertices))
        # Light says nothing: what is known of the index is the prior.
        assert trial.index_deviation == pytest.approx(0.02, rel=0.05)


@pytest.mark.slow
def test_an_index_that_the_user_gave_stays(world, seen):
    model = SingleObject(Sphere(_ORIGIN, 1.005), 1.48, deviation=0.0)
    found = gauss_newton.fit(model, model.start(), world, seen, settings=Steps(blurs=(0, 0)))
    assert model.index_of(found.x) == pytest.approx(1.48, abs=1e-9)
    assert found.covariance[-1, -1] < 1e-12 and found.taken > 0


@pytest.mark.slow
def test_tints_are_found_with_the_index(world, seen, ball):
    tint = np.array([0.9, 0.97, 0.8])
    true = SingleObject(ball, _INDEX, tinted=True)
    body = gauss_newton.traced_object(
        true.pose(np.concatenate([ball.start(), [_INDEX], np.log(tint)]))
    )
    rgb = photometry.encode(photometry.predict(body, world, seen.rays).linear)
    found = gauss_newton.fit(
        true, true.start(), world, seen._replace(rgb=rgb), settings=Steps(blurs=(0, 0, 0, 0))
    )
    np.testing.assert_allclose(np.exp(found.x[-3:]), tint, atol=5e-3)
    assert true.index_of(found.x) == pytest.approx(_INDEX, abs=2e-3)


@pytest.mark.parametrize(
    ("mesh", "creased"),
    [
        (trimesh.creation.box(), True),
        (trimesh.creation.cylinder(0.5, 1.0, sections=64), True),
        (trimesh.creation.icosphere(subdivisions=3), False),
        (trimesh.creation.torus(1.0, 0.3), False),
    ],
)
def test_creases_are_told_from_smooth_surfaces(mesh, creased):
    assert shape_from_refraction._has_creases(bodies.as_mesh(mesh)) == creased


@pytest.mark.slow
def test_no_pixels_are_refused_with_advice(world, glass, ball, seen):
    nothing = seen.chosen(np.zeros(0, np.int64))
    with pytest.raises(ReconstructionError, match=r"No pixel sees the object. Check the masks"):
        gauss_newton.fit(glass, glass.start(), world, nothing)
    with pytest.raises(ReconstructionError, match=r"No pixel sees the object. Check the masks"):
        shape_from_refraction.find_index(_ball_mesh(ball), world, nothing)


def _equations(candidate, surface, pixels):
    body = gauss_newton.traced_object(candidate)
    return gauss_newton.linearise(candidate, body, surface, pixels, Steps())


@pytest.mark.slow
def test_saturated_and_unseen_pixels_lose_their_weight(world, glass, seen):
    candidate = glass.pose(glass.start())
    plain = _equations(candidate, world, seen)
    np.testing.assert_allclose(plain.by_view.sum(axis=0), plain.gradient)
    assert np.trace(plain.matrix) > 0.0
    bright = world._replace(mips=tuple(30.0 * mip for mip in world.mips))
    white = seen._replace(rgb=np.ones_like(seen.rgb))
    assert not np.any(_equations(candidate, bright, white).matrix)
    # Where no photograph shows the backdrop directly, it is not known.
    unseen = world._replace(coverage=tuple(0.0 * mip for mip in world.coverage))
    assert not np.any(_equations(candidate, unseen, seen).matrix)
    # What something else covers counts little.
    covered = seen.rgb.copy()
    covered[::4] = 0.0
    hidden = _equations(candidate, world, seen._replace(rgb=covered))
    assert np.linalg.norm(hidden.gradient) < 0.1 * np.sqrt(np.trace(hidden.matrix) * len(covered))


@pytest.mark.slow
def test_degenerate_faces_harm_nothing(world, ball, seen):
    mesh = _ball_mesh(ball)
    one, two = mesh.faces[:2, 0]
    faces = np.concatenate([mesh.faces, [[one, one, two], [two, two, two]]])
    normals = np.concatenate([mesh.normals, mesh.normals[:2]])
    broken = mesh._replace(faces=faces, normals=normals)
    for shape in (FixedShape(broken), FreeSurface(broken, 0.25)):
        model = SingleObject(shape, _INDEX)
        found = _equations(model.pose(model.start()), world, seen)
        assert np.all(np.isfinite(found.matrix)) and np.all(np.isfinite(found.gradient))
        assert found.matrix[-1, -1] > 0.0


def _trial(name, unknowns, by_view):
    nothing = Fit(np.zeros(unknowns), np.eye(unknowns), ())
    return Trial(name, None, nothing, np.asarray(by_view))


def test_the_smallest_shape_within_two_standard_errors_is_chosen():
    views = np.linspace(-1.0, 1.0, 9)
    best = _trial("free", 500, 0.02 + 0.0 * views)
    # The standard error of the mean difference is 2.3e-3: first beyond two of them, then within.
    masks = _trial("masks", 1, 0.026 + 1e-2 * views)
    sphere = _trial("sphere", 5, 0.024 + 1e-2 * views)
    worse = compare(masks, best)
    assert worse.mean == pytest.approx(6e-3)
    assert worse.error == pytest.approx(1e-2 * views.std(ddof=1) / 3.0)
    assert choose([masks, sphere, best]) is sphere
    assert choose([best, sphere, masks]) is sphere
    assert choose([masks, best]) is best
    # Where views are alike, a small difference is significant, but not a quarter of an 8-bit level.
    assert choose([_trial("sphere", 5, best.by_view + 1.1e-3), best]) is best
    within = _trial("sphere", 5, best.by_view + 0.9e-3)
    assert choose([within, best]) is within
    # Of two with as many unknowns, neither is smaller: the better one is chosen.
    other = _trial("torus", 5, best.by_view + 0.5e-3)
    assert choose([within, other, best]) is other


def test_one_view_has_no_standard_error():
    masks, free = _trial("masks", 1, [0.03]), _trial("free", 500, [0.02])
    assert compare(masks, free) == pytest.approx((0.01, 0.0))
    assert choose([masks, free]) is free and choose([masks, masks._replace(name="same")]) is masks


def test_the_index_is_as_uncertain_as_hypotheses_that_explain_nearly_as_much():
    def known(index, error):
        model = SingleObject(Sphere(np.zeros(3), 1.0), index)
        fit = Fit(model.start(), np.diag([0.0] * 4 + [3e-4**2]), ())
        return Trial("a ball", model, fit, np.array([error]))

    chosen = known(1.48, 0.04)
    assert chosen.index_deviation == pytest.approx(3e-4)
    assert index_deviation(chosen, []) == pytest.approx(3e-4)
    assert index_deviation(chosen, [chosen, known(1.46, 0.06)]) == pytest.approx(3e-4)
    found = index_deviation(chosen, [chosen, known(1.484, 0.045), known(1.479, 0.041)])
    assert found == pytest.approx(np.hypot(3e-4, 4e-3))
