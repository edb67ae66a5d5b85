import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.training import presets
from refref_jax.training.config import ScheduleConfig, require
from refref_jax.training.loop import learning_rate, optimizer
from tests.factories.small_model import MODEL

pytestmark = pytest.mark.loose

_PAPER = ScheduleConfig(steps=25_000, warmup=1000, peak=8e-3, end=1e-3, anneal=1000)


@pytest.mark.parametrize(
    ("step", "rate"),
    [
        (0, 0.0),
        (500, 4e-3),
        (1000, 8e-3),
        (13_000, (8e-3 * 1e-3) ** 0.5),
        (25_000, 1e-3),
        (30_000, 1e-3),
    ],
)
def test_the_papers_schedule(step, rate):
    np.testing.assert_allclose(learning_rate(_PAPER)(step), rate, rtol=1e-5)


def test_adam_follows_the_schedule():
    schedule = ScheduleConfig(steps=10, warmup=2, peak=1e-2, end=1e-3, anneal=1)
    adam = optimizer(schedule, MODEL)
    state = adam.init(jnp.zeros(()))
    for step in range(10):
        update, state = jax.jit(adam.update)(jnp.float32(3.0), state, jnp.zeros(()))
        # On a constant gradient Adam's step is the learning rate.
        np.testing.assert_allclose(-update, learning_rate(schedule)(step), rtol=1e-4)


@pytest.mark.parametrize(("given", "b2"), [({}, 0.99), ({"adam_b2": 0.999}, 0.999)])
def test_adam_has_the_schedule_s_second_moment_decay(given, b2):
    adam = optimizer(dataclasses.replace(_PAPER, **given), MODEL)
    _, state = adam.update(jnp.float32(3.0), adam.init(jnp.zeros(())), jnp.zeros(()))
    np.testing.assert_allclose(state[0].nu, (1.0 - b2) * 9.0, rtol=1e-4)


@pytest.mark.parametrize("b2", [-0.1, 1.0])
def test_a_second_moment_decay_out_of_range_is_refused(b2):
    with pytest.raises(ValueError, match="adam_b2 is"):
        ScheduleConfig(adam_b2=b2)


def test_a_schedule_stretches_with_its_steps():
    half = presets.stretched(_PAPER, 12_500)
    assert (half.steps, half.warmup, half.anneal) == (12_500, 500, 500)
    assert (half.peak, half.end) == (_PAPER.peak, _PAPER.end)
    assert presets.stretched(_PAPER, 25_000) == _PAPER


def test_a_schedule_that_is_still_open_is_refused():
    assert require(0) == 0
    with pytest.raises(ValueError, match=r"Use the configuration that training\.resolve returns"):
        learning_rate(ScheduleConfig(steps=10))
