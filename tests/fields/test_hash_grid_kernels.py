import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid_kernels
from tests.factories.arrays import single
from tests.laws import gradients
from tests.oracles import reference_sampling

# Sums of products of float32 numbers of about 1, eight a point.
_BLENDING = 2e-5

# Dense (4^3 entries), and hashed.
_LEVELS = {"dense": (3, 64), "hashed": (18, 256)}
_LEVEL = pytest.mark.parametrize("level", _LEVELS)
_FEATURES = 3

_FACES = np.array(
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 0.5], [0.3, 0.0, 1.0], [1.0, 0.2, 0.0]]
)


def _table(level, seed=0):
    return np.random.default_rng(seed).normal(size=(_LEVELS[level][1], _FEATURES))


def _points(kind, count=12):
    rng = np.random.default_rng(1)
    if kind == "faces":
        return _FACES
    if kind == "one cell":
        return (1.0 + rng.uniform(size=(count, 3))) / 18.0
    return rng.uniform(size=(count, 3))


_POINTS = pytest.mark.parametrize("kind", ["anywhere", "faces", "one cell"])


def _matrix(level, points):
    """Returns the weight of every entry at every point, in float64."""
    resolution, entries = _LEVELS[level]
    matrix = np.zeros((len(points), entries))
    for row, point in zip(matrix, np.float32(points).astype(np.float64), strict=True):
        for entry, weight in reference_sampling.touched_entries(point, resolution, entries):
            row[entry] += weight
    return matrix


@functools.partial(jax.jit, static_argnames=("level", "precision"))
def _blend(table, points, *, level, precision="float32"):
    return hash_grid_kernels.interpolate(
        table, points, resolution=_LEVELS[level][0], precision=precision
    )


@functools.partial(jax.jit, static_argnames=("level", "precision"))
def _pull(table, points, slopes, *, level, precision="float32"):
    """Returns the gradient by the table."""
    total = lambda x: jnp.sum(slopes * _blend(x, points, level=level, precision=precision))
    return jax.grad(total)(table)


@_LEVEL
@_POINTS
def test_values_and_gradients_against_a_matrix(level, kind):
    points, table = _points(kind), _table(level)
    matrix = _matrix(level, points)
    got = _blend(single(table), single(points), level=level)
    np.testing.assert_allclose(got, matrix @ table, atol=_BLENDING)
    slopes = np.random.default_rng(2).normal(size=(len(points), _FEATURES))
    got = _pull(single(table), single(points), single(slopes), level=level)
    np.testing.assert_allclose(got, matrix.T @ slopes, atol=_BLENDING)


@_LEVEL
def test_a_gradient_does_not_depend_on_the_table(level):
    points, slopes = single(_points("anywhere")), jnp.ones((12, _FEATURES))
    first = _pull(single(_table(level)), points, slopes, level=level)
    huge = _pull(single(1e30 * _table(level, 5)), points, slopes, level=level)
    np.testing.assert_array_equal(first, huge)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "order"),
    [("dense", 2), ("dense", 1), ("hashed", 1)],
)
def test_derivatives_by_table_and_position(level, order):
    def blend(table, points):
        return hash_grid_kernels.interpolate(
            table, points, resolution=_LEVELS[level][0], precision="float32"
        )

    # Away from the borders of cells, where the slope jumps.
    points = (np.array([[0, 1, 2], [2, 0, 1]]) + 0.4) / _LEVELS[level][0]
    gradients.assert_numerical(blend, _table(level), points, order=order, rtol=1e-3)


# --- transformations ---


@pytest.mark.slow
@_LEVEL
def test_values_do_not_depend_on_batching(level):
    table, points = single(_table(level)), single(_points("anywhere"))
    flat = _blend(table, points, level=level)
    one = functools.partial(_blend, table, level=level)
    np.testing.assert_allclose(jax.vmap(one)(points), flat, atol=_BLENDING)
    nested = points.reshape(3, 4, 3)
    for together in (one(nested), jax.vmap(jax.vmap(one))(nested), jax.vmap(one, 1, 1)(nested)):
        np.testing.assert_allclose(together.reshape(12, _FEATURES), flat, atol=_BLENDING)


@pytest.mark.slow
@_LEVEL
def test_gradients_do_not_depend_on_batching(level):
    table, points = single(_table(level)), single(_points("anywhere"))
    slopes = single(np.random.default_rng(2).normal(size=(12, _FEATURES)))
    flat = _pull(table, points, slopes, level=level)
    nested, by_place = points.reshape(3, 4, 3), slopes.reshape(3, 4, _FEATURES)

    def total(table):
        blend = jax.vmap(jax.vmap(functools.partial(_blend, table, level=level)))
        return jnp.sum(by_place * blend(nested))

    np.testing.assert_allclose(jax.jit(jax.grad(total))(table), flat, atol=_BLENDING)
    pull = jax.vmap(functools.partial(_pull, level=level), in_axes=(None, 0, 0))
    np.testing.assert_allclose(pull(table, nested, by_place).sum(axis=0), flat, atol=_BLENDING)


@_LEVEL
def test_many_tables_at_once(level):
    tables, points = single([_table(level, 0), _table(level, 1)]), single(_points("anywhere"))
    got = jax.vmap(functools.partial(_blend, level=level), in_axes=(0, None))(tables, points)
    expected = [_matrix(level, _points("anywhere")) @ _table(level, seed) for seed in (0, 1)]
    np.testing.assert_allclose(got, expected, atol=_BLENDING)


@_LEVEL
def test_steps_in_a_scan(level):
    points = single(_points("anywhere"))

    def step(table, _):
        blend = lambda x: jnp.sum(_blend(x, points, level=level))
        return table - 0.1 * jax.grad(blend)(table), None

    got, _ = jax.jit(lambda x: jax.lax.scan(step, x, length=3))(single(_table(level)))
    slope = _matrix(level, _points("anywhere")).sum(axis=0)[:, None]
    np.testing.assert_allclose(got, _table(level) - 0.3 * slope, atol=_BLENDING)


@_LEVEL
def test_the_loop_of_cpus_means_what_the_formula_does(level):
    resolution, entries = _LEVELS[level]
    table, points = single(_table(level)), single(_points("anywhere"))
    slopes, options = table[:12], {"resolution": resolution, "entries": entries}
    np.testing.assert_allclose(
        hash_grid_kernels.scatter(slopes, points, **options),
        hash_grid_kernels._scattered(slopes, points, **options),
        atol=_BLENDING,
    )


@pytest.mark.parametrize("platform", ["cuda", "tpu"])
def test_other_devices_get_plain_operations(platform):
    arguments = jnp.zeros((64, 3)), jnp.zeros((5, 3)), jnp.zeros((5, 3))
    pull = jax.jit(functools.partial(_pull, level="dense"))
    text = pull.trace(*arguments).lower(lowering_platforms=(platform,)).as_text()
    assert "stablehlo.scatter" in text and "stablehlo.while" not in text


@_LEVEL
def test_rows_are_read_as_bfloat16_and_gradients_are_exact(level):
    table, points = single(_table(level)), single(_points("anywhere"))
    got = _blend(table, points, level=level, precision="bfloat16")
    rounded = np.asarray(table.astype(jnp.bfloat16).astype(jnp.float32), np.float64)
    expected = _matrix(level, _points("anywhere")) @ rounded
    np.testing.assert_allclose(got, expected, atol=_BLENDING)
    assert np.abs(got - _blend(table, points, level=level)).max() > 1e-4
    slopes = jnp.ones((12, _FEATURES))
    np.testing.assert_array_equal(
        _pull(table, points, slopes, level=level, precision="bfloat16"),
        _pull(table, points, slopes, level=level),
    )
