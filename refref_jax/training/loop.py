"""Training loop: the state of a run, pre-traced batches of light paths, and compiled steps.

The light paths of many batches are traced at once (*pre-traced*), then used by consecutive steps.
If all batches of an epoch fit in memory, they are only traced once. This module calls `jax.jit`.
"""

import functools
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, UInt8

from refref_jax.compilation import at_once, jit_quickly, runs_on_cpu, threads
from refref_jax.data.batches import PixelBatch, PixelSampler
from refref_jax.fields import registry
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import (
    STRAIGHT,
    Detail,
    PathSettings,
    capacity_for,
)
from refref_jax.optics.path_tracing import Survey, Traced
from refref_jax.render import pixels
from refref_jax.render.model import (
    ModelConfig,
    Params,
    bends_light,
    has_foreground,
    init_params,
    path_detail,
)
from refref_jax.training import devices, learned_surface, objective
from refref_jax.training.config import ScheduleConfig, TrainConfig, require
from refref_jax.training.devices import AXIS
from refref_jax.training.objective import StepReport, Totals

_EPSILON = 1e-15

# Slope of Schlick's bias function for the annealing of proposal weights (Mip-NeRF 360).
_ANNEAL_SLOPE = 10.0

# Number of pixels from which the capacity for the paths of a batch is estimated.
_SURVEY = 1 << 14

MULTIPLE = 128
"""Number that divides the capacity for the paths of a batch on accelerators."""

# Maximum memory for the light paths of all pixels.
_MOST_BYTES = 1 << 29


class TrainState(NamedTuple):
    """State of a run.

    Attributes:
      step: number of steps taken. With the seed, it determines the pixels and the noise of the
        next step, so it is also the position in the data.
      params: parameters of the model.
      optimizer: state of optax.
    """

    step: Int[Array, ""]
    params: Params
    optimizer: optax.OptState


def init_state(seed: int, model: ModelConfig, schedule: ScheduleConfig) -> TrainState:
    """Returns the initial state of a run."""
    # One program for all arrays compiles in half of the time of one for each.
    params = jax.jit(init_params, static_argnames="config")(jax.random.key(seed), config=model)
    moments = optimizer(schedule, model).init(params)
    return TrainState(jnp.zeros((), jnp.int32), params, moments)


def optimizer(schedule: ScheduleConfig, model: ModelConfig) -> optax.GradientTransformation:
    """Returns Adam with the schedule's learning rate and second moment decay.

    A backdrop behind a field stays as it is, and a surface that bends light learns slowly.
    """
    rate = learning_rate(schedule)
    adam = optax.adam(rate, b2=schedule.adam_b2, eps=_EPSILON)
    if bends_light(model):
        slow = learned_surface.slowed(rate, model, require(schedule.steps))
        surface = optax.adam(slow, b2=schedule.adam_b2, eps=_EPSILON)
        return optax.partition({"learned": adam, "surface": surface}, _surface_labels)
    if not has_foreground(model):
        return adam
    return optax.partition({"learned": adam, "fixed": optax.set_to_zero()}, _labels)


def _surface_labels(params: Params) -> Params:
    """Returns which parameters are those of a surface that bends light."""
    learned = jax.tree.map(lambda leaf: "learned", params)
    surface = jax.tree.map(lambda leaf: "surface", params.field.surface)
    return learned._replace(field=learned.field._replace(surface=surface))


def _labels(params: Params) -> Params:
    """Returns which parameters are learned in front of a backdrop, and which are fixed."""
    learned = jax.tree.map(lambda leaf: "learned", params)
    fixed = jax.tree.map(lambda leaf: "fixed", params.field)
    return learned._replace(field=fixed._replace(field=learned.field.field))


def learning_rate(schedule: ScheduleConfig) -> optax.Schedule:
    """Returns the learning rate by step: a linear warm-up, then an exponential decay.

    Source: paper (arXiv 2505.05848), supplement (implementation details).
    """
    steps, warmup = require(schedule.steps), require(schedule.warmup)
    peak, end = require(schedule.peak), require(schedule.end)
    return optax.warmup_exponential_decay_schedule(
        init_value=0.0,
        peak_value=peak,
        warmup_steps=warmup,
        transition_steps=max(1, steps - warmup),
        decay_rate=end / peak,
        end_value=end,
    )


class PretracedBatches(NamedTuple):
    """Pre-traced light paths and true colours of many batches, and the batch of each step.

    Attributes:
      traced: light paths, stacked by batch.
      rgb: true colours, 8-bit sRGB.
      order: index of the batch of each step.
      views: index of the image of each ray, if the exposure of images is learned.
    """

    traced: Traced
    rgb: UInt8[Array, "batches rays 3"]
    order: Int[Array, " steps"]
    views: Int[Array, "batches rays"] | None = None


# Sharding of pre-traced batches: every device has a share of the paths of every batch, and all
# colours. `Any`, as a specification takes the place of each array.
_SHARE: Any = PartitionSpec(None, AXIS)
_WHOLE: Any = PartitionSpec()
_SHARED = PretracedBatches(Traced(paths=_SHARE, dropped=_WHOLE), _WHOLE, _WHOLE, _WHOLE)


@functools.partial(jit_quickly, static_argnames=("settings", "capacity", "detail", "mesh"))
def pretrace(
    scene: Scene,
    rays: Rays,
    *,
    settings: PathSettings,
    capacity: int,
    detail: Detail,
    mesh: Mesh | None = None,
) -> Traced:
    """Traces the rays `[batches, rays]` of many batches; see `path_tracing.trace_batches`.

    Each device of a mesh traces whole batches; afterwards it holds a share of the paths of every
    batch. Lists that cannot be shared evenly are padded with empty slots.
    """
    trace = functools.partial(
        path_tracing.trace_batches, settings=settings, capacity=capacity, detail=detail
    )
    if mesh is None:
        return trace(scene, rays)
    batches = rays.radii.shape[0]
    again = jnp.arange(-(-batches // mesh.size) * mesh.size) % batches
    specs = PartitionSpec(), PartitionSpec(AXIS)
    trace = jax.shard_map(trace, mesh=mesh, in_specs=specs, out_specs=specs[1], check_vma=False)
    traced = trace(scene, jax.tree.map(lambda x: x[again], rays))
    paths, dropped = jax.tree.map(lambda x: x[:batches], traced)
    paths = jax.vmap(functools.partial(light_paths.filled_up, multiple=mesh.size))(paths)
    shared = jax.tree.map(lambda spec: NamedSharding(mesh, spec), _SHARED.traced)
    return jax.lax.with_sharding_constraint(Traced(paths, dropped), shared)


@functools.partial(jit_quickly, static_argnames="settings")
def survey_paths(scene: Scene, rays: Rays, *, settings: PathSettings) -> Survey:
    """Returns statistics of the paths of the rays `[rays]`; see `path_tracing.survey`."""
    return path_tracing.survey(scene, rays, settings=settings)


@functools.partial(jax.jit, static_argnames=("config", "model", "mesh"), donate_argnames="state")
def train_steps(
    state: TrainState,
    pretraced: PretracedBatches,
    first: Int[Array, ""],
    last: Int[Array, ""],
    *,
    config: TrainConfig,
    model: ModelConfig,
    mesh: Mesh | None = None,
) -> tuple[TrainState, StepReport]:
    """Takes consecutive steps with pre-traced batches, without returning to the host in between.

    Args:
      state: state before the first step, which is donated: its buffers are reused.
      pretraced: light paths and colours.
      first: index of the first step in the order of the batches.
      last: index after the last step; all numbers of steps share one compiled program.
      config: configuration of the run.
      model: configuration of the model.
      mesh: devices that share the paths, as in `pretrace`; they affect results only by rounding.

    Returns:
      The state after the last step, and the report of that step.
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
    return take(state, pretraced, first, last)


def _take_steps(
    state: TrainState,
    pretraced: PretracedBatches,
    first: Int[Array, ""],
    last: Int[Array, ""],
    *,
    config: TrainConfig,
    model: ModelConfig,
    axis: str | None = None,
) -> tuple[TrainState, StepReport]:
    step = functools.partial(_step, pretraced=pretraced, config=config, model=model, axis=axis)
    shapes = jax.eval_shape(step, state, first)[1]
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.fori_loop(
        first, last, lambda place, carry: step(carry[0], place), (state, blank)
    )


def _step(
    state: TrainState,
    place: Int[Array, ""],
    *,
    pretraced: PretracedBatches,
    config: TrainConfig,
    model: ModelConfig,
    axis: str | None,
) -> tuple[TrainState, StepReport]:
    """Takes one step, with this device's paths of the batch."""
    batch = pretraced.order[place]
    kept = pretraced.traced, pretraced.rgb, pretraced.views
    traced, rgb, views = jax.tree.map(lambda x: x[batch], kept)
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    branches = (
        path_tracing.branches_of(learned_surface.settings_of(config)) if bends_light(model) else 1
    )
    jitter = pixels.random_jitter(key, model, _slots(branches * traced.paths.radii.shape[0], axis))
    anneal = _anneal(state.step, require(config.schedule.anneal))
    progress = _progress(state.step, config, model)

    gather = functools.partial(
        pixels.gather_light, rays=rgb.shape[0], anneal=anneal, progress=progress
    )

    def sum_paths(params: Params) -> Totals:
        if bends_light(model):
            through = key, params, model, traced.paths, jitter
            return learned_surface.total(*through, gather=gather, progress=progress, config=config)
        light = gather(params, model, traced.paths, jitter)
        return objective.total(light, traced.paths, config.losses)

    def combine(params: Params, totals: Totals) -> tuple[Float[Array, ""], StepReport]:
        target = rgb.astype(jnp.float32) / 255.0
        losses, dropped = config.losses, traced.dropped
        report = objective.measure(
            params, totals, target, dropped, losses, progress=progress, views=views
        )
        return report.loss, report

    # The sums over paths are summed over devices between the two halves.
    totals, pull_back = jax.vjp(sum_paths, state.params)
    slopes = jax.grad(combine, argnums=(0, 1), has_aux=True)
    (by_params, by_totals), report = slopes(state.params, _sum_devices(totals, axis))
    (through_paths,) = pull_back(by_totals)
    gradient = jax.tree.map(jnp.add, by_params, _sum_devices(through_paths, axis))
    adam = optimizer(config.schedule, model)
    updates, moments = adam.update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    return TrainState(state.step + 1, params, moments), report


def _slots(paths: int, axis: str | None) -> Int[Array, " paths"]:
    """Returns the indices of this device's paths in the list of the batch."""
    slots = jnp.arange(paths, dtype=jnp.int32)
    return slots if axis is None else slots + paths * jax.lax.axis_index(axis)


def _sum_devices(tree: Any, axis: str | None) -> Any:
    return tree if axis is None else jax.lax.psum(tree, axis)


def _anneal(step: Int[Array, ""], steps: int) -> Float[Array, ""]:
    """Returns the exponent on the proposals' weights (Mip-NeRF 360, Eq 18)."""
    progress = jnp.minimum(step.astype(jnp.float32) / max(1, steps), 1.0)
    return _ANNEAL_SLOPE * progress / ((_ANNEAL_SLOPE - 1.0) * progress + 1.0)


def _progress(
    step: Int[Array, ""], config: TrainConfig, model: ModelConfig
) -> Float[Array, ""] | None:
    """Returns the progress of the training, 0 to 1, if surfaces or deformations depend on it."""
    if not (registry.has_surface(model.field) or registry.has_deformation(model.field)):
        return None
    return step.astype(jnp.float32) / require(config.schedule.steps)


class Setup(NamedTuple):
    """The constant part of a run.

    Attributes:
      config: configuration of the run.
      model: configuration of the model.
      settings: path settings.
      scene: scene through which paths are traced.
      sampler: sampler of the training pixels.
      capacity: capacity for the paths of a batch.
      hit_fraction: share of the pixels whose rays hit an object, 0 if no light is bent.
      epoch: all batches, if they are only traced once; `None` if they are traced again and again.
      mesh: devices that train together; `None` for a single device.
    """

    config: TrainConfig
    model: ModelConfig
    settings: PathSettings
    scene: Scene
    sampler: PixelSampler
    capacity: int
    hit_fraction: float
    epoch: PretracedBatches | None = None
    mesh: Mesh | None = None


def set_up(
    config: TrainConfig,
    model: ModelConfig,
    settings: PathSettings,
    scene: Scene,
    sampler: PixelSampler,
    *,
    mesh: Mesh | None = None,
    beside: Callable[["Setup", PretracedBatches], Any] | None = None,
) -> Setup:
    """Moves the scene to the devices, and estimates the number of paths per ray.

    The light paths of all pixels are kept if the run uses them more than once and they take at most
    half a gibibyte; while the last ones are cut off, twice that is in use. Where cores are free,
    `beside` is called while they are traced, such as `compile_steps`.
    """
    scene = jax.device_put(scene)
    if bends_light(model):  # paths through the surface are traced within the steps
        settings = STRAIGHT
    found = survey_paths(scene, sampler.survey(_SURVEY).rays, settings=settings)
    found = devices.as_in_the_first(jax.device_get(found))
    batch = require(config.schedule.batch)
    capacity = capacity_for(
        settings,
        batch,
        mean=float(found.mean),
        deviation=float(found.deviation),
        multiple=8 if runs_on_cpu() else MULTIPLE,
    )
    samples = model.samples + sum(each.samples for each in model.proposals)
    rendered = capacity * samples // (1 if mesh is None else mesh.size)
    devices.in_all(lambda: devices.check_memory(batch, rendered))
    hit_fraction = float(found.hit_fraction)
    scene = devices.put_everywhere(scene, mesh=mesh)
    setup = Setup(config, model, settings, scene, sampler, capacity, hit_fraction, mesh=mesh)
    drawn, kept, shapes = _draw_first(setup)
    tasks: list[Callable[[], Any]] = [lambda: _trace_epoch(setup)] if kept else []
    if beside is not None and mesh is None and threads() > 1:
        lower = functools.partial(pretrace.lower, setup.scene, drawn.rays, **_tracing(setup))
        tasks = [*(tasks or [lambda: lower().compile()]), lambda: beside(setup, shapes)]
    done = at_once(operator.call, tasks)
    return setup._replace(epoch=done[0] if kept else None)


def compile_steps(setup: Setup, pretraced: PretracedBatches) -> None:
    """Compiles `train_steps` for pre-traced batches of these shapes; JAX keeps the program."""
    config, model = setup.config, setup.model
    begin = functools.partial(init_state, config.seed, model, config.schedule)
    step, options = jax.ShapeDtypeStruct((), np.int32), {"config": config, "model": model}
    train_steps.lower(jax.eval_shape(begin), pretraced, step, step, mesh=None, **options).compile()


def run_steps(
    setup: Setup, state: TrainState, until: int, *, every: Sequence[int] = (1,)
) -> Iterator[tuple[TrainState, StepReport]]:
    """Takes all steps up to `until`, and yields the state and the report at regular steps.

    A yielded state is donated to the following steps: copy it to keep it. A run that starts from a
    restored state continues exactly like the uninterrupted run.

    The light paths of the next batches are dispatched before the steps of the current ones, so that
    they can be traced at the same time; at most twice `pretraced_batches` are held.

    Args:
      setup: constant part of the run.
      state: initial state, on all devices of the run if there are several.
      until: number of the last step.
      every: periods; the state is yielded at the multiples of each of these numbers, at the end of
        all pre-traced batches, and at the end. In between, the device takes steps without the host.
    """
    config = setup.config
    step, size = int(state.step), require(config.schedule.pretraced_batches)
    for first, pretraced in _pretraced_in_turn(setup, step, until):
        end = min(first + size, until)
        while step < end:
            last = min(end, *(step + period - step % period for period in every))
            batches = np.int32(step - first), np.int32(last - first)
            state, report = train_steps(
                state, pretraced, *batches, config=config, model=setup.model, mesh=setup.mesh
            )
            step = last
            yield state, report


def _pretraced_in_turn(
    setup: Setup, step: int, until: int
) -> Iterator[tuple[int, PretracedBatches]]:
    """Yields pre-traced batches, with the number of steps before them; traces one group ahead."""
    size = require(setup.config.schedule.pretraced_batches)
    firsts = range(step - step % size, until, size)
    ahead = ((first, _pretraced_after(setup, first)) for first in firsts)
    pretraced = next(ahead, None)
    while pretraced is not None:
        following = next(ahead, None)
        yield pretraced
        pretraced = following


def _pretraced_after(setup: Setup, first: int) -> PretracedBatches:
    """Returns the pre-traced batches of the steps after the first `first` ones."""
    numbers = setup.sampler.numbers(first, require(setup.config.schedule.pretraced_batches))
    if setup.epoch is not None:
        return setup.epoch._replace(order=devices.put_everywhere(numbers, mesh=setup.mesh))
    return trace_batches(setup, numbers.tolist())


def _tracing(setup: Setup) -> dict[str, Any]:
    """Returns the static arguments of `pretrace`."""
    return {
        "settings": setup.settings,
        "capacity": setup.capacity,
        "detail": path_detail(setup.model, setup.settings),
        "mesh": setup.mesh,
    }


def trace_batches(setup: Setup, numbers: Sequence[int]) -> PretracedBatches:
    """Traces the batches of a run with these numbers, for steps in the same order."""
    drawn = setup.sampler.draw(np.asarray(numbers))
    traced = pretrace(setup.scene, drawn.rays, **_tracing(setup))
    order = np.arange(len(numbers), dtype=np.int32)
    views = drawn.views if setup.model.learned_gains else None
    host = drawn.rgb, order, views
    return PretracedBatches(traced, *devices.put_everywhere(host, mesh=setup.mesh))


def _draw_first(setup: Setup) -> tuple[PixelBatch, bool, PretracedBatches]:
    """Draws the first batches; returns whether all are kept, and the shapes of pre-traced ones."""
    config, batches = setup.config, setup.sampler.batches
    size = require(config.schedule.pretraced_batches)
    drawn = setup.sampler.draw(setup.sampler.numbers(0, size))
    traced = pretrace.eval_shape(setup.scene, drawn.rays, **_tracing(setup))
    bytes_ = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves((traced, drawn.rgb)))
    groups = -(-batches // size)
    kept = require(config.schedule.steps) > batches and bytes_ * groups <= _MOST_BYTES
    stacked: Any = traced, drawn.rgb, drawn.views if setup.model.learned_gains else None
    count = batches if kept else size
    shape = jax.ShapeDtypeStruct
    paths, rgb, views = jax.tree.map(lambda x: shape((count, *x.shape[1:]), x.dtype), stacked)
    order: Any = shape((size,), np.int32)
    return drawn, kept, PretracedBatches(paths, rgb, order, views)


def _trace_epoch(setup: Setup) -> PretracedBatches:
    """Traces all batches in groups; one that is full drops paths, which depend on the group."""
    size, batches = require(setup.config.schedule.pretraced_batches), setup.sampler.batches
    firsts = range(0, batches, size)
    traced = (trace_batches(setup, range(first, first + size)) for first in firsts)
    return devices.concatenated(traced, count=batches)
