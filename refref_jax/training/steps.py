"""One training step, and the tracing of the light paths that many steps use.

This is one of the modules that call `jax.jit`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, UInt8

from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.budgets import Budget
from refref_jax.optics.details import Detail
from refref_jax.optics.path_tracing import Survey, Traced
from refref_jax.optics.scene import Scene
from refref_jax.render import pixels
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params
from refref_jax.training import objective
from refref_jax.training.config import TrainConfig
from refref_jax.training.devices import AXIS
from refref_jax.training.objective import StepReport, Totals
from refref_jax.training.state import TrainState, optimizer

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
_SHARED = Pool(
    traced=Traced(paths=PartitionSpec(None, AXIS), lost=PartitionSpec()),
    rgb=PartitionSpec(),
    order=PartitionSpec(),
)


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
    anneal = _anneal(state.step, config.schedule.anneal)

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
