import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from refref_jax import metrics
from tests.laws import gradients, transformations

pytestmark = pytest.mark.loose

# Decibels: float32 logarithms of float32 means.
_DECIBELS = 1e-4

# Variances of the window are differences of float32 means.
_SIMILARITY = 2e-5

_SHAPE = (14, 17, 3)


def _images(seed=0):
    target, noise = np.random.default_rng(seed).uniform(size=(2, *_SHAPE)).astype(np.float32)
    return jnp.asarray(np.clip(target + 0.3 * (noise - 0.5), 0.0, 1.0)), jnp.asarray(target)


def _mask():
    mask = np.zeros(_SHAPE[:2], bool)
    mask[3:9, 4:15] = True
    return jnp.asarray(mask)


@pytest.mark.parametrize(("error", "expected"), [(1.0, 0.0), (0.1, 20.0), (0.01, 40.0)])
def test_psnr_by_hand(error, expected):
    target = jnp.zeros(_SHAPE)
    np.testing.assert_allclose(metrics.psnr(target + error, target), expected, atol=_DECIBELS)


def test_psnr_of_equal_images_is_infinite():
    _, target = _images()
    assert metrics.psnr(target, target) == jnp.inf


@pytest.mark.parametrize("error", [1e-10, 1e-5, 1.0, 1e10])
def test_psnr_over_magnitudes(error):
    target = jnp.zeros(_SHAPE)
    got = metrics.psnr(target + error, target)
    np.testing.assert_allclose(got, -20.0 * np.log10(error), atol=1e-2)


def test_psnr_masked_is_the_psnr_of_a_cropped_image():
    rendered, target = _images()
    crop = (slice(3, 9), slice(4, 15))
    np.testing.assert_allclose(
        metrics.psnr_masked(rendered, target, _mask()),
        metrics.psnr(rendered[crop], target[crop]),
        atol=_DECIBELS,
    )


@pytest.mark.parametrize("value", [0.0, 1.0, 1e30, np.inf, np.nan])
def test_psnr_masked_ignores_what_is_outside(value):
    rendered, target = _images()
    changed = jnp.where(_mask()[..., None], rendered, value)
    expected = metrics.psnr_masked(rendered, target, _mask())
    assert metrics.psnr_masked(changed, target, _mask()) == expected


def test_psnr_masked_of_equal_images_is_infinite():
    _, target = _images()
    assert metrics.psnr_masked(target, target, _mask()) == jnp.inf


def test_psnr_masked_over_nothing_is_undefined():
    rendered, target = _images()
    assert np.isnan(metrics.psnr_masked(rendered, target, jnp.zeros(_SHAPE[:2], bool)))


def _similarity(rendered, target):
    return structural_similarity(
        np.asarray(rendered, np.float64),
        np.asarray(target, np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=-1,
        data_range=1.0,
    )


@pytest.mark.parametrize("seed", range(3))
def test_ssim_against_scikit_image(seed):
    rendered, target = _images(seed)
    np.testing.assert_allclose(
        metrics.ssim(rendered, target), _similarity(rendered, target), atol=_SIMILARITY
    )


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_ssim_is_finite_on_flat_images(value):
    _, target = _images()
    flat = jnp.full(_SHAPE, value)
    assert np.isfinite(metrics.ssim(flat, target)) and np.isfinite(metrics.ssim(flat, flat))


def _agreeing_images():
    """Yields pairs of images that are rendered, noisy, unlike, dark, bright and flat."""
    rng = np.random.default_rng(2)
    ramp = np.indices((32, 40)).sum(axis=0)[..., None] / 70.0 * np.array([1.0, 0.5, 0.2])
    noise = rng.normal(size=ramp.shape)
    yield ramp, np.clip(ramp + 0.05 * noise, 0.0, 1.0)
    yield rng.uniform(size=(2, 32, 40, 3))
    yield np.full_like(ramp, 0.97), np.full_like(ramp, 0.96)
    yield 0.9 + 1e-3 * noise, np.full_like(ramp, 0.9)
    yield np.zeros_like(ramp), np.ones_like(ramp)
    yield 1e-3 * ramp, np.zeros_like(ramp)


@pytest.mark.parametrize("pair", list(_agreeing_images()))
def test_psnr_and_ssim_are_those_of_scikit_image(pair):
    with jax.enable_x64(True):
        arrays = jax.device_put(tuple(np.asarray(image, np.float64) for image in pair))
        assert metrics.psnr(*arrays).dtype == np.float64
        expected = peak_signal_noise_ratio(pair[1], pair[0], data_range=1.0)
        np.testing.assert_allclose(metrics.psnr(*arrays), expected, atol=1e-5, rtol=0.0)
        expected = _similarity(*pair)
        np.testing.assert_allclose(metrics.ssim(*arrays), expected, atol=1e-5, rtol=0.0)


def test_ssim_of_the_smallest_image_is_that_of_its_one_window():
    rng = np.random.default_rng(3)
    edge = metrics.SMALLEST_FOR_SSIM
    rendered, target = rng.uniform(size=(2, edge, edge, 3))
    gauss = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(gauss, gauss)[..., None] / gauss.sum() ** 2

    def mean(x):
        return np.sum(window * x, axis=(0, 1))

    a, b = mean(rendered), mean(target)
    spread = mean(rendered**2) - a**2 + mean(target**2) - b**2
    shared = mean(rendered * target) - a * b
    by_channel = (2 * a * b + 1e-4) * (2 * shared + 9e-4)
    by_channel /= (a**2 + b**2 + 1e-4) * (spread + 9e-4)
    with jax.enable_x64(True):
        got = metrics.ssim(*jax.device_put((rendered, target)))
    np.testing.assert_allclose(got, by_channel.mean(), rtol=1e-9)


@pytest.mark.parametrize("shape", [(10, 40, 3), (40, 10, 3)])
def test_an_image_smaller_than_the_window_has_no_ssim(shape):
    with pytest.raises(ValueError, match="11 x 11"):
        metrics.ssim(jnp.zeros(shape), jnp.zeros(shape))


def test_metrics_check_grads():
    rendered, target = (np.asarray(image, np.float64)[:12, :12] for image in _images())
    gradients.assert_numerical(metrics.psnr, rendered, target)


_METRICS = {
    "psnr": (metrics.psnr, lambda a, b, mask: (a, b)),
    "psnr_masked": (metrics.psnr_masked, lambda a, b, mask: (a, b, mask)),
    "ssim": (metrics.ssim, lambda a, b, mask: (a, b)),
}


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _METRICS)
def test_transformations_change_nothing(name, transformation):
    metric, choose = _METRICS[name]
    items = [choose(*_images(seed), _mask()) for seed in range(2)]
    transformation(metric, jax.tree.map(lambda *x: jnp.stack(x), *items))
