"""Errors of distances over a mask: their means and the roots of their mean squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax import metrics
from tests.laws import gradients, transformations

_SHAPE = (14, 17)

_ERRORS = (metrics.mean_absolute_error, metrics.root_mean_square_error)


def _distances(seed=0):
    rendered, target = np.random.default_rng(seed).uniform(0.1, 10.0, (2, *_SHAPE))
    return jnp.asarray(rendered, jnp.float32), jnp.asarray(target, jnp.float32)


def _mask():
    mask = np.zeros(_SHAPE, bool)
    mask[3:9, 4:15] = True
    return jnp.asarray(mask)


def test_both_by_hand():
    rendered = jnp.array([[1.0, 2.0], [3.0, 9.0]])
    target = jnp.array([[1.5, 2.0], [2.0, 0.0]])
    mask = jnp.array([[True, True], [True, False]])
    # Errors of 0.5, 0 and 1: their mean is 1.5 / 3, that of their squares 1.25 / 3.
    np.testing.assert_allclose(metrics.mean_absolute_error(rendered, target, mask), 0.5)
    got = metrics.root_mean_square_error(rendered, target, mask)
    np.testing.assert_allclose(got, np.sqrt(1.25 / 3.0), rtol=1e-6)


def test_both_against_float64():
    rendered, target = _distances()
    mask = np.asarray(_mask())
    pairs = zip(np.asarray(rendered)[mask], np.asarray(target)[mask], strict=True)
    errors = np.array([abs(float(a) - float(b)) for a, b in pairs])
    got = [error(rendered, target, _mask()) for error in _ERRORS]
    np.testing.assert_allclose(got, [errors.mean(), np.sqrt((errors**2).mean())], rtol=1e-6)


@pytest.mark.parametrize("error", _ERRORS)
@pytest.mark.parametrize("elsewhere", [np.inf, -np.inf, np.nan, 1e30])
def test_what_is_outside_the_mask_counts_for_nothing(error, elsewhere):
    rendered, target = _distances()
    expected = error(rendered, target, _mask())
    missing = jnp.where(_mask(), target, elsewhere)
    assert error(rendered, missing, _mask()) == expected
    blind = jnp.where(_mask(), rendered, elsewhere)
    assert error(blind, target, _mask()) == expected
    assert gradients.all_finite(jax.grad(error)(blind, missing, _mask()))


@pytest.mark.parametrize("error", _ERRORS)
def test_over_nothing_both_are_undefined(error):
    assert np.isnan(error(*_distances(), jnp.zeros_like(_mask())))


@pytest.mark.parametrize("error", _ERRORS)
def test_what_is_not_seen_is_infinitely_wrong(error):
    rendered, target = _distances()
    assert error(rendered.at[4, 5].set(jnp.inf), target, _mask()) == jnp.inf


@pytest.mark.parametrize("error", _ERRORS)
def test_equal_distances_have_no_error_and_no_slope(error):
    _, target = _distances()
    assert error(target, target, _mask()) == 0.0
    slope = jax.grad(error)(target, target, _mask())
    assert gradients.all_finite(slope)
    assert np.all(np.asarray(slope)[~np.asarray(_mask())] == 0.0)


@pytest.mark.parametrize("error", _ERRORS)
def test_check_grads(error):
    rendered, target = (np.asarray(x, np.float64) for x in _distances())
    gradients.assert_numerical(lambda x: error(x, jnp.asarray(target), _mask()), rendered)


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("error", _ERRORS)
def test_transformations_change_nothing(error, transformation):
    items = [(*_distances(seed), _mask()) for seed in range(2)]
    transformation(error, jax.tree.map(lambda *x: jnp.stack(x), *items))
