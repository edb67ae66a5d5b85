"""Trains an occupancy field on masks and extracts its surface.

This is the paper's method (UNISURF on masks); `masks.carve` solves the same problem exactly and
faster. The two differ between tangent cones: the visual hull bulges there, whereas here the
smoothness of the normals decides, so that round objects become rounder and flat faces less flat.
Wrong masks harm both: a ray that a mask marks as empty carves the object along its full length.

Each step draws rays, half of them from pixels near an outline of a mask, and minimises

    b C / p  +  lambda_e mean (|grad f| - 1)^2  +  lambda_s mean |n(x) - n(x + e)|^2
             +  lambda_v mean f(x) / p

where `C` is the mean binary cross entropy between rendered silhouettes and masks, `b` the softness
of the step and `p` the size of a pixel, both in edges of the cube. The first term of a ray on the
wrong side of an outline is then about its distance from the outline, in pixels. The second term,
which UNISURF does not have, keeps `f` close to a distance, at points of the surface and anywhere.
The third is UNISURF's smoothness of the normals `n` at points of the surface, with small random
steps `e`. The fourth pushes the surface outwards, too weakly to move outlines. It selects the
largest of all shapes with the same silhouettes; otherwise, a dent that no outline shows would
remain as the first steps happened to leave it.

This is one of the modules that call `jax.jit`.

Sources: Oechsle, Peng and Geiger, UNISURF (2021), section 3.3; Gropp et al., Implicit Geometric
Regularization for Learning Shapes (2020), for the second term.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.numerics import host_array
from refref_jax.reconstruct import ReconstructionError, occupancy_field
from refref_jax.reconstruct.grids import Box, Grid, Points
from refref_jax.reconstruct.masks import check_masks, find_box, hull_field, signed_distances
from refref_jax.reconstruct.occupancy_field import (
    Chord,
    OccupancyFieldConfig,
    Params,
    at,
    cross_entropy,
    logit_along,
    scan,
)


@dataclasses.dataclass(frozen=True)
class OccupancyTrainingConfig:
    """An occupancy field and its training schedule.

    Attributes:
      field: shape of the field.
      steps: number of steps.
      batch: number of rays per step.
      scan: number of samples along a ray that locate its deepest point, without gradient.
      samples: number of rendered samples around that point.
      softness: `b` at the first and the last step, in pixels; interpolated geometrically.
      rate: Adam's learning rate at the first and the last step; interpolated geometrically.
      distance: weight `lambda_e` of the field's slope.
      smoothness: weight `lambda_s` of the normals' differences.
      solidity: weight `lambda_v` of the push outwards; without it flat faces keep dents, and three
        times as much distorts outlines.
      reach: standard deviation of the steps between compared normals, in cells of the finest grid.
      surface: number of rays per batch that are used for the terms after the first.
      band: distance from an outline up to which a ray counts as near it, pixels.
    """

    field: OccupancyFieldConfig = dataclasses.field(default_factory=OccupancyFieldConfig)
    steps: int = 1200
    batch: int = 2048
    scan: int = 32
    samples: int = 4
    softness: tuple[float, float] = (2.0, 0.02)
    rate: tuple[float, float] = (1e-2, 5e-4)
    distance: float = 0.1
    smoothness: float = 0.02
    solidity: float = 0.001
    reach: float = 1.0
    surface: int = 256
    band: float = 3.0

    def __post_init__(self) -> None:
        """Validates the schedule."""
        if min(self.steps, self.samples) < 1 or self.scan < 2:
            raise ValueError(
                f"steps and samples must be at least 1 and scan at least 2; got {self}. "
                "Correct the configuration."
            )
        if not 1 <= self.surface <= self.batch or min(*self.softness, *self.rate) <= 0.0:
            raise ValueError(
                "softness and rate must be above 0, and surface must lie between 1 and batch; "
                f"got {self}. Correct the configuration."
            )


# As for the radiance fields: entries of a hash table are updated too rarely for 0.999.
_SECOND_MOMENT_DECAY = 0.99


class Silhouettes(NamedTuple):
    """Pixels of masks, and the chords of their rays; those near an outline come first.

    Attributes:
      chords: chords of all rays that may hit the object, followed by padding.
      seen: whether the mask marks the pixel.
      rays: number of rays; the padding after them is never drawn.
      near: number of rays near an outline.
      pixel: size of a pixel at the object, in edges of the cube.
    """

    chords: Chord
    seen: Bool[Array, " rays"]
    rays: Int[Array, ""]
    near: Int[Array, ""]
    pixel: Float[Array, ""]


class OccupancyState(NamedTuple):
    """Parameters and optimizer state during training.

    Attributes:
      step: number of steps taken.
      params: parameters of the field.
      optimizer: optax's state.
    """

    step: Int[Array, ""]
    params: Params
    optimizer: optax.OptState


class OccupancyReport(NamedTuple):
    """Values of a step before its update.

    Attributes:
      loss: minimised loss.
      wrong: share of the rays whose silhouette, rounded to 0 or 1, differs from the mask.
      slope: unweighted term of the field's slope.
      smoothness: unweighted term of the normals.
    """

    loss: Float[Array, ""]
    wrong: Float[Array, ""]
    slope: Float[Array, ""]
    smoothness: Float[Array, ""]


def init_state(key: Array, config: OccupancyTrainingConfig) -> OccupancyState:
    """Returns the initial state of a training."""
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
    """Takes steps until the total number of steps is `last`.

    Args:
      key: random key of the training; together with the step's number it determines the step's
        draws.
      state: current state, whose buffers are donated.
      views: pixels to train on.
      last: total number of steps after which to stop; any value uses the same compiled program.
      config: settings of the training.

    Returns:
      The new state, and the report of the last step.
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
    """Draws rays: half of them near outlines, the others from all pixels."""
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
    # The last rays of a batch are drawn from all pixels, so they also see the front of the object.
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
    """Returns the term of the field's slope, and that of the normals at surface points."""
    cell = 1.0 / config.field.grid.max_res
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


Progress = Callable[[int, OccupancyReport], None]
"""Called with the number of steps taken, and the report of the last one."""

# Share of the masks that may be wrong without making the box around the object too small.
_DOUBTED = 0.05

# Cells added around the box, so that the surface stays inside.
_RIM = 3

# Rays are padded to a multiple of this, so that scenes of similar size compile once.
_ROOM = 1 << 17

# Points evaluated at once, and steps between two reports.
_SWEEP = 1 << 17
_EVERY = 100


def fit(
    masks: Bool[np.ndarray, "views h w"],
    cameras: Cameras,
    *,
    config: OccupancyTrainingConfig,
    seed: int = 0,
    resolution: int = 128,
    box: Box | None = None,
    progress: Progress | None = None,
) -> Grid:
    """Trains the field of an object on its masks and returns it on a grid.

    Args:
      masks: one mask per view, true where the object is visible.
      cameras: cameras of the masks, in the same order.
      config: field and training schedule.
      seed: seed of the initial parameters and of the draws of each step; equal seeds give equal
        grids.
      resolution: cells along the longest edge of the box.
      box: bounding box of the object; that of `search_box` if `None`.
      progress: function called every hundred steps and at the end.

    Raises:
      ReconstructionError: if there is no mask, if a mask is empty or of another size, if no ray
        hits the box, or if the field became empty.
    """
    check_masks(masks, cameras)
    if box is None:
        box = search_box(masks, cameras)
    spacing = float(np.max(box.high - box.low)) / (resolution - 2 * _RIM)
    wide = Box(box.low - _RIM * spacing, box.high + _RIM * spacing)
    edge = float(np.max(wide.high - wide.low))
    corner = 0.5 * (wide.low + wide.high) - 0.5 * edge
    views = _silhouettes(masks, cameras, wide, corner, edge, config.band)
    params = _train(jax.device_put(views), config, seed, progress)
    cells = np.ceil((wide.high - wide.low) / spacing - 1e-6).astype(np.int64)
    index = np.indices(cells + 1).reshape(3, -1).T
    low = 0.5 * (wide.low + wide.high) - 0.5 * cells * spacing
    values = edge * _evaluate(params, (low + spacing * index - corner) / edge, config.field)
    if not np.any(values < 0.0):
        raise ReconstructionError(
            f"The field is empty after {config.steps} steps on {len(masks)} masks. Check masks and "
            "poses with masks.carve, which names the view that removes the most, or train "
            "with more steps and a lower rate."
        )
    return Grid(values.reshape(cells + 1), low, spacing)


def search_box(masks: Bool[np.ndarray, "views h w"], cameras: Cameras) -> Box:
    """Returns a bounding box of the object; one mask in twenty may be wrong.

    Args:
      masks: one mask per view, true where the object is visible.
      cameras: cameras of the masks, in the same order.

    Raises:
      ReconstructionError: if nothing is left within `masks.REACH`.
    """
    doubted = int(_DOUBTED * len(masks))
    return find_box(hull_field(masks, cameras, outliers=doubted), masks, cameras)


def _train(
    views: Silhouettes, config: OccupancyTrainingConfig, seed: int, progress: Progress | None
) -> Params:
    first, steps = jax.random.split(jax.random.key(seed))
    state = init_state(first, config)
    for done in [*range(_EVERY, config.steps, _EVERY), config.steps]:
        state, report = train_steps(steps, state, views, np.int32(done), config=config)
        if progress is not None:
            progress(done, report)
    return state.params


def _evaluate(params: Params, positions: Points, config: OccupancyFieldConfig) -> np.ndarray:
    """Returns the field at points of the cube; the last sweep is padded, to compile one size."""
    sweep = min(_SWEEP, len(positions))
    padded = np.pad(positions, ((0, -len(positions) % sweep), (0, 0))).astype(np.float32)
    parts = [
        np.asarray(field_values(params, jax.device_put(part), config=config), np.float64)
        for part in padded.reshape(-1, sweep, 3)
    ]
    return np.concatenate(parts)[: len(positions)]


def _silhouettes(
    masks: Bool[np.ndarray, "views h w"],
    cameras: Cameras,
    box: Box,
    corner: Float[np.ndarray, "3"],
    edge: float,
    band: float,
) -> Silhouettes:
    """Returns the pixels whose rays cross a box, relative to a cube given by corner and edge."""
    parts = []
    for view, mask in enumerate(masks):
        rays = image_rays(cameras, view)
        start, end = _crossing(np.asarray(rays.origins), np.asarray(rays.directions), box)
        kept = end > start
        close = np.abs(signed_distances(mask, blur=0.0)) <= band
        chord = ((rays.origins - corner) / edge, rays.directions, start / edge, end / edge)
        parts.append((*(x[kept] for x in chord), mask[kept], close[kept]))
    *chords, seen, close = (np.concatenate(x) for x in zip(*parts, strict=True))
    if len(seen) == 0:
        raise ReconstructionError(
            f"No ray of {len(masks)} views hits the box between {np.round(box.low, 2)} and "
            f"{np.round(box.high, 2)}. Check the poses, or pass another box."
        )
    order = np.argsort(~close, kind="stable")
    away = np.linalg.norm(cameras.poses[:, :, 3] - 0.5 * (box.low + box.high), axis=-1)
    room = (0, -len(seen) % _ROOM)
    chords = [x[order].astype(np.float32) for x in chords]
    return Silhouettes(
        Chord(*(host_array(np.pad(x, (room, (0, 0))[: x.ndim])) for x in chords)),
        host_array(np.pad(seen[order], room)),
        host_array(np.int32(len(seen))),
        # Without an outline all rays count as near.
        host_array(np.int32(close.sum() or len(seen))),
        host_array(np.float32(np.median(away) / cameras.focal / edge)),
    )


def _crossing(
    origins: Float[np.ndarray, "h w 3"], directions: Float[np.ndarray, "h w 3"], box: Box
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Returns the distances at which rays enter and leave a box; the first is larger on a miss."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [(side - origins) / directions for side in box]
    # A ray within the plane of a side gives 0 / 0, which is ignored.
    near = np.nanmax(np.minimum(*ends), axis=-1)
    far = np.nanmin(np.maximum(*ends), axis=-1)
    return np.maximum(near, 0.0), far
