"""Layers that the viewer can display, and their colouring.

- `rgb`: the image.
- `refraction only`, `reflection only`: two images whose linear colours sum to it. A light path
  belongs to `reflection only` if it was reflected at the *first* surface it hit; all others belong
  to `refraction only`, whatever happens to them later.
  Neither equals a rendering with fewer reflections, which redistributes the share of omitted paths
  to the remaining ones.
- `distance`: the median of the field's weights along a pixel's heaviest path (see
  `render.images.Rendering`), from 0 to a fixed length, so that colours mean the same in all views.
- `normals`, `mask`: of the first surface of the meshes, without light. Normals point outwards and
  are coloured `(n + 1) / 2` by world axes. Along straight rays, a field with a surface shows its
  normals at the distances of the pixels.
- `error`: of one test view, amplified as in `comparison`, at its own pixels.

Everything is drawn in bands of rows; drawing can be cancelled between two bands. Gaussian splats
have `rgb`, `distance` and `error`, and are drawn at once.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from experiments.exporting import field_mesh
from experiments.figures import comparison
from experiments.viewer.cameras import Window
from refref_jax.data import image_files
from refref_jax.data.scene_folder import Frames
from refref_jax.fields import registry
from refref_jax.geometry.rays import Rays
from refref_jax.optics.interface_rules import RULES, ambient_of
from refref_jax.optics.light_paths import Branch
from refref_jax.optics.media import Interfaces
from refref_jax.render import Model, images, render_image
from refref_jax.render.images import NO_PART, find_first_surface
from refref_jax.render.model import ball_of

RGB, REFRACTION, REFLECTION = "rgb", "refraction only", "reflection only"
DISTANCE, NORMALS, MASK, ERROR = "distance", "normals", "mask", "error"

_BRANCHES: dict[str, Branch] = {RGB: "both", REFRACTION: "transmitted", REFLECTION: "reflected"}

# Layers that need only the meshes, no light paths.
OF_SURFACES = (NORMALS, MASK)

_NOWHERE = 255

GAIN = comparison.ERROR_GAIN
"""Amplification of errors."""

Cancelled = Callable[[], bool]
Image = UInt8[np.ndarray, "h w 3"]


class Pixels(NamedTuple):
    """Some pixels of a test view, evenly spaced.

    Attributes:
      window: the pixels.
      target: their true sRGB, in `[0, 1]`.
    """

    window: Window
    target: Float[np.ndarray, "h w 3"]


def offered(model: Model, *, truth: bool) -> tuple[str, ...]:
    """Returns the available layers of a model.

    Args:
      model: trained model of the scene.
      truth: whether there are test views.
    """
    layers: tuple[str, ...] = (DISTANCE,)
    if model.settings.max_bends:
        layers = (REFRACTION, REFLECTION, DISTANCE, NORMALS, MASK)
    elif registry.has_surface(model.config.field):
        layers = (DISTANCE, NORMALS)
    return (RGB, *layers, *((ERROR,) if truth else ()))


def draw(
    model: Model, layer: str, rays: Rays, *, chunk: int | None, most: int, cancelled: Cancelled
) -> Image | None:
    """Draws a layer other than `error`.

    Args:
      model: trained model of the scene.
      layer: name of a layer of this module.
      rays: rays, `[h, w]`.
      chunk: number of paths rendered at once.
      most: number of pixels of the uncropped image. Cropped images are padded to it, so that
        windows of all shapes share one compiled program.
      cancelled: callback that returns whether to stop; queried before every band.

    Returns:
      The image, or `None` if it was cancelled.
    """
    learned = layer == NORMALS and not model.settings.max_bends
    if layer in OF_SURFACES and not learned:
        return None if cancelled() else _draw_surface(model, layer, rays, most)
    bands = []
    for band in _bands(rays):
        if cancelled():
            return None
        seen = render_image(model, band, chunk=chunk, branch=_BRANCHES.get(layer, "both"))
        bands.append(seen.distance if layer in (DISTANCE, NORMALS) else seen.rgb)
    whole = np.concatenate(bands)
    if learned:
        return _normals_at(model, rays, whole)
    if layer == DISTANCE:
        return _draw_distance(model, whole)
    return image_files.to_bytes(whole)


def draw_splats(model: Model, layer: str, window: Window) -> Image:
    """Draws a layer of Gaussian splats, which are seen by a camera instead of along rays.

    Args:
      model: model of Gaussian splats.
      layer: `rgb` or `distance`.
      window: pixels to draw.
    """
    rgb, distance = _seen(model, window)
    return image_files.to_bytes(rgb) if layer == RGB else _draw_distance(model, distance)


def draw_error(
    model: Model, pixels: Pixels, *, chunk: int | None, cancelled: Cancelled
) -> tuple[Image, float] | None:
    """Draws the amplified error of a test view.

    Returns:
      The image and the root mean square of the unamplified error, of sRGB in `[0, 1]`; `None` if it
      was cancelled.
    """
    if model.config.splats is not None:
        seen = _seen(model, pixels.window)[0]
    else:
        bands = []
        for band in _bands(pixels.window.rays):
            if cancelled():
                return None
            bands.append(render_image(model, band, chunk=chunk).rgb)
        seen = np.concatenate(bands)
    error = math.sqrt(float(np.mean(np.square(seen - pixels.target, dtype=np.float64))))
    return image_files.to_bytes(comparison.amplified_error(seen, pixels.target)), error


def view_pixels(frames: Frames, i: int, most: int) -> Pixels:
    """Returns every pixel of a test view, or every second, third, ... in each direction.

    Nothing is averaged: a small image's error is that of its own pixels.

    Args:
      frames: frames of the split.
      i: index of the view.
      most: largest number of pixels.
    """
    height, width = frames.cameras.height, frames.cameras.width
    stride = max(1, math.ceil(math.sqrt(height * width / most)))
    rows, columns = (np.arange(stride // 2, edge, stride) for edge in (height, width))
    camera = frames.cameras._replace(poses=frames.cameras.poses[i : i + 1])
    target = image_files.read_rgb(frames.images[i])[np.ix_(rows, columns)] / np.float32(255.0)
    return Pixels(Window(camera, rows, columns), target)


def with_indices(interfaces: Interfaces, indices: Sequence[float], rule: str) -> Interfaces:
    """Returns interfaces with new indices of refraction, one per part, without dispersion.

    Args:
      interfaces: interfaces of the scene.
      indices: index of refraction inside each part; the rule decides those outside.
      rule: rule of the scene, a name in `interface_rules.RULES`.
    """
    parents = [int(medium) - 1 for medium in interfaces.medium_outside]
    made = RULES[rule](indices, parents, ambient=ambient_of(interfaces))
    return interfaces._replace(
        index_inside=made.index_inside,
        index_outside=made.index_outside,
        index_by_channel=interfaces.index_by_channel[:0],
    )


def _seen(
    model: Model, window: Window
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Returns the colours and distances of Gaussian splats at some pixels."""
    whole, chosen = images.render_camera(model, window.camera, 0), np.ix_(*window[1:])
    return np.asarray(whole.rgb)[chosen], np.asarray(whole.distance)[chosen]


def _draw_distance(model: Model, distance: Float[np.ndarray, "h w"]) -> Image:
    # From wall to wall: hardly anything inside a bounded scene is farther.
    return comparison.colour_distances([distance], farthest=2.0 * model.config.radius)[0]


def _draw_surface(model: Model, layer: str, rays: Rays, most: int) -> Image:
    shape = rays.radii.shape
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    filled, _ = images.crop(flat, None, 0, max(most, flat.radii.size))
    met = find_first_surface(model.scene.surfaces, filled)
    count = flat.radii.size
    found = (met.parts[:count] != NO_PART).reshape(*shape, 1)
    if layer == MASK:
        return np.broadcast_to(np.where(found, 255, 0), (*shape, 3)).astype(np.uint8)
    normals = image_files.to_bytes(0.5 * (met.normals[:count].reshape(*shape, 3) + 1.0))
    return np.where(found, normals, np.uint8(_NOWHERE))


def _normals_at(model: Model, rays: Rays, distance: Float[np.ndarray, "h w"]) -> Image:
    """Returns the normals of a field's surface at distances along straight rays."""
    ball = ball_of(model.config)
    points = rays.origins + distance[..., None] * rays.directions
    flat = (each.reshape(-1, 3) for each in (points, rays.directions))
    _, normals, _ = field_mesh.look_up_surfaces(model, *flat)
    found = np.linalg.norm(points - ball.centre, axis=-1, keepdims=True) < ball.radius
    seen = image_files.to_bytes(0.5 * (normals.reshape(points.shape) + 1.0))
    return np.where(found, seen, np.uint8(_NOWHERE))


def _bands(rays: Rays) -> Iterator[Rays]:
    """Yields bands of rows, as many as are traced at once, but at least one row each."""
    height, width = rays.radii.shape
    rows = max(1, images.on_this_device(images.TILE) // width)
    for start in range(0, height, rows):
        yield jax.tree.map(lambda x, start=start: x[start : start + rows], rays)
