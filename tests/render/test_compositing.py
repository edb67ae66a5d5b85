import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.render import volume_rendering
from tests.factories.arrays import singles
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# A dozen float32 products and sums.
_SUMMATION = 2e-6

_SAMPLES = 8

_weigh = jax.jit(volume_rendering.alpha_weights)
_close = jax.jit(volume_rendering.opaque_end)
_composite = jax.jit(volume_rendering.composite)

# What the factors of a medium's depth may be multiplied by, as in the tests of Zip-NeRF.
_MULTIPLIERS = [0.0, 1e-10, 1.0, 1e10, 1e30]


def _medium(seed=0):
    """Returns densities and lengths whose products are of about 0.3."""
    rng = np.random.default_rng(seed)
    return singles(rng.uniform(0.1, 3.0, size=_SAMPLES), rng.uniform(0.1, 0.3, size=_SAMPLES))


def _see(weights, *, edges=None, rgb=None):
    count = len(weights)
    edges = np.linspace(0.0, count, count + 1) if edges is None else edges
    rgb = np.ones((count, 3)) if rgb is None else rgb
    return _composite(*singles(weights, rgb, edges))


def test_alpha_weights_by_hand():
    # Each sample takes half of what reaches it, and the last one everything.
    half = np.log(2.0)
    got = _weigh(*singles([half, 2.0 * half, 1e10], [1.0, 0.5, 1.0]))
    np.testing.assert_allclose(got, [0.5, 0.25, 0.25], rtol=_SUMMATION)


@pytest.mark.parametrize("seed", range(3))
def test_alpha_weights_against_a_loop(seed):
    density, lengths = _medium(seed)
    expected = reference_sampling.alpha_weights(density, lengths)
    np.testing.assert_allclose(_weigh(density, lengths), expected, rtol=_SUMMATION)


@pytest.mark.parametrize("density_scale", [0.0, 1e-10, 1e-5, 1.0, 1e5, 1e10])
@pytest.mark.parametrize("length_scale", [1e-10, 1e-3, 1.0, 1e3, 1e6])
def test_alpha_weights_over_magnitudes(density_scale, length_scale):
    density, lengths = _medium()
    density, lengths = np.float32(density_scale) * density, np.float32(length_scale) * lengths
    expected = reference_sampling.alpha_weights(density, lengths)
    got = _weigh(*singles(density, lengths))
    # Light that many samples have dimmed keeps the error of the exponent: up to 1e-6 times 100.
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-37)


@jax.jit
def _weights_and_gradients(density, lengths):
    # A sum over unequal factors, so that no gradient cancels.
    factors = jnp.arange(1.0, _SAMPLES + 1.0)
    total = lambda *x: jnp.sum(factors * volume_rendering.alpha_weights(*x))
    gradient = jax.grad(total, argnums=(0, 1))(density, lengths)
    return volume_rendering.alpha_weights(density, lengths), gradient


@pytest.mark.parametrize("density_scale", _MULTIPLIERS)
@pytest.mark.parametrize("length_scale", _MULTIPLIERS)
def test_alpha_weights_are_finite_with_their_gradients(density_scale, length_scale):
    density, lengths = (
        np.float32(scale) * np.asarray(x)
        for x, scale in zip(_medium(), (density_scale, length_scale), strict=True)
    )
    weights, gradient = _weights_and_gradients(*singles(density, lengths))
    assert gradients.all_finite((weights, gradient))
    assert (np.asarray(weights) >= 0.0).all() and np.sum(weights) <= 1.0 + _SUMMATION


@pytest.mark.parametrize("density_scale", _MULTIPLIERS)
def test_a_length_that_rounding_made_negative_holds_nothing(density_scale):
    density, lengths = _medium()
    density, negative = density * jnp.float32(density_scale), lengths.at[2].set(-1e-6)
    weights, gradient = _weights_and_gradients(density, negative)
    np.testing.assert_array_equal(weights, _weigh(density, lengths.at[2].set(0.0)))
    assert gradients.all_finite(gradient)


@pytest.mark.parametrize("place", [0, 3, _SAMPLES - 1])
@pytest.mark.parametrize("size", [1e10, 1e30, 3e38])
def test_one_opaque_sample_takes_all_the_light_that_reaches_it(place, size):
    density, lengths = np.zeros(_SAMPLES), np.ones(_SAMPLES)
    density[place] = size
    weights, gradient = _weights_and_gradients(*singles(density, lengths))
    np.testing.assert_array_equal(weights, np.eye(_SAMPLES)[place])
    assert gradients.all_finite(gradient)


def test_alpha_weights_check_grads():
    gradients.assert_numerical(volume_rendering.alpha_weights, *_medium())


@pytest.mark.parametrize("scale", [0.0, 1e-10, 0.1, 1.0, 1e10])
def test_an_opaque_end_makes_the_weights_sum_to_one(scale):
    density, lengths = _medium()
    weights = _close(_weigh(*singles(scale * np.asarray(density), lengths)))
    np.testing.assert_allclose(np.sum(weights), 1.0, rtol=_SUMMATION)
    assert (np.asarray(weights) >= 0.0).all()


def test_an_opaque_end_by_hand():
    np.testing.assert_allclose(_close(*singles([0.25, 0.5, 0.0])), [0.25, 0.5, 0.25])
    np.testing.assert_allclose(_close(*singles([0.75, 0.5, 0.1])), [0.75, 0.5, 0.0])


def test_an_opaque_end_check_grads():
    gradients.assert_numerical(volume_rendering.opaque_end, _weigh(*_medium()))


def test_composite_sums_colours_by_hand():
    seen = _see([0.5, 0.25], rgb=[[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
    np.testing.assert_allclose(seen.rgb, [0.5, 0.25, 0.375], rtol=_SUMMATION)
    np.testing.assert_allclose(seen.accumulation, 0.75, rtol=_SUMMATION)


# --- distances ---


def test_median_by_hand():
    edges = [1.0, 2.0, 4.0, 5.0]
    # Half of the light has come after 0.3 of 0.6 of the second interval.
    np.testing.assert_allclose(_see([0.2, 0.6, 0.2], edges=edges).median, 3.0, rtol=_SUMMATION)
    np.testing.assert_allclose(_see([0.0, 0.0, 1.0], edges=edges).median, 4.5, rtol=_SUMMATION)


def test_the_median_lies_between_two_equal_halves():
    assert 2.0 <= _see([0.5, 0.0, 0.5], edges=[1.0, 2.0, 4.0, 5.0]).median <= 4.0


def test_mean_by_hand():
    seen = _see([0.2, 0.6, 0.2], edges=[1.0, 2.0, 4.0, 5.0])
    np.testing.assert_allclose(seen.mean, 0.2 * 1.5 + 0.6 * 3.0 + 0.2 * 4.5, rtol=_SUMMATION)
    np.testing.assert_allclose(
        _see([0.1, 0.3, 0.1], edges=[1.0, 2.0, 4.0, 5.0]).mean, seen.mean, rtol=_SUMMATION
    )


@pytest.mark.parametrize("seed", range(5))
def test_distances_against_a_loop(seed):
    rng = np.random.default_rng(seed)
    weights = np.float32(rng.uniform(size=_SAMPLES) ** 4)
    weights *= np.float32(rng.uniform(0.55, 1.0)) / weights.sum()
    edges = np.float32(np.cumsum(rng.uniform(0.1, 2.0, size=_SAMPLES + 1)))
    seen = _see(weights, edges=edges)
    expected = reference_sampling.median_distance(weights, edges)
    np.testing.assert_allclose(seen.median, expected, rtol=1e-5)
    middles = 0.5 * (edges[1:].astype(np.float64) + edges[:-1])
    np.testing.assert_allclose(seen.mean, np.average(middles, weights=weights), rtol=1e-5)


def test_the_median_finds_a_translucent_surface_in_front_of_a_wall():
    edges = np.linspace(0.0, 8.0, 9)
    front = np.eye(8)[2]
    assert 2.0 <= _see(0.6 * front + 0.4 * np.eye(8)[7], edges=edges).median <= 3.0
    assert 7.0 <= _see(0.4 * front + 0.6 * np.eye(8)[7], edges=edges).median <= 8.0


@pytest.mark.parametrize(("front", "median"), [(0.0, 8.0), (0.4, 8.0), (0.6, 2.0 + 0.5 / 0.6)])
def test_a_surface_at_the_end_is_at_its_end(front, median):
    weights = front * np.eye(8)[2] + (1.0 - front) * np.eye(8)[7]
    arrays = singles(weights, np.ones((8, 3)), np.linspace(0.0, 8.0, 9))
    seen = volume_rendering.composite(*arrays, last_sample="end")
    np.testing.assert_allclose(seen.mean, front * 2.5 + (1.0 - front) * 8.0, rtol=_SUMMATION)
    np.testing.assert_allclose(seen.median, median, rtol=_SUMMATION)


def test_nothing_is_at_an_infinite_distance():
    seen = _see(np.zeros(_SAMPLES))
    assert seen.median == seen.mean == jnp.inf
    assert seen.accumulation == 0.0


@pytest.mark.parametrize(("total", "found"), [(0.49, False), (0.4999, False), (0.51, True)])
def test_the_median_is_infinite_where_less_than_half_of_the_light_is_found(total, found):
    seen = _see(total * np.full(_SAMPLES, 1.0 / _SAMPLES))
    assert np.isfinite(seen.median) == found
    np.testing.assert_allclose(seen.mean, 0.5 * _SAMPLES, rtol=_SUMMATION)


@jax.jit
def _composite_gradients(density, lengths, rgb):
    def total(density, lengths, rgb):
        weights = volume_rendering.alpha_weights(density, lengths)
        edges = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths)])
        seen = volume_rendering.composite(weights, rgb, edges)
        finite = jnp.where(jnp.isfinite(seen.median), seen.median, 0.0)
        finite += jnp.where(jnp.isfinite(seen.mean), seen.mean, 0.0)
        return jnp.sum(seen.rgb) + seen.accumulation + finite

    return jax.grad(total, argnums=(0, 1, 2))(density, lengths, rgb)


# Past 1e10 the distances themselves have no finite squares.
@pytest.mark.parametrize("density_scale", _MULTIPLIERS)
@pytest.mark.parametrize("length_scale", _MULTIPLIERS[:-1])
def test_gradients_of_colour_and_distances_are_finite(density_scale, length_scale):
    density, lengths = (np.asarray(x) for x in _medium())
    scaled = np.float32(density_scale) * density, np.float32(length_scale) * lengths
    assert gradients.all_finite(_composite_gradients(*singles(*scaled, np.ones((_SAMPLES, 3)))))


def test_composite_check_grads():
    weights, rgb = np.asarray(_weigh(*_medium())), np.random.default_rng(0).uniform(size=(8, 3))
    edges = np.linspace(1.0, 3.0, _SAMPLES + 1)
    gradients.assert_numerical(
        lambda *x: tuple(volume_rendering.composite(*x)), weights, rgb, edges, rtol=1e-4
    )


_CASES = {
    "alpha_weights": lambda density, lengths: volume_rendering.alpha_weights(density, lengths),
    "opaque_end": lambda density, lengths: volume_rendering.opaque_end(0.1 * density),
    "composite": lambda density, lengths: volume_rendering.composite(
        0.05 * density, jnp.stack([density, lengths, density], axis=-1), jnp.append(lengths, 9.0)
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    items = [_medium(seed) for seed in range(3)]
    transformation(_CASES[name], tuple(jnp.stack(x) for x in zip(*items, strict=True)))
