"""The training loop: state, compiled steps, and pre-traced batches.

What changes while a model is trained.

One training step, and the tracing of the light paths that many steps use.

This is one of the modules that call `jax.jit`.

The loop over training steps: draws pixels, traces them in pools, and steps.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, UInt8

from refref_jax.data.batches import PixelSampler
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.path_settings import Budget, Detail, capacity_for
from refref_jax.optics.path_tracing import Survey, Traced
from refref_jax.optics.scene import Scene
from refref_jax.render import pixels
from refref_jax.render.model import ModelConfig, Params, init_params, path_detail
from refref_jax.training import devices, objective
from refref_jax.training.config import ScheduleConfig, TrainConfig, settled
from refref_jax.training.devices import AXIS
from refref_jax.training.objective import StepReport, Totals

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
    steps, warmup = settled(schedule.steps), settled(schedule.warmup)
    peak, end = settled(schedule.peak), settled(schedule.end)
    return optax.warmup_exponential_decay_schedule(
        init_value=0.0,
        peak_value=peak,
        warmup_steps=warmup,
        transition_steps=max(1, steps - warmup),
        decay_rate=end / peak,
        end_value=end,
    )


# Slope of Schlick's bias function, by which trust in the proposals grows (Mip-NeRF 360).
_ANNEAL_SLOPE = 10.0


class Pool(NamedTuple):
    """The light paths and true colours of many batches, and of some steps which they see.

    Attributes:
      traced: paths, stacked by batch.
      rgb: 8-bit sRGB.
      order: the batch of each step.
    """

    traced: Traced
    rgb: UInt8[Array, "batches rays 3"]
    order: Int[Array, " steps"]


# How a pool lies on a mesh: of every batch each device has a share of the paths, and all colours.
# `Any`, as a specification takes the place of each array.
_SHARE: Any = PartitionSpec(None, AXIS)
_WHOLE: Any = PartitionSpec()
_SHARED = Pool(traced=Traced(paths=_SHARE, lost=_WHOLE), rgb=_WHOLE, order=_WHOLE)


@functools.partial(jax.jit, static_argnames=("budget", "capacity", "detail", "mesh"))
def trace_pool(
    geometry: Scene,
    rays: Rays,
    *,
    budget: Budget,
    capacity: int,
    detail: Detail,
    mesh: Mesh | None = None,
) -> Traced:
    """Traces the rays `[batches, rays]` of many batches; see `path_tracing.trace_batches`.

    The devices of a mesh trace whole batches each, and are left with a share of every batch's
    paths; a list is filled up with empty slots where it can not be shared evenly.
    """
    trace = functools.partial(
        path_tracing.trace_batches, budget=budget, capacity=capacity, detail=detail
    )
    if mesh is None:
        return trace(geometry, rays)
    batches = rays.radii.shape[0]
    again = jnp.arange(-(-batches // mesh.size) * mesh.size) % batches
    specs = PartitionSpec(), PartitionSpec(AXIS)
    trace = jax.shard_map(trace, mesh=mesh, in_specs=specs, out_specs=specs[1], check_vma=False)
    traced = trace(geometry, jax.tree.map(lambda x: x[again], rays))
    paths, lost = jax.tree.map(lambda x: x[:batches], traced)
    paths = jax.vmap(functools.partial(light_paths.filled_up, multiple=mesh.size))(paths)
    shared = jax.tree.map(lambda spec: NamedSharding(mesh, spec), _SHARED.traced)
    return jax.lax.with_sharding_constraint(Traced(paths, lost), shared)


@functools.partial(jax.jit, static_argnames="budget")
def survey_paths(geometry: Scene, rays: Rays, *, budget: Budget) -> Survey:
    """Measures how many paths the rays `[rays]` of a scene have; see `path_tracing.survey`."""
    return path_tracing.survey(geometry, rays, budget=budget)


@functools.partial(jax.jit, static_argnames=("config", "model", "mesh"), donate_argnames="state")
def train_steps(
    state: TrainState,
    pool: Pool,
    first: Int[Array, ""],
    last: Int[Array, ""],
    *,
    config: TrainConfig,
    model: ModelConfig,
    mesh: Mesh | None = None,
) -> tuple[TrainState, StepReport]:
    """Takes consecutive steps of a pool, without a word to the host in between.

    Args:
      state: consumed: its buffers are reused for the result.
      pool: light paths and colours.
      first: place of the first step in the pool's order.
      last: place after that of the last step; any number of steps is one compiled program.
      config: the run.
      model: the model.
      mesh: the devices among which the pool's paths are shared out, by `trace_pool`. Results
        depend on them by rounding alone.

    Returns:
      The state after the last step, and what that step measured.
    """
    take = functools.partial(_take_steps, config=config, model=model)
    if mesh is not None:
        whole = PartitionSpec()
        take = jax.shard_map(
            functools.partial(take, axis=AXIS),
            mesh=mesh,
            in_specs=(whole, _SHARED, whole, whole),
            out_specs=whole,
            check_vma=False,
        )
    return take(state, pool, first, last)


def _take_steps(
    state: TrainState,
    pool: Pool,
    first: Int[Array, ""],
    last: Int[Array, ""],
    *,
    config: TrainConfig,
    model: ModelConfig,
    axis: str | None = None,
) -> tuple[TrainState, StepReport]:
    step = functools.partial(_step, pool=pool, config=config, model=model, axis=axis)
    shapes = jax.eval_shape(step, state, first)[1]
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.fori_loop(
        first, last, lambda place, carry: step(carry[0], place), (state, blank)
    )


def _step(
    state: TrainState,
    place: Int[Array, ""],
    *,
    pool: Pool,
    config: TrainConfig,
    model: ModelConfig,
    axis: str | None,
) -> tuple[TrainState, StepReport]:
    """Takes one step, with the paths that this device has of the batch."""
    batch = pool.order[place]
    traced, rgb = jax.tree.map(lambda x: x[batch], (pool.traced, pool.rgb))
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    jitter = pixels.random_jitter(key, model, _slots(traced.paths.radii.shape[0], axis))
    anneal = _anneal(state.step, settled(config.schedule.anneal))

    def look(params: Params) -> Totals:
        light = pixels.gather_light(
            params, model, traced.paths, jitter, rays=rgb.shape[0], anneal=anneal
        )
        return objective.total(light, traced.paths, config.losses)

    def judge(params: Params, totals: Totals) -> tuple[Float[Array, ""], StepReport]:
        target = rgb.astype(jnp.float32) / 255.0
        report = objective.measure(params, totals, target, traced.lost, config.losses)
        return report.loss, report

    # In two halves, between which devices tell each other what their paths sum to.
    totals, pull_back = jax.vjp(look, state.params)
    slopes = jax.grad(judge, argnums=(0, 1), has_aux=True)
    (by_params, by_totals), report = slopes(state.params, _sum_devices(totals, axis))
    (through_paths,) = pull_back(by_totals)
    gradient = jax.tree.map(jnp.add, by_params, _sum_devices(through_paths, axis))
    updates, moments = optimizer(config.schedule).update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    return TrainState(state.step + 1, params, moments), report


def _slots(paths: int, axis: str | None) -> Int[Array, " paths"]:
    """Returns the places that this device's paths have in the batch's list."""
    slots = jnp.arange(paths, dtype=jnp.int32)
    return slots if axis is None else slots + paths * jax.lax.axis_index(axis)


def _sum_devices(tree: Any, axis: str | None) -> Any:
    return tree if axis is None else jax.lax.psum(tree, axis)


def _anneal(step: Int[Array, ""], steps: int) -> Float[Array, ""]:
    """Returns the exponent on the proposals' weights (Mip-NeRF 360, Eq 18)."""
    progress = jnp.minimum(step.astype(jnp.float32) / max(1, steps), 1.0)
    return _ANNEAL_SLOPE * progress / ((_ANNEAL_SLOPE - 1.0) * progress + 1.0)


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
    epoch: Pool | None = None
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
    found = survey_paths(geometry, sampler.survey(_SURVEY).rays, budget=budget)
    found = devices.as_in_the_first(jax.device_get(found))
    batch = settled(config.schedule.batch)
    capacity = capacity_for(budget, batch, mean=float(found.mean), deviation=float(found.deviation))
    hit_fraction = float(found.hit_fraction)
    geometry = devices.put_everywhere(geometry, mesh=mesh)
    setup = Setup(config, model, budget, geometry, sampler, capacity, hit_fraction, mesh=mesh)
    return setup._replace(epoch=_trace_epoch(setup))


def run_steps(
    setup: Setup, state: TrainState, until: int, *, every: Sequence[int] = (1,)
) -> Iterator[tuple[TrainState, StepReport]]:
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
    step, size = int(state.step), settled(config.schedule.pool)
    for first, pool in _pools(setup, step, until):
        end = min(first + size, until)
        while step < end:
            last = min(end, *(step + period - step % period for period in every))
            batches = np.int32(step - first), np.int32(last - first)
            state, report = train_steps(
                state, pool, *batches, config=config, model=setup.model, mesh=setup.mesh
            )
            step = last
            yield state, report


def _pools(setup: Setup, step: int, until: int) -> Iterator[tuple[int, Pool]]:
    """Yields the pools of some steps with the number of steps before each, one traced ahead."""
    size = settled(setup.config.schedule.pool)
    firsts = range(step - step % size, until, size)
    ahead = ((first, _pool(setup, first)) for first in firsts)
    pool = next(ahead, None)
    while pool is not None:
        following = next(ahead, None)
        yield pool
        pool = following


def _pool(setup: Setup, first: int) -> Pool:
    """Returns the pool of the steps that follow the first so many."""
    numbers = setup.sampler.numbers(first, settled(setup.config.schedule.pool))
    if setup.epoch is not None:
        return setup.epoch._replace(order=devices.put_everywhere(numbers, mesh=setup.mesh))
    return trace_batches(setup, numbers.tolist())


def trace_batches(setup: Setup, numbers: Sequence[int]) -> Pool:
    """Traces some batches of a run, to be seen in their order."""
    drawn = setup.sampler.draw(np.asarray(numbers))
    traced = trace_pool(
        setup.geometry,
        drawn.rays,
        budget=setup.budget,
        capacity=setup.capacity,
        detail=path_detail(setup.model, setup.budget),
        mesh=setup.mesh,
    )
    order = np.arange(len(numbers), dtype=np.int32)
    return Pool(traced, *devices.put_everywhere((drawn.rgb, order), mesh=setup.mesh))


def _trace_epoch(setup: Setup) -> Pool | None:
    """Traces all batches once and for all, if their paths are worth keeping and fit in memory.

    They are traced pool by pool, with a pool's room for paths. Training is the same whether they
    are kept or not as long as a pool has that room: when not kept, its batches are others.
    """
    config, batches = setup.config, setup.sampler.batches
    size = settled(config.schedule.pool)
    pools = range(0, batches, size)
    if settled(config.schedule.steps) <= batches:
        return None
    one = jax.eval_shape(lambda: trace_batches(setup, range(size)))
    bytes_ = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(one))
    if bytes_ * len(pools) > _MOST_BYTES:
        return None
    traced = [trace_batches(setup, range(first, first + size)) for first in pools]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:batches], *traced)
