"""Bubbles of air in a ball of glass: their unknowns, and the search, with camera noise."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import ReconstructionError, bubble_search, gauss_newton, photometry
from refref_jax.reconstruct.bubble_search import BubbleSettings, find_bubbles, peaks
from refref_jax.reconstruct.bubbles import Bubble, ObjectWithBubbles, depth_inside
from refref_jax.reconstruct.families import Sphere
from refref_jax.reconstruct.gauss_newton import Fit, Steps
from refref_jax.reconstruct.model_selection import Trial, judged
from refref_jax.reconstruct.photometry import Photographs, make_backdrop
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, FreeSurface
from refref_jax.render import backdrop
from refref_jax.sampling.scene_bounds import Domain
from tests.factories import bodies
from tests.laws import posed_surfaces

_SIDE, _NOISE = 64, 0.005
_ORIGIN = np.zeros(3)
_ONE = Bubble(np.array([0.3, -0.2, 0.25]), 0.12)
_TWO = Bubble(np.array([-0.3, 0.1, -0.3]), 0.09)
_FEW = BubbleSettings(rays=9000)


class _Part:
    """One part of an object as a surface that depends on unknowns."""

    def __init__(self, model, number):
        self.start, self.scales = model.start, model.scales
        self.pose = lambda x: model.pose(x).parts[number]


def _ball(index=1.5):
    return SingleObject(Sphere(_ORIGIN, 1.0, subdivisions=4), index)


def _filled(*bubbles, index=1.0):
    solid = _ball()
    return ObjectWithBubbles(solid, solid.start(), bubbles, index=index)


@pytest.mark.parametrize(
    ("bubbles", "held"),
    [
        ([_ONE, _TWO], [0.12, 0.09]),
        # The second reaches through the surface, then into the first; the last is too small.
        ([_ONE, Bubble(np.array([0.1, 0.9, 0.2]), 0.2)], [0.12, 0.07]),
        ([_ONE, Bubble(np.array([0.3, -0.2, 0.45]), 0.2)], [0.12, 0.08]),
        ([_ONE, Bubble(np.array([0.3, -0.17, 0.3]), 0.2)], [0.12, 0.01]),
        ([Bubble(np.array([0.02, 0.6, 0.797]), 0.2)], [0.01]),
        ([Bubble(np.array([0.1, 0.2, 0.3]), 1e-4)], [0.01]),
    ],
)
def test_balls_are_held_inside_with_exact_derivatives(bubbles, held):
    model = _filled(*bubbles)
    for number in range(1 + len(bubbles)):
        posed_surfaces.assert_derivatives(
            _Part(model, number), near=1e-3, step=1e-5, tolerance=2e-3
        )
        posed_surfaces.assert_closed(model.pose(model.start()).parts[number])
    found = model.bubbles(model.start())
    assert [each.radius for each in found] == pytest.approx(held, rel=0.2)
    outer = model.pose(model.start()).parts[0]
    for number, one in enumerate(found):
        assert depth_inside(one.centre, outer).distance > one.radius
        for other in found[:number]:
            apart = np.linalg.norm(one.centre - other.centre)
            assert apart > one.radius + other.radius


def test_a_ball_far_outside_comes_back():
    model = _filled(_ONE)
    x = model.start()
    x[-4:] = [3.0, -2.0, 4.0, 0.5]
    (found,) = model.bubbles(x)
    assert np.linalg.norm(found.centre) + found.radius < 1.0 and found.radius > 0.0


def test_the_prior_is_quadratic():
    posed_surfaces.assert_prior(_filled(_ONE, _TWO))


def test_parts_are_those_of_an_ordinary_scene():
    model = _filled(_ONE, _TWO)
    solids = model.solids(model.start())
    assert [each.name for each in solids] == ["glass", "bubble1", "bubble2"]
    assert [each.index for each in solids] == [1.5, 1.0, 1.0]
    assert [each.parent for each in solids] == [NO_PARENT, 0, 0]
    radii = np.linalg.norm(solids[1].mesh.vertices - _ONE.centre, axis=-1)
    np.testing.assert_allclose(radii, 0.12)


@pytest.mark.parametrize("bubble", [Bubble(2.0 * np.ones(3), 0.1), Bubble(_ORIGIN, 0.0)])
def test_what_is_no_bubble_is_refused(bubble):
    with pytest.raises(ReconstructionError, match="not inside"):
        _filled(bubble)


def test_bubbles_in_any_shape_have_derivatives():
    cube, rough = bodies.as_mesh(trimesh.creation.box()), bodies.icosphere(3)
    inside = [Bubble(np.array([0.1, 0.2, 0.42]), 0.2)]
    for shape in (FixedShape(cube), FreeSurface(rough, 0.4)):
        solid = SingleObject(shape, 1.5, tinted=True)
        model = ObjectWithBubbles(solid, solid.start(), inside)
        candidate = model.pose(model.start())
        assert candidate.by_indices.shape == (2, len(model.start()))
        assert candidate.by_tints.shape == (6, len(model.start()))
        posed_surfaces.assert_derivatives(_Part(model, 1), near=1e-3, tolerance=2e-3)
    assert model.bubbles(model.start())[0].radius == pytest.approx(0.2)


@pytest.fixture(scope="module")
def world():
    """A cube of random radiance, smooth over a tenth of a face."""
    return _world(0.1)


def _world(contrast):
    random = np.random.default_rng(3)
    levels = list(backdrop.init(_SIDE, radiance=0.4))
    for number, level in enumerate(levels[:4]):
        noise = random.normal(size=level.shape, scale=contrast)
        levels[number] = level + jnp.asarray(noise, level.dtype)
    seen = np.full((6, _SIDE + 1, _SIDE + 1), 9.0, np.float32)
    return make_backdrop(Domain(3.0, "bounded", (0.1, -0.2, 0.15)), tuple(levels), seen)


@functools.cache
def _rays(views, size):
    cameras = bodies.cameras_around(views, size=size, distance=2.3)
    every = [image_rays(cameras, view) for view in range(views)]
    origins, directions, radii = (
        np.concatenate([np.asarray(rays[n]).reshape(size**2, -1) for rays in every])
        for n in range(3)
    )
    impact = np.linalg.norm(np.cross(origins, directions), axis=-1)
    near = np.flatnonzero(impact < 0.95)
    return Rays(origins[near], directions[near], radii[near, 0]), near // size**2


def _photographs(surface, meshes, views, *, size=36, inside=1.0):
    """Pixels of a ball of glass with others inside, on icospheres of trimesh, turned, with noise.

    They are rendered by the library's path tree, with the normals that trimesh has.
    """
    count = len(meshes) - 1
    scene = photometry.assemble(
        np.concatenate([np.asarray(mesh.triangles) for mesh in meshes]),
        np.concatenate([mesh.vertex_normals[mesh.faces] for mesh in meshes]),
        np.repeat(np.arange(1 + count), [len(mesh.faces) for mesh in meshes]),
        nested([1.5] + [inside] * count, [NO_PARENT] + [0] * count),
    )
    rays, view = _rays(views, size)
    seen = photometry.encode(photometry.predict(scene, surface, rays).linear)
    noisy = seen + _NOISE * np.random.default_rng(views).normal(size=seen.shape)
    return Photographs(rays, np.clip(noisy, 0.0, 1.0), view)


def _icosphere(centre, radius, level):
    mesh = trimesh.creation.icosphere(subdivisions=level)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, -1.0]))
    mesh.apply_scale(radius)
    return mesh.apply_translation(centre)


def _seen(surface, bubbles, *, inside=1.0, glass=None):
    meshes = [glass or _icosphere(_ORIGIN, 1.0, 4)]
    meshes += [_icosphere(each.centre, each.radius, 4) for each in bubbles]
    return [_photographs(surface, meshes, views, inside=inside) for views in (12, 7)]


def _solid(surface, pixels, judges, *, steps=2):
    """The ball as it is fitted without bubbles, from a start that is a little off."""
    off = Sphere(np.array([0.004, -0.003, 0.0]), 1.003, subdivisions=4)
    solid = SingleObject(off, 1.495)
    fit = Fit(_ball().start(), 1e-6 * np.eye(5), ())
    if steps:
        settings = Steps((0,) * steps, rays=9000, judges=4096)
        fit = gauss_newton.fit(solid, solid.start(), surface, pixels, settings=settings)
    return judged("sphere", solid, fit, surface, judges)


@pytest.fixture(scope="module", autouse=True)
def small_tiles():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photometry, "_TILE", 2048)
        yield


@pytest.mark.slow
@pytest.mark.parametrize("bubbles", [[_ONE], [_ONE, _TWO]], ids=["one", "two"])
def test_bubbles_are_found(world, bubbles):
    pixels, judges = _seen(world, bubbles)
    solid, told = _solid(world, pixels, judges), []
    found = find_bubbles(
        solid, world, pixels, judges, settings=_FEW, progress=lambda share, text: told.append(share)
    )
    assert isinstance(found.model, ObjectWithBubbles)
    every = sorted(found.model.bubbles(found.fit.x), key=lambda each: -each.radius)
    assert len(every) == len(bubbles)
    for one, true in zip(every, bubbles, strict=True):
        assert np.linalg.norm(one.centre - true.centre) < 0.02 * true.radius
        assert one.radius == pytest.approx(true.radius, rel=0.02)
    assert found.name == f"sphere with {len(bubbles)} bubble{'s' * (len(bubbles) > 1)}"
    assert found.outer_index == pytest.approx(1.5, abs=1e-3)
    assert found.error < 1.2 * _NOISE < solid.error
    assert np.all(np.sqrt(np.diag(found.fit.covariance))[-4:] < 0.01)
    assert told == sorted(told) and told[-1] == 1.0


@pytest.mark.slow
def test_nothing_is_found_in_clear_glass(world):
    pixels, judges = _seen(world, [])
    solid = _solid(world, pixels, judges, steps=0)
    assert find_bubbles(solid, world, pixels, judges, settings=_FEW) is solid


@pytest.mark.slow
def test_a_bubble_of_glass_is_none(world):
    pixels, judges = _seen(world, [_ONE], inside=1.5)
    solid = _solid(world, pixels, judges, steps=0)
    assert find_bubbles(solid, world, pixels, judges, settings=_FEW) is solid


@pytest.mark.slow
def test_nothing_is_found_before_a_grey_wall():
    grey = _world(0.0)
    pixels, judges = _seen(grey, [_ONE])
    solid = _solid(grey, pixels, judges, steps=0)
    assert find_bubbles(solid, grey, pixels, judges, settings=_FEW) is solid


@pytest.mark.slow
def test_a_dent_of_the_surface_is_no_bubble(world):
    glass = _icosphere(_ORIGIN, 1.0, 5)
    away = np.arccos(np.clip(glass.vertices @ np.array([0.0, 0.6, 0.8]), -1.0, 1.0))
    glass.vertices *= 1.0 - 0.03 * np.exp(-((away / 0.2) ** 2))[:, None]
    pixels, judges = _seen(world, [], glass=glass)
    solid = _solid(world, pixels, judges, steps=0)
    assert find_bubbles(solid, world, pixels, judges, settings=_FEW) is solid


def test_without_pixels_the_search_is_refused_with_advice(world):
    rays, views = _rays(7, 36)
    some = Photographs(rays, np.zeros((len(views), 3)), views)
    none, trial = some.chosen(np.zeros(0, np.int64)), _perfect()
    for pixels, judges in ((none, some), (some, none)):
        with pytest.raises(ReconstructionError, match="No pixel sees the object"):
            find_bubbles(trial, world, pixels, judges)


def _perfect():
    """The true ball, with no error."""
    model = _ball()
    return Trial("sphere", model, Fit(model.start(), np.eye(5), ()), np.zeros(1))


def _chords(count=6000):
    """Straight segments through the unit ball, between random points of its surface."""
    random = np.random.default_rng(5)
    ends = random.normal(size=(2, count, 1, 3))
    ends /= np.linalg.norm(ends, axis=-1, keepdims=True)
    return photometry.InnerSegments(*ends, np.ones((count, 1), bool))


def test_peaks_and_the_best_sphere_find_a_ball_from_chords():
    trial, segments = _perfect(), _chords()
    passes = bubble_search._distances(segments, _ONE.centre) <= _ONE.radius
    errors = np.where(passes, 0.1, 0.005)
    first, *_ = peaks(trial, segments, errors)
    assert np.linalg.norm(first.centre - _ONE.centre) < 0.08
    assert first.error > 0.05 and first.level < 0.02
    ball = bubble_search._best_sphere(segments, errors, first.centre, 0.4)
    np.testing.assert_allclose(ball.centre, _ONE.centre, atol=0.01)
    assert ball.radius == pytest.approx(0.12, abs=0.005)
    # Even errors, and no segments at all, have no peak.
    assert not peaks(trial, segments, np.full(6000, 0.03))
    assert not peaks(trial, segments._replace(inside=np.zeros((6000, 1), bool)), errors)


@pytest.mark.slow
def test_inner_segments_of_a_ball_are_its_chords(world):
    del world
    rays, _ = _rays(7, 36)
    model = _filled(_TWO)
    found = photometry.inner_segments(gauss_newton.traced_object(model.pose(model.start())), rays)
    counts = found.inside.sum(axis=1)
    assert np.all(counts[counts > 0] >= 1) and np.mean(counts == 1) > 0.8
    # A path that meets the bubble has a piece before it and one behind it, and one inside.
    assert np.any(counts >= 2)
    one = np.flatnonzero((counts == 1) & found.inside[:, 1])
    starts, ends = found.starts[one, 1], found.ends[one, 1]
    np.testing.assert_allclose(np.linalg.norm(starts, axis=-1), 1.0, atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(ends, axis=-1), 1.0, atol=2e-3)
    origins, directions = np.asarray(rays.origins)[one], np.asarray(rays.directions)[one]
    sine = np.linalg.norm(np.cross(origins, directions), axis=-1)
    inner = np.cross(starts, (ends - starts) / np.linalg.norm(ends - starts, axis=-1)[:, None])
    np.testing.assert_allclose(np.linalg.norm(inner, axis=-1), sine / 1.5, atol=5e-3)
