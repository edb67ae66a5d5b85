"""Trains an occupancy field on silhouettes alone.

A step draws rays, half of them from pixels near an outline of a mask, and descends on

    b C / p  +  lambda_e mean (|grad f| - 1)^2  +  lambda_s mean |n(x) - n(x + e)|^2
             +  lambda_v mean f(x) / p

where `C` is the mean binary cross entropy between rendered silhouettes and masks, `b` the softness
of the step and `p` a pixel, both in edges of the cube: a ray on the wrong side of an outline then
costs about the pixels by which it is. The second term, which UNISURF has not, holds `f` to a
distance, at points of the surface and anywhere; the third is UNISURF's smoothness of the normals
`n` at points of the surface, with small random steps `e`. The fourth pushes the surface outwards,
so little that outlines resist: a dent that no outline shows would otherwise stay where the first
steps happened to leave one. Of all bodies with the same silhouettes it asks for the largest.

This is one of the modules that call `jax.jit`.

Source: Oechsle, Peng and Geiger, UNISURF (2021), section 3.3; Gropp et al., Implicit Geometric
Regularization for Learning Shapes (2020), for the second term.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.reconstruct import occupancy_field
from refref_jax.reconstruct.occupancy_config import OccupancyTrainingConfig
from refref_jax.reconstruct.occupancy_field import OccupancyFieldConfig, Params
from refref_jax.reconstruct.occupancy_rendering import (
    Chord,
    at,
    cross_entropy,
    logit_along,
    scan,
)

# As for the radiance fields: entries of a hash table are touched too rarely for 0.999.
_SECOND_MOMENT_DECAY = 0.99


class Silhouettes(NamedTuple):
    """Pixels of masks, and the chords of their rays; those near an outline come first.

    Attributes:
      chords: of all rays that may meet the body, and what fills the arrays up.
      seen: whether the mask marks the pixel.
      rays: number of rays; what follows is never drawn.
      near: number of rays that are near an outline.
      pixel: a pixel's size where the body is, in edges of the cube.
    """

    chords: Chord
    seen: Bool[Array, " rays"]
    rays: Int[Array, ""]
    near: Int[Array, ""]
    pixel: Float[Array, ""]


class OccupancyState(NamedTuple):
    """What changes while a field is trained.

    Attributes:
      step: steps taken.
      params: of the field.
      optimizer: optax's state.
    """

    step: Int[Array, ""]
    params: Params
    optimizer: optax.OptState


class OccupancyReport(NamedTuple):
    """What a step measured before it moved the parameters.

    Attributes:
      loss: what is minimised.
      wrong: share of the rays whose silhouette is on the other side of 1/2 than the mask.
      slope: unweighted term of the field's slope.
      smoothness: unweighted term of the normals.
    """

    loss: Float[Array, ""]
    wrong: Float[Array, ""]
    slope: Float[Array, ""]
    smoothness: Float[Array, ""]


def init_state(key: Array, config: OccupancyTrainingConfig) -> OccupancyState:
    """Returns the state of a training that has not begun."""
    params = occupancy_field.init(key, config.field)
    return OccupancyState(jnp.zeros((), jnp.int32), params, _optimizer(config).init(params))


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def train_steps(
    key: Array,
    state: OccupancyState,
    views: Silhouettes,
    last: Int[Array, ""],
    *,
    config: OccupancyTrainingConfig,
) -> tuple[OccupancyState, OccupancyReport]:
    """Takes steps until so many have been taken in all.

    Args:
      key: of the training; with the number of a step it fixes what the step draws.
      state: consumed.
      views: what is trained on.
      last: number of steps after which to stop; any is one compiled program.
      config: the training.

    Returns:
      The state, and what the last step measured.
    """
    step = functools.partial(_step, key, views=views, config=config)
    zero = jnp.zeros(())
    return jax.lax.fori_loop(
        state.step,
        last,
        lambda _, carry: step(carry[0]),
        (state, OccupancyReport(zero, zero, zero, zero)),
    )


@functools.partial(jax.jit, static_argnames="config")
def field_values(
    params: Params, positions: Float[Array, "points 3"], *, config: OccupancyFieldConfig
) -> Float[Array, " points"]:
    """Returns `f` at points of the cube, in edges of it."""
    return jax.vmap(functools.partial(occupancy_field.signed, params, config))(positions)


def _step(
    key: Array, state: OccupancyState, *, views: Silhouettes, config: OccupancyTrainingConfig
) -> tuple[OccupancyState, OccupancyReport]:
    """Takes one step."""
    pick, draw = jax.random.split(jax.random.fold_in(key, state.step))
    rays = _pick(pick, views, config.batch)
    chosen = views._replace(
        chords=jax.tree.map(lambda x: x[rays], views.chords), seen=views.seen[rays]
    )
    progress = state.step.astype(jnp.float32) / max(1, config.steps - 1)
    first, end = config.softness
    softness = views.pixel * first * (end / first) ** progress

    def objective(params: Params) -> tuple[Float[Array, ""], OccupancyReport]:
        report = _measure(draw, params, chosen, softness, config)
        return report.loss, report

    gradient, report = jax.grad(objective, has_aux=True)(state.params)
    updates, moments = _optimizer(config).update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    return OccupancyState(state.step + 1, params, moments), report


def _pick(key: Array, views: Silhouettes, batch: int) -> Int[Array, " batch"]:
    """Draws rays: half of them near outlines, the others anywhere."""
    one, other = jax.random.split(key)
    near = jax.random.randint(one, (batch - batch // 2,), 0, views.near)
    anywhere = jax.random.randint(other, (batch // 2,), 0, views.rays)
    return jnp.concatenate([near, anywhere])


def _measure(
    key: Array,
    params: Params,
    views: Silhouettes,
    softness: Float[Array, ""],
    config: OccupancyTrainingConfig,
) -> OccupancyReport:
    signed = functools.partial(occupancy_field.signed, params, config.field)
    keys = jax.random.split(key, 3)
    batch = views.seen.shape[0]
    looked = jax.vmap(functools.partial(scan, signed, samples=config.scan))(
        views.chords, jax.random.uniform(keys[0], (batch,))
    )
    logits = jax.vmap(functools.partial(logit_along, signed, softness=softness))(
        views.chords, looked, jax.random.uniform(keys[1], (batch, config.samples))
    )
    seen = views.seen.astype(logits.dtype)
    entropy = jnp.mean(jax.vmap(cross_entropy)(logits, seen))
    wrong = jnp.mean((logits > 0.0) != views.seen, dtype=logits.dtype)
    # The last rays of a batch are drawn from anywhere, and look at the body from the front too.
    some = jax.tree.map(lambda x: x[-config.surface :], (views.chords, looked))
    points = jax.vmap(at)(some[0], some[1].surface)
    slope, smoothness = _shape_terms(keys[2], params, points, some[1].meets, config)
    depth = _mean_where(some[1].meets, jax.vmap(signed)(points)) / views.pixel
    loss = entropy * softness / views.pixel + config.solidity * depth
    loss += config.distance * slope + config.smoothness * smoothness
    return OccupancyReport(loss, wrong, slope, smoothness)


def _shape_terms(
    key: Array,
    params: Params,
    points: Float[Array, "points 3"],
    meets: Float[Array, " points"],
    config: OccupancyTrainingConfig,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the terms of the field's slope, and of the normals where the surface is met."""
    cell = 1.0 / config.field.grid.finest
    gradient = jax.vmap(
        functools.partial(occupancy_field.slope, params, config.field, step=0.5 * cell)
    )
    one, other = jax.random.split(key)
    beside = points + config.reach * cell * jax.random.normal(one, points.shape)
    anywhere = jax.random.uniform(other, points.shape)
    slopes = gradient(jnp.concatenate([points, beside, anywhere]))
    lengths, normals = numerics.length(slopes), numerics.normalize(slopes)
    here, there, _ = jnp.split(normals, 3)
    turned = here - there
    smoothness = _mean_where(meets, numerics.dot(turned, turned))
    return jnp.mean((lengths - 1.0) ** 2), smoothness


def _mean_where(counts: Float[Array, " n"], values: Float[Array, " n"]) -> Float[Array, ""]:
    """Returns the mean of the values that count; 0, with gradient 0, if there are none."""
    return numerics.safe_divide(jnp.sum(counts * values), jnp.sum(counts))


def _optimizer(config: OccupancyTrainingConfig) -> optax.GradientTransformation:
    first, end = config.rate
    rate = optax.exponential_decay(first, config.steps, end / first)
    return optax.adam(rate, b2=_SECOND_MOMENT_DECAY, eps=1e-15)
