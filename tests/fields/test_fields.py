import dataclasses
import functools
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import registry, zipnerf
from refref_jax.fields.base import DensityConfig, check_precision
from refref_jax.fields.hash_grid import HashGridConfig, MultisampledGrid, tables
from refref_jax.fields.nerfacto import NerfactoConfig, NerfactoProposalConfig
from refref_jax.fields.zipnerf import DensityFieldConfig, RadianceFieldConfig
from refref_jax.sampling.polylines import Gaussians
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# Two small matrix products in float32.
_NETWORK = 1e-5

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_DENSITY = DensityFieldConfig(_GRID, width=8)
_RADIANCE = RadianceFieldConfig(
    _GRID, density_width=8, bottleneck=4, colour_width=8, colour_depth=2
)

_CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)), np.float32)


_CONFIGS = {
    "density": _DENSITY,
    "radiance": _RADIANCE,
    "nerfacto density": NerfactoProposalConfig(_GRID, width=8),
    "nerfacto radiance": NerfactoConfig(
        _GRID, density_width=8, bottleneck=4, colour_width=8, colour_depth=2
    ),
}

_CONFIGS |= {
    f"{name} with a skip": dataclasses.replace(_CONFIGS[name], colour_network="skip")
    for name in ("radiance", "nerfacto radiance")
}


def _few(*names):
    """Every run of the suite tests these, and slow ones the others."""
    assert set(names) <= set(_CONFIGS)
    marks = {name: () if name in names else pytest.mark.slow for name in _CONFIGS}
    return pytest.mark.parametrize(
        "name", [pytest.param(name, marks=mark) for name, mark in marks.items()]
    )


@jax.jit
def _untrained(seed):
    return zipnerf.init_radiance(jax.random.key(seed), _RADIANCE)


@functools.cache
def _parameters(name):
    """Returns parameters as after training: large entries, and biases that are not 0."""
    config = _CONFIGS[name]
    begin = registry.init_density if _is_density(config) else registry.init_radiance
    shapes = jax.eval_shape(lambda: begin(jax.random.key(0), config))
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: jnp.asarray(0.6 * rng.normal(size=x.shape), jnp.float32), shapes)


def _gaussians(count=6, seed=0, scale=0.01):
    rng = np.random.default_rng(seed)
    positions = jnp.asarray(rng.uniform(size=(count, 3)), jnp.float32)
    return Gaussians(positions, jnp.asarray(np.full(count, scale), jnp.float32))


def _direction(seed=0):
    vector = np.random.default_rng(seed).normal(size=3)
    return jnp.asarray(vector / np.linalg.norm(vector), jnp.float32)


def _is_density(config):
    return isinstance(config, DensityConfig)


def _ask(params, config, gaussians, direction):
    """Returns density, and colour if the field has one."""
    if _is_density(config):
        return (registry.density(params, config, gaussians),)
    return registry.radiance(params, config, gaussians, direction)


_asked = jax.jit(_ask, static_argnames="config")


def _see(name, gaussians, direction=None, params=None):
    """Returns density, and colour if the field has one, as one array."""
    params = _parameters(name) if params is None else params
    direction = _direction() if direction is None else direction
    seen = _asked(params, _CONFIGS[name], gaussians, direction)
    return np.concatenate([np.atleast_1d(each) for each in seen])


@pytest.mark.parametrize("brightest", [1.0, 2.0, 8.0])
def test_colours_go_from_below_black_to_above_the_brightest(brightest):
    ends = zipnerf.pad_colour(jnp.array([0.0, 1.0]), brightest=brightest)
    np.testing.assert_allclose(ends, [-0.001, brightest + 0.001], rtol=1e-5)


@pytest.mark.parametrize(
    ("raw", "expected"), [(1.0, np.log(2.0)), (101.0, 100.0), (-99.0, 0.0), (0.0, 0.3132617)]
)
def test_activate_density_by_hand(raw, expected):
    got = zipnerf.activate_density(jnp.float32(raw))
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-30)


@pytest.mark.parametrize("raw", [-1e30, -1e3, 0.0, 1e3, 1e30])
def test_activate_density_is_finite_and_not_negative(raw):
    value, slope = jax.value_and_grad(zipnerf.activate_density)(jnp.float32(raw))
    assert value >= 0.0 and np.isfinite(value)
    assert 0.0 <= slope <= 1.0


def test_activate_density_check_grads():
    gradients.assert_numerical(zipnerf.activate_density, 0.7)


def test_an_untrained_field_is_thin_but_not_empty():
    density = _see("radiance", _gaussians(), params=_untrained(1))[0]
    np.testing.assert_allclose(density, np.log1p(np.exp(-1.0)), rtol=1e-2)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("name", "padding"), [("radiance", 0.001), ("nerfacto radiance", 0.0)])
def test_colours_stay_within_their_padding(name, padding, seed):
    huge = jax.tree.map(lambda x: jnp.asarray(1e3 * np.asarray(x)), _parameters(name))
    for params in (_parameters(name), huge):
        rgb = _see(name, _gaussians(seed=seed), _direction(seed), params)[1:]
        assert ((rgb >= -padding - 1e-6) & (rgb <= 1.0 + padding + 1e-6)).all()


def test_black_and_white_lie_within_reach():
    params = jax.tree.map(jnp.zeros_like, _parameters("radiance"))
    last = max(name for name in params["params"] if name.startswith("Dense"))
    params["params"][last]["bias"] = jnp.array([20.0, 0.0, -20.0])
    rgb = _see("radiance", _gaussians(), params=params)[1:]
    np.testing.assert_allclose(rgb, [1.001, 0.5, -0.001], atol=1e-6)


# --- both ---


def _dense(params, index, x):
    layer = params["params"][f"Dense_{index}"]
    return x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)


def _mean_features(name, gaussians):
    (grid,) = (key for key in _parameters(name)["params"] if "Grid" in key)
    params = {"params": _parameters(name)["params"][grid]}
    return np.asarray(jax.jit(MultisampledGrid(_GRID).apply)(params, gaussians), np.float64)


def _softplus(raw):
    return np.logaddexp(0.0, raw - 1.0)


@pytest.mark.parametrize(
    ("name", "scale", "activation"),
    [("density", 0.01, _softplus), ("nerfacto density", 0.0, np.exp)],
)
def test_the_density_network_against_numpy(name, scale, activation):
    # Nerfacto sees points, however wide its Gaussians are.
    params, seen = _parameters(name), _gaussians(scale=scale)
    hidden = np.maximum(_dense(params, 0, _mean_features(name, seen)), 0.0)
    raw = _dense(params, 1, hidden)[0]
    np.testing.assert_allclose(_see(name, _gaussians())[0], activation(raw), rtol=_NETWORK)


@pytest.mark.parametrize(
    ("name", "scale", "activation", "padding"),
    [
        ("radiance", 0.01, _softplus, 0.001),
        ("nerfacto radiance", 0.0, np.exp, 0.0),
        ("radiance with a skip", 0.01, _softplus, 0.001),
        ("nerfacto radiance with a skip", 0.0, np.exp, 0.0),
    ],
)
def test_the_radiance_network_against_numpy(name, scale, activation, padding):
    params, direction = _parameters(name), _direction()
    hidden = np.maximum(_dense(params, 0, _mean_features(name, _gaussians(scale=scale))), 0.0)
    raw = _dense(params, 1, hidden)
    inputs = np.concatenate([raw[1:], reference_sampling.spherical_harmonics(direction)])
    hidden = np.maximum(_dense(params, 2, inputs), 0.0)
    if name.endswith("skip"):
        hidden = np.concatenate([hidden, inputs])
    hidden = np.maximum(_dense(params, 3, hidden), 0.0)
    rgb = (1.0 + 2.0 * padding) / (1.0 + np.exp(-_dense(params, 4, hidden))) - padding
    got = _see(name, _gaussians(), direction)
    np.testing.assert_allclose(got[0], activation(raw[0]), rtol=_NETWORK)
    np.testing.assert_allclose(got[1:], rgb, atol=_NETWORK)


@pytest.mark.parametrize("name", _CONFIGS)
def test_only_fields_that_anti_alias_heed_the_width_of_a_pixel(name):
    narrow, wide = (_see(name, _gaussians(scale=scale)) for scale in (0.0, 0.3))
    assert np.array_equal(narrow, wide) == name.startswith("nerfacto")


def test_an_untrained_nerfacto_is_as_dense_as_its_exponential_says():
    config = _CONFIGS["nerfacto radiance"]
    params = jax.jit(lambda: registry.init_radiance(jax.random.key(0), config))()
    density = _see("nerfacto radiance", _gaussians(), params=params)[0]
    np.testing.assert_allclose(density, 1.0, rtol=1e-3)


@pytest.mark.parametrize("name", _CONFIGS)
@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0, 1e30])
def test_fields_are_finite_at_the_corners_of_the_cube(name, scale):
    gaussians = Gaussians(jnp.asarray(_CORNERS[:6]), jnp.full(6, scale, jnp.float32))
    assert np.isfinite(_see(name, gaussians)).all()


def test_the_same_key_gives_the_same_field():
    first, same, other = (_untrained(seed) for seed in (5, 5, 6))
    jax.tree.map(np.testing.assert_array_equal, first, same)
    assert not np.array_equal(tables(first)[0], tables(other)[0])


def test_parameters_hold_the_tables_of_their_grids():
    for name in _CONFIGS:
        assert [table.shape for table in tables(_parameters(name))] == [(64, 2), (256, 2)]


@functools.cache
def _gradient(name):
    def total(params, gaussians, direction):
        return sum(map(jnp.sum, _ask(params, _CONFIGS[name], gaussians, direction)))

    return jax.jit(jax.grad(total, argnums=(0, 1, 2)))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if "nerfacto" in name else ()) for name in _CONFIGS],
)
@pytest.mark.parametrize("scale", [0.0, 0.01, 1e30])
def test_gradients_are_finite_at_the_corners_of_the_cube(name, scale):
    for positions in (_CORNERS[:6], _CORNERS[2:]):
        gaussians = Gaussians(jnp.asarray(positions), jnp.full(6, scale, jnp.float32))
        got = _gradient(name)(_parameters(name), gaussians, _direction())
        assert gradients.all_finite(got)


@pytest.mark.parametrize("name", _CONFIGS)
def test_gradients_reach_every_layer_and_table(name):
    reached = jax.tree.map(lambda x: np.zeros(x.shape, bool), _parameters(name))
    for seed in range(8):
        by_params = _gradient(name)(_parameters(name), _gaussians(seed=seed), _direction(seed))[0]
        reached = jax.tree.map(lambda a, b: a | (np.asarray(b) != 0.0), reached, by_params)
    assert all(leaf.any() for leaf in jax.tree.leaves(reached))


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CONFIGS)
def test_transformations_change_nothing(name, transformation):
    gaussians = jax.tree.map(lambda *x: jnp.stack(x), *(_gaussians(seed=seed) for seed in range(3)))
    directions = jnp.stack([_direction(seed) for seed in range(3)])
    ask = functools.partial(_ask, _parameters(name), _CONFIGS[name])
    transformation(ask, (gaussians, directions))


# --- bfloat16 ---

# Eight bits, lost in the table, in the factors of up to five layers, and in their sums.
_HALF = 0.05


@functools.cache
def _learning(name, precision):
    config = dataclasses.replace(_CONFIGS[name], precision=precision)

    def total(params, gaussians, direction):
        seen = list(_ask(params, config, gaussians, direction))
        return sum(map(jnp.sum, seen)), seen

    return jax.jit(jax.grad(total, has_aux=True))


def _taught(name, precision, params, gaussians):
    """Returns what a field answers and its gradient, of the sum of the answer."""
    slopes, seen = _learning(name, precision)(params, gaussians, _direction())
    return jax.tree.leaves(seen), slopes


@pytest.mark.slow
@pytest.mark.parametrize("name", _CONFIGS)
def test_half_precision_is_near_single_precision(name):
    single, single_slopes = _taught(name, "float32", _parameters(name), _gaussians())
    half, half_slopes = _taught(name, "bfloat16", _parameters(name), _gaussians())
    for a, b in zip(half, single, strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=_HALF, atol=_HALF)
    for a, b in zip(jax.tree.leaves(half_slopes), jax.tree.leaves(single_slopes), strict=True):
        assert a.dtype == jnp.float32
        assert np.linalg.norm(a - b) <= _HALF * (np.linalg.norm(b) + 1.0)
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in zip(half, single, strict=True))


@_few("density", "radiance", "nerfacto radiance with a skip")
@pytest.mark.parametrize("size", [0.0, 1e4])
@pytest.mark.parametrize("scale", [0.0, 1e30])
def test_half_precision_is_finite(name, size, scale):
    params = jax.tree.map(lambda x: jnp.asarray(size * np.asarray(x)), _parameters(name))
    seen, slopes = _taught(name, "bfloat16", params, _gaussians(scale=scale))
    assert gradients.all_finite(seen) and gradients.all_finite(slopes)


@pytest.mark.parametrize("name", ["density", "radiance"])
@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_hidden_layers_keep_bfloat16_and_no_sum_is_in_it(name, platform):
    learn = jax.jit(_learning(name, "bfloat16"))
    traced = learn.trace(_parameters(name), _gaussians(), _direction())
    text = traced.lower(lowering_platforms=(platform,)).as_text()
    products = re.findall(r"stablehlo.dot_general .*", text)
    assert any(each.rstrip().endswith("xbf16>") for each in products)
    assert any(each.rstrip().endswith("xf32>") for each in products)
    sums = re.findall(r"stablehlo.reduce\(.*", text)
    assert sums and not any("bf16" in each for each in sums)


def test_unknown_precisions_are_refused():
    with pytest.raises(ValueError, match="must be one of float32, bfloat16, not 'half'"):
        check_precision("half")


def test_a_skip_makes_the_released_code_s_colour_network():
    # There, 256 features and 27 of the direction are the inputs, of two layers of 256 neurons.
    paper = zipnerf.KIND.sizes["paper"].field
    config = dataclasses.replace(paper, colour_network="skip")
    shapes = jax.eval_shape(lambda: registry.init_radiance(jax.random.key(0), config))["params"]
    inputs = 255 + 16
    layers = [shapes[f"Dense_{i}"]["kernel"].shape for i in (2, 3, 4)]
    assert layers == [(inputs, 256), (256 + inputs, 256), (256, 3)]
    theirs = [(inputs + 12, 256), (256 + inputs + 12, 256), (256, 3)]
    sizes = [fan_in * width + width for fan_in, width in theirs]
    density = [40 * 64 + 64, 64 * 256 + 256, 6 * 64 + 64 + 65, 8 * 64 + 64 + 65]
    assert sum(sizes) + sum(density) == 232_133  # parameters of all of its networks


def test_one_hidden_layer_skips_to_the_output():
    tiny = dataclasses.replace(zipnerf.KIND.sizes["tiny"].field, colour_network="skip")
    shapes = jax.eval_shape(lambda: registry.init_radiance(jax.random.key(0), tiny))["params"]
    assert [shapes[f"Dense_{i}"]["kernel"].shape for i in (2, 3)] == [(31, 32), (63, 3)]
