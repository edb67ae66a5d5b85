"""Straight rays that a field bends: moved samples, polylines, and what proposals learn of them."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import raydef, registry
from refref_jax.fields.base import Offset
from refref_jax.fields.raydef import (
    RaydefConfig,
    RaydefParams,
    RaydefPolylineConfig,
    RaydefPolylineProposalConfig,
    RaydefProposalConfig,
)
from refref_jax.optics.path_settings import STRAIGHT
from refref_jax.render import Model, learned_media, render_ray, volume_rendering
from refref_jax.render.model import ProposalConfig, init_params, look_up
from refref_jax.render.volume_rendering import Jitter
from refref_jax.sampling import polylines, scene_bounds
from tests.factories import arrays, made_paths, scenes
from tests.factories.small_model import MODEL
from tests.laws import gradients

pytestmark = pytest.mark.longest

_ONE = jnp.float32(1.0)
_SPACES = ("bounded", "spherical", "unbounded")

# A few float32 roundings of lengths of about 10, and of what a field makes of them.
_ROUNDING = 1e-5

_NETWORK = {"octaves": 3, "deformation_width": 6, "deformation_depth": 2}
_PLAIN = {
    name: getattr(MODEL.field, name)
    for name in ("grid", "density_width", "bottleneck", "colour_width", "colour_depth")
}
_KINDS = {
    "raydef": (RaydefConfig(**_PLAIN, **_NETWORK), RaydefProposalConfig),
    "raydef_polyline": (
        RaydefPolylineConfig(**_PLAIN, **_NETWORK, knots=4),
        RaydefPolylineProposalConfig,
    ),
}

# Every run of the suite does both kinds, and two spaces.
_OFTEN = [("raydef", "bounded"), ("raydef_polyline", "unbounded")]


def _cases(often):
    return pytest.mark.parametrize(
        ("kind", "space"),
        [
            pytest.param(*pair, marks=() if pair in often else pytest.mark.slow)
            for pair in itertools.product(_KINDS, _SPACES)
        ],
    )


_each_kind_and_space = _cases(_OFTEN)


def _config(kind, space="bounded", **changes):
    field, proposal = _KINDS[kind]
    proposals = tuple(
        ProposalConfig(proposal(each.field.grid, each.field.width), each.samples)
        for each in MODEL.proposals
    )
    made = dataclasses.replace(MODEL, field=field, proposals=proposals, space=space, dilation=0.0)
    return dataclasses.replace(made, **changes)


def _trained(config, scale=0.6):
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    return arrays.drawn(shapes, scale=scale)


def _with_offset(params, *, position=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 0.0)):
    """Returns parameters whose offsets are the same everywhere."""
    layers = params.field.deformation["params"]
    last = f"Dense_{_NETWORK['deformation_depth']}"
    bias = jnp.asarray([*position, *direction], jnp.float32) / raydef._PACE
    constant = {"kernel": jnp.zeros_like(layers[last]["kernel"]), "bias": bias}
    made = RaydefParams(params.field.field, {"params": layers | {last: constant}})
    return params._replace(field=made)


def _path(origin=(0.0, 0.4, 2.5), direction=(0.1, -0.2, -1.0)):
    return jax.tree.map(jnp.asarray, made_paths.path([], [direction], [0], origin=origin))


_radiance = jax.jit(volume_rendering.path_radiance, static_argnums=1)


def _seen(config, params, path=None, anneal=_ONE):
    still = Jitter(jnp.zeros(2), jnp.zeros(2))
    return _radiance(params, config, _path() if path is None else path, still, anneal)


def _straight(config, params, path=None):
    """Returns what the same field shows without its deformation."""
    plain = dataclasses.replace(config, field=MODEL.field, proposals=MODEL.proposals)
    return _seen(plain, params._replace(field=params.field.field), path)


@pytest.mark.slow
@_each_kind_and_space
def test_without_offsets_a_ray_is_straight(kind, space):
    config = _config(kind, space)
    params = _with_offset(_trained(config))
    found, expected = _seen(config, params), _straight(config, params)
    for ours, theirs in zip(found.composite, expected.composite, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=_ROUNDING, atol=_ROUNDING)
    np.testing.assert_allclose(found.bent.offsets, 0.0, atol=_ROUNDING)
    np.testing.assert_allclose(found.bent.turned, found.bent.straight, atol=_ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raydef", "raydef_polyline"])
def test_an_untrained_ray_is_nearly_straight(kind):
    config = _config(kind)
    params = jax.jit(lambda: init_params(jax.random.key(3), config))()
    found, expected = _seen(config, params).composite, _straight(config, params).composite
    np.testing.assert_allclose(found.rgb, expected.rgb, atol=1e-4)
    assert not np.array_equal(found.rgb, expected.rgb)


@pytest.mark.slow
def test_moved_samples_are_those_of_a_moved_ray():
    """A ray at a right angle to its wall, moved along it; proposals see the moved one, too."""
    config = _config("raydef")
    params = _with_offset(_trained(config), position=(0.1, -0.05, 0.0))
    ray = functools.partial(_path, direction=(0.0, 0.0, -1.0))
    found = _seen(config, params, ray(origin=(0.0, 0.4, 2.5)))
    moved = ray(origin=(0.0 + 0.1 * 7.5, 0.4 - 0.05 * 7.5, 2.5))
    expected = _straight(config, params, moved)
    np.testing.assert_allclose(found.composite.rgb, expected.composite.rgb, atol=2e-5)
    for ours, theirs in zip(found.histograms, expected.histograms, strict=True):
        np.testing.assert_allclose(ours.weights, theirs.weights, atol=2e-5)
    apart = np.abs(found.composite.rgb - _straight(config, params, ray()).composite.rgb)
    assert np.max(apart) > 1e-3


@pytest.mark.slow
def test_a_turned_sample_is_seen_from_elsewhere():
    """The density stays, and the colour is that of the turned direction."""
    config = _config("raydef")
    params = _with_offset(_trained(config), direction=(0.8, 0.1, 0.3))
    found, plain = _seen(config, params), _straight(config, params)
    np.testing.assert_array_equal(found.histograms[-1].weights, plain.histograms[-1].weights)
    assert np.max(np.abs(found.composite.rgb - plain.composite.rgb)) > 1e-3
    start = np.asarray(found.bent.straight, np.float64) + np.array([0.8, 0.1, 0.3])
    turned = start / np.linalg.norm(start, axis=-1, keepdims=True)
    np.testing.assert_allclose(found.bent.turned, turned, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("space", _SPACES)
def test_moved_samples_stay_in_the_unit_cube(space):
    config = _config("raydef", space)
    domain = config.domain

    @jax.jit
    def move(params):
        gaussians = polylines.Gaussians(jnp.full((6, 1, 3), 0.4), jnp.full((6, 1), 0.01))
        line = polylines.whole_path(_path())
        points = jax.vmap(polylines.point_at, in_axes=(None, 0))(line, jnp.arange(6.0))
        moved = learned_media.move(params, config.field, domain, gaussians, points, _ONE)
        return *moved, points

    params = _with_offset(_trained(config), position=(9.0, -9.0, 0.5))
    moved, turned, bent, points = move(params.field)
    radii = 4.0 if space == "unbounded" else 2.0
    expected = np.tile([1.0, 0.0, 0.4 + 0.5 / radii], (6, 1))
    np.testing.assert_allclose(moved.positions[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(bent.offsets, radii * (expected - 0.4), atol=1e-5)
    np.testing.assert_array_equal(turned.position, points.position)


# --- polylines ---


@functools.partial(jax.jit, static_argnums=0)
def _knots(config, path, s):
    warp = volume_rendering.distance_warp(config, polylines.whole_path(path))
    return scene_bounds.to_distance(warp, s)


def _bend(config, wanted, monkeypatch, path=None):
    """Bends a ray by given offsets of its knots, in world units.

    Returns:
      The distances and places of the knots along the straight ray, the polyline, and the bent ray.
    """
    path = _path() if path is None else path
    t = np.asarray(_knots(config, path, np.linspace(0.0, 1.0, len(wanted) + 1)[1:]))
    places = np.asarray(path.points[0]) + t[:, None] * np.asarray(path.directions[0])
    table = np.float32(np.asarray(wanted) / config.radius)
    cells = np.float32(0.5 * places / config.radius + 0.5)

    def planted(params, field, cell, direction, progress):
        nearest = jnp.argmin(jnp.sum(jnp.square(cells - cell[None]), axis=-1))
        return Offset(jnp.asarray(table)[nearest], jnp.zeros(3))

    monkeypatch.setattr(registry, "deform", planted)

    @jax.jit
    def bend(path):
        line = polylines.whole_path(path)
        warp = volume_rendering.distance_warp(config, line)
        return learned_media.bend(None, config.field, config.domain, line, warp, _ONE)

    return t, places, *bend(path)


@pytest.mark.slow
def test_knots_become_the_corners_of_a_polyline(monkeypatch):
    """Only what moves a knot across its ray counts."""
    config = _config("raydef_polyline")
    wanted = np.array([[0.3, 0.0, 0.1], [0.2, -0.5, 0.0], [0.5, -0.9, -0.4], [0.1, 0.2, 0.3]])
    way = np.array([0.1, -0.2, -1.0]) / np.linalg.norm([0.1, -0.2, -1.0])
    t, places, bent, found = _bend(config, wanted, monkeypatch)
    vertices = places + wanted - np.outer(wanted @ way, way)
    vertices[-1] = np.clip(vertices[-1], -7.5, 7.5)
    start = np.concatenate([[[0.0, 0.4, 2.5]], vertices])
    steps = np.diff(start, axis=0)
    lengths = np.linalg.norm(steps, axis=-1)
    np.testing.assert_allclose(bent.points, start[:-1], atol=_ROUNDING)
    np.testing.assert_allclose(bent.directions, steps / lengths[:, None], atol=_ROUNDING)
    np.testing.assert_allclose(bent.knots, [0.0, *np.cumsum(lengths[:-1])], atol=_ROUNDING)
    np.testing.assert_allclose(found.places, [0.0, *t / 7.5], atol=1e-6)
    np.testing.assert_array_equal(found.offsets[0], 0.0)
    moved = np.concatenate([np.zeros((1, 3)), vertices - places]) / 7.5
    np.testing.assert_allclose(found.offsets, moved, atol=_ROUNDING)
    # The light ends on the wall, on the way to the last vertex or beyond it.
    end = polylines.point_at(bent, volume_rendering.distance_warp(config, bent).far)
    np.testing.assert_allclose(np.max(np.abs(end.position)), 7.5, rtol=1e-5)


def test_knots_stay_within_the_bounds(monkeypatch):
    config = _config("raydef_polyline")
    down = _path(direction=(0.0, 0.0, -1.0))
    wanted = [[0.3, 0.0, 0.0], [0.2, -0.5, 0.0], [9.0, -0.9, 0.0], [2.0, -30.0, 0.0]]
    _, places, bent, _ = _bend(config, wanted, monkeypatch, path=down)
    third = [7.5, 0.4 - 0.9, places[2, 2]]
    np.testing.assert_allclose(bent.points[-1], third, atol=_ROUNDING)
    towards = np.array([2.0, -7.5, -7.5]) - third
    np.testing.assert_allclose(
        bent.directions[-1], towards / np.linalg.norm(towards), atol=_ROUNDING
    )


@pytest.mark.slow
def test_a_far_sky_can_move_behind_a_polyline():
    """Offsets grow with distance: otherwise the last segment would hardly turn."""
    config = _config("raydef_polyline", "unbounded", far=1000.0)
    params = _with_offset(_trained(config), position=(0.3, 0.0, 0.0))
    line = polylines.whole_path(_path())
    warp = volume_rendering.distance_warp(config, line)
    bent, _ = learned_media.bend(params.field, config.field, config.domain, line, warp, _ONE)
    assert np.linalg.norm(bent.directions[-1] - line.directions[0]) > 0.2
    end = volume_rendering.distance_warp(config, bent).far
    last = polylines.point_at(bent, end)
    straight = line.points[0] + 1000.0 * line.directions[0]
    apart = np.linalg.norm(last.position - straight) / np.linalg.norm(straight)
    across = np.linalg.norm(np.cross([0.3, 0.0, 0.0], line.directions[0]))
    np.testing.assert_allclose(apart, across, rtol=1e-2)


# --- gradients ---


@functools.partial(jax.jit, static_argnums=1)
@jax.grad
def _slopes_of_colours(params, config, path):
    return jnp.sum(_seen(config, params, path).composite.rgb)


@pytest.mark.slow
@_cases(_OFTEN[1:])
def test_colours_train_the_deformation(kind, space):
    config = _config(kind, space)
    slopes = _slopes_of_colours(_trained(config), config, _path())
    assert gradients.all_finite(slopes)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(slopes.field.deformation))
    # Also where all offsets are 0, as at the beginning: with zero steps, and zero lengths.
    slopes = _slopes_of_colours(_with_offset(_trained(config)), config, _path())
    assert gradients.all_finite(slopes)


@pytest.mark.slow
def test_proposals_do_not_train_the_deformation():
    config = _config("raydef")

    @functools.partial(jax.jit, static_argnums=1)
    @jax.grad
    def slopes(params, level):
        return jnp.sum(jnp.square(_seen(config, params).histograms[level].weights))

    params = _trained(config)
    first = slopes(params, 0)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(first.field))
    assert any(np.any(leaf) for leaf in jax.tree.leaves(first.proposals))
    last = slopes(params, -1)
    assert any(np.any(leaf) for leaf in jax.tree.leaves(last.field.deformation))


@pytest.mark.slow
def test_the_end_of_the_training_is_the_default_progress():
    config = _config("raydef")
    params, still = _trained(config), Jitter(jnp.zeros(2), jnp.zeros(2))
    half, done = (
        _radiance(params, config, _path(), still, _ONE, progress=jnp.float32(x)).composite
        for x in (0.02, 1.0)
    )
    np.testing.assert_allclose(_seen(config, params).composite.rgb, done.rgb, atol=1e-6)
    assert np.max(np.abs(half.rgb - done.rgb)) > 1e-4


# --- what asks for a point alone ---


@pytest.mark.parametrize("kind", _KINDS)
def test_a_point_alone_has_no_colour(kind):
    config = _config(kind)
    params = _trained(config)
    with pytest.raises(ValueError, match=f"A point has no colour in fields of kind {kind}"):
        look_up(params, config, jnp.zeros(3), jnp.eye(3)[0], width=0.1)
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    model = Model(config, STRAIGHT, scene, params)
    ray = jax.tree.map(lambda x: x[0], scenes.rays([[-4.0, 0.2, 0.3]], [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=rf"of kind {kind}\. Use render_rays"):
        render_ray(model, ray)
