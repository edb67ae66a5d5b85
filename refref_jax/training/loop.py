"""The loop over training steps: draws pixels, traces them in pools, and steps."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from refref_jax.data.batches import PixelSampler
from refref_jax.optics.budgets import Budget, capacity_for
from refref_jax.optics.scene import Scene
from refref_jax.render.config import ModelConfig, path_detail
from refref_jax.training import devices, steps
from refref_jax.training.config import TrainConfig
from refref_jax.training.state import TrainState

# Pixels by which the room for a batch's paths is measured.
_SURVEY = 1 << 14

# Memory for the light paths of all pixels.
_MOST_BYTES = 1 << 29


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
      epoch: all batches, traced once and for all; `None` if they are traced as they come.
      mesh: the devices that train together; `None` for one alone.
    """

    config: TrainConfig
    model: ModelConfig
    budget: Budget
    geometry: Scene
    sampler: PixelSampler
    capacity: int
    hit_fraction: float
    epoch: steps.Pool | None = None
    mesh: Mesh | None = None


def set_up(
    config: TrainConfig,
    model: ModelConfig,
    budget: Budget,
    geometry: Scene,
    sampler: PixelSampler,
    *,
    mesh: Mesh | None = None,
) -> Setup:
    """Moves the geometry to the devices, and measures how many paths it makes of a ray.

    Light paths of all pixels are kept if the run sees them more than once and they take at most
    half a gibibyte; while they are joined, three times that is in use.
    """
    geometry = jax.tree.map(jnp.asarray, geometry)
    found = steps.survey_paths(geometry, sampler.survey(_SURVEY).rays, budget=budget)
    found = devices.as_in_the_first(jax.device_get(found))
    capacity = capacity_for(
        budget, config.schedule.batch, mean=float(found.mean), deviation=float(found.deviation)
    )
    hit_fraction = float(found.hit_fraction)
    geometry = devices.put_everywhere(geometry, mesh=mesh)
    setup = Setup(config, model, budget, geometry, sampler, capacity, hit_fraction, mesh=mesh)
    return setup._replace(epoch=_trace_epoch(setup))


def run_steps(
    setup: Setup, state: TrainState, until: int, *, every: Sequence[int] = (1,)
) -> Iterator[tuple[TrainState, steps.StepReport]]:
    """Takes all steps up to `until`; yields the state and the report every so many of them.

    A state is consumed by the steps that follow it: copy what is to be kept. Starting from a
    restored state continues exactly where its run would have gone on.

    The light paths of the next pool are asked for before the steps of this one are, so that they
    can be traced meanwhile; there are never more than two pools.

    Args:
      setup: the run.
      state: where to begin; on all of the run's devices, if there are several.
      until: number of the last step.
      every: the state is seen at the multiples of each of these numbers, at the end of every pool,
        and at the end; in between the device takes steps without a word to the host.
    """
    config = setup.config
    step = int(state.step)
    for first, pool in _pools(setup, step, until):
        end = min(first + config.schedule.pool, until)
        while step < end:
            last = min(end, *(step + period - step % period for period in every))
            batches = np.int32(step - first), np.int32(last - first)
            state, report = steps.train_steps(
                state, pool, *batches, config=config, model=setup.model, mesh=setup.mesh
            )
            step = last
            yield state, report


def _pools(setup: Setup, step: int, until: int) -> Iterator[tuple[int, steps.Pool]]:
    """Yields the pools of some steps with the number of steps before each, one traced ahead."""
    size = setup.config.schedule.pool
    firsts = range(step - step % size, until, size)
    ahead = (_pool(setup, first) for first in firsts)
    pool = next(ahead, None)
    for first in firsts:
        following = next(ahead, None)
        yield first, pool
        pool = following


def _pool(setup: Setup, first: int) -> steps.Pool:
    """Returns the pool of the steps that follow the first so many."""
    numbers = setup.sampler.numbers(first, setup.config.schedule.pool)
    if setup.epoch is not None:
        return setup.epoch._replace(order=devices.put_everywhere(numbers, mesh=setup.mesh))
    return trace_batches(setup, numbers.tolist())


def trace_batches(setup: Setup, numbers: Sequence[int]) -> steps.Pool:
    """Traces some batches of a run, to be seen in their order."""
    drawn = setup.sampler.draw(np.asarray(numbers))
    traced = steps.trace_pool(
        setup.geometry,
        drawn.rays,
        budget=setup.budget,
        capacity=setup.capacity,
        detail=path_detail(setup.model, setup.budget),
        mesh=setup.mesh,
    )
    order = np.arange(len(numbers), dtype=np.int32)
    return steps.Pool(traced, *devices.put_everywhere((drawn.rgb, order), mesh=setup.mesh))


def _trace_epoch(setup: Setup) -> steps.Pool | None:
    """Traces all batches once and for all, if their paths are worth keeping and fit in memory.

    They are traced pool by pool, with a pool's room for paths. Training is the same whether they
    are kept or not as long as a pool has that room: when not kept, its batches are others.
    """
    config, batches = setup.config, setup.sampler.batches
    pools = range(0, batches, config.schedule.pool)
    if config.schedule.steps <= batches:
        return None
    one = jax.eval_shape(lambda: trace_batches(setup, range(config.schedule.pool)))
    bytes_ = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(one))
    if bytes_ * len(pools) > _MOST_BYTES:
        return None
    traced = [trace_batches(setup, range(first, first + config.schedule.pool)) for first in pools]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:batches], *traced)
