"""What changes while a model is trained."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int

from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params, init_params
from refref_jax.training.config import ScheduleConfig

# Zip-NeRF's decay of the second moment; hash entries are touched too rarely for 0.999.
_SECOND_MOMENT_DECAY = 0.99

_EPSILON = 1e-15


class TrainState(NamedTuple):
    """State of a run.

    Attributes:
      step: steps taken. With the seed it fixes which pixels and which noise come next, so it is
        also the position in the data.
      params: the model's parameters.
      optimizer: optax's state.
    """

    step: Int[Array, ""]
    params: Params
    optimizer: optax.OptState


def init_state(seed: int, model: ModelConfig, schedule: ScheduleConfig) -> TrainState:
    """Returns the state of a run that has not begun."""
    params = init_params(jax.random.key(seed), model)
    return TrainState(jnp.zeros((), jnp.int32), params, optimizer(schedule).init(params))


def optimizer(schedule: ScheduleConfig) -> optax.GradientTransformation:
    """Returns Adam under the schedule's learning rate."""
    return optax.adam(learning_rate(schedule), b2=_SECOND_MOMENT_DECAY, eps=_EPSILON)


def learning_rate(schedule: ScheduleConfig) -> optax.Schedule:
    """Returns the learning rate by step: a linear warm-up, then an exponential decay.

    Source: paper (arXiv 2505.05848), supplement (implementation details).
    """
    return optax.warmup_exponential_decay_schedule(
        init_value=0.0,
        peak_value=schedule.peak,
        warmup_steps=schedule.warmup,
        transition_steps=max(1, schedule.steps - schedule.warmup),
        decay_rate=schedule.end / schedule.peak,
        end_value=schedule.end,
    )
