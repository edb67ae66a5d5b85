import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from refref_jax.optics.light_paths import PathStatus
from refref_jax.render.learned_media import BentRay
from refref_jax.render.model import Params
from refref_jax.render.pixels import Light
from refref_jax.render.volume_rendering import Composite, Histogram, PathRadiance
from refref_jax.training import objective
from refref_jax.training.config import LossConfig
from tests.factories import made_paths
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# A few float32 roundings.
_ROUNDING = 1e-6

# Two double sums or two integrals in float32 against float64.
_SUMMATION = 2e-5

_BLUR = 0.02


def _histogram(edges, weights):
    return Histogram(jnp.asarray(edges, jnp.float32), jnp.asarray(weights, jnp.float32))


def _random_histogram(rng, samples, *, total=1.0):
    edges = np.concatenate([[0.0], np.sort(rng.uniform(size=samples - 1)), [1.0]])
    weights = rng.uniform(size=samples) ** 4
    return _histogram(edges, total * weights / weights.sum())


def _even_histogram(weights):
    return _histogram(np.linspace(0.0, 1.0, len(weights) + 1), weights)


@functools.cache
def _interlevel_blurred(blur):
    return jax.jit(functools.partial(objective.interlevel, blur=blur))


_interlevel = _interlevel_blurred(_BLUR)
_interlevel_gradients = jax.jit(jax.grad(_interlevel, argnums=(0, 1)))
_distortion = jax.jit(objective.distortion)
_PHOTOMETRIC = {
    loss: jax.jit(loss) for loss in (objective.mean_squared_error, objective.charbonnier)
}
_PHOTOMETRIC_SLOPES = {loss: jax.jit(jax.value_and_grad(loss)) for loss in _PHOTOMETRIC}
_distortion_gradient = jax.jit(jax.grad(objective.distortion))

# --- photometric losses ---


def test_mean_squared_error_by_hand():
    rendered = jnp.array([[0.0, 0.5, 1.0], [0.2, 0.2, 0.2]])
    target = jnp.array([[0.0, 0.0, 0.0], [0.2, 0.2, 0.5]])
    expected = (0.25 + 1.0 + 0.09) / 6.0
    np.testing.assert_allclose(
        _PHOTOMETRIC[objective.mean_squared_error](rendered, target), expected, rtol=_ROUNDING
    )


def test_charbonnier_by_hand():
    rendered, target = jnp.array([[0.0, 0.003, 1.0]]), jnp.array([[0.0, 0.0, 0.0]])
    expected = (0.001 + np.sqrt(1e-5) + np.sqrt(1.0 + 1e-6)) / 3.0
    np.testing.assert_allclose(
        _PHOTOMETRIC[objective.charbonnier](rendered, target), expected, rtol=_ROUNDING
    )


@pytest.mark.parametrize("loss", _PHOTOMETRIC)
@pytest.mark.parametrize("size", [0.0, 1e-10, 1.0, 1e10])
def test_photometric_losses_are_finite(loss, size):
    rendered, target = (jnp.asarray(np.full((2, 3), x), jnp.float32) for x in (size, 0.0))
    assert gradients.all_finite(_PHOTOMETRIC_SLOPES[loss](rendered, target))


@pytest.mark.parametrize("loss", _PHOTOMETRIC)
def test_photometric_losses_check_grads(loss):
    rendered, target = np.random.default_rng(0).uniform(size=(2, 4, 3))
    gradients.assert_numerical(loss, rendered, target)


def test_interlevel_by_hand():
    # All light in [0.4, 0.6], which the proposal gives 0.75 of; the blur stays within 0.25.
    final = _histogram([0.0, 0.4, 0.6, 1.0], [0.0, 1.0, 0.0])
    proposal = _histogram([0.0, 0.25, 0.75, 1.0], [0.125, 0.75, 0.125])
    expected = 0.25**2 / (0.75 + 1e-5)
    np.testing.assert_allclose(_interlevel(final, proposal), expected, rtol=_SUMMATION)


@pytest.mark.parametrize("seed", range(3))
def test_interlevel_against_its_definition(seed):
    rng = np.random.default_rng(seed)
    final, proposal = _random_histogram(rng, 12), _random_histogram(rng, 9)
    expected = reference_sampling.interlevel(*final, *proposal, _BLUR)
    assert expected > 0.0
    np.testing.assert_allclose(_interlevel(final, proposal), expected, rtol=_SUMMATION)


def test_interlevel_is_zero_where_the_proposal_bounds_the_final_histogram():
    rng = np.random.default_rng(0)
    final = _random_histogram(rng, 12)
    edges = np.linspace(0.0, 1.0, 6)
    below = [reference_sampling.blurred_mass_below(x, *final, _BLUR) for x in edges]
    bound = _histogram(edges, np.diff(below) + 1e-4)
    assert _interlevel(final, bound) == 0.0
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(_interlevel_gradients(final, bound)))


def test_interlevel_gradient_reaches_the_proposals_weights_only():
    rng = np.random.default_rng(1)
    final, proposal = _random_histogram(rng, 12), _random_histogram(rng, 9)
    by_final, by_proposal = _interlevel_gradients(final, proposal)
    for stopped in (*by_final, by_proposal.edges):
        np.testing.assert_array_equal(stopped, np.zeros_like(stopped))
    # More weight can only bring the bound closer.
    assert (by_proposal.weights <= 0.0).all() and (by_proposal.weights < 0.0).any()


def test_interlevel_check_grads():
    # Even weights, so that the loss bends little over the step of the differences.
    final, proposal = _random_histogram(np.random.default_rng(2), 12), _even_histogram([0.1] * 9)

    def loss(weights):
        wide = [jnp.asarray(x, jnp.float64) for x in (*final, proposal.edges)]
        return objective.interlevel(Histogram(*wide[:2]), Histogram(wide[2], weights), blur=_BLUR)

    gradients.assert_numerical(loss, proposal.weights)


_NARROW = [0.0, 0.2, 0.2, 0.2, 0.5, 0.5 + 1e-6, 1.0, 1.0]


@pytest.mark.parametrize("final_weights", [np.zeros(7), np.eye(7)[2], np.full(7, 1.0 / 7.0)])
@pytest.mark.parametrize("proposal_weights", [np.zeros(7), np.eye(7)[2], np.full(7, 1.0 / 7.0)])
def test_interlevel_is_finite_with_empty_bins_and_bins_of_no_width(final_weights, proposal_weights):
    final, proposal = _histogram(_NARROW, final_weights), _histogram(_NARROW, proposal_weights)
    assert np.isfinite(_interlevel(final, proposal))
    assert gradients.all_finite(_interlevel_gradients(final, proposal))


def _converged_histogram(rng, width):
    """Returns a histogram whose light lies in a few of many very thin bins, as round a wall."""
    surface = rng.uniform(0.3, 0.6)
    thin = rng.uniform(surface, surface + width, size=24)
    edges = np.sort(np.concatenate([[0.0, 1.0], rng.uniform(size=8), thin]).astype(np.float32))
    weights = rng.uniform(size=edges.size - 1) * 1e-3
    first = np.searchsorted(edges, np.float32(surface))
    weights[first + 8 : first + 11] = 0.3
    # Edges that float32 can not tell apart hold nothing.
    weights[np.diff(edges) == 0.0] = 0.0
    return _histogram(edges, weights / weights.sum())


@pytest.mark.parametrize("blur", [0.03, 0.003])
@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_interlevel_of_a_surface_in_thin_bins(width, blur):
    """Heights of thin bins are huge; what they round off must not turn up as light elsewhere."""
    loss = _interlevel_blurred(blur)
    for seed in range(4):
        final = _converged_histogram(np.random.default_rng(seed), width)
        edges = np.linspace(0.0, 1.0, 33, dtype=np.float32)
        below = [reference_sampling.blurred_mass_below(x, *final, blur) for x in edges]
        proposal = _histogram(edges, np.maximum(0.9 * np.diff(below), 1e-4))
        expected = reference_sampling.interlevel(*final, *proposal, blur)
        np.testing.assert_allclose(loss(final, proposal), expected, rtol=1e-2)


def test_distortion_by_hand():
    # 2 * 0.25 * 0.5 between the two bins, 2 * 0.25 * 0.5 / 3 within them.
    final = _even_histogram([0.5, 0.5])
    np.testing.assert_allclose(_distortion(final, jnp.ones(2, bool)), 1.0 / 3.0, rtol=_ROUNDING)


def test_distortion_by_hand_of_the_outer_samples():
    # The middle sample lies inside: 2 * 0.16 * 2/3 between the others, 2 * 0.16 / 3 / 3 within.
    final = _even_histogram([0.4, 0.2, 0.4])
    expected = 0.32 * 2.0 / 3.0 + 0.32 / 9.0
    got = _distortion(final, jnp.array([True, False, True]))
    np.testing.assert_allclose(got, expected, rtol=_ROUNDING)


@pytest.mark.parametrize("seed", range(3))
def test_distortion_against_the_double_sum(seed):
    rng = np.random.default_rng(seed)
    final = _random_histogram(rng, 12)
    outside = rng.uniform(size=12) > 0.4
    expected = reference_sampling.distortion(*final, outside)
    np.testing.assert_allclose(_distortion(final, jnp.asarray(outside)), expected, rtol=_SUMMATION)


def _path_through_an_object(seed=3):
    """Returns a histogram whose samples 4 to 7 lie inside, and which are outside."""
    return _random_histogram(np.random.default_rng(seed), 12), np.array([1] * 4 + [0] * 4 + [1] * 4)


def test_distortion_ignores_the_samples_inside():
    final, outside = _path_through_an_object()
    outside = jnp.asarray(outside, bool)
    changed = final._replace(weights=jnp.where(outside, final.weights, 0.9))
    assert _distortion(final, outside) == _distortion(changed, outside)
    by_weights = _distortion_gradient(changed, outside).weights
    np.testing.assert_array_equal(by_weights[4:8], np.zeros(4))


def test_distortion_counts_the_samples_after_the_exit():
    final, outside = _path_through_an_object()
    outside = jnp.asarray(outside, bool)
    changed = final._replace(weights=final.weights.at[8:].multiply(2.0))
    assert _distortion(changed, outside) > _distortion(final, outside)
    by_weights = _distortion_gradient(final, outside).weights
    assert (by_weights[8:] > 0.0).all() and (by_weights[:4] > 0.0).all()


@pytest.mark.parametrize("weights", [np.zeros(7), np.eye(7)[2], np.full(7, 1e-30), np.ones(7)])
def test_distortion_is_finite_with_bins_of_no_width(weights):
    final, outside = _histogram(_NARROW, weights), jnp.ones(7, bool)
    assert np.isfinite(_distortion(final, outside))
    assert gradients.all_finite(_distortion_gradient(final, outside))


def test_distortion_check_grads():
    final, outside = _path_through_an_object()
    mask = jnp.asarray(outside, bool)
    loss = lambda edges, weights: objective.distortion(Histogram(edges, weights), mask)
    gradients.assert_numerical(loss, *final)


# --- losses of paths ---

_TURN = [(0.0, 0.0, -1.0), (0.0, 0.1, 1.0), (0.0, 1.0, 0.0)]

# Mirrored at the first surface, through the object, beside it, and an empty slot.
_PATHS = made_paths.stack(
    [
        made_paths.path([2.0], _TURN[:2], [0, 0], segments=3, throughput=(0.04,) * 3),
        made_paths.path([2.0, 1.0], _TURN, [0, 1, 0], segments=3, throughput=(0.96,) * 3),
        made_paths.path([], _TURN[:1], [0], segments=3, ray=1, status=PathStatus.MISSED),
        made_paths.path([], _TURN[:1], [0], segments=3, ray=1, status=PathStatus.EMPTY),
    ]
)


def _path_losses(histograms, path_losses):
    """Returns the totals of paths with histograms `[paths]`: of a proposal, then the final one."""
    nothing = Composite(jnp.zeros((4, 3)), *jnp.zeros((3, 4)))
    seen = PathRadiance(nothing, histograms, jnp.ones((4, 12), bool))
    config = LossConfig(blurs=(_BLUR,), path_losses=path_losses)
    return objective.total(Light(jnp.ones((2, 3)), seen), _PATHS, config)


def _some_histograms(samples):
    made = [_random_histogram(np.random.default_rng(seed), samples) for seed in range(4)]
    return jax.tree.map(lambda *x: jnp.stack(x), *made)


@pytest.mark.slow
@pytest.mark.parametrize(("path_losses", "kept"), [("all", [0, 1, 2]), ("transmitted", [1, 2])])
def test_losses_of_paths_are_those_of_the_included_paths(path_losses, kept):
    histograms = (_some_histograms(9), _some_histograms(12))
    totals = _path_losses(histograms, path_losses)
    pairs = [jax.tree.map(lambda x, i=i: x[i], histograms) for i in kept]
    expected = sum(float(_interlevel(final, proposal)) for proposal, final in pairs)
    np.testing.assert_allclose(totals.interlevel, expected, rtol=_SUMMATION)
    expected = sum(float(_distortion(final, jnp.ones(12, bool))) for _, final in pairs)
    np.testing.assert_allclose(totals.distortion, expected, rtol=_SUMMATION)
    assert totals.paths == len(kept)
    # The colours of rays keep all of their paths.
    np.testing.assert_array_equal(totals.linear, np.ones((2, 3)))


@pytest.mark.parametrize(("path_losses", "reached"), [("all", True), ("transmitted", False)])
def test_a_reflected_path_has_no_gradient_from_the_losses_of_transmitted_ones(path_losses, reached):
    def loss(proposal, final):
        totals = _path_losses((proposal, final), path_losses)
        return totals.interlevel + totals.distortion

    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(_some_histograms(9), _some_histograms(12))
    for by_histogram in slopes:
        weights = np.abs(by_histogram.weights).max(axis=-1)
        assert (weights[0] > 0.0) == reached
        assert weights[1] > 0.0 and weights[2] > 0.0 and weights[3] == 0.0


# --- hash decay ---


def test_hash_decay_by_hand():
    tables = [jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array([[2.0, 0.0]])]
    np.testing.assert_allclose(objective.hash_decay(tables), 7.5 + 2.0, rtol=_ROUNDING)


def test_hash_decay_gradient_is_per_level():
    tables = [jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array([[2.0, 0.0]])]
    first, second = jax.grad(objective.hash_decay)(tables)
    np.testing.assert_allclose(first, 2.0 * tables[0] / 4.0, rtol=_ROUNDING)
    np.testing.assert_allclose(second, [[2.0, 0.0]], rtol=_ROUNDING)


def test_hash_decay_takes_tables_of_any_sizes():
    # The shape checks look at one table of a list at random: ask them often.
    tables = [jnp.ones((2 + level, 1 + level % 2)) for level in range(8)]
    for _ in range(5):
        assert objective.hash_decay(tables) == 8.0


def test_hash_decay_without_tables_is_zero():
    assert objective.hash_decay([]) == 0.0


def _batch(make):
    items = [make(np.random.default_rng(seed)) for seed in range(3)]
    return jax.tree.map(lambda *x: jnp.stack(x), *items)


_COLOURS = tuple(np.random.default_rng(0).uniform(size=(2, 3, 5, 3)).astype(np.float32))

_CASES = {
    "mean_squared_error": (objective.mean_squared_error, lambda: _COLOURS),
    "charbonnier": (objective.charbonnier, lambda: _COLOURS),
    "interlevel": (
        lambda final, proposal: objective.interlevel(final, proposal, blur=_BLUR),
        lambda: (
            _batch(lambda rng: _random_histogram(rng, 12)),
            _batch(lambda rng: _random_histogram(rng, 9)),
        ),
    ),
    "distortion": (
        objective.distortion,
        lambda: (
            _batch(lambda rng: _random_histogram(rng, 12)),
            _batch(lambda rng: rng.uniform(size=12) > 0.5),
        ),
    ),
    "hash_decay": (lambda *tables: objective.hash_decay(list(tables)), lambda: _COLOURS),
}


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    function, make = _CASES[name]
    transformation(function, jax.tree.map(jnp.asarray, make()))


# --- bent rays ---

_deformation = jax.jit(objective.deformation)
_deformation_slopes = jax.jit(jax.grad(lambda bent: sum(objective.deformation(bent))))


def _bent_ray(places, points, *, turned=None, weights=None):
    """Returns a ray along z from the origin whose points at some distances are moved."""
    places, points = np.asarray(places, np.float64), np.asarray(points, np.float64)
    straight = np.tile([0.0, 0.0, 1.0], (len(places), 1))
    even = np.full(len(places), 1.0 / len(places))
    made = (
        points - places[:, None] * straight,
        places,
        straight,
        straight if turned is None else turned,
        even if weights is None else weights,
    )
    return BentRay(*(jnp.asarray(x, jnp.float32) for x in made))


def test_a_ray_without_bends_has_no_loss():
    found = _deformation(
        _bent_ray([0.1, 0.5, 0.6, 1.9], np.eye(3)[2] * [[0.1], [0.5], [0.6], [1.9]])
    )
    np.testing.assert_allclose(np.array(found), 0.0, atol=_ROUNDING)


def test_a_bend_costs_twice_the_sine_of_half_its_angle():
    """Nothing on both sides of the bend, where the light comes from or not."""
    places = np.array([0.0, 0.3, 0.5, 1.0, 1.2, 2.0])
    direction = np.array([np.sin(0.4), 0.0, np.cos(0.4)])
    points = np.outer(np.minimum(places, 0.5), [0, 0, 1]) + np.outer(
        np.maximum(places - 0.5, 0.0), direction
    )
    turned = np.where(places[:, None] < 0.5, [0.0, 0.0, 1.0], direction)
    for weights, share in (([0, 0, 0.2, 0, 0, 0.8], 0.1), ([0, 0, 0, 0, 0, 1.0], 0.0)):
        found = _deformation(_bent_ray(places, points, turned=turned, weights=weights))
        np.testing.assert_allclose(found.bends, (share + 1e-3) * 2.0 * np.sin(0.2), rtol=1e-4)
        np.testing.assert_allclose(found.turns, 0.0, atol=_ROUNDING)
        offset = np.sum(np.square(points - np.outer(places, [0, 0, 1])), axis=-1)
        size = np.mean(offset + np.sum(np.square(turned - [0.0, 0.0, 1.0]), axis=-1))
        np.testing.assert_allclose(found.size, size, rtol=1e-5)


def test_an_arc_costs_its_angle():
    """Of equally many, equally weighted points, in the limit of many."""
    angles = np.linspace(0.0, 1.0, 401)
    points = np.stack([1.0 - np.cos(angles), 0.0 * angles, np.sin(angles)], axis=-1)
    found = _deformation(_bent_ray(angles, points))
    np.testing.assert_allclose(found.bends, 1.0 * (1.0 / 401 + 1e-3), rtol=0.02)


def test_a_direction_that_the_bends_do_not_explain_costs_its_cosine():
    places = np.array([0.0, 1.0, 2.0, 3.0])
    turned = np.tile([np.sin(0.7), 0.0, np.cos(0.7)], (4, 1))
    points = np.outer(places, [0, 0, 1])
    found = _deformation(_bent_ray(places, points, turned=turned, weights=[0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(found.turns, 0.6 * (1.0 - np.cos(0.7)), rtol=1e-5)
    np.testing.assert_allclose(found.bends, 0.0, atol=_ROUNDING)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1.0, 1e6])
def test_losses_of_bent_rays_are_finite(scale):
    """Points at the same place, as of an empty interval, make no bend."""
    places = np.array([0.0, 0.5, 0.5, 0.5 + 1e-9, 0.8])
    points = scale * np.random.default_rng(0).normal(size=(5, 3))
    bent = _bent_ray(places, points)
    assert gradients.all_finite((_deformation(bent), _deformation_slopes(bent)))


# --- gains of images ---


def _measured(gains, linear, target, views):
    params = Params((), {}, None, jnp.asarray(gains))
    zero = jnp.zeros((), jnp.asarray(gains).dtype)
    totals = objective.Totals(jnp.asarray(linear), zero, zero, zero)
    config = LossConfig(hash_decay=0.0)
    return objective.measure(
        params,
        totals,
        jnp.asarray(target),
        jnp.zeros((len(linear), 3)),
        config,
        views=jnp.asarray(views),
    ).loss


def _gained(seed=0):
    rng = np.random.default_rng(seed)
    linear = rng.uniform(0.1, 0.6, (6, 3))
    target = rng.uniform(0.1, 0.9, (6, 3))
    return rng.normal(0.0, 0.2, (4, 3)), linear, target, np.array([0, 1, 1, 2, 0, 2])


@pytest.mark.slow
def test_gains_multiply_linear_light_and_their_geometric_mean_is_one():
    gains, linear, target, views = _gained()
    with jax.enable_x64(True):
        found = objective.gains(Params((), {}, None, jnp.asarray(gains)))
        loss = _measured(gains, linear, target, views)
    factors = np.exp(gains - gains.mean(axis=0))
    np.testing.assert_allclose(found, factors, rtol=1e-12)
    np.testing.assert_allclose(np.exp(np.log(found).mean(axis=0)), 1.0, rtol=1e-12)
    seen = factors[views] * linear  # above the knee of the transfer function
    encoded = 1.055 * seen ** (1.0 / 2.4) - 0.055
    assert float(loss) == pytest.approx(np.mean((encoded - target) ** 2), rel=1e-9)


@pytest.mark.slow
def test_a_gain_that_all_images_share_changes_nothing():
    gains, linear, target, views = _gained()
    with jax.enable_x64(True):
        pair = [_measured(gains + shift, linear, target, views) for shift in (0.0, 0.7)]
        slopes = jax.grad(_measured)(jnp.asarray(gains), linear, target, views)
    assert float(pair[1]) == pytest.approx(float(pair[0]), rel=1e-12)
    np.testing.assert_allclose(np.asarray(slopes).sum(axis=0), 0.0, atol=1e-12)


@pytest.mark.slow
def test_slopes_of_gains():
    gains, linear, target, views = _gained(1)
    with jax.enable_x64(True):
        check_grads(
            lambda x: _measured(x, linear, target, views),
            (jnp.asarray(gains),),
            order=1,
            modes="rev",
        )


@pytest.mark.slow
@pytest.mark.parametrize("extreme", [0.0, 1e-30, 1e4])
def test_gains_of_black_and_of_glaring_pixels_stay_finite(extreme):
    gains, _, target, views = _gained()
    linear = np.full((6, 3), extreme, np.float32)
    gains, target = gains.astype(np.float32), target.astype(np.float32)
    value, slopes = jax.value_and_grad(_measured)(jnp.asarray(gains), linear, target, views)
    assert np.isfinite(value) and np.all(np.isfinite(slopes))


def test_parameters_without_gains_say_so():
    with pytest.raises(ValueError, match="Train with exposure=per_image"):
        objective.gains(Params((), {}))


def _error(linear, target):
    """Returns the data loss of one pixel of equal channels."""
    totals = objective.Totals(jnp.full((1, 3), linear), *jnp.zeros(3))
    target, config = jnp.full((1, 3), target), LossConfig(hash_decay=0.0)
    return objective.measure(Params((), {}), totals, target, jnp.zeros((1, 3)), config).loss


@pytest.mark.parametrize(
    ("linear", "target", "error"),
    [
        (4.0, 1.0, 0.0),  # a lamp
        (1e4, 254.6 / 255.0, 0.0),
        (4.0, 0.9, (1.055 * 4.0 ** (1.0 / 2.4) - 0.055 - 0.9) ** 2),  # too bright
        (0.5, 1.0, (1.055 * 0.5 ** (1.0 / 2.4) - 0.055 - 1.0) ** 2),  # too dark for a lamp
    ],
)
def test_only_saturated_pixels_may_be_brighter_than_they_look(linear, target, error):
    value, slope = jax.value_and_grad(_error)(jnp.float32(linear), jnp.float32(target))
    assert float(value) == pytest.approx(error, rel=1e-5, abs=1e-12)
    assert np.isfinite(slope) and (float(slope) != 0.0) == (error != 0.0)
