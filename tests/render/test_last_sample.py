"""The last interval of a path is opaque: a field evaluated at its end is a painted wall."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import registry
from refref_jax.fields.base import Radiance
from refref_jax.optics.light_paths import Stop
from refref_jax.render import pixels, volume_rendering
from refref_jax.render.model import Params
from refref_jax.render.volume_rendering import Jitter
from tests.factories import made_paths
from tests.factories.small_model import MODEL, initial

_MIDDLE = dataclasses.replace(MODEL, interior="clear", last_sample="middle")
_END = dataclasses.replace(_MIDDLE, last_sample="end")

# Positions in the unit cube, at distances of about 15.
_ROUNDING = 1e-5

_RADIUS = 1e-3


def _bent():
    """Returns a path through a slab, which is not sampled inside."""
    return made_paths.path(
        [3.0, 2.0],
        [[0, 0, 1], [0.3, 0, 1], [0.4, -0.2, 1]],
        (0, 1, 0),
        origin=(0.0, 0.0, -4.0),
        radius=_RADIUS,
    )


def _head_on():
    return made_paths.path([], [[0, 0, 1]], [0], origin=(0.5, -0.3, -4.0), radius=_RADIUS)


def _sample(config, path, *, count=4, offset=0.0):
    return _samples(config, jax.tree.map(jnp.asarray, path), count, jnp.float32(offset))


@functools.partial(jax.jit, static_argnums=(0, 2))
def _samples(config, path, count, offset):
    line = volume_rendering.polyline(config, path)
    warp = volume_rendering.distance_warp(config, line)
    jitter = Jitter(offset, jnp.float32(0.2))
    return volume_rendering.sample(
        config, line, warp, [], count, jitter=jitter, anneal=jnp.float32(1.0)
    )


def _exit(path, order):
    """Returns where the last segment reaches the bounds, by bisection in float64."""
    last = int(path.num_bends)
    start = np.asarray(path.points[last], np.float64)
    direction = np.asarray(path.directions[last], np.float64)
    low, high = 0.0, 100.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        inside = np.linalg.norm(start + middle * direction, order) < MODEL.radius
        low, high = (middle, high) if inside else (low, middle)
    return start + low * direction, float(path.tau[last]) + low


def _in_unit_cube(point):
    return 0.5 * np.asarray(point) / MODEL.radius + 0.5


def _paint(monkeypatch, fog):
    """Has all fields show the position as colour, times a parameter, and the density `fog`."""

    def radiance(strength, field, gaussians, direction):
        del field, direction
        density = jnp.full_like(strength, fog)
        return Radiance(density, strength * jnp.mean(gaussians.positions, axis=0))

    monkeypatch.setattr(registry, "density", lambda strength, *_: jnp.full_like(strength, fog))
    monkeypatch.setattr(registry, "radiance", radiance)


def _render_painted(monkeypatch, config, path, *, offset=0.0, fog=0.0, strength=1.0):
    """Returns what is seen of a path, and the derivatives of its colour by the strength."""
    _paint(monkeypatch, fog)
    return _painted(config, fog)(
        jnp.float32(strength), made_paths.stack([path]), jnp.float32(offset)
    )


@functools.cache
def _painted(config, fog):
    """Returns the program that renders paths through fields that `_paint` has painted."""
    del fog  # Part of what is compiled.

    def see(strength, paths, offset):
        jitter = Jitter(jnp.full((1, 2), offset), jnp.full((1, 2), 0.2, jnp.float32))
        params = Params(proposals=(strength,), field=strength)
        seen = pixels.render_paths(params, config, paths, jitter, anneal=jnp.float32(1.0))
        return seen.composite.rgb[0], seen.composite

    slopes = jax.jacrev(see, has_aux=True)
    return jax.jit(lambda *arguments: slopes(*arguments)[::-1])


@pytest.mark.slow
@pytest.mark.parametrize("multisamples", [1, 6])
@pytest.mark.parametrize("offset", [-0.4, 0.0, 0.3])
@pytest.mark.parametrize(
    ("space", "order"),
    [("bounded", np.inf), ("spherical", 2)],
)
def test_a_painted_wall_is_seen_exactly(monkeypatch, space, order, offset, multisamples):
    config = dataclasses.replace(_END, space=space, multisamples=multisamples, samples=2)
    wall = _in_unit_cube(_exit(_bent(), order)[0])
    got = _render_painted(monkeypatch, config, _bent(), offset=offset)[0].rgb[0]
    # Of the six points around the end of the path, three may lie beyond the wall.
    footprint = 0.0 if multisamples == 1 else _RADIUS
    np.testing.assert_allclose(got, wall, atol=_ROUNDING + footprint)
    _, gradient = _render_painted(monkeypatch, config, _bent(), offset=offset, strength=2.0)
    np.testing.assert_allclose(gradient, got, atol=_ROUNDING)
    before = dataclasses.replace(config, last_sample="middle")
    short, _ = _render_painted(monkeypatch, before, _bent(), offset=offset)
    assert np.max(np.abs(np.asarray(short.rgb[0]) - wall)) > 0.01


def test_an_opaque_surface_is_seen_where_the_path_ends_on_it(monkeypatch):
    path = _bent()
    stopped = path._replace(stop=Stop(path.tau[2] + jnp.float32(2.0), None))
    point = np.asarray(path.points[2]) + 2.0 * np.asarray(path.directions[2])
    got, _ = _render_painted(monkeypatch, _END, stopped)
    np.testing.assert_allclose(got.rgb[0], _in_unit_cube(point), atol=_ROUNDING)


def _distances(monkeypatch, config, path, *, fog=0.0):
    """Returns the median and mean distances of a path."""
    seen, _ = _render_painted(monkeypatch, config, path, fog=fog)
    return np.array([seen.median[0], seen.mean[0]])


@pytest.mark.slow
@pytest.mark.parametrize("samples", [2, 5])
@pytest.mark.parametrize(("space", "order"), [("bounded", np.inf), ("spherical", 2)])
def test_a_wall_is_as_far_as_the_end_of_the_path(monkeypatch, space, order, samples):
    config = dataclasses.replace(_END, space=space, samples=samples)
    arc = _exit(_bent(), order)[1]
    np.testing.assert_allclose(_distances(monkeypatch, config, _bent()), arc, rtol=1e-5)
    middle = dataclasses.replace(config, last_sample="middle")
    assert np.all(_distances(monkeypatch, middle, _bent()) < arc - 0.1)


@pytest.mark.slow
def test_the_distance_of_what_is_in_front_of_the_wall_is_as_before(monkeypatch):
    seen = [_distances(monkeypatch, config, _bent(), fog=1e3) for config in (_MIDDLE, _END)]
    np.testing.assert_array_equal(*seen)


@pytest.mark.slow
def test_what_is_in_front_of_the_wall_hides_it_as_before(monkeypatch):
    seen = [_render_painted(monkeypatch, config, _bent(), fog=1e3)[0] for config in (_MIDDLE, _END)]
    np.testing.assert_array_equal(*(each.rgb for each in seen))


@pytest.mark.parametrize(("space", "order"), [("bounded", np.inf), ("spherical", 2)])
def test_the_footprint_is_that_of_the_wall(space, order):
    point, arc = _exit(_bent(), order)
    found = _sample(dataclasses.replace(_END, space=space), _bent()).gaussians
    np.testing.assert_allclose(found.positions[-1, 0], _in_unit_cube(point), atol=_ROUNDING)
    # A disc's radius is twice its standard deviation along an axis.
    expected = 0.5 * _RADIUS * arc * 0.5 / MODEL.radius
    np.testing.assert_allclose(found.scales[-1, 0], expected, rtol=_ROUNDING)


def test_all_multisamples_of_the_end_lie_in_a_wall_that_is_met_head_on():
    found = _sample(dataclasses.replace(_END, multisamples=6), _head_on()).gaussians
    point, arc = _exit(_head_on(), np.inf)
    offsets = np.asarray(found.positions[-1]) - _in_unit_cube(point)
    np.testing.assert_allclose(offsets[:, 2], 0.0, atol=1e-7)
    np.testing.assert_allclose(np.mean(offsets, axis=0), 0.0, atol=1e-6)
    radii = np.linalg.norm(offsets, axis=-1)
    np.testing.assert_allclose(radii, _RADIUS * arc / np.sqrt(2.0) * 0.5 / MODEL.radius, rtol=1e-3)


@pytest.mark.parametrize("multisamples", [1, 6])
def test_only_the_last_interval_is_evaluated_elsewhere(multisamples):
    middle, end = (
        _sample(dataclasses.replace(config, multisamples=multisamples), _bent(), offset=0.2)
        for config in (_MIDDLE, _END)
    )
    np.testing.assert_array_equal(middle.s, end.s)
    np.testing.assert_array_equal(middle.t, end.t)
    for old, new in zip(
        *map(jax.tree.leaves, ((*middle.gaussians, middle.points), (*end.gaussians, end.points))),
        strict=True,
    ):
        np.testing.assert_array_equal(old[:-1], new[:-1])
    assert not np.allclose(middle.gaussians.positions[-1], end.gaussians.positions[-1], atol=0.01)


def test_an_end_behind_a_bend_is_seen_along_the_last_direction():
    # The only inner edge is on the first bend, so the last interval holds the second.
    found = _sample(dataclasses.replace(_END, interior="field"), _bent(), count=2)
    np.testing.assert_allclose(found.t[1], 3.0, rtol=_ROUNDING)
    np.testing.assert_array_equal(found.points.direction[-1], _bent().directions[2])
    assert bool(found.points.outside[-1])


@pytest.mark.slow
@pytest.mark.parametrize("multisamples", [1, 6])
def test_an_unbounded_scene_is_unchanged(multisamples):
    configs = (
        dataclasses.replace(config, space="unbounded", far=1000.0, multisamples=multisamples)
        for config in (_MIDDLE, _END)
    )
    for old, new in zip(*(jax.tree.leaves(_sample(x, _bent())) for x in configs), strict=True):
        np.testing.assert_array_equal(old, new)


@functools.cache
def _brightness(config):
    """Returns the program of the sum of colours of a path, and of its slopes."""

    def brightness(params, points, path):
        paths = made_paths.stack([path._replace(points=points)])
        jitter = pixels.no_jitter(config, 1)
        seen = pixels.render_paths(params, config, paths, jitter, anneal=jnp.float32(1.0))
        return jnp.sum(seen.composite.rgb)

    return jax.jit(jax.value_and_grad(brightness, argnums=(0, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("multisamples", [1, 6])
@pytest.mark.parametrize("distance", [0.0, 7.5, 300.0])
def test_values_and_gradients_are_finite_wherever_the_camera_is(distance, multisamples):
    config = dataclasses.replace(_END, multisamples=multisamples)
    path = made_paths.path([], [[0, 0, 1]], [0], origin=(0.0, 0.0, distance))
    both = _brightness(config)(initial(config), path.points, path)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(both))
    assert any(bool(jnp.any(leaf != 0.0)) for leaf in jax.tree.leaves(both[1][0].field))
