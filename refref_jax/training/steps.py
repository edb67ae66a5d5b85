"""One training step, and the tracing of the light paths that many steps use.

This is one of the modules that call `jax.jit`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, UInt8

from refref_jax import losses, numerics
from refref_jax.fields import hash_grid
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.budgets import Budget
from refref_jax.optics.details import Detail
from refref_jax.optics.light_paths import LightPaths
from refref_jax.optics.path_tracing import Survey, Traced
from refref_jax.optics.wavefront import Geometry
from refref_jax.render import dyes, pixels
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params
from refref_jax.render.transport import PathRadiance
from refref_jax.training.config import LossConfig, TrainingConfig
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


class StepReport(NamedTuple):
    """What a step measured before it moved the parameters.

    Attributes:
      loss: what is minimised.
      psnr: of the batch's sRGB colours, in dB.
      interlevel: unweighted interlevel loss.
      distortion: unweighted distortion loss.
      hash_decay: unweighted hash decay.
      lost: mean share of a ray's light that found no room among the batch's paths.
    """

    loss: Float[Array, ""]
    psnr: Float[Array, ""]
    interlevel: Float[Array, ""]
    distortion: Float[Array, ""]
    hash_decay: Float[Array, ""]
    lost: Float[Array, ""]


@functools.partial(jax.jit, static_argnames=("budget", "capacity", "detail"))
def trace_pool(
    geometry: Geometry, rays: Rays, *, budget: Budget, capacity: int, detail: Detail
) -> Traced:
    """Traces the rays `[batches, rays]` of many batches; see `path_tracing.trace_batches`."""
    return path_tracing.trace_batches(
        geometry, rays, budget=budget, capacity=capacity, detail=detail
    )


@functools.partial(jax.jit, static_argnames="budget")
def survey_paths(geometry: Geometry, rays: Rays, *, budget: Budget) -> Survey:
    """Measures how many paths the rays `[rays]` of a scene have; see `path_tracing.survey`."""
    return path_tracing.survey(geometry, rays, budget=budget)


@functools.partial(jax.jit, static_argnames=("config", "model"), donate_argnames="state")
def train_steps(
    state: TrainState,
    pool: Pool,
    first: Int[Array, ""],
    last: Int[Array, ""],
    *,
    config: TrainingConfig,
    model: ModelConfig,
) -> tuple[TrainState, StepReport]:
    """Takes consecutive steps of a pool, without a word to the host in between.

    Args:
      state: consumed: its buffers are reused for the result.
      pool: light paths and colours.
      first: place of the first step in the pool's order.
      last: place after that of the last step; any number of steps is one compiled program.
      config: the run.
      model: the model.

    Returns:
      The state after the last step, and what that step measured.
    """
    step = functools.partial(_step, pool=pool, config=config, model=model)
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
    config: TrainingConfig,
    model: ModelConfig,
) -> tuple[TrainState, StepReport]:
    """Takes one step."""
    batch = pool.order[place]
    traced, rgb = jax.tree.map(lambda x: x[batch], (pool.traced, pool.rgb))
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    jitter = pixels.random_jitter(key, model, traced.paths.radii.shape[0])
    anneal = _anneal(state.step, config.schedule.anneal)

    def objective(params: Params) -> tuple[Float[Array, ""], StepReport]:
        seen = pixels.render_pixels(
            params, model, traced.paths, jitter, rays=rgb.shape[0], anneal=anneal
        )
        target = rgb.astype(jnp.float32) / 255.0
        report = _measure(params, seen, target, traced, config.loss)
        return report.loss, report

    gradient, report = jax.grad(objective, has_aux=True)(state.params)
    updates, moments = optimizer(config.schedule).update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    return TrainState(state.step + 1, params, moments), report


def _measure(
    params: Params,
    seen: pixels.Pixels,
    target: Float[Array, "rays 3"],
    traced: Traced,
    config: LossConfig,
) -> StepReport:
    mse = losses.mean_squared_error(seen.rgb, target)
    data = mse if config.data == "mse" else losses.charbonnier(seen.rgb, target)
    interlevel, distortion = _path_losses(seen.paths, traced.paths, config)
    decay = losses.hash_decay(hash_grid.tables(params))
    loss = (
        data
        + config.interlevel * interlevel
        + config.distortion * distortion
        + config.hash_decay * decay
        + config.dye_decay * dyes.optical_density(params.dyes)
    )
    psnr = -10.0 * jnp.log10(mse)
    return StepReport(loss, psnr, interlevel, distortion, decay, jnp.mean(traced.lost))


def _path_losses(
    seen: PathRadiance, paths: LightPaths, config: LossConfig
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns interlevel and distortion loss, averaged over the paths that exist."""
    *proposals, final = seen.histograms
    exists = light_paths.exists(paths)
    interlevel = jnp.zeros(())
    for proposal, blur in zip(proposals, config.blurs, strict=True):
        per_path = jax.vmap(functools.partial(losses.interlevel, blur=blur))(final, proposal)
        interlevel += _mean_where(exists, per_path)
    counted = seen.outside
    if config.distortion_over == "everywhere":
        counted = jnp.ones_like(counted)
    distortion = jax.vmap(losses.distortion)(final, counted)
    return interlevel, _mean_where(exists, distortion)


def _mean_where(mask: Bool[Array, " n"], values: Float[Array, " n"]) -> Float[Array, ""]:
    """Returns the mean of the values that count; 0, with gradient 0, if there are none."""
    count = jnp.sum(mask, dtype=values.dtype)
    return numerics.safe_divide(jnp.sum(jnp.where(mask, values, 0.0)), count)


def _anneal(step: Int[Array, ""], steps: int) -> Float[Array, ""]:
    """Returns the exponent on the proposals' weights (Mip-NeRF 360, Eq 18)."""
    progress = jnp.minimum(step.astype(jnp.float32) / max(1, steps), 1.0)
    return _ANNEAL_SLOPE * progress / ((_ANNEAL_SLOPE - 1.0) * progress + 1.0)
