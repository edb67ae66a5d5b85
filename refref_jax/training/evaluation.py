"""Evaluates a model: renders the images of a split, and compares them with the true images.

`evaluate` does both; `measure` compares one image that has been rendered already, and
`measure_view` one that any program has rendered.

Distances are of three kinds, distinguished by name:

- `distance_*`: the median of the weights of the field, as the paper defines it (section 5).
- `surface_*`: the first surface of the meshes that the ray through the pixel's centre meets, and
  the median elsewhere. Clear glass has hardly any density, so the median passes through it to the
  background; a method that knows or reconstructs the glass has the distance of its surface.
- `substituted_*`: the true distance inside the object's mask, and the median elsewhere; its masked
  error is 0 by definition. The first release of the paper's code did this for its two methods
  that know objects, which explains the oracle's masked DMAE of 0.00 in the paper's table 2, though
  not R3F's 0.01 to 0.05. Only use it for comparison with that table.

For straight rays, which ignore objects, all three are the median, as for the paper's baselines.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from refref_jax import choices, metrics, numerics
from refref_jax.choices import SATURATED
from refref_jax.compilation import jit_quickly
from refref_jax.data import scene_folder
from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras
from refref_jax.render import images, learned_media, pixels
from refref_jax.render.images import Rendering
from refref_jax.render.model import Model

Measured = dict[str, float | None]
"""Metrics by name; `None` if a metric is undefined or not available."""

# Compiled as a whole, which is faster than op by op.
_lpips = jit_quickly(metrics.lpips)

_DISTANCE_ERRORS = {"mae": metrics.mean_absolute_error, "rmse": metrics.root_mean_square_error}


class Truth(NamedTuple):
    """True images of a split; masks and distances may be missing."""

    frames: scene_folder.Frames
    images: UInt8[np.ndarray, "frames h w 3"]
    masks: Bool[np.ndarray, "frames h w"] | None
    distances: Float[np.ndarray, "frames h w"] | None


class Perceptual(NamedTuple):
    """Perceptual metrics, which have optional dependencies.

    Attributes:
      lpips: weights of `metrics.lpips`, or `None`.
      flip: the function `metrics.flip`, or `None` if it is not installed.
    """

    lpips: metrics.LpipsParams | None = None
    flip: Callable[[np.ndarray, np.ndarray], float] | None = None


_WITHOUT_EYES = Perceptual()


class EvaluatedView(NamedTuple):
    """An image that has been rendered and measured, for callers that save it.

    Attributes:
      name: stem of the true image's file.
      place: position among the images that are evaluated, from 0.
      count: number of images that are evaluated.
      target: true image, 8-bit sRGB.
      rendering: rendered image.
      measures: metrics of the image, and the `seconds` that rendering took.
      mask: mask of the object, if there is one.
    """

    name: str
    place: int
    count: int  # type: ignore[assignment]  # hides tuple.count
    target: UInt8[np.ndarray, "h w 3"]
    rendering: Rendering
    measures: Measured
    mask: Bool[np.ndarray, "h w"] | None = None


class Evaluation(NamedTuple):
    """Metrics of a split.

    Attributes:
      results: means over the images that have a measure, and `seconds_per_image`.
      learned: learned tints and absorptions, see `learned_colours`.
      per_image: `name`, metrics and `seconds` of each image.
    """

    results: Measured
    learned: dict[str, Any] | None
    per_image: list[dict[str, Any]]


def evaluate(
    model: Model,
    scene: Path | str,
    *,
    split: str = "test",
    rays_per_pixel: int = 1,
    limit: int | None = None,
    chunk: int | None = None,
    perceptual: Perceptual = _WITHOUT_EYES,
    progress: Callable[[int, int, str], None] | None = None,
    on_view: Callable[[EvaluatedView], None] | None = None,
) -> Evaluation:
    """Renders and measures the images of a split.

    The measured seconds do not include compilation.

    Args:
      model: trained model, see `refref_jax.render.load_model`.
      scene: scene folder.
      split: `train`, `val` or `test`.
      rays_per_pixel: number of rays in each pixel, a square.
      limit: number of images to evaluate, evenly spread; all if not given.
      chunk: number of paths rendered at once, as in `render.render_image`.
      perceptual: perceptual metrics to compute in addition.
      progress: function of the number of images done, their total, and a line of text; called
        once before the first image and after each.
      on_view: function that receives each image as soon as it is measured. No image is kept.

    Raises:
      SceneError: if a file of the split is missing or broken.
      ValueError: if `limit` is below 1, or the rays of a pixel do not make a square grid.
    """
    if limit is not None and limit < 1:
        raise ValueError(f"limit={limit} leaves no image to evaluate. Give 1 or more.")
    choices.side_of(rays_per_pixel)
    truth = read_truth(Path(scene), split)
    chosen = spread(len(truth.images), limit)
    views = truth.frames.cameras
    with ThreadPoolExecutor(1) as beside:
        compiled = beside.submit(_warm_up_measures, truth, perceptual)
        images.warm_up(model, views, rays_per_pixel=rays_per_pixel, chunk=chunk)
        compiled.result()
    if progress is not None:
        progress(0, len(chosen), "")
    per_image: list[dict[str, Any]] = []
    for place, i in enumerate(chosen):
        name, start = truth.frames.names[i], time.monotonic()
        seen = images.render_camera(model, views, i, rays_per_pixel=rays_per_pixel, chunk=chunk)
        seconds = time.monotonic() - start
        first = first_distances(model, views, i)
        measured = measure(seen, truth, i, first=first, perceptual=perceptual)
        if model.params.gains is not None:
            mask = None if truth.masks is None else truth.masks[i]
            measured |= measure_after_gain(np.asarray(seen.rgb), truth.images[i] / 255.0, mask)
        measured["seconds"] = seconds
        per_image.append({"name": name, **measured})
        if on_view is not None:
            target, mask = truth.images[i], None if truth.masks is None else truth.masks[i]
            on_view(EvaluatedView(name, place, len(chosen), target, seen, measured, mask))
        if progress is not None:
            progress(place + 1, len(chosen), f"{name}  PSNR {measured['psnr']:.2f}")
    results = {key: mean_of(per_image, key) for key in per_image[0] if key != "name"}
    results["seconds_per_image"] = results.pop("seconds")
    return Evaluation(results, learned_colours(model), per_image)


def _warm_up_measures(truth: Truth, perceptual: Perceptual) -> None:
    """Compiles the metrics of a split's images, by measuring an empty one."""
    empty = np.zeros(truth.images.shape[1:], np.float32)
    measure_view(empty, empty[..., 0], truth, 0, perceptual=perceptual)


def learned_colours(model: Model) -> dict[str, Any] | None:
    """Returns tints and absorptions of all parts, in the order of their file names, if learned."""
    colours = model.params.tints
    if colours is None:
        return None
    absorptions = learned_media.absorptions(colours, model.config.radius)
    return {
        "tints": np.asarray(learned_media.tints(colours), float).round(4).tolist(),
        "absorptions": np.asarray(absorptions, float).round(4).tolist(),
    }


def first_distances(model: Model, views: Cameras, i: int) -> Float[np.ndarray, "h w"] | None:
    """Returns the distance of the first surface along the rays of pixel centres.

    Args:
      model: model of the scene.
      views: cameras.
      i: index of the camera.

    Returns:
      Distances in world units, `inf` where there is no surface; `None` for straight
      rays.
    """
    if model.settings.max_bends == 0:
        return None
    rays = cameras.image_rays(views, i)
    return images.find_first_surface(model.scene.surfaces, rays).distances


def read_truth(scene: Path, split: str) -> Truth:
    """Reads all images of a split."""
    frames = scene_folder.read_frames(scene, split)
    return Truth(
        frames,
        scene_folder.read_images(frames),
        scene_folder.read_masks(frames) if frames.masks else None,
        scene_folder.read_distances(frames) if frames.depths else None,
    )


def measure(
    seen: Rendering,
    truth: Truth,
    i: int,
    *,
    first: Float[np.ndarray, "h w"] | None,
    perceptual: Perceptual,
) -> Measured:
    """Returns all metrics of one image; `None` where the scene lacks the true values.

    `dropped` is the dropped throughput.

    Args:
      seen: rendered image.
      truth: true images of the split.
      i: index of the image in the split.
      first: distance of the first surface of the meshes, `inf` where there is none; `None` for
        straight rays.
      perceptual: perceptual metrics to compute in addition.
    """
    result = measure_view(
        np.asarray(seen.rgb),
        np.asarray(seen.distance),
        truth,
        i,
        first=first,
        perceptual=perceptual,
    )
    return result | {"dropped": float(np.mean(seen.dropped))}


def measure_view(
    rgb: Float[np.ndarray, "h w 3"],
    distance: Float[np.ndarray, "h w"] | None,
    truth: Truth,
    i: int,
    *,
    first: Float[np.ndarray, "h w"] | None = None,
    perceptual: Perceptual = _WITHOUT_EYES,
) -> Measured:
    """Returns the metrics of an image from any renderer; `None` where a value is missing.

    Args:
      rgb: image, sRGB in `[0, 1]`.
      distance: distances along the rays of the pixels, world units, `inf` where there is none;
        `None` if they are unknown.
      truth: true images of the split.
      i: index of the image in the split.
      first: distance of the first surface of the meshes, `inf` where there is none; `None` if the
        method knows no objects.
      perceptual: perceptual metrics to compute in addition.
    """
    mask = None if truth.masks is None else truth.masks[i]
    target = (truth.images[i] / 255.0).astype(np.float32)
    result = measure_colours(rgb, target, mask, perceptual)
    true = None if truth.distances is None else truth.distances[i]
    for name, known in _distances(distance, first, true, mask).items():
        result |= measure_distances(name, known, true, mask)
    return result


def measure_colours(
    rendered: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None,
    perceptual: Perceptual,
) -> Measured:
    """Returns the colour metrics of an image in sRGB, `[0, 1]`.

    PSNR and SSIM are computed in double precision. There is no masked PSNR if the mask is empty, no
    SSIM if the image is smaller than its window, and no LPIPS if it is too small for the network.
    """
    shortest = min(target.shape[:2])
    result: Measured = dict.fromkeys(("psnr", "psnr_masked", "ssim", "lpips", "flip"))
    with jax.enable_x64(True), jax.default_device(_device_of_doubles()):
        pair: tuple[Array, Array]
        pair = jax.device_put((rendered.astype(np.float64), target.astype(np.float64)))
        area = jax.device_put(mask) if mask is not None and mask.any() else None
        result |= {key: float(value) for key, value in _colour_measures(*pair, area).items()}
    if perceptual.lpips is not None and shortest >= metrics.SMALLEST_FOR_LPIPS:
        pair = jax.device_put((rendered.astype(np.float32), target.astype(np.float32)))
        result["lpips"] = float(_lpips(perceptual.lpips, *pair))
    if perceptual.flip is not None:
        result["flip"] = perceptual.flip(rendered, target)
    return result


def measure_after_gain(
    rendered: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None,
) -> Measured:
    """Returns the PSNR of an image that has the exposure and white balance of the true one.

    The gain of each channel of linear light is fitted to pixels beside the object by least squares,
    so that what is seen through the object cannot affect it. Pixels that are saturated in either
    image are left out; without others, the gain is 1.

    Args:
      rendered: rendered image, sRGB in `[0, 1]`.
      target: true image.
      mask: mask of the object, if there is one.
    """
    inside = np.zeros(target.shape[:2], bool) if mask is None else mask
    with jax.enable_x64(True), jax.default_device(_device_of_doubles()):
        pair = jax.device_put((rendered.astype(np.float64), target.astype(np.float64)))
        gained = np.asarray(_with_gain(*pair, jax.device_put(~inside)))
    found = measure_colours(gained, target, mask, _WITHOUT_EYES)
    return {f"{name}_after_gain": found[name] for name in ("psnr", "psnr_masked")}


@jit_quickly
def _with_gain(
    rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"], beside: Bool[Array, "h w"]
) -> Float[Array, "h w 3"]:
    """Returns the image with the gains of `measure_after_gain`."""
    usable = beside & jnp.all(jnp.maximum(rendered, target) < SATURATED, axis=-1)
    seen, true = pixels.srgb_to_linear(rendered), pixels.srgb_to_linear(target)
    weights = jnp.where(usable[..., None], seen, 0.0)
    power, shared = (jnp.sum(weights * each, axis=(0, 1)) for each in (seen, true))
    gain = jnp.where(power > 0.0, numerics.safe_divide(shared, power), 1.0)
    return jnp.clip(pixels.linear_to_srgb(gain[None, None] * seen), 0.0, 1.0)


@jit_quickly
def _colour_measures(
    rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"], mask: Bool[Array, "h w"] | None
) -> dict[str, Float[Array, ""]]:
    """Returns the metrics that are defined for the image, without perceptual ones."""
    found = {"psnr": metrics.psnr(rendered, target)}
    if mask is not None:
        found["psnr_masked"] = metrics.psnr_masked(rendered, target, mask)
    if min(target.shape[:2]) >= metrics.SMALLEST_FOR_SSIM:
        found["ssim"] = metrics.ssim(rendered, target)
    return found


@jit_quickly
def _distance_measures(
    seen: Float[Array, "h w"], true: Float[Array, "h w"], area: Bool[Array, "h w"]
) -> dict[str, Float[Array, ""]]:
    return {key: error(seen, true, area) for key, error in _DISTANCE_ERRORS.items()}


def measure_distances(
    name: str,
    seen: Float[np.ndarray, "h w"] | None,
    true: Float[np.ndarray, "h w"] | None,
    mask: Bool[np.ndarray, "h w"] | None,
) -> Measured:
    """Returns errors of distances, over all pixels with a known distance, and over the mask.

    Args:
      name: kind of distance, the prefix of all keys.
      seen: rendered distances; `None` if there are none.
      true: true distances, `inf` where there is none; `None` if unknown.
      mask: mask of the object; masked errors are `None` without one, or if it is empty.
    """
    areas = ("", "_masked")
    result: Measured = {f"{name}_{key}{area}": None for key in _DISTANCE_ERRORS for area in areas}
    if seen is None or true is None:
        return result
    known = np.isfinite(true)
    masked = known & (False if mask is None else mask)
    with jax.enable_x64(True), jax.default_device(_device_of_doubles()):
        pair: tuple[Array, Array]
        pair = jax.device_put((seen.astype(np.float64), true.astype(np.float64)))
        for suffix, area in zip(areas, (known, masked), strict=True):
            if area.any():
                found = _distance_measures(*pair, jax.device_put(area))
                result |= {f"{name}_{key}{suffix}": float(value) for key, value in found.items()}
    return result


def mean_of(per_image: Sequence[Mapping[str, Any]], measure: str) -> float | None:
    """Returns the mean of a metric over the images that have it."""
    values = [image[measure] for image in per_image if image[measure] is not None]
    return float(np.mean(values)) if values else None


def spread(count: int, limit: int | None) -> list[int]:
    """Returns indices of all images, or of `limit` evenly spaced ones.

    Args:
      count: number of images.
      limit: number of images to choose; all if not given.
    """
    chosen = np.linspace(0, count - 1, min(limit or count, count)).astype(int)
    return np.unique(chosen).tolist()


def _distances(
    median: Float[np.ndarray, "h w"] | None,
    first: Float[np.ndarray, "h w"] | None,
    true: Float[np.ndarray, "h w"] | None,
    mask: Bool[np.ndarray, "h w"] | None,
) -> dict[str, Float[np.ndarray, "h w"] | None]:
    """Returns an image's distances of all three kinds; `None` if one is unknown."""
    if first is None or median is None:
        return dict.fromkeys(("distance", "surface", "substituted"), median)
    substituted = None if true is None or mask is None else np.where(mask, true, median)
    return {
        "distance": median,
        "surface": np.where(np.isfinite(first), first, median),
        "substituted": substituted,
    }


def _device_of_doubles() -> jax.Device:
    """Returns the device for metrics: the CPU if the default is a TPU, which has no doubles."""
    return jax.devices("cpu")[0] if jax.default_backend() == "tpu" else jax.devices()[0]
