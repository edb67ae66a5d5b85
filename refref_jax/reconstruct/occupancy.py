"""A body from masks by an occupancy field that is trained on their silhouettes (host).

The paper's way (UNISURF on masks), for which `visual_hull` is the exact and faster one. They differ
in what lies between tangent cones: there the hull bulges, and here the smoothness of the normals
decides, so that round bodies come out rounder and flat faces less flat. Masks that err harm both: a
ray that a mask says is empty empties all of itself in either.
"""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Bool, Float

from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.reconstruct.errors import ReconstructionError
from refref_jax.reconstruct.grids import Box, Grid, Points
from refref_jax.reconstruct.occupancy_field import OccupancyFieldConfig, Params
from refref_jax.reconstruct.occupancy_rendering import Chord
from refref_jax.reconstruct.occupancy_training import (
    OccupancyReport,
    OccupancyTrainingConfig,
    Silhouettes,
    field_values,
    init_state,
    train_steps,
)
from refref_jax.reconstruct.silhouettes import check_masks, signed_distances
from refref_jax.reconstruct.visual_hull import find_box, hull_field

Progress = Callable[[int, OccupancyReport], None]
"""Told the number of steps taken, and what the last one measured."""

# Share of the views that may be wrong without the box around the body becoming too small.
_DOUBTED = 0.05

# Cells that are added around the box, so that the surface stays within.
_RIM = 3

# Rays are filled up to a multiple of this, so that scenes of about one size compile once.
_ROOM = 1 << 17

# Points whose values are computed at once, and steps between two reports.
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
    """Returns the field of the body that masks show, trained on them, on a grid.

    Args:
      masks: one a view, true where the object is seen.
      cameras: of the masks, in the same order.
      config: the field and its training.
      seed: of the first parameters and of what each step draws; the same one gives the same grid.
      resolution: cells along the longest edge of the box.
      box: where the body lies; that of `search_box` if not given.
      progress: called every hundred steps and at the end.

    Raises:
      ReconstructionError: if there is no mask, if a mask is empty or of another size, if no ray
        meets the box, or if the field became empty.
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
            "poses with visual_hull.carve, which names the view that removes the most, or take "
            "more steps at a lower rate."
        )
    return Grid(values.reshape(cells + 1), low, spacing)


def search_box(masks: Bool[np.ndarray, "views h w"], cameras: Cameras) -> Box:
    """Returns a box around what masks show, of which a twentieth may be wrong.

    Args:
      masks: one a view, true where the object is seen.
      cameras: of the masks, in the same order.

    Raises:
      ReconstructionError: if nothing is left within `visual_hull.REACH`.
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
    """Returns the field at points of the cube; the last sweep is filled up, to compile one size."""
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
    """Returns the pixels whose rays cross a box, in the cube at a corner with an edge."""
    parts = []
    for view, mask in enumerate(masks):
        rays = image_rays(cameras, view)
        start, end = _crossing(rays.origins, rays.directions, box)
        kept = end > start
        close = np.abs(signed_distances(mask, blur=0.0)) <= band
        chord = Chord((rays.origins - corner) / edge, rays.directions, start / edge, end / edge)
        parts.append((*(x[kept] for x in chord), mask[kept], close[kept]))
    *chords, seen, close = (np.concatenate(x) for x in zip(*parts, strict=True))
    if len(seen) == 0:
        raise ReconstructionError(
            f"No ray of {len(masks)} views meets the box between {np.round(box.low, 2)} and "
            f"{np.round(box.high, 2)}. Check the poses, or give another box."
        )
    order = np.argsort(~close, kind="stable")
    away = np.linalg.norm(cameras.poses[:, :, 3] - 0.5 * (box.low + box.high), axis=-1)
    room = (0, -len(seen) % _ROOM)
    chords = [x[order].astype(np.float32) for x in chords]
    return Silhouettes(
        Chord(*(np.pad(x, (room, (0, 0))[: x.ndim]) for x in chords)),
        np.pad(seen[order], room),
        np.int32(len(seen)),
        # Without an outline all rays are as good.
        np.int32(close.sum() or len(seen)),
        np.float32(np.median(away) / cameras.focal / edge),
    )


def _crossing(
    origins: Float[np.ndarray, "h w 3"], directions: Float[np.ndarray, "h w 3"], box: Box
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Returns where rays enter and leave a box; the end is not above the start if they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [(side - origins) / directions for side in box]
    # A ray within the plane of a side gives 0 / 0, and is as good as beside it.
    near = np.nanmax(np.minimum(*ends), axis=-1)
    far = np.nanmin(np.maximum(*ends), axis=-1)
    return np.maximum(near, 0.0), far
