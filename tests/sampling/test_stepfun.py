import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.sampling import stepfun
from tests.factories.arrays import singles
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# Cumulative sums of a dozen float32 numbers of about 1.
_SUMMATION = 2e-6

_BINS = 9

_AMOUNT = 0.07
_AMOUNTS = [0.0, _AMOUNT, 3.0]
_RADII = [0.003, _AMOUNT, 2.0]

_heights = jax.jit(stepfun.weight_to_pdf)
_cumulative = jax.jit(stepfun.integrate_weights)
_invert = jax.jit(stepfun.invert_cdf)
_sample = jax.jit(stepfun.sample_intervals)
_dilate = jax.jit(stepfun.dilate, static_argnums=2)
_blurred_mass = jax.jit(stepfun.blurred_mass_below, static_argnums=3)


def _step_function(seed, *, empty=0):
    """Returns edges in `[0, 1]` and weights that sum to 1, some of them 0, as float32."""
    rng = np.random.default_rng(seed)
    edges = np.concatenate([[0.0], np.sort(rng.uniform(size=_BINS - 1)), [1.0]])
    weights = rng.uniform(0.05, 1.0, size=_BINS)
    weights[rng.permutation(_BINS)[:empty]] = 0.0
    return singles(edges, weights / weights.sum())


def _middles(count):
    return (jnp.arange(count, dtype=jnp.float32) + 0.5) / count


# A dozen bins, of which some have no width at all.
_NARROW = jnp.array([0.0, 0.2, 0.2, 0.2, 0.5, 0.5 + 1e-6, 0.8, 1.0, 1.0])


def test_heights_by_hand():
    got = _heights(*singles([0.0, 0.5, 0.5, 2.5], [0.25, 0.5, 1.0]))
    np.testing.assert_allclose(got, [0.5, 0.0, 0.5])


def test_heights_have_finite_gradients_where_a_bin_has_no_width():
    total = lambda edges, weights: jnp.sum(stepfun.weight_to_pdf(edges, weights))
    assert gradients.all_finite(jax.grad(total, argnums=(0, 1))(_NARROW, jnp.ones(8)))


def test_cumulative_by_hand():
    got = _cumulative(jnp.array([1.0, 0.0, 2.0, 5.0]))
    np.testing.assert_allclose(got, [0.0, 0.125, 0.125, 0.375, 1.0], rtol=_SUMMATION)


@pytest.mark.parametrize("empty", [0, 4, _BINS - 1])
def test_cumulative_against_a_loop(empty):
    _, weights = _step_function(1, empty=empty)
    expected = reference_sampling.integrate_weights(weights)
    np.testing.assert_allclose(_cumulative(weights), expected, atol=_SUMMATION)


def test_cumulative_of_nothing_is_uniform():
    got = _cumulative(jnp.zeros(_BINS))
    np.testing.assert_allclose(got, np.linspace(0.0, 1.0, _BINS + 1), atol=_SUMMATION)


@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1e10, 1e30])
def test_cumulative_ignores_the_scale_of_the_weights(scale):
    _, weights = _step_function(2, empty=2)
    np.testing.assert_allclose(_cumulative(scale * weights), _cumulative(weights), atol=_SUMMATION)


@pytest.mark.parametrize("bins", [7, 64, 193])
def test_cumulative_runs_from_exactly_zero_to_exactly_one_and_never_decreases(bins):
    rng = np.random.default_rng(bins)
    weights = rng.uniform(size=(300, bins)) ** 4 * (rng.uniform(size=(300, bins)) > 0.5)
    cdf = np.asarray(_cumulative(*singles(weights)))
    assert (cdf[:, 0] == 0.0).all() and (cdf[:, -1] == 1.0).all()
    assert (np.diff(cdf, axis=-1) >= 0.0).all()


@pytest.mark.parametrize("weights", [np.zeros(_BINS), np.eye(_BINS)[3], np.full(_BINS, 1e-30)])
def test_cumulative_has_finite_gradients(weights):
    total = lambda w: jnp.sum(jnp.square(stepfun.integrate_weights(w)))
    assert gradients.all_finite(jax.jit(jax.grad(total))(*singles(weights)))


def test_invert_cumulative_by_hand():
    arguments = singles([0.0, 0.25, 0.5, 0.75, 1.0], [0.0, 1.0, 4.0, 6.0], [0.0, 0.5, 0.5, 1.0])
    np.testing.assert_allclose(_invert(*arguments), [0.0, 0.5, 4.0, 5.0, 6.0])


@pytest.mark.parametrize("empty", [0, 4])
def test_invert_cumulative_against_a_loop(empty):
    edges, weights = _step_function(3, empty=empty)
    cdf = _cumulative(weights)
    u = np.random.default_rng(0).uniform(size=30).astype(np.float32)
    wide = np.asarray(edges, np.float64), np.asarray(cdf, np.float64)
    expected = [reference_sampling.invert_cdf(float(x), *wide) for x in u]
    np.testing.assert_allclose(_invert(jnp.asarray(u), edges, cdf), expected, atol=_SUMMATION)


def test_invert_cumulative_skips_what_is_empty():
    edges, cdf = singles([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.0, 1.0, 1.0, 1.0])
    got = _invert(jnp.array([0.0, 1e-6, 0.5, 1.0 - 1e-6]), edges, cdf)
    np.testing.assert_allclose(got, [1.0, 1.0, 1.5, 2.0], atol=1e-5)


def test_sample_edges_by_hand():
    # Samples at 1/4 and 3/4 of the mass: at 1 and 2.5, with 1.75 between.
    got = _sample(*singles([0.25, 0.75], [0.0, 2.0, 3.0], [0.5, 0.5]))
    np.testing.assert_allclose(got, [0.25, 1.75, 3.0])


@pytest.mark.parametrize("empty", [0, 4, _BINS - 1])
@pytest.mark.parametrize("count", [2, 7, 16])
def test_sample_edges_against_a_loop(empty, count):
    edges, weights = _step_function(6, empty=empty)
    u = np.sort(np.random.default_rng(count).uniform(size=count)).astype(np.float32)
    expected = reference_sampling.sample_intervals(u, edges, weights)
    np.testing.assert_allclose(
        _sample(jnp.asarray(u), edges, weights), expected, atol=2.0 * _SUMMATION
    )


_HARD_WEIGHTS = [np.zeros(8), *np.eye(8), np.full(8, 1e-30), np.array([1.0, 0, 0, 0, 0, 0, 0, 1])]


@pytest.mark.parametrize("weights", _HARD_WEIGHTS)
@pytest.mark.parametrize("offset", [-0.5, 0.0, 0.499999])
def test_samples_are_sorted_and_stay_within_the_domain(weights, offset):
    u = (jnp.arange(16, dtype=jnp.float32) + 0.5 + offset) / 16.0
    drawn = np.asarray(_sample(u, _NARROW, *singles(weights)))
    assert np.isfinite(drawn).all() and (np.diff(drawn) >= 0.0).all()
    assert drawn[0] >= 0.0 and drawn[-1] <= 1.0


@pytest.mark.parametrize("seed", range(3))
def test_samples_of_random_functions_are_sorted_and_stay_within_the_domain(seed):
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.uniform(size=(200, 65)) ** rng.choice([1, 8], size=(200, 1)), axis=-1)
    weights = rng.uniform(size=(200, 64)) ** 8 * (rng.uniform(size=(200, 64)) > 0.7)
    u = np.sort(rng.uniform(size=(200, 32)), axis=-1)
    drawn = np.asarray(_sample(*singles(u, edges, weights)))
    first, last = np.float32(edges[:, :1]), np.float32(edges[:, -1:])
    assert ((drawn >= first) & (drawn <= last)).all()
    # Where a bin is left and the next one starts, rounding may swap two samples by this much.
    assert (np.diff(drawn, axis=-1) >= -_SUMMATION).all()


def test_all_weight_in_a_bin_of_no_width_draws_one_point():
    edges, weights = singles([0.0, 0.3, 0.3, 1.0], [0.0, 7.0, 0.0])
    np.testing.assert_allclose(_sample(_middles(8), edges, weights), np.full(9, 0.3), rtol=1e-6)


@pytest.mark.parametrize(("scale", "shift"), [(3.0, 0.0), (1.0, -5.0), (0.1, 100.0)])
def test_sampling_moves_and_scales_with_the_edges(scale, shift):
    edges, weights = _step_function(9)
    moved = _sample(_middles(16), scale * edges + shift, 5.0 * weights)
    expected = scale * _sample(_middles(16), edges, weights) + shift
    np.testing.assert_allclose(moved, expected, atol=_SUMMATION * (scale + abs(shift)))


def test_dilate_by_hand():
    edges, weights = _dilate(*singles([0.0, 0.4, 0.6, 1.0], [0.0, 1.0, 0.0]), 0.1)
    # The bins' ends, and where they were moved to: -0.1, 0.3, 0.5 and 0.5, 0.7, 1.1.
    np.testing.assert_allclose(edges, [0, 0, 0.3, 0.4, 0.5, 0.5, 0.6, 0.7, 1, 1], atol=1e-6)
    inside = (edges[:-1] >= 0.2999) & (edges[1:] <= 0.7001)
    heights = _heights(edges, weights)
    wide = np.diff(edges) > 1e-5
    np.testing.assert_allclose(heights[inside & wide], 2.5, rtol=1e-5)
    np.testing.assert_array_equal(heights[~inside], 0.0)


@pytest.mark.parametrize("amount", _AMOUNTS)
def test_dilate_against_a_loop(amount):
    edges, weights = _step_function(10, empty=3)
    grid, dilated = (np.asarray(x, np.float64) for x in _dilate(edges, weights, amount))
    assert grid.shape == (3 * _BINS + 1,)
    middles, widths = 0.5 * (grid[1:] + grid[:-1]), np.diff(grid)
    tops = [reference_sampling.dilated_height(x, edges, weights, amount) for x in middles]
    expected = np.array(tops) * widths / np.sum(np.array(tops) * widths)
    np.testing.assert_allclose(dilated, expected, atol=5.0 * _SUMMATION)


@pytest.mark.parametrize("amount", _AMOUNTS)
def test_dilate_keeps_the_domain_and_sums_to_one(amount):
    edges, weights = _step_function(11, empty=3)
    grid, dilated = _dilate(edges, 5.0 * weights, amount)
    assert grid[0] == edges[0] and grid[-1] == edges[-1]
    assert (np.diff(grid) >= 0.0).all() and (dilated >= 0.0).all()
    np.testing.assert_allclose(np.sum(dilated), 1.0, rtol=_SUMMATION)


@pytest.mark.parametrize("weights", _HARD_WEIGHTS)
def test_dilate_is_finite_with_bins_of_no_width(weights):
    grid, dilated = _dilate(_NARROW, *singles(weights), _AMOUNT)
    assert np.isfinite(grid).all() and np.isfinite(dilated).all()
    visible = (np.asarray(weights) * np.diff(_NARROW)).sum() > 0.0
    np.testing.assert_allclose(np.sum(dilated), float(visible), rtol=_SUMMATION)


def test_blurred_mass_by_hand():
    # One bin with mass 2, spread over [-0.25, 1.25]; ramps of width 0.5 at both ends.
    at = [-9.0, -0.25, 0.0, 0.25, 0.5, 0.75, 1.25, 9.0]
    expected = [0.0, 0.0, 0.125, 0.5, 1.0, 1.5, 2.0, 2.0]
    got = _blurred_mass(*singles(at, [0.0, 1.0], [2.0]), 0.25)
    np.testing.assert_allclose(got, expected, atol=_SUMMATION)


@pytest.mark.parametrize("radius", _RADII)
def test_blurred_mass_against_a_loop(radius):
    edges, weights = _step_function(17)
    at = jnp.linspace(-2.0 * radius, 1.0 + 2.0 * radius, 31)
    expected = [reference_sampling.blurred_mass_below(float(x), edges, weights, radius) for x in at]
    np.testing.assert_allclose(_blurred_mass(at, edges, weights, radius), expected, atol=1e-5)


def test_blurred_mass_of_a_bin_without_width_is_that_of_a_point():
    edges, weights = singles([0.0, 0.5, 0.5, 1.0], [0.0, 1.0, 0.0])
    got = _blurred_mass(jnp.array([0.3, 0.45, 0.5, 0.55, 0.7]), edges, weights, 0.1)
    np.testing.assert_allclose(got, [0.0, 0.25, 0.5, 0.75, 1.0], atol=_SUMMATION)


@pytest.mark.parametrize("width", [1e-3, 1e-5, 1e-7])
def test_blurred_mass_of_thin_bins_is_no_more_than_they_hold(width):
    edges = np.float32(0.6) + np.float32(width) * np.linspace(0.0, 1.0, 9)
    edges, weights = singles([0.0, *edges, 1.0], [0.0, *np.full(8, 0.125), 0.0])
    below = np.asarray(_blurred_mass(jnp.linspace(0.0, 1.0, 201), edges, weights, 0.01))
    assert (np.diff(below) >= -_SUMMATION).all()
    assert below.max() <= 1.0 + _SUMMATION
    # A float32 number near 0.6 is only known to 6e-8, which is 3e-6 of the blurred width.
    expected = np.clip((np.linspace(0.0, 1.0, 201) - 0.6 - 0.5 * width + 0.01) / 0.02, 0.0, 1.0)
    np.testing.assert_allclose(below, expected, atol=width / 0.02 + 1e-5)


def test_count_below_is_a_right_sided_search():
    values, queries = singles([0.0, 1.0, 1.0, 3.0], [-1.0, 0.0, 0.5, 1.0, 3.0, 4.0])
    expected = np.searchsorted(values, queries, side="right")
    np.testing.assert_array_equal(stepfun.count_below(values, queries), expected)
    assert stepfun.count_below(values, queries).dtype == jnp.int32


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 65])
def test_accelerators_count_the_same_values_in_blocks(count):
    draw = np.random.default_rng(count)
    values = np.sort(np.round(draw.uniform(size=(3, count)), 1), axis=-1).astype(np.float32)
    queries = np.round(draw.uniform(-0.2, 1.2, (3, 40)), 1).astype(np.float32)
    expected = np.stack(
        [np.searchsorted(*each, side="right") for each in zip(values, queries, strict=True)]
    )
    got = stepfun._count_in_blocks(jnp.asarray(values), jnp.asarray(queries))
    np.testing.assert_array_equal(got, expected)


def test_only_cpus_compare_all_values():
    traced = jax.jit(stepfun.count_below).trace(jnp.ones((5, 65)), jnp.ones((5, 9)))
    for platform, compares in {"cpu": True, "cuda": False, "tpu": False}.items():
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        assert ("5x9x65" in text) == compares


def test_take_works_batch_by_batch():
    values = jnp.arange(12.0).reshape(2, 2, 3)
    index = jnp.array([[[0, 2], [1, 1]], [[2, 2], [0, 1]]])
    got = stepfun.take(values, index)
    for batch in itertools.product(range(2), repeat=2):
        np.testing.assert_array_equal(got[batch], values[batch][index[batch]])


# --- gradients and transformations ---


def test_check_grads():
    _, weights = _step_function(18)
    edges = np.linspace(0.0, 1.0, _BINS + 1) ** 1.5
    u = np.linspace(0.07, 0.93, 6)

    def everything(u, edges, weights):
        return (
            stepfun.weight_to_pdf(edges, weights),
            stepfun.integrate_weights(weights),
            stepfun.sample_intervals(u, edges, weights),
            stepfun.blurred_mass_below(u, edges, weights, 0.2),
        )

    gradients.assert_numerical(everything, u, edges, weights)


def _batch():
    """Returns edges, weights and quantiles with a leading axis."""
    edges, weights = zip(*(_step_function(seed, empty=seed) for seed in range(3)), strict=True)
    u = jnp.stack([_middles(5)] * 3)
    return jnp.stack(edges), jnp.stack(weights), u


_CASES = {
    "heights": lambda edges, weights, u: stepfun.weight_to_pdf(edges, weights),
    "integrate_weights": lambda edges, weights, u: stepfun.integrate_weights(weights),
    "invert_cdf": lambda edges, weights, u: stepfun.invert_cdf(
        u, edges, stepfun.integrate_weights(weights)
    ),
    "sample_intervals": lambda edges, weights, u: stepfun.sample_intervals(u, edges, weights),
    "dilate": lambda edges, weights, u: stepfun.dilate(edges, weights, _AMOUNT),
    "blurred_mass_below": lambda edges, weights, u: stepfun.blurred_mass_below(
        u, edges, weights, _AMOUNT
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("transformation", [transformations.jitted, transformations.batched])
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    transformation(_CASES[name], _batch())


_snap = jax.jit(stepfun.snap)


def test_snap_by_hand():
    edges = jnp.array([0.0, 0.2, 0.5, 0.7, 1.0])
    np.testing.assert_array_equal(
        _snap(edges, jnp.array([0.56, 0.05])), np.float32([0.0, 0.05, 0.56, 0.7, 1.0])
    )


def test_knots_outside_and_at_the_ends_draw_nothing():
    edges = jnp.array([0.1, 0.2, 0.9])
    np.testing.assert_array_equal(_snap(edges, jnp.array([0.0, 0.1, 0.9, 1.0])), edges)
    np.testing.assert_array_equal(_snap(edges, jnp.zeros(0)), edges)
    np.testing.assert_array_equal(_snap(edges[::2], jnp.array([0.5])), edges[::2])


def test_of_two_knots_that_draw_one_edge_the_first_has_it():
    edges = jnp.array([0.0, 0.5, 1.0])
    for knots in ([0.4, 0.55], [0.55, 0.4]):
        np.testing.assert_array_equal(_snap(edges, jnp.array(knots))[1], np.float32(knots[0]))


@pytest.mark.parametrize("knots", [1, 3, 24])
def test_snapped_edges_stay_in_order_and_hold_the_knots(knots):
    rng = np.random.default_rng(knots)
    edges = np.sort(rng.uniform(size=(200, 21)).astype(np.float32), axis=-1)
    edges[:50, 3:6] = edges[:50, 3:4]  # intervals of no width
    at = rng.uniform(-0.1, 1.1, size=(200, knots)).astype(np.float32)
    snapped = np.asarray(_snap(jnp.asarray(edges), jnp.asarray(at)))
    assert np.all(np.diff(snapped, axis=-1) >= 0.0)
    for row, knot, result in zip(edges, at, snapped, strict=True):
        inner = [k for k in knot if row[0] < k < row[-1]]
        for k in inner:
            # It is an edge now, or another knot was there first: its nearest edge is one.
            nearest = row[1:-1][np.argmin(np.abs(row[1:-1] - k))]
            there = result[1:-1][np.abs(row[1:-1] - nearest) == 0.0]
            assert k in result or np.isin(there, knot).any()
        kept = result == row
        assert np.isin(result[~kept], knot).all() and (~kept).sum() <= len(inner)
