"""Fields with a surface along a path: weights, sums for the losses, points, what is refused."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from refref_jax.fields import neus
from refref_jax.fields.neus import NeusConfig, NeusProposalConfig, UnisurfConfig
from refref_jax.optics.path_settings import STRAIGHT, TREE
from refref_jax.render import Model, render_ray, render_rays, volume_rendering
from refref_jax.render.model import (
    ProposalConfig,
    ball_of,
    init_params,
    look_up,
    look_up_surface,
)
from refref_jax.render.volume_rendering import Jitter
from tests.factories import made_paths, scenes
from tests.factories.small_model import MODEL, initial
from tests.laws import gradients

_PLAIN = MODEL.field
_SHAPE = {
    "grid": _PLAIN.grid,
    "density_width": _PLAIN.density_width,
    "bottleneck": _PLAIN.bottleneck,
    "colour_width": _PLAIN.colour_width,
    "colour_depth": _PLAIN.colour_depth,
    "around": _PLAIN.grid,
    "ball_radius": 0.2,
}
_PROPOSALS = tuple(
    ProposalConfig(NeusProposalConfig(each.field.grid, each.field.width), samples=64)
    for each in MODEL.proposals
)
_CONFIG = dataclasses.replace(
    MODEL, field=NeusConfig(**_SHAPE), proposals=_PROPOSALS, samples=96, last_sample="end"
)
_UNISURF = dataclasses.replace(_CONFIG, field=UnisurfConfig(**_SHAPE))
_KINDS = pytest.mark.parametrize(
    "config", [_CONFIG, pytest.param(_UNISURF, marks=pytest.mark.slow)], ids=["neus", "unisurf"]
)
_ONE = jnp.float32(1.0)
_radiance = jax.jit(volume_rendering.path_radiance, static_argnums=1)


def _params(config, sharpness=None):
    params = initial(config)
    if sharpness is None:
        return params
    sharper = params.field._replace(log_sharpness=jnp.log(jnp.float32(sharpness)))
    return params._replace(field=sharper)


def _straight(origin=(0.1, 0.2, -5.0)):
    return made_paths.path([], [(0.0, 0.0, 1.0)], [0], origin=origin)


def _seen(config, params, path=None, progress=None, anneal=0.0):
    path = jax.tree.map(jnp.asarray, _straight() if path is None else path)
    jitter = Jitter(jnp.zeros(2), jnp.zeros(2))
    return _radiance(params, config, path, jitter, jnp.float32(anneal), progress=progress)


@pytest.mark.slow
def test_the_distance_of_an_untrained_field_is_that_of_its_ball():
    """The ball has half the radius of the ball of radius 3 around the origin."""
    assert ball_of(_CONFIG) == ((0.0, 0.0, 0.0), 3.0)
    wanted = 5.0 - np.sqrt(1.5**2 - 0.1**2 - 0.2**2)
    for sharpness in (100.0, 1000.0):
        found = _seen(_CONFIG, _params(_CONFIG, sharpness)).composite
        spacing = 12.5 / 96.0
        assert abs(found.median - wanted) < 2.0 * spacing, sharpness
        np.testing.assert_allclose(found.accumulation, 1.0, atol=1e-5)


@pytest.mark.slow
def test_a_ray_beside_the_ball_ends_on_the_wall():
    found = _seen(_CONFIG, _params(_CONFIG, 1000.0), _straight((2.5, 2.5, -5.0)))
    assert found.surface.share < 1e-6 and found.composite.median > 10.0


@pytest.mark.slow
def test_weights_are_those_of_the_kinds_law():
    """The weights of NeuS from its own samples, in NumPy and float64."""
    params = _params(_CONFIG, 40.0)
    path = jax.tree.map(jnp.asarray, _straight())

    def sampled(params, path):
        line = volume_rendering.polyline(_CONFIG, path)
        warp = volume_rendering.distance_warp(_CONFIG, line)
        jitter, even = Jitter(jnp.zeros(2), jnp.zeros(2)), jnp.float32(0.0)
        return volume_rendering._sampled(params, _CONFIG, line, warp, jitter, even)

    samples, seen, _ = jax.jit(sampled)(params, path)
    signed, lengths = np.asarray(seen.signed, np.float64), np.diff(np.asarray(samples.t)) / 3.0
    falls = np.maximum(0.0, -np.asarray(seen.slope, np.float64)[:, 2])
    first, second = (
        scipy.special.log_expit(40.0 * (signed + sign * 0.5 * falls * lengths)) for sign in (1, -1)
    )
    around = np.asarray(seen.density) * lengths * 3.0 / _CONFIG.radius
    depth = np.where(seen.within, np.maximum(0.0, first - second), around)
    passed = np.exp(-np.concatenate([[0.0], np.cumsum(depth)[:-1]]))
    weights = passed * -np.expm1(-depth)
    weights[-1] = 1.0 - weights[:-1].sum()
    found = _seen(_CONFIG, params)
    np.testing.assert_allclose(found.histograms[-1].weights, weights, atol=2e-5)
    within = np.asarray(seen.within)
    assert 10 < within.sum() < 90
    np.testing.assert_allclose(found.surface.share, weights[within].sum(), rtol=1e-4)
    assert int(found.surface.samples) == within.sum()
    stretch = np.square(np.linalg.norm(np.asarray(seen.slope), axis=-1) - 1.0)
    np.testing.assert_allclose(found.surface.eikonal, stretch[within].sum(), rtol=1e-4)
    bends = np.abs(np.asarray(seen.curvature))
    np.testing.assert_allclose(found.surface.curvature, bends[within].sum(), rtol=1e-4)


@pytest.mark.slow
def test_the_end_of_the_training_is_the_default_progress():
    config = dataclasses.replace(
        _CONFIG, field=dataclasses.replace(_CONFIG.field, head_on=(0.0, 0.4))
    )
    params = _params(config, 20.0)
    last, first = (_seen(config, params, progress=x) for x in (_ONE, jnp.float32(0.0)))
    default = _seen(config, params)
    np.testing.assert_array_equal(default.composite.rgb, last.composite.rgb)
    assert not np.array_equal(first.histograms[-1].weights, last.histograms[-1].weights)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "settings"),
    [
        pytest.param(_CONFIG, STRAIGHT, id="neus-straight"),
        pytest.param(_CONFIG, TREE, id="neus-tree"),
        pytest.param(_UNISURF, STRAIGHT, id="unisurf-straight"),
        pytest.param(_UNISURF, TREE, id="unisurf-tree"),
    ],
)
def test_it_renders_along_straight_and_bent_paths(config, settings):
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    rays = scenes.rays([[-4.0, 0.21, 0.33], [-4.0, 3.0, 0.0]], [1.0, 0.02, 0.01])
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: jnp.asarray(0.6 * rng.normal(size=x.shape), x.dtype), shapes)
    seen = jax.jit(lambda s, p: render_rays(Model(config, settings, s, p), rays))(scene, params)
    assert gradients.all_finite(seen.rgb) and np.all(np.asarray(seen.linear) >= -0.0011)
    assert np.all(np.asarray(seen.linear) <= 1.0011) and np.std(seen.linear) > 0.0


@functools.partial(jax.jit, static_argnums=1)
@jax.value_and_grad
def _sum_of_a_path(params, config):
    path = jax.tree.map(jnp.asarray, _straight())
    jitter = Jitter(jnp.zeros(2), jnp.zeros(2))
    seen = volume_rendering.path_radiance(params, config, path, jitter, _ONE)
    sums = sum(map(jnp.sum, seen.surface))
    moments = sum(jnp.sum(jnp.square(each.weights)) for each in seen.histograms)
    return jnp.sum(seen.composite.rgb) + sums + moments


@pytest.mark.slow
@_KINDS
@pytest.mark.parametrize("size", [0.0, 0.6, 30.0])
def test_paths_are_finite_with_their_gradients(config, size):
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(2)
    params = jax.tree.map(lambda x: jnp.asarray(size * rng.normal(size=x.shape), x.dtype), shapes)
    assert gradients.all_finite(_sum_of_a_path(params, config))


# --- points ---


@pytest.mark.slow
def test_a_point_has_a_signed_distance_and_a_normal():
    params = _params(_CONFIG)
    look = jax.jit(functools.partial(look_up_surface, params, _CONFIG))
    down = jnp.array([0.0, 0.0, -1.0])
    for point, distance in [
        ([0.0, 0.0, 2.0], 0.5),
        ([0.6, 0.0, 0.8], -0.5),
        ([0.0, 6.0, 0.0], 3.0),
        ([0.0, -3.3, 0.0], 1.2),
    ]:
        seen = look(jnp.asarray(point), down)
        if np.linalg.norm(point) < 3.0:
            np.testing.assert_allclose(seen.distance, distance, atol=1e-5)
            cosine = np.dot(seen.normal, point) / np.linalg.norm(point)
            assert cosine > 0.98
        else:  # beyond the ball of radius 3
            assert seen.distance >= np.linalg.norm(point) - 3.0 - 1e-5
        assert np.all((seen.linear >= -0.0011) & (seen.linear <= 1.0011))


@pytest.mark.slow
def test_the_ball_of_a_scene_elsewhere():
    field = dataclasses.replace(_CONFIG.field, ball_centre=(0.6, 0.5, 0.4))
    config = dataclasses.replace(_CONFIG, field=field, centre=(1.0, 2.0, 3.0))
    ball = ball_of(config)
    np.testing.assert_allclose([*ball.centre, ball.radius], [2.5, 2.0, 1.5, 3.0], atol=1e-12)
    look = jax.jit(functools.partial(look_up_surface, _params(config), config))
    seen = look(jnp.array([2.5, 2.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(seen.distance, 0.0, atol=1e-5)


@_KINDS
def test_a_density_at_a_point_is_refused(config):
    kind = config.field.kind
    params, towards = _params(config), jnp.array([0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match=f"no density in fields of kind {kind}.* look_up_surface"):
        look_up(params, config, jnp.zeros(3), towards, width=0.1)
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    ray = jax.tree.map(lambda x: x[0], scenes.rays([[-4.0, 0.2, 0.3]], [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=rf"of kind {kind}\. Use render_rays"):
        render_ray(Model(config, STRAIGHT, scene, params), ray)


def test_a_surface_of_a_field_without_one_is_refused():
    params = initial(MODEL)
    with pytest.raises(ValueError, match=r"kind zipnerf have no surface\. Use look_up"):
        look_up_surface(params, MODEL, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))


def test_kinds_differ_in_their_law_alone():
    assert neus.UNISURF.radiance is neus.KIND.radiance
    assert neus.UNISURF.init_radiance is neus.KIND.init_radiance
    assert neus.UNISURF.depth is not neus.KIND.depth
