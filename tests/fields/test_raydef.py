"""Networks that move and turn points of rays; `render/test_deformation.py` has whole rays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid, raydef, registry, zipnerf
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.sampling.polylines import Gaussians
from tests.factories import arrays
from tests.laws import gradients

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_SHAPE = {"density_width": 8, "bottleneck": 4, "colour_width": 8, "colour_depth": 1}
_CONFIG = raydef.RaydefConfig(_GRID, **_SHAPE, octaves=3, deformation_width=6, deformation_depth=2)
_ONE = jnp.float32(1.0)


def _place():
    return jnp.array([0.3, 0.7, 0.55], jnp.float32)


def _direction():
    return jnp.array([0.48, -0.6, 0.64], jnp.float32)


def _trained(config=_CONFIG, scale=0.6):
    shapes = jax.eval_shape(lambda: raydef.init_radiance(jax.random.key(0), config))
    return arrays.drawn(shapes, scale=scale)


@pytest.mark.parametrize("depth", [1, 2, 6])
def test_offsets_by_plain_matrix_products(depth):
    """With more than four layers, the inputs are appended after the fourth."""
    config = dataclasses.replace(_CONFIG, deformation_depth=depth)
    params = _trained(config, scale=0.4)
    layers = jax.tree.map(lambda x: np.asarray(x, np.float64), params.deformation["params"])
    centred = 2.0 * np.asarray(_place(), np.float64) - 1.0
    waves = [wave(np.pi * 2.0**k * centred) for wave in (np.sin, np.cos) for k in range(3)]
    harmonics = np.asarray(hash_grid.spherical_harmonics(_direction()))
    inputs = hidden = np.concatenate([centred, *waves, harmonics])
    for i in range(depth):
        if i == 4:
            hidden = np.concatenate([hidden, inputs])
        layer = layers[f"Dense_{i}"]
        hidden = np.maximum(hidden @ layer["kernel"] + layer["bias"], 0.0)
    layer = layers[f"Dense_{depth}"]
    expected = 0.1 * (hidden @ layer["kernel"] + layer["bias"])
    found = registry.deform(params, config, _place(), _direction(), _ONE)
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=2e-4, atol=1e-5)
    assert np.max(np.abs(expected)) > 0.01


def test_octaves_open_one_after_the_other_in_the_first_fifth_of_the_training():
    """By hand: after a thirtieth, half of the first octave; after a tenth, half of the second."""
    seen = jax.jit(lambda x, done: raydef.windowed(x, 3, done).reshape(2, 3, 3))
    x = 2.0 * _place() - 1.0
    whole = seen(x, _ONE)
    np.testing.assert_array_equal(seen(x, jnp.float32(0.0)), 0.0)
    for done, shares in ((1.0 / 30.0, [0.5, 0.0, 0.0]), (0.1, [1.0, 0.5, 0.0]), (0.2, [1, 1, 1])):
        expected = np.asarray(whole) * np.array(shares)[None, :, None]
        np.testing.assert_allclose(seen(x, jnp.float32(done)), expected, atol=2e-6)
    np.testing.assert_allclose(whole[0, 1], np.sin(2.0 * np.pi * np.asarray(x)), atol=1e-6)


@pytest.mark.slow
def test_a_point_begins_nearly_where_it_is():
    config = raydef.KIND.sizes["tiny"].field
    params = jax.jit(lambda: raydef.init_radiance(jax.random.key(0), config))()
    places = jnp.asarray(np.random.default_rng(2).uniform(size=(200, 3)), jnp.float32)
    offsets = jax.jit(
        jax.vmap(registry.deform, in_axes=(None, None, 0, None, None)), static_argnums=1
    )(params, config, places, _direction(), _ONE)
    assert 0.0 < np.max(np.abs(offsets.position)) < 2e-3
    assert 0.0 < np.max(np.abs(offsets.direction)) < 2e-3


@pytest.mark.slow
def test_density_and_colour_are_those_of_zipnerf():
    params = _trained()
    plain = zipnerf.RadianceFieldConfig(_GRID, **_SHAPE)
    gaussians = Gaussians(_place()[None], jnp.full(1, 0.01, jnp.float32))
    seen = registry.radiance(params, _CONFIG, gaussians, _direction())
    expected = zipnerf.radiance(params.field, plain, gaussians, _direction())
    np.testing.assert_array_equal(seen.density, expected.density)
    np.testing.assert_array_equal(seen.rgb, expected.rgb)


@pytest.mark.slow
def test_gradients_are_numerical():
    """At a place without kinks of the network's activation nearby."""
    leaves, tree = jax.tree.flatten(_trained().deformation)

    def offsets(place, direction, *leaves):
        params = raydef.RaydefParams(None, jax.tree.unflatten(tree, leaves))
        return jnp.concatenate(raydef.deform(params, _CONFIG, place, direction, jnp.ones(())))

    gradients.assert_numerical(offsets, _place(), [0.36, 0.48, 0.8], *leaves)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e4])
def test_offsets_are_finite(scale):
    def size(params, place):
        found = registry.deform(params, _CONFIG, place, _direction(), jnp.float32(0.1))
        return jnp.sum(jnp.concatenate(found)), found

    slopes, found = jax.jit(jax.grad(size, argnums=(0, 1), has_aux=True))(
        _trained(scale=scale), _place()
    )
    assert gradients.all_finite((slopes, found))


def test_places_are_not_rounded_in_half_precision():
    half = dataclasses.replace(_CONFIG, precision="bfloat16")
    params = _trained()
    one, other = (
        registry.deform(params, each, _place(), _direction(), _ONE) for each in (_CONFIG, half)
    )
    np.testing.assert_array_equal(np.concatenate(one), np.concatenate(other))


def test_sizes_are_those_of_zipnerf_behind_a_deformation():
    published = raydef.KIND.sizes["paper"].field
    assert (published.deformation_width, published.deformation_depth) == (128, 6)
    for name, size in raydef.KIND.sizes.items():
        plain, bent = zipnerf.KIND.sizes[name], raydef.POLYLINE.sizes[name]
        assert size.field.grid == bent.field.grid == plain.field.grid
        assert size.samples == bent.samples == plain.samples
        assert size.footprint == plain.footprint and size.dilation == plain.dilation
        assert size.field.precision == plain.field.precision
        assert registry.knots(size.field) == 0 < registry.knots(bent.field)
        # A fifth of the evaluations of the network.
        assert registry.knots(bent.field) <= 0.25 * sum(size.samples)


@pytest.mark.parametrize("name", ["octaves", "deformation_width", "deformation_depth"])
def test_a_deformation_without_a_network_is_refused(name):
    with pytest.raises(ValueError, match=rf"{name}=0.* is invalid\. Give at least 1"):
        dataclasses.replace(_CONFIG, **{name: 0})


def test_a_polyline_has_knots():
    shape = _SHAPE | {"octaves": 3, "deformation_width": 6, "deformation_depth": 2}
    with pytest.raises(ValueError, match=r"knots is 1, but a ray needs 2 to bend"):
        raydef.RaydefPolylineConfig(_GRID, **shape, knots=1)
    assert registry.knots(raydef.RaydefPolylineConfig(_GRID, **shape, knots=2)) == 2
