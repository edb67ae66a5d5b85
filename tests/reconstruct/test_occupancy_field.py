import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.reconstruct.occupancy_field import (
    Chord,
    at,
    cross_entropy,
    logit_along,
    scan,
    silhouette_logit,
    weights,
)
from tests.factories.arrays import single
from tests.laws import gradients


def _chord(offset=0.0):
    """A chord through the unit cube along x, at some distance from the middle."""
    return Chord(single([-1.0, 0.5 + offset, 0.5]), single([1.0, 0.0, 0.0]), _one(1.0), _one(2.0))


def _one(value):
    return jnp.asarray(value, jnp.float32)


def _ball(position, *, radius=0.25):
    return jnp.linalg.norm(position - 0.5) - radius


_scan = jax.jit(scan, static_argnums=0, static_argnames="samples")


def test_weights_are_known_by_hand():
    found = weights(single([0.5, 0.0, 0.5, 1.0, 0.7]))
    np.testing.assert_allclose(found, [0.5, 0.0, 0.25, 0.25, 0.0], atol=1e-7)


@pytest.mark.parametrize("samples", [1, 2, 5])
def test_the_logit_is_that_of_the_weights_sum(samples):
    logits = np.random.default_rng(1).normal(scale=2.0, size=(40, samples)).astype(np.float32)
    found = jax.nn.sigmoid(jax.vmap(silhouette_logit)(jax.device_put(logits)))
    expected = jax.vmap(lambda x: jnp.sum(weights(jax.nn.sigmoid(x))))(jax.device_put(logits))
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_the_logit_s_derivative_is_that_of_differences():
    gradients.assert_numerical(silhouette_logit, [0.3, -1.0, 0.5])
    gradients.assert_numerical(lambda x: jnp.sum(weights(x) ** 2), [0.3, 0.9, 0.5])


@pytest.mark.parametrize("occupancies", [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 0.0]])
def test_gradients_by_weights_are_finite_where_all_or_nothing_is_stopped(occupancies):
    slopes = jax.grad(lambda x: jnp.sum(weights(x) * jnp.arange(3.0)))(single(occupancies))
    assert gradients.all_finite(slopes)


@jax.jit
@jax.value_and_grad
def _loss(logits, seen):
    return cross_entropy(silhouette_logit(logits), seen)


@pytest.mark.parametrize("size", [0.0, 1.0, 1e3, 1e6, 1e30])
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, -1, -1), (1, -1, -1), (-1, -1, 1)])
@pytest.mark.parametrize("seen", [0.0, 1.0])
def test_the_loss_and_its_gradient_are_finite_for_any_logits(size, signs, seen):
    value, slopes = _loss(size * single(signs), _one(seen))
    assert np.isfinite(value) and value >= 0.0 and gradients.all_finite(slopes)
    pulled, most = np.abs(slopes).sum(), signs.count(max(signs))
    if size > 1.0 and seen == 0.0:
        # Every occupied sample of a ray that should be empty is pulled at fully.
        np.testing.assert_allclose(pulled, most if max(signs) > 0 else 0.0, atol=1e-3)
    elif size > 1.0 and max(signs) < 0:
        # All samples of a ray that should be stopped share one pull, but for rounding.
        assert 0.9 <= pulled <= most


def test_the_cross_entropy_is_known_by_hand():
    for probability in (0.1, 0.5, 0.8):
        logit = _one(np.log(probability / (1.0 - probability)))
        np.testing.assert_allclose(cross_entropy(logit, _one(1.0)), -np.log(probability), rtol=1e-5)
        np.testing.assert_allclose(
            cross_entropy(logit, _one(0.0)), -np.log(1.0 - probability), rtol=1e-5
        )


def test_a_scan_finds_the_deepest_place_and_the_surface():
    found = _scan(_ball, _chord(0.1), _one(0.5), samples=40)
    assert abs(found.deepest - 1.5) <= found.spacing + 1e-6
    assert found.meets == 1.0
    np.testing.assert_allclose(found.surface, 1.5 - np.sqrt(0.25**2 - 0.1**2), atol=2e-3)
    np.testing.assert_allclose(_ball(at(_chord(0.1), found.surface)), 0.0, atol=2e-3)


def test_a_scan_that_meets_nothing_says_where_it_came_closest():
    found = _scan(_ball, _chord(0.3), _one(0.5), samples=40)
    assert found.meets == 0.0
    assert abs(found.surface - 1.5) <= 0.5 / 40 + 1e-6
    assert abs(found.deepest - 1.5) <= found.spacing + 1e-6 and found.spacing < 0.1 / 40


def test_an_edge_between_two_samples_is_found():
    def wedge(position):
        return jnp.sum(jnp.abs(position[:2] - 0.5)) - 0.25

    found = _scan(wedge, _chord(0.245), _one(0.1), samples=10)
    assert abs(found.deepest - 1.5) <= found.spacing + 1e-6
    assert wedge(at(_chord(0.245), found.deepest)) < 0.0


def test_a_scan_that_starts_inside_meets_no_surface():
    chord = _chord()._replace(starts=_one(1.5))
    assert _scan(_ball, chord, _one(0.5), samples=20).meets == 0.0


def test_a_chord_of_no_length_is_seen_as_one_point():
    chord = _chord()._replace(ends=_one(1.0))
    found = _scan(_ball, chord, _one(0.5), samples=4)
    assert all(np.isfinite(value) for value in found) and found.deepest == 1.0
    logit = logit_along(_ball, chord, found, jnp.full(4, 0.5), softness=_one(0.1))
    # Four samples of one point, 0.25 from the ball.
    odds = (1.0 + np.exp(-2.5)) ** 4 - 1.0
    np.testing.assert_allclose(np.exp(logit), odds, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("softness", [0.03, 0.003])
def test_the_outline_of_a_ball_lies_outside_of_it_by_softness_times_log_of_samples(softness):
    offsets = jnp.linspace(0.15, 0.35, 401)

    def logit(offset):
        chord = _chord(offset)
        looked = scan(_ball, chord, _one(0.5), samples=33)
        shifts = jnp.full(4, 0.5)
        return logit_along(_ball, chord, looked, shifts, softness=_one(softness))

    seen = np.asarray(jax.vmap(logit)(offsets)) > 0.0
    outline = float(offsets[np.flatnonzero(seen)[-1]])
    assert np.all(seen[: np.flatnonzero(seen)[-1]])
    assert -1e-3 <= outline - 0.25 <= softness * np.log(4.0) / np.log(2.0) + 1e-3


def test_gradients_reach_the_field_and_none_flow_through_the_scan():
    def total(radius, shift):
        signed = functools.partial(_ball, radius=radius)
        looked = scan(signed, _chord(0.25), shift, samples=33)
        logit = logit_along(signed, _chord(0.25), looked, jnp.full(2, 0.5), softness=_one(0.05))
        return logit + 0.0 * looked.surface

    slope = jax.jit(jax.grad(total))(_one(0.25), _one(0.5))
    assert np.isfinite(slope) and 0.9 / 0.05 < slope < 3.0 / 0.05
    looked = functools.partial(scan, chord=_chord(), shift=_one(0.5), samples=9)

    def deepest(radius):
        return looked(functools.partial(_ball, radius=radius)).deepest

    assert jax.jit(jax.grad(deepest))(_one(0.25)) == 0.0
