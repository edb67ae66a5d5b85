"""The loop over training steps: draws pixels, traces them in pools, and steps."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.data.batches import PixelSampler
from refref_jax.optics.budgets import Budget, capacity_for
from refref_jax.optics.wavefront import Geometry
from refref_jax.render.config import ModelConfig, path_detail
from refref_jax.training import steps
from refref_jax.training.config import TrainingConfig
from refref_jax.training.state import TrainState

# Pixels by which the share that meets an object is estimated.
_SURVEY = 1 << 15


class Setup(NamedTuple):
    """Everything about a run that does not change.

    Attributes:
      config: the run.
      model: the model.
      budget: which light is followed.
      geometry: what bends it.
      sampler: where the pixels come from.
      capacity: room for the paths of a batch.
      hit_fraction: share of the pixels that see an object, 0 if no light is bent.
    """

    config: TrainingConfig
    model: ModelConfig
    budget: Budget
    geometry: Geometry
    sampler: PixelSampler
    capacity: int
    hit_fraction: float


def set_up(
    config: TrainingConfig,
    model: ModelConfig,
    budget: Budget,
    geometry: Geometry,
    sampler: PixelSampler,
) -> Setup:
    """Moves the geometry to the device, and measures how many paths it makes of a ray."""
    geometry = jax.tree.map(jnp.asarray, geometry)
    found = steps.survey_paths(geometry, sampler.survey(_SURVEY).rays, budget=budget)
    capacity = capacity_for(
        budget, config.batch, mean=float(found.mean), deviation=float(found.deviation)
    )
    hit_fraction = float(found.hit_fraction)
    return Setup(config, model, budget, geometry, sampler, capacity, hit_fraction)


def run_steps(
    setup: Setup, state: TrainState, until: int
) -> Iterator[tuple[TrainState, steps.StepReport]]:
    """Yields the state and the report after every step up to `until`.

    A state is consumed by the step that follows it: copy what is to be kept. Starting from a
    restored state continues exactly where its run would have gone on.
    """
    config = setup.config
    step = int(state.step)
    while step < until:
        first = step - step % config.pool
        pool = _trace(setup, first)
        for batch in range(step - first, min(config.pool, until - first)):
            state, report = steps.train_step(
                state, pool, np.int32(batch), config=config, model=setup.model
            )
            step += 1
            yield state, report


def _trace(setup: Setup, first: int) -> steps.Pool:
    drawn = setup.sampler.draw(first, setup.config.pool)
    traced = steps.trace_pool(
        setup.geometry,
        drawn.rays,
        budget=setup.budget,
        capacity=setup.capacity,
        detail=path_detail(setup.model, setup.budget),
    )
    return steps.Pool(traced, jnp.asarray(drawn.rgb))
