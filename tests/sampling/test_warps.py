import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.sampling import scene_bounds
from refref_jax.sampling.scene_bounds import DistanceWarp
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

_EPSILON = float(np.finfo(np.float32).eps)

_WARPS = [
    DistanceWarp(near=0.05, far=15.0, unit=3.0),
    DistanceWarp(near=0.05, far=1000.0, unit=2.0),
    DistanceWarp(near=0.05, far=1e6, unit=1.0),
    DistanceWarp(near=0.0, far=1000.0, unit=2.0),
]

# The transformed distance is a float32 of about 1; where the warp flattens, one unit in its last
# place is a long way. Every operation of the warp may cost about one.
_OPERATIONS = 4.0


_to_distance = jax.jit(scene_bounds.to_distance, static_argnums=0)
_to_unit = jax.jit(scene_bounds.to_unit, static_argnums=0)


def _slope(warp, t):
    """Returns `dt / ds` at a distance."""
    step = 1e-6 * np.maximum(t, 1e-6 * warp.unit)
    low, high = (
        reference_sampling.warped_distance(*warp, x) for x in (t - 0.5 * step, t + 0.5 * step)
    )
    return step / (high - low)


def _tolerance(warp, t):
    """Returns how far rounding may move a distance: by way of `s`, and where it is formed."""
    return _OPERATIONS * _EPSILON * (_slope(warp, t) + t + warp.unit)


def _distances(warp, count=200):
    first = warp.near or 1e-6 * warp.unit
    return np.concatenate([[warp.near], np.geomspace(first, warp.far, count)[1:]])


@pytest.mark.parametrize("warp", _WARPS)
def test_to_unit_against_the_power_transformation(warp):
    t = _distances(warp)
    expected = reference_sampling.warped_distance(*warp, t)
    got = _to_unit(warp, jnp.asarray(t, jnp.float32))
    np.testing.assert_allclose(got, expected, atol=_OPERATIONS * _EPSILON)


@pytest.mark.parametrize("warp", _WARPS)
def test_to_distance_against_the_power_transformation(warp):
    s = np.linspace(0.0, 1.0, 101, dtype=np.float32)
    t = np.asarray(_to_distance(warp, jnp.asarray(s)), np.float64)
    back = reference_sampling.warped_distance(*warp, t)
    np.testing.assert_allclose(back, s, atol=_OPERATIONS * _EPSILON)


def test_to_unit_by_hand():
    # In units of 1.25 the distances are 0, 3 and 8, whose ladders are 1, 1/8 and 1/27.
    warp = DistanceWarp(near=0.0, far=10.0, unit=1.0)
    s = _to_unit(warp, jnp.float32(3.75))
    np.testing.assert_allclose(s, (1.0 - 1.0 / 8.0) / (1.0 - 1.0 / 27.0), rtol=1e-6)


@pytest.mark.parametrize("warp", _WARPS)
def test_to_distance_meets_both_ends(warp):
    near, far = _to_distance(warp, jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(near, warp.near, atol=_OPERATIONS * _EPSILON * warp.unit)
    np.testing.assert_allclose(far, warp.far, rtol=_OPERATIONS * _EPSILON)


@pytest.mark.parametrize("warp", _WARPS)
def test_to_unit_meets_both_ends(warp):
    ends = _to_unit(warp, jnp.array([warp.near, warp.far]))
    np.testing.assert_allclose(ends, [0.0, 1.0], atol=_OPERATIONS * _EPSILON)


@pytest.mark.parametrize("warp", _WARPS)
def test_the_unit_coordinate_survives_a_round_trip(warp):
    s = jnp.linspace(0.0, 1.0, 1001)
    back = _to_unit(warp, _to_distance(warp, s))
    np.testing.assert_allclose(back, s, atol=_OPERATIONS * _EPSILON)


@pytest.mark.parametrize("warp", _WARPS)
def test_distances_survive_a_round_trip(warp):
    # Beyond 1e4 units one float32 step of `s` is more than a hundredth of the distance.
    t = _distances(warp)
    t = t[t < 1e4 * warp.unit]
    back = np.asarray(_to_distance(warp, _to_unit(warp, jnp.asarray(t, jnp.float32))))
    assert (abs(back - t) <= _tolerance(warp, t)).all()


@pytest.mark.parametrize("warp", _WARPS)
def test_to_distance_increases(warp):
    t = np.asarray(_to_distance(warp, jnp.linspace(0.0, 1.0, 10001)))
    assert (np.diff(t) > 0.0).all()


@pytest.mark.parametrize("warp", _WARPS)
def test_to_unit_increases(warp):
    s = np.asarray(_to_unit(warp, jnp.asarray(_distances(warp), jnp.float32)))
    assert (np.diff(s) >= 0.0).all()


def test_equal_steps_grow_from_about_the_scenes_size():
    warp = DistanceWarp(near=0.05, far=1000.0, unit=2.0)
    t = np.asarray(_to_distance(warp, jnp.linspace(0.0, 1.0, 1001)))
    steps = np.diff(t) / (t[1] - t[0])
    assert steps[np.searchsorted(t, 0.2 * warp.unit)] < 2.0
    assert steps[np.searchsorted(t, 10.0 * warp.unit)] > 10.0


@pytest.mark.parametrize("warp", _WARPS)
def test_to_unit_holds_distances_outside_the_interval(warp):
    got = _to_unit(warp, jnp.array([0.0, 0.5 * warp.near, 2.0 * warp.far, 1e30]))
    np.testing.assert_array_equal(got, [0.0, 0.0, 1.0, 1.0])


@pytest.mark.parametrize("warp", _WARPS)
def test_gradients_are_finite_and_positive(warp):
    s = jnp.linspace(0.0, 1.0, 101)
    slope = jax.jit(jax.vmap(jax.grad(functools.partial(scene_bounds.to_distance, warp))))(s)
    assert np.isfinite(slope).all() and (slope > 0.0).all()
    t = jnp.asarray(_distances(warp), jnp.float32)
    slope = jax.jit(jax.vmap(jax.grad(functools.partial(scene_bounds.to_unit, warp))))(t)
    assert np.isfinite(slope).all() and (slope[1:-1] > 0.0).all()


def test_check_grads():
    warp = _WARPS[0]
    gradients.assert_numerical(functools.partial(scene_bounds.to_distance, warp), [0.1, 0.5, 0.9])
    gradients.assert_numerical(functools.partial(scene_bounds.to_unit, warp), [0.1, 1.0, 10.0])


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("function", [scene_bounds.to_distance, scene_bounds.to_unit])
def test_transformations_change_nothing(function, transformation):
    transformation(functools.partial(function, _WARPS[0]), (jnp.array([0.1, 0.5, 0.9]),))
