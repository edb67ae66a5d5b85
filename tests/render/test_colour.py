import jax
import numpy as np
import pytest

from refref_jax.render import pixels
from tests.factories.arrays import single
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# A power in float32.
_POWER = 1e-6

_encode = jax.jit(pixels.linear_to_srgb)
_decode = jax.jit(pixels.srgb_to_linear)
_encode_slope = jax.jit(jax.vmap(jax.grad(pixels.linear_to_srgb)))
_decode_slope = jax.jit(jax.vmap(jax.grad(pixels.srgb_to_linear)))

_LINEAR = np.concatenate(
    [[-1.0, -1e-3, 0.0, 1e-30, 0.003130, 0.0031308, 0.003131, 1.0], np.linspace(0.0, 4.0, 101)]
)


@pytest.mark.parametrize(
    ("linear", "srgb"),
    [(0.0, 0.0), (1.0, 1.0), (0.0025, 0.0323), (0.5, 0.7353569), (0.214041, 0.5), (-0.5, -6.46)],
)
def test_linear_to_srgb_by_hand(linear, srgb):
    np.testing.assert_allclose(_encode(single(linear)), srgb, rtol=1e-5, atol=1e-7)


def test_linear_to_srgb_against_float64():
    linear = np.float32(_LINEAR)
    expected = [reference_sampling.linear_to_srgb(x) for x in linear]
    np.testing.assert_allclose(_encode(single(linear)), expected, rtol=_POWER)


def test_srgb_to_linear_inverts():
    np.testing.assert_allclose(_decode(_encode(single(_LINEAR))), single(_LINEAR), rtol=4e-6)
    srgb = np.linspace(-0.5, 1.5, 201)
    np.testing.assert_allclose(_encode(_decode(single(srgb))), srgb, rtol=4e-6, atol=1e-6)


def test_eight_bit_colours_survive():
    srgb = np.arange(256) / 255.0
    back = np.asarray(_encode(_decode(single(srgb)))) * 255.0
    np.testing.assert_array_equal(np.round(back), np.arange(256))


def test_gradient_is_finite_everywhere_and_not_cut_off():
    magnitudes = 10.0 ** np.arange(-30.0, 31.0)
    linear = np.concatenate([-magnitudes, [-0.0, 0.0, 0.0031308], magnitudes])
    slope = np.asarray(_encode_slope(single(linear)), np.float64)
    assert np.isfinite(slope).all() and (slope > 0.0).all()
    np.testing.assert_allclose(slope[linear <= 0.0031308], 12.92, rtol=_POWER)
    above = np.float32(linear[linear > 0.0031308]).astype(np.float64)
    expected = 1.055 / 2.4 * above ** (1.0 / 2.4 - 1.0)
    np.testing.assert_allclose(slope[linear > 0.0031308], expected, rtol=1e-5)


def test_gradient_of_the_inverse_is_finite():
    slope = np.asarray(_decode_slope(single([-1e30, -1.0, 0.0, 0.04045, 1.0, 10.0, 1e10])))
    assert np.isfinite(slope).all() and (slope > 0.0).all()


@pytest.mark.parametrize("function", [pixels.linear_to_srgb, pixels.srgb_to_linear])
def test_check_grads(function):
    gradients.assert_numerical(function, [-0.5, 0.001, 0.2, 1.5], rtol=1e-4)


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("function", [pixels.linear_to_srgb, pixels.srgb_to_linear])
def test_transformations_change_nothing(function, transformation):
    transformation(function, (single([-0.5, 0.0, 0.001, 0.2, 1.5]),))
