"""What is measured of a rendered image, against what a scene tells of it.

Distances are of three kinds, told apart by name:

- `distance_*`: the median of the weights of the field, as the paper defines it (section 5).
- `surface_*`: of the first surface of the meshes that bend light, where the ray through the pixel's
  centre meets one; elsewhere the median. Clear glass has hardly any density, so the median passes
  through it, to the wall; a method that is given, or finds, the glass knows better.
- `substituted_*`: inside the object's mask the true distance itself, elsewhere the median: an error
  of 0 in the mask, by definition. The first release of the paper's code did so for its two methods
  that know objects, which explains the oracle's masked DMAE of 0.00 in the paper's table 2, though
  not R3F's 0.01 to 0.05. Only for comparison with that table.

Straight light knows of no object: there, all three are the median, as for the paper's baselines.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from refref_jax import metrics
from refref_jax.data import local_layout
from refref_jax.render import Rendering

Measured = dict[str, float | None]
"""Values by name; `None` where there is nothing to measure, or nothing to measure it with."""

# Sooner compiled as a whole than op by op.
_lpips = jax.jit(metrics.lpips)


class Truth(NamedTuple):
    """What a split says of its images; masks and distances may be missing."""

    frames: local_layout.Frames
    images: UInt8[np.ndarray, "frames h w 3"]
    masks: Bool[np.ndarray, "frames h w"] | None
    distances: Float[np.ndarray, "frames h w"] | None


class Perceptual(NamedTuple):
    """What measures as eyes do: not all is always at hand.

    Attributes:
      lpips: weights of `metrics.lpips`, or `None`.
      flip: `metrics.flip`, or `None` where it is not installed.
    """

    lpips: metrics.LpipsParams | None = None
    flip: Callable[[np.ndarray, np.ndarray], float] | None = None


def read_truth(scene: Path, split: str) -> Truth:
    """Reads all that a split has."""
    frames = local_layout.read_frames(scene, split)
    return Truth(
        frames,
        local_layout.read_images(frames),
        local_layout.read_masks(frames) if frames.masks else None,
        local_layout.read_distances(frames) if frames.depths else None,
    )


def measure(
    seen: Rendering,
    truth: Truth,
    i: int,
    *,
    first: Float[np.ndarray, "h w"] | None,
    perceptual: Perceptual,
) -> Measured:
    """Returns all metrics of one image; `None` for what the scene does not tell.

    `lost` is the share of light that found no room.

    Args:
      seen: the image, as it was rendered.
      truth: of its split.
      i: which image of the split.
      first: distance of the first surface of the meshes that bent the light, `inf` where there is
        none; `None` if light went straight.
      perceptual: what is at hand to measure as eyes do.
    """
    mask = None if truth.masks is None else truth.masks[i]
    target = (truth.images[i] / 255.0).astype(np.float32)
    result = measure_colours(seen.rgb, target, mask, perceptual)
    true = None if truth.distances is None else truth.distances[i]
    for name, known in _distances(seen.distance, first, true, mask).items():
        result |= measure_distances(name, known, true, mask)
    return result | {"lost": float(np.mean(seen.lost))}


def measure_colours(
    rendered: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None,
    perceptual: Perceptual,
) -> Measured:
    """Returns what is measured of an image's colours, which are sRGB in `[0, 1]`.

    PSNR and SSIM in double precision. An empty mask has no masked PSNR, and an image that is too
    small for a window or a network has no SSIM or LPIPS.
    """
    shortest = min(target.shape[:2])
    result: Measured = dict.fromkeys(("psnr", "psnr_masked", "ssim", "lpips", "flip"))
    with jax.enable_x64(True), jax.default_device(_device_of_doubles()):
        pair = jax.device_put((rendered.astype(np.float64), target.astype(np.float64)))
        result["psnr"] = float(metrics.psnr(*pair))
        if mask is not None and mask.any():
            result["psnr_masked"] = float(metrics.psnr_masked(*pair, jax.device_put(mask)))
        if shortest >= metrics.SMALLEST_FOR_SSIM:
            result["ssim"] = float(metrics.ssim(*pair))
    if perceptual.lpips is not None and shortest >= metrics.SMALLEST_FOR_LPIPS:
        pair = jax.device_put((rendered.astype(np.float32), target.astype(np.float32)))
        result["lpips"] = float(_lpips(perceptual.lpips, *pair))
    if perceptual.flip is not None:
        result["flip"] = perceptual.flip(rendered, target)
    return result


def measure_distances(
    name: str,
    seen: Float[np.ndarray, "h w"] | None,
    true: Float[np.ndarray, "h w"] | None,
    mask: Bool[np.ndarray, "h w"] | None,
) -> Measured:
    """Returns errors of distances, over all pixels whose distance is known, and in the mask.

    Args:
      name: of their kind, with which all keys begin.
      seen: the distances; `None` has no error.
      true: the true ones, `inf` where there is none; `None` if nothing is known.
      mask: the object's; without one, or over an empty one, nothing is in it.
    """
    keys = {"mae": metrics.mean_absolute_error, "rmse": metrics.root_mean_square_error}
    result: Measured = {f"{name}_{key}{area}": None for key in keys for area in ("", "_masked")}
    if seen is None or true is None:
        return result
    known = np.isfinite(true)
    areas = {"": known, "_masked": known & (False if mask is None else mask)}
    with jax.enable_x64(True), jax.default_device(_device_of_doubles()):
        pair = jax.device_put((seen.astype(np.float64), true.astype(np.float64)))
        for suffix, area in areas.items():
            if area.any():
                area = jax.device_put(area)
                for key, error in keys.items():
                    result[f"{name}_{key}{suffix}"] = float(error(*pair, area))
    return result


def mean_of(per_image: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Returns the mean of a measure over the images that have it."""
    values = [image[key] for image in per_image if image[key] is not None]
    return float(np.mean(values)) if values else None


def _distances(
    median: Float[np.ndarray, "h w"],
    first: Float[np.ndarray, "h w"] | None,
    true: Float[np.ndarray, "h w"] | None,
    mask: Bool[np.ndarray, "h w"] | None,
) -> dict[str, Float[np.ndarray, "h w"] | None]:
    """Returns an image's distances of all three kinds; `None` where one can not be known."""
    if first is None:
        return dict.fromkeys(("distance", "surface", "substituted"), median)
    unknown = true is None or mask is None
    return {
        "distance": median,
        "surface": np.where(np.isfinite(first), first, median),
        "substituted": None if unknown else np.where(mask, true, median),
    }


def _device_of_doubles() -> jax.Device:
    """Returns the device to measure on; of a TPU, which has no double precision, the CPU."""
    return jax.devices("cpu")[0] if jax.default_backend() == "tpu" else jax.devices()[0]
