"""MS-NeRF's sub-spaces, decoder and gate; `render/test_sub_spaces.py` has whole paths."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid, msnerf, registry, zipnerf
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.sampling.polylines import Gaussians
from refref_jax.sampling.scene_bounds import Bounds
from refref_jax.training.config import FieldConfig
from refref_jax.training.presets import PRESETS, override_model, sampling_of
from tests.laws import gradients

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_CONFIG = msnerf.MsnerfConfig(
    _GRID,
    density_width=8,
    bottleneck=4,
    colour_width=8,
    colour_depth=1,
    sub_spaces=3,
    channels=2,
    decoder_width=4,
)
_BOUNDS = Bounds(near=0.05, far=16.0, radius=7.3, space="bounded")

# Sums of a few products in float32.
_ROUNDING = 2e-6


def _gaussians(count=4):
    rng = np.random.default_rng(0)
    positions = jnp.asarray(rng.uniform(size=(count, 3)), jnp.float32)
    return Gaussians(positions, jnp.full(count, 0.01, jnp.float32))


def _trained(config=_CONFIG):
    """Returns parameters as after training: large entries, and biases that are not 0."""
    shapes = jax.eval_shape(lambda: msnerf.init_radiance(jax.random.key(0), config))
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: jnp.asarray(0.6 * rng.normal(size=x.shape), jnp.float32), shapes)


def _direction():
    return jnp.array([0.36, 0.48, 0.8], jnp.float32)


@pytest.mark.slow
def test_outputs_by_plain_matrix_products():
    params = _trained()
    features = jax.jit(hash_grid.MultisampledGrid(_GRID, "float32").apply)
    layers = params.sub_spaces["params"]
    grid = {"params": layers["MultisampledGrid_0"]}
    hidden = np.asarray(features(grid, _gaussians()), np.float64)

    def dense(name, x):
        return x @ np.asarray(layers[name]["kernel"], np.float64) + np.asarray(layers[name]["bias"])

    raw = dense("Dense_1", np.maximum(dense("Dense_0", hidden), 0.0))
    harmonics = np.asarray(hash_grid.spherical_harmonics(_direction()))
    inner = np.maximum(dense("Dense_2", np.concatenate([raw[3:], harmonics])), 0.0)
    expected = np.maximum(dense("Dense_3", inner), 0.0).reshape(3, 2)
    seen = registry.radiance(params, _CONFIG, _gaussians(), _direction())
    np.testing.assert_allclose(seen.density, np.logaddexp(0.0, raw[:3] - 1.0), rtol=1e-5)
    np.testing.assert_allclose(seen.features, expected, rtol=1e-4, atol=1e-6)
    assert np.any(expected > 0.0) and np.any(expected == 0.0)


def test_density_does_not_depend_on_the_direction_and_features_do():
    seen = jax.jit(lambda d: msnerf.radiance(_trained(), _CONFIG, _gaussians(), d))
    one, other = seen(_direction()), seen(-_direction())
    np.testing.assert_array_equal(one.density, other.density)
    assert not np.allclose(one.features, other.features)


def test_permuted_features_permute_colours_and_shares():
    params, order = _trained(), np.array([2, 0, 1])
    features = jnp.asarray(np.random.default_rng(2).uniform(size=(3, 2)), jnp.float32)
    one, other = (registry.blend(params, _CONFIG, x) for x in (features, features[order]))
    np.testing.assert_allclose(other.rgb, one.rgb[order], atol=_ROUNDING)
    np.testing.assert_allclose(other.shares, one.shares[order], atol=_ROUNDING)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e6, 1e30])
def test_a_blend_is_finite_and_its_shares_add_up_to_1(scale):
    """A gate may be saturated: one share is then 1, and the others 0."""
    features = scale * jnp.asarray(np.random.default_rng(3).uniform(size=(3, 2)), jnp.float32)

    def colour(params, features):
        blend = msnerf.blend(params, _CONFIG, features)
        return jnp.sum(blend.shares[:, None] * blend.rgb), blend

    slopes, blend = jax.jit(jax.grad(colour, argnums=(0, 1), has_aux=True))(_trained(), features)
    assert gradients.all_finite((slopes, blend))
    np.testing.assert_allclose(np.sum(blend.shares), 1.0, atol=_ROUNDING)
    assert np.all((blend.rgb >= -0.00101) & (blend.rgb <= 1.00101))
    if scale >= 1e6:
        np.testing.assert_array_equal(np.sort(blend.shares), [0.0, 0.0, 1.0])


@pytest.mark.slow
def test_gradients_of_the_blend_are_numerical():
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), _trained().decoder)
    leaves, tree = jax.tree.flatten(params)

    def colour(features, *leaves):
        decoder = jax.tree.unflatten(tree, leaves)
        blend = msnerf.blend(msnerf.MsnerfParams(None, decoder), _CONFIG, features)
        return jnp.sum(blend.shares[:, None] * blend.rgb, axis=0)

    features = np.random.default_rng(4).uniform(0.5, 1.5, size=(3, 2))
    gradients.assert_numerical(colour, features, *leaves)


@pytest.mark.slow
def test_the_gate_begins_with_nearly_equal_shares():
    config = msnerf.KIND.sizes["tiny"].field
    params = jax.jit(lambda: msnerf.init_radiance(jax.random.key(0), config))()
    seen = jax.jit(lambda: msnerf.radiance(params, config, _gaussians(), _direction()))()
    shares = registry.blend(params, config, seen.features).shares
    assert np.all(shares > 0.02) and np.all(shares < 0.5)


def test_sizes_are_those_of_zipnerf_with_sub_spaces():
    published = msnerf.KIND.sizes["paper"].field
    assert (published.sub_spaces, published.channels, published.decoder_width) == (8, 32, 64)
    for name, size in msnerf.KIND.sizes.items():
        plain = zipnerf.KIND.sizes[name]
        assert size.field.grid == plain.field.grid and size.samples == plain.samples
        assert size.field.precision == plain.field.precision
        assert [each.grid for each in size.proposals] == [each.grid for each in plain.proposals]


@pytest.mark.parametrize("name", ["sub_spaces", "channels", "decoder_width"])
def test_a_field_without_a_sub_space_is_refused(name):
    with pytest.raises(ValueError, match=f"{name}=0.* is invalid. Give at least 1"):
        dataclasses.replace(_CONFIG, **{name: 0})


@pytest.mark.parametrize("count", [0, -3, 65])
def test_a_number_of_sub_spaces_is_checked(count):
    with pytest.raises(ValueError, match=rf"sub_spaces is {count}\. Give 1 to 64"):
        FieldConfig(field="msnerf", sub_spaces=count)


def test_sub_spaces_are_an_option_of_msnerf_alone():
    model = PRESETS["tiny"].model(_BOUNDS, "field", field="msnerf")
    assert sampling_of(model)["sub_spaces"] == 6
    made = override_model(model, FieldConfig(sub_spaces=2))
    assert made.field == dataclasses.replace(model.field, sub_spaces=2)
    plain = PRESETS["tiny"].model(_BOUNDS, "field")
    assert sampling_of(plain)["sub_spaces"] is None
    with pytest.raises(ValueError, match=r"sub_spaces=2 has no effect on field kind zipnerf"):
        override_model(plain, FieldConfig(sub_spaces=2))
