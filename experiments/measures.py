"""What is measured of a rendered image, against what a scene tells of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from refref_jax import metrics
from refref_jax.data import local_layout
from refref_jax.render import Rendering


class Truth(NamedTuple):
    """What a split says of its images; masks and distances may be missing."""

    frames: local_layout.Frames
    images: UInt8[np.ndarray, "frames h w 3"]
    masks: Bool[np.ndarray, "frames h w"] | None
    distances: Float[np.ndarray, "frames h w"] | None


def read_truth(scene: Path, split: str) -> Truth:
    """Reads all that a split has."""
    frames = local_layout.read_frames(scene, split)
    return Truth(
        frames,
        local_layout.read_images(frames),
        local_layout.read_masks(frames) if frames.masks else None,
        local_layout.read_distances(frames) if frames.depths else None,
    )


def measure(seen: Rendering, truth: Truth, i: int) -> dict[str, float | None]:
    """Returns all metrics of one image; `None` for what the scene does not tell.

    `lost` is the share of light that found no room.
    """
    target = jax.device_put((truth.images[i] / 255.0).astype(np.float32))
    rgb, distance = jax.device_put((seen.rgb, seen.distance))
    result = {
        "psnr": metrics.psnr(rgb, target),
        "psnr_masked": None,
        "ssim": metrics.ssim(rgb, target),
        "distance_mae": None,
        "distance_mae_masked": None,
        "lost": np.mean(seen.lost),
    }
    mask = np.zeros(target.shape[:2], bool) if truth.masks is None else truth.masks[i]
    if mask.any():
        result["psnr_masked"] = metrics.psnr_masked(rgb, target, jax.device_put(mask))
    if truth.distances is not None:
        known = np.isfinite(truth.distances[i])
        wanted = jax.device_put(truth.distances[i])
        for key, area in {"distance_mae": known, "distance_mae_masked": known & mask}.items():
            if area.any():
                area = jax.device_put(area)
                result[key] = metrics.mean_absolute_error(distance, wanted, area)
    return {key: None if value is None else float(value) for key, value in result.items()}


def mean_of(per_image: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Returns the mean of a measure over the images that have it."""
    values = [image[key] for image in per_image if image[key] is not None]
    return float(np.mean(values)) if values else None
