"""A training step at the edges of what can happen in it: values and gradients stay finite.

The step is `loop.train_steps` itself. Its gradient is read from the optimizer, which has seen no
other: the first moment of Adam is then a tenth of it.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid
from refref_jax.render import learned_media
from refref_jax.training import loop
from refref_jax.training.loop import TrainState, optimizer
from tests.factories import extremes, small_model
from tests.laws import gradients

pytestmark = [pytest.mark.loose, pytest.mark.longest]

_ADAM = 0.1

# Without a warm-up the first step moves the parameters.
_SCHEDULE = dataclasses.replace(small_model.CONFIG.schedule, warmup=0)
_CONFIG = dataclasses.replace(small_model.CONFIG, schedule=_SCHEDULE)
_FORGIVING = dataclasses.replace(
    _CONFIG, losses=dataclasses.replace(_CONFIG.losses, data="charbonnier")
)

# Between them all choices of interior, footprint, multisamples, space, dilation, loss, and near.
_CASES = {
    "field": (_CONFIG, {"near": 1e-6}),
    "clear": (
        _FORGIVING,
        {
            "interior": "clear",
            "footprint": "differential",
            "multisamples": 6,
            "near": 0.0,
            "far": 1000.0,
            "radius": 2.0,
            "space": "unbounded",
        },
    ),
    "absorbing": (
        _CONFIG,
        {
            "interior": "absorbing",
            "learned_tints": extremes.PARTS,
            "footprint": "differential",
            "near": 0.0,
            "dilation": 0.0,
        },
    ),
}

_begin = jax.jit(optimizer(_SCHEDULE, small_model.MODEL).init)

_each_precision = pytest.mark.parametrize("precision", ["float32", "bfloat16"])

# A step takes seconds to compile: every run of the suite does the richest.
_OFTEN = [("absorbing", "float32")]
_each_case = pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(*pair, marks=[] if pair in _OFTEN else pytest.mark.slow)
        for pair in itertools.product(_CASES, ("float32", "bfloat16"))
    ],
)


@functools.cache
def _case(name, precision):
    """Returns configuration, model, batches by name, and the same as a pool's paths."""
    config, changes = _CASES[name]
    model = extremes.model(precision=precision, **changes)
    batches = extremes.batches(model)
    return config, model, list(batches), extremes.stack(batches)


def _step(case, batch, params, target, *, step=2):
    """Takes one step; returns the gradient, the new parameters and the report."""
    config, model, names, traced = case
    rgb = np.broadcast_to(np.uint8(target), (len(names), extremes.RAYS, 3))
    params = jax.tree.map(jnp.array, params)
    state = TrainState(jnp.int32(step), params, _begin(params))
    first = np.int32(names.index(batch))
    order = jnp.arange(len(names), dtype=jnp.int32)
    state, report = loop.train_steps(
        state,
        loop.PretracedBatches(traced, jnp.asarray(rgb), order),
        first,
        first + 1,
        config=config,
        model=model,
    )
    gradient = jax.tree.map(lambda x: x / _ADAM, state.optimizer[0].mu)
    return gradient, state.params, jax.device_get(report)


@_each_case
def test_a_step_is_finite_whatever_it_is_given(name, precision):
    case = _case(name, precision)
    parameters = extremes.parameters(case[1])
    wrong = []
    for batch, params, target in itertools.product(case[2], parameters, (0, 255)):
        # With no trust in the proposals yet, and with some.
        step = 0 if target else 2
        gradient, moved, report = _step(case, batch, parameters[params], target, step=step)
        # Of a batch that is met exactly it is infinite.
        measured = report._replace(psnr=0.0) if report.psnr == np.inf else report
        if not gradients.all_finite((gradient, moved, measured)):
            wrong.append((batch, params, target))
    assert not wrong


@_each_case
def test_every_parameter_learns_from_an_ordinary_batch(name, precision):
    case = _case(name, precision)
    params = extremes.parameters(case[1])["trained"]
    gradient, moved, _ = _step(case, "ordinary", params, 128)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(gradient))
    changed = jax.tree.map(lambda a, b: np.any(a != b), moved, params)
    assert all(jax.tree.leaves(changed))


@pytest.mark.parametrize("batch", ["all empty", "no weight"])
def test_without_light_only_what_does_not_need_it_is_learned(batch):
    case = _case("absorbing", "float32")
    gradient, _, report = _step(case, batch, extremes.parameters(case[1])["trained"], 200)
    # Learned colours only fade, by the weight of their own loss.
    assert np.all(gradient.tints.density > 0.0) and np.all(gradient.tints.absorption > 0.0)
    assert not np.any(extremes.colour_bias(gradient))
    assert all(np.any(table) for table in hash_grid.tables(gradient))
    fading = learned_media.optical_density(extremes.parameters(case[1])["trained"].tints)
    expected = (200 / 255.0) ** 2 + _CONFIG.losses.hash_decay * report.hash_decay
    expected += _CONFIG.losses.tint_decay * fading
    if batch == "all empty":
        assert report.interlevel == report.distortion == 0.0
        np.testing.assert_allclose(report.loss, expected, rtol=1e-6)


@pytest.mark.slow
def test_light_that_found_no_room_is_told():
    config, model, names, traced = _case("field", "float32")
    some = traced._replace(dropped=traced.dropped.at[:, 0].set(jnp.array([0.3, 0.6, 0.0])))
    params = extremes.parameters(model)["trained"]
    _, _, report = _step((config, model, names, some), "ordinary", params, 128)
    np.testing.assert_allclose(report.dropped, 0.9 / (3 * extremes.RAYS), rtol=1e-6)
    _, _, report = _step((config, model, names, traced), "ordinary", params, 128)
    assert report.dropped == 0.0


@pytest.mark.slow
def test_a_perfect_batch_has_an_infinite_psnr_that_harms_nothing():
    case = _case("field", "float32")
    params = extremes.parameters(case[1])["trained"]
    gradient, moved, report = _step(case, "no weight", params, 0)
    assert report.psnr == np.inf
    assert np.isfinite(report.loss)
    assert gradients.all_finite((gradient, moved))


@pytest.mark.slow
@_each_precision
def test_colours_below_black_are_drawn_back(precision):
    case = _case("field", precision)
    beyond = extremes.with_colour(extremes.parameters(case[1])["trained"], -8.0)
    gradient, moved, _ = _step(case, "all missed", beyond, 0)
    assert np.all(extremes.colour_bias(gradient) < 0.0)
    assert np.all(extremes.colour_bias(moved) > -8.0)


@pytest.mark.slow
@_each_precision
@pytest.mark.parametrize(("target", "drawn_back"), [(255, False), (250, True)])
def test_colours_above_white_are_drawn_back_unless_a_pixel_is_saturated(
    target, drawn_back, precision
):
    case = _case("field", precision)
    beyond = extremes.with_colour(extremes.parameters(case[1])["trained"], 9.0)
    gradient, moved, _ = _step(case, "all missed", beyond, target)
    assert np.all(extremes.colour_bias(gradient) >= 0.0)
    assert np.all((extremes.colour_bias(gradient) > 0.0) == drawn_back)
    assert np.all(extremes.colour_bias(moved) <= 9.0)


@pytest.mark.slow
@_each_precision
@pytest.mark.parametrize(("raw", "target"), [(8.0, 0), (-8.0, 255)])
def test_a_wrong_colour_beyond_what_an_image_holds_can_still_turn(raw, target, precision):
    case = _case("field", precision)
    wrong = extremes.with_colour(extremes.parameters(case[1])["trained"], raw)
    gradient, _, _ = _step(case, "all missed", wrong, target)
    # An error of 1, on the slope of the sigmoid there, which the transfer function makes no flatter
    # than 0.4.
    slope = 0.3 * 2.0 / 3.0 * np.exp(-abs(raw))
    assert np.all(np.sign(raw) * extremes.colour_bias(gradient) > slope)
