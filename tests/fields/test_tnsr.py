"""TNSR's field: the surface is that of NeuS, and only the field around it is seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import neus, registry, tnsr
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.geometry.surfaces import slope
from refref_jax.sampling.polylines import Gaussians
from tests.factories.small_model import initial_field

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_CENTRE, _RADIUS = (0.3, -0.2, 0.1), 2.0
_TOWARDS = jnp.array([0.36, 0.48, 0.8], jnp.float32)


_seen = jax.jit(registry.radiance, static_argnums=1)


def _config(**changes):
    return tnsr.TnsrConfig(
        _GRID,
        density_width=8,
        bottleneck=4,
        colour_width=8,
        colour_depth=1,
        around=_GRID,
        **changes,
    )


def _trained(config):
    """Returns parameters as after training: large entries, and biases that are not 0."""
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda x: jnp.float32(0.6 * rng.normal(size=x.shape)), initial_field(config)
    )


def _surface(params, config):
    return tnsr.level_set(params, config, centre=_CENTRE, radius=_RADIUS)


def test_the_initial_surface_is_a_ball():
    config = _config(start=0.4)
    params = initial_field(config)
    points = jnp.float32(np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)))
    found = jax.jit(lambda x: _surface(params, config).values(x))(points)
    expected = np.linalg.norm(np.asarray(points) - _CENTRE, axis=-1) - 0.4 * _RADIUS
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_values_and_slopes_are_those_of_neus():
    """Slopes are differences, of values that `neus.radiance` returns for the same parameters."""
    config = _config()
    params, surface = _trained(config), _surface(_trained(config), config)
    opaque, point = tnsr.opaque(config), jnp.array([0.5, 0.3, -0.4], jnp.float32)

    @jax.jit
    def value(x):
        cell = (x - jnp.asarray(_CENTRE)) / _RADIUS * config.ball_radius + 0.5
        seen = neus.radiance(params, opaque, Gaussians(cell[None], jnp.zeros(1)), _TOWARDS)
        return _RADIUS * seen.signed

    values = jax.jit(lambda at: surface.values(at))
    np.testing.assert_allclose(values(point[None])[0], value(point), rtol=1e-5)
    step = 2.0 * _RADIUS / _GRID.max_res
    moves = np.float32(step * np.eye(3))
    ends = [[value(np.asarray(point) + s * move) for move in moves] for s in (1, -1)]
    expected = (np.array(ends[0]) - np.array(ends[1])) / (2.0 * step)
    np.testing.assert_allclose(jax.jit(slope)(surface, point), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "seen"),
    [((0.5, 0.5, 0.6), False), ((0.2, 0.1, 0.05), False), ((0.8, 0.9, 0.95), True)],
    ids=["in the ball", "in front of it", "behind it"],
)
def test_light_comes_from_behind_the_ball_only(place, seen):
    config = _config()
    params = _trained(config)
    at = Gaussians(jnp.asarray(place, jnp.float32)[None], jnp.zeros(1, jnp.float32))
    found = _seen(params, config, at, _TOWARDS)
    assert (float(found.density) > 0.0) == seen
    around = _seen(params, tnsr.opaque(config), at, _TOWARDS)
    if seen:
        np.testing.assert_allclose(found.density, around.density, rtol=1e-5)
        np.testing.assert_allclose(found.rgb, around.rgb, rtol=1e-5)


@pytest.mark.slow
def test_an_index_is_learned_within_bounds():
    given, learned = _config(index=1.4), _config(index=1.4, index_from="learned")
    params = initial_field(given)
    assert params.index_change is None
    np.testing.assert_allclose(tnsr.index_of(params, given), 1.4, rtol=1e-6)
    params = initial_field(learned)
    move = lambda change: tnsr.index_of(params._replace(index_change=jnp.float32(change)), learned)
    least, most = tnsr.INDICES
    share = (1.4 - least) / (most - least)
    pace = 4.0 * share * (1.0 - share) * neus.PACE  # the slope of the sigmoid, at most 1
    np.testing.assert_allclose(move(0.0), 1.4, rtol=1e-6)
    np.testing.assert_allclose((move(0.1) - move(-0.1)) / 0.2, pace, rtol=1e-3)
    np.testing.assert_allclose([move(-1e3), move(1e3)], tnsr.INDICES, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"index": 1.0}, r"index of a surface is 1\.0\. Give surface_index a number"),
        ({"index": 7.0}, r"index of a surface is 7\.0"),
        ({"straight": 1.0}, r"share of steps with straight rays is 1\.0\. Give straight_share 0"),
    ],
)
def test_wrong_shapes_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        _config(**changes)


def test_the_opaque_field_has_the_same_parameters():
    config = _config(start=0.3, sharpness=30.0)
    opaque = tnsr.opaque(config)
    assert isinstance(opaque, neus.NeusConfig) and tnsr.opaque(opaque) is opaque
    assert (opaque.start, opaque.sharpness, opaque.around) == (0.3, 30.0, _GRID)
    one, other = (
        jax.eval_shape(lambda c=c: registry.init_radiance(jax.random.key(0), c))
        for c in (config, opaque)
    )
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert dataclasses.replace(config) == config and hash(config) != hash(opaque)
