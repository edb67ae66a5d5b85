"""LPIPS against a second implementation in NumPy, and its weights as they are read from files."""

import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax import metrics
from tests.factories import made_lpips
from tests.laws import gradients, transformations

_SHAPE = (47, 39, 3)

# Compiled once for all tests: op by op, every operation would be.
_distance = jax.jit(metrics.lpips)
_slope = jax.jit(jax.value_and_grad(metrics.lpips, argnums=1))


@pytest.fixture(scope="module")
def params(tmp_path_factory):
    return metrics.load_lpips(made_lpips.write(tmp_path_factory.mktemp("lpips") / "weights.npz"))


def _images(seed=0, shape=_SHAPE):
    return jnp.asarray(np.random.default_rng(seed).uniform(size=(2, *shape)), jnp.float32)


def _convolve(image, kernel, bias, stride, padding):
    """Slides a kernel over an image as a camera would be moved: place by place, in float64."""
    padded = np.pad(image, ((padding, padding), (padding, padding), (0, 0)))
    side = kernel.shape[-1]
    rows = range(0, padded.shape[0] - side + 1, stride)
    columns = range(0, padded.shape[1] - side + 1, stride)
    result = np.empty((len(rows), len(columns), len(kernel)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            seen = padded[row : row + side, column : column + side]
            result[i, j] = np.einsum("hwc,ochw->o", seen, kernel) + bias
    return result


def _pool(image):
    rows, columns = (range(0, size - 2, 2) for size in image.shape[:2])
    return np.array([[image[i : i + 3, j : j + 3].max((0, 1)) for j in columns] for i in rows])


def _features(image, alexnet):
    x = 2.0 * np.asarray(image, np.float64) - 1.0
    x = (x - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    for name in made_lpips.ALEXNET:
        if name in ("features.3", "features.6"):
            x = _pool(x)
        stride, padding = {"features.0": (4, 2), "features.3": (1, 2)}.get(name, (1, 1))
        kernel, bias = (alexnet[f"{name}.{kind}"].astype(np.float64) for kind in ("weight", "bias"))
        x = np.maximum(_convolve(x, kernel, bias, stride, padding), 0.0)
        yield x / (np.sqrt((x**2).sum(-1, keepdims=True)) + 1e-10)


def _reference(rendered, target, seed=0):
    alexnet, linear = made_lpips.state_dicts(seed)
    layers = zip(_features(rendered, alexnet), _features(target, alexnet), strict=True)
    return sum(
        np.mean((a - b) ** 2 @ linear[f"lin{i}.model.1.weight"].reshape(-1))
        for i, (a, b) in enumerate(layers)
    )


def test_black_and_white_by_hand(params):
    # The first layer sees red in one channel and its lack in another, and the others see nothing.
    first = jnp.zeros((64, 3, 11, 11)).at[0, 0, 5, 5].set(1.0).at[1, 0, 5, 5].set(-1.0)
    kernels = (first, *map(jnp.zeros_like, params.kernels[1:]))
    weights = params.channels[0].at[:2].set(jnp.array([0.2, 0.3]))
    made = metrics.LpipsParams(
        kernels, tuple(map(jnp.zeros_like, params.biases)), (weights, *params.channels[1:])
    )
    got = _distance(made, jnp.zeros(_SHAPE), jnp.ones(_SHAPE))
    np.testing.assert_allclose(got, 0.5, rtol=1e-6)


@pytest.mark.parametrize("shape", [_SHAPE, (31, 31, 3)])
def test_against_numpy(params, shape):
    images = _images(1, shape)
    expected = _reference(*images)
    assert expected > 0.1
    np.testing.assert_allclose(_distance(params, *images), expected, rtol=1e-5)


def test_images_that_hardly_differ_against_numpy(params):
    rendered, noise = _images(2)
    target = jnp.clip(rendered + 0.02 * (noise - 0.5), 0.0, 1.0)
    expected = _reference(rendered, target)
    np.testing.assert_allclose(_distance(params, rendered, target), expected, rtol=1e-3)


@pytest.mark.slow
def test_equal_images_are_at_no_distance_and_no_slope(params):
    image, _ = _images()
    assert metrics.lpips(params, image, image) == 0.0
    # Compiled, the two are not rounded alike.
    value, slope = _slope(params, image, image)
    assert abs(value) < 1e-12
    np.testing.assert_allclose(slope, jnp.zeros_like(image), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_images_and_features_that_are_nothing_stay_finite(params, level):
    flat, (target, _) = jnp.full(_SHAPE, level), _images()
    assert gradients.all_finite(_slope(params, flat, target))
    blind = params._replace(biases=tuple(bias - 1e3 for bias in params.biases))
    value, slope = _slope(blind, flat, target)
    assert value == 0.0 and not np.any(slope)


@pytest.mark.parametrize("shape", [(30, 64, 3), (64, 30, 3)])
def test_an_image_too_small_for_the_network_is_refused(params, shape):
    with pytest.raises(ValueError, match="31 x 31"):
        metrics.lpips(params, jnp.zeros(shape), jnp.zeros(shape))


@pytest.mark.slow
@pytest.mark.parametrize(
    "transformation",
    [transformations.jitted, transformations.mapped],
)
def test_transformations_change_nothing(params, transformation):
    def distance(rendered, target):
        return metrics.lpips(params, rendered, target)

    transformation(
        distance, tuple(jnp.stack([_images(seed)[i] for seed in (0, 1)]) for i in (0, 1))
    )


def test_weights_are_those_of_the_file(params):
    alexnet, linear = made_lpips.state_dicts()
    assert len(params.kernels) == len(params.biases) == len(params.channels) == 5
    np.testing.assert_array_equal(params.kernels[3], alexnet["features.8.weight"])
    np.testing.assert_array_equal(params.biases[1], alexnet["features.3.bias"])
    np.testing.assert_array_equal(params.channels[2], linear["lin2.model.1.weight"].reshape(-1))
    assert {x.dtype for x in jax.tree.leaves(params)} == {jnp.dtype(jnp.float32)}


def _without(name):
    return lambda arrays: arrays.pop(name)


def _with(name, change):
    return lambda arrays: arrays.update({name: change(arrays[name])})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_without("features.6.bias"), "has no features.6.bias; it has features.0.weight"),
        (_without("lin4.model.1.weight"), "has no lin4.model.1.weight"),
        (dict.clear, "it has nothing"),
        (_with("features.0.weight", lambda x: x[..., :7]), r"not \(64, 3, 11, 11\)"),
        (_with("lin0.model.1.weight", lambda x: x.reshape(-1)), "belongs to another network"),
        (_with("features.3.bias", lambda x: x * np.nan), "not finite"),
        (_with("features.3.bias", lambda x: x.astype(np.int32)), "not finite"),
        (_with("features.3.bias", lambda x: x.astype(np.float64) + 1e300), "in single precision"),
        (_with("lin1.model.1.weight", lambda x: x - 0.5), "negative weights"),
        (_with("lin3.model.1.weight", np.zeros_like), "only zero weights"),
        (_with("features.6.weight", np.zeros_like), "only zero weights"),
    ],
)
def test_weights_of_something_else_are_refused(tmp_path, spoil, message):
    alexnet, linear = made_lpips.state_dicts()
    arrays = alexnet | linear
    spoil(arrays)
    path = tmp_path / "weights.npz"
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=message) as raised:
        metrics.load_lpips(path)
    assert str(path) in str(raised.value)


def test_half_precision_is_read_as_single(tmp_path):
    alexnet, linear = made_lpips.state_dicts()
    path = tmp_path / "weights.npz"
    np.savez(path, **{name: x.astype(np.float16) for name, x in (alexnet | linear).items()})
    assert metrics.load_lpips(path).kernels[0].dtype == jnp.float32


@pytest.mark.parametrize(
    "kind", ["missing", "text", "empty", "npy", "cut off", "inflated", "header"]
)
def test_a_file_of_something_else_is_named(tmp_path, kind):
    path = tmp_path / "weights.npz"
    if kind == "text":
        path.write_text("weights")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "npy":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "cut off":
        content = made_lpips.write(path).read_bytes()
        path.write_bytes(content[: len(content) // 2])
    elif kind == "inflated":
        np.savez_compressed(path, x=np.arange(1000.0))
        content = bytearray(path.read_bytes())
        content[200:300] = bytes(100)
        path.write_bytes(content)
    elif kind == "header":
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("x.npy", np.lib.format.magic(1, 0) + b"\x02\x00((")
    with pytest.raises(ValueError, match=r"docs/metrics\.md") as raised:
        metrics.load_lpips(path)
    assert str(path) in str(raised.value)


def test_weights_are_checked_without_a_device(tmp_path, monkeypatch):
    path = made_lpips.write(tmp_path / "weights.npz")
    monkeypatch.setattr(jax, "device_put", None)
    found = metrics.read_lpips(path)
    assert len(found) == 15 and {x.dtype for x in found.values()} == {np.dtype(np.float32)}
