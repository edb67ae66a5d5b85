import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from refref_jax.fields import hash_grid, hash_grid_kernels
from refref_jax.fields.hash_grid import HashGrid, HashGridConfig, MultisampledGrid
from refref_jax.sampling.polylines import Gaussians
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# Eight products of float32 numbers; the place in a cell of the finest level is rounded most.
_BLENDING = 2e-5

# The first two levels have fewer vertices than entries (4^3 and 6^3), the last two are hashed.
_CONFIG = HashGridConfig(levels=4, base_res=3, max_res=18, hashmap_size=256, features=2)
_SHAPE = (_CONFIG.levels, _CONFIG.base_res, _CONFIG.max_res, _CONFIG.hashmap_size)
_RESOLUTIONS = [3, 5, 10, 18]

_POSITIONS = np.concatenate(
    [
        np.array(list(itertools.product((0.0, 1.0), repeat=3))),
        [[0.5, 0.5, 0.5], [1.0 / 3.0, 0.6, 0.1], [0.0, 0.4, 1.0], [1e-7, 1.0 - 1e-7, 0.2]],
        np.random.default_rng(0).uniform(size=(20, 3)),
    ]
).astype(np.float32)


def _initialise(seed):
    return HashGrid(_CONFIG).init(jax.random.key(seed), jnp.zeros(3), jnp.float32(0.0))


@functools.cache
def _parameters():
    """Returns parameters whose entries are of about 1, so that errors show."""
    shapes = jax.eval_shape(_initialise, 0)
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)


@jax.jit
def _features(params, positions, scales):
    return jax.vmap(functools.partial(HashGrid(_CONFIG).apply, params))(positions, scales)


def _at(positions, scales=None):
    positions = jnp.asarray(positions, jnp.float32)
    scales = np.zeros(positions.shape[0]) if scales is None else scales
    return _features(_parameters(), positions, jnp.asarray(scales, jnp.float32))


def _expected(positions, scales=None):
    tables = hash_grid.tables(_parameters())
    scales = np.zeros(len(positions)) if scales is None else scales
    return np.array(
        [
            reference_sampling.grid_features(tables, _SHAPE, position, scale)
            for position, scale in zip(positions, scales, strict=True)
        ]
    )


# --- configuration ---


def test_resolutions_by_hand():
    config = HashGridConfig(levels=5, base_res=16, max_res=256, hashmap_size=2, features=1)
    assert hash_grid.resolutions(config) == [16, 32, 64, 128, 256]
    assert hash_grid.resolutions(_CONFIG) == _RESOLUTIONS


@pytest.mark.parametrize(
    ("levels", "base_res", "max_res"), [(8, 16, 512), (10, 16, 8192), (2, 4, 4)]
)
def test_resolutions_grow_geometrically_to_the_finest(levels, base_res, max_res):
    config = HashGridConfig(levels, base_res, max_res, hashmap_size=2, features=1)
    got = hash_grid.resolutions(config)
    assert got == reference_sampling.grid_resolutions(levels, base_res, max_res)
    assert len(got) == levels and got[0] == base_res and got[-1] == max_res
    assert got == sorted(got)


def test_a_grid_of_one_level_has_its_coarsest_resolution():
    config = HashGridConfig(levels=1, base_res=7, max_res=100, hashmap_size=2, features=3)
    assert hash_grid.resolutions(config) == [7]


@pytest.mark.parametrize(
    "wrong",
    [{"levels": 0}, {"features": 0}, {"base_res": 0}, {"base_res": 20}, {"max_res": 2}],
)
def test_impossible_shapes_are_refused(wrong):
    shape = {"levels": 4, "base_res": 3, "max_res": 18, "hashmap_size": 256, "features": 2}
    with pytest.raises(ValueError, match="1 <= base_res <= max_res"):
        HashGridConfig(**{**shape, **wrong})


@pytest.mark.parametrize(("entries", "hint"), [(0, 2), (1, 2), (3, 4), (255, 256), (257, 512)])
def test_tables_must_have_a_power_of_two_entries(entries, hint):
    with pytest.raises(ValueError, match=f"not {entries}. Use for example {hint}"):
        HashGridConfig(levels=4, base_res=3, max_res=18, hashmap_size=entries, features=2)


# --- vertices ---


def _entries(points, resolution, entries):
    """The table entries of grid vertices, as a cell has them in whose corner they lie."""
    position = [*jnp.asarray(np.asarray(points) / resolution, jnp.float32).T]
    rows, weights = (
        np.array(x)
        for x in zip(*hash_grid_kernels.corners(position, resolution, entries), strict=True)
    )
    assert weights.max(axis=0).min() > 0.99
    return np.take_along_axis(rows, weights.argmax(axis=0)[None], axis=0)[0]


def test_entries_by_hand():
    assert _entries([[1, 2, 3]], 4, 128) == 1 + 2 * 5 + 3 * 25  # dense
    # 1 xor 2654435761 * 2 xor 805459861 * 3, each modulo 2^32; then the last eight bits.
    hashed = (1 ^ (2654435761 * 2 % 2**32) ^ (805459861 * 3 % 2**32)) % 256
    assert _entries([[1, 2, 3]], 16, 256) == hashed


@pytest.mark.parametrize(
    ("resolution", "entries"), [(5, 256), (18, 256), (18, 8192), (8192, 2**16)]
)
def test_entries_against_python_integers(resolution, entries):
    drawn = np.random.default_rng(0).integers(0, resolution + 1, size=(40, 3))
    drawn[:2] = [[0, 0, 0], [resolution] * 3]
    expected = [reference_sampling.vertex_entry(v, resolution, entries) for v in drawn]
    np.testing.assert_array_equal(_entries(drawn, resolution, entries), expected)


def test_vertices_of_a_dense_level_have_entries_of_their_own():
    every = list(itertools.product(range(6), repeat=3))
    np.testing.assert_array_equal(np.sort(_entries(every, 5, 256)), np.arange(216))


# --- interpolation ---


def test_features_against_a_loop():
    np.testing.assert_allclose(_at(_POSITIONS), _expected(_POSITIONS), atol=_BLENDING)


def test_features_of_blurred_points_against_a_loop():
    scales = np.random.default_rng(2).choice([0.0, 1e-3, 0.03, 0.2, 1.0], size=len(_POSITIONS))
    got, expected = _at(_POSITIONS, scales), _expected(_POSITIONS, scales)
    np.testing.assert_allclose(got, expected, atol=_BLENDING)


def test_a_position_that_rounding_left_outside_the_cube_is_finite():
    outside = np.nextafter(np.float32([0.0, 1.0]), np.float32([-1.0, 2.0]))
    positions = np.array(list(itertools.product(outside, repeat=3)))
    np.testing.assert_allclose(_at(positions), _at(np.round(positions)), atol=_BLENDING)


@pytest.mark.parametrize("resolution", [1, 16, 8192])
def test_fading_follows_the_error_function(resolution):
    scales = np.geomspace(1e-3, 1e3, 13) / resolution
    expected = scipy.special.erf(1.0 / (np.sqrt(8.0) * scales * resolution))
    got = jax.vmap(lambda s: hash_grid.fading(s, resolution))(jnp.asarray(scales, jnp.float32))
    np.testing.assert_allclose(got, expected, rtol=2e-6)


@pytest.mark.parametrize(
    ("scale", "expected"), [(0.0, 1.0), (1e-30, 1.0), (1e10, 0.0), (1e30, 0.0)]
)
def test_fading_at_its_ends(scale, expected):
    value, slope = jax.value_and_grad(lambda s: hash_grid.fading(s, 64))(jnp.float32(scale))
    np.testing.assert_allclose(value, expected, atol=1e-10)
    assert slope == 0.0 or scale > 1.0
    assert np.isfinite(slope)


def _multisamples(count, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        jnp.asarray(rng.uniform(size=(count, 3)), jnp.float32),
        jnp.asarray(rng.uniform(size=count) * 0.1, jnp.float32),
    )


@pytest.mark.slow
def test_multisamples_are_averaged():
    gaussians = _multisamples(6)
    nested = {"params": {"grid": _parameters()["params"]}}
    got = MultisampledGrid(_CONFIG).apply(nested, gaussians)
    np.testing.assert_allclose(got, np.mean(_at(*gaussians), axis=0), atol=_BLENDING)
    np.testing.assert_allclose(got, _expected(*gaussians).mean(axis=0), atol=_BLENDING)


def test_multisamples_share_their_tables():
    grid = MultisampledGrid(_CONFIG)
    one, six = (
        jax.eval_shape(grid.init, jax.random.key(0), _multisamples(count)) for count in (1, 6)
    )
    assert jax.tree.map(jnp.shape, one) == jax.tree.map(jnp.shape, six)


def test_tables_are_all_found_in_order():
    tables = hash_grid.tables(_parameters())
    assert [table.shape for table in tables] == [(64, 2), (216, 2), (256, 2), (256, 2)]


def test_tables_are_found_in_any_tree_and_nothing_else_is():
    tree = {"a": (_parameters(), {"Dense_0": jnp.ones((3, 3))}), "b": [_parameters()]}
    assert len(hash_grid.tables(tree)) == 8
    assert hash_grid.tables({"Dense_0": jnp.ones(3)}) == []


def test_tables_start_small_and_even():
    params = jax.jit(_initialise)(3)
    entries = np.concatenate([np.ravel(table) for table in hash_grid.tables(params)])
    assert abs(entries).max() <= 1e-4 and abs(entries.mean()) < 1e-5
    np.testing.assert_allclose(entries.std(), 1e-4 / np.sqrt(3.0), rtol=0.1)


@jax.jit
def _gradients(params, position, scale):
    total = lambda *x: jnp.sum(HashGrid(_CONFIG).apply(*x))
    return jax.grad(total, argnums=(0, 1, 2))(params, position, scale)


@pytest.mark.slow
@pytest.mark.parametrize("position", [_POSITIONS[0], _POSITIONS[7], _POSITIONS[9], _POSITIONS[-1]])
def test_gradients_reach_the_touched_entries_only(position):
    by_params, _, _ = _gradients(_parameters(), jnp.asarray(position), jnp.float32(0.02))
    for gradient, resolution in zip(hash_grid.tables(by_params), _RESOLUTIONS, strict=True):
        expected = np.zeros(gradient.shape)
        fade = reference_sampling.grid_fading(0.02, resolution)
        for entry, weight in reference_sampling.touched_entries(
            position, resolution, _CONFIG.hashmap_size
        ):
            expected[entry] += weight * fade
        np.testing.assert_allclose(gradient, expected, atol=_BLENDING)
        np.testing.assert_array_equal(np.asarray(gradient)[expected == 0.0], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("position", [_POSITIONS[0], _POSITIONS[7], _POSITIONS[9]])
@pytest.mark.parametrize("scale", [0.0, 1e-30, 0.1, 1e10, 1e30])
def test_gradients_are_finite(position, scale):
    got = _gradients(_parameters(), jnp.asarray(position), jnp.float32(scale))
    assert gradients.all_finite(got)


@pytest.mark.slow
def test_check_grads():
    def features(tables, position, scale):
        params = {"params": {f"hash_table_{i:02d}": table for i, table in enumerate(tables)}}
        return HashGrid(_CONFIG).apply(params, position, scale)

    wide = [np.asarray(table, np.float64) for table in hash_grid.tables(_parameters())]

    def by_place(position, scale):
        return features([jnp.asarray(table) for table in wide], position, scale)

    gradients.assert_numerical(by_place, [0.31, 0.62, 0.13], 0.05, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
def test_transformations_change_nothing(transformation):
    batches = jnp.asarray(_POSITIONS[-3:]), jnp.array([0.0, 0.01, 1.0])
    transformation(lambda *x: HashGrid(_CONFIG).apply(_parameters(), *x), batches)
