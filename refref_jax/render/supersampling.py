"""Images of a trained model with several rays in every pixel.

A pixel is divided into `side x side` smaller ones. Each has a ray of its own with a footprint as
much smaller, so the fields are queried for finer detail too. Colours are averaged as linear light
and encoded afterwards: what a camera does, and what the true images were made with.
"""

from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Float

from refref_jax.choices import side_of
from refref_jax.geometry.cameras import Cameras, box_filter, pixel_rays, supersample
from refref_jax.geometry.rays import Rays
from refref_jax.render import colour, tiles
from refref_jax.render.images import CHUNK, Rendering, render_image
from refref_jax.render.model import Model

RAYS_OF_A_BAND = 1 << 18
"""Most rays that are held at once, where a row of pixels has no more."""


def render_camera(
    model: Model,
    cameras: Cameras,
    view: int,
    *,
    rays_per_pixel: int = 1,
    chunk: int = CHUNK,
    band: int = RAYS_OF_A_BAND,
) -> Rendering:
    """Renders one camera's image, with one or several rays in every pixel.

    Rows of pixels are rendered band by band, so that memory does not grow with the image.

    Args:
      model: the scene.
      cameras: cameras with the resolution of the image.
      view: index of the camera.
      rays_per_pixel: number of rays in each pixel, a square: 1, 4, 9, 16.
      chunk: number of paths rendered at once.
      band: number of rays held at once; at least one row of pixels is.

    Returns:
      NumPy arrays as `[height, width]`, see `average`.

    Raises:
      ValueError: if the rays of a pixel do not make a square grid.
      TypeError: if it is called in a function that JAX transforms.
    """
    side = side_of(rays_per_pixel)
    fine = supersample(cameras, side)
    bands = [
        average(render_image(model, rays, chunk=chunk), side)
        for rays in _bands(fine, view, rows=side * max(1, band // (side * fine.width)))
    ]
    return tiles.join(bands)


def warm_up(model: Model, cameras: Cameras, *, chunk: int) -> None:
    """Compiles all programs of rendering, so that later timings are of rendering alone."""
    zero = np.zeros(1, np.int64)
    render_image(model, pixel_rays(cameras, zero, zero, zero), chunk=chunk)


def average(fine: Rendering, side: int) -> Rendering:
    """Averages the small pixels of a supersampled camera.

    Colours are averaged as linear light, without clipping, and then encoded and clipped; mean
    distances and accumulations are averaged as they are. The distance is the median of the small
    pixels', the lower of the two middle ones if their number is even: at an edge it is that of one
    of the two surfaces, never a place between them where nothing is.
    """
    linear = box_filter(fine.linear, side)
    return Rendering(
        rgb=np.clip(jax.device_get(colour.linear_to_srgb(jax.device_put(linear))), 0.0, 1.0),
        distance=_lower_median(fine.distance, side),
        mean_distance=box_filter(fine.mean_distance, side),
        accumulation=box_filter(fine.accumulation, side),
        linear=linear,
        lost=box_filter(fine.lost, side),
    )


def _lower_median(fine: Float[np.ndarray, "height width"], side: int) -> Float[np.ndarray, "h w"]:
    height, width = fine.shape
    blocks = fine.reshape(height // side, side, width // side, side).swapaxes(1, 2)
    ordered = np.sort(blocks.reshape(*blocks.shape[:2], side**2), axis=-1)
    return ordered[..., (side**2 - 1) // 2]


def _bands(cameras: Cameras, view: int, *, rows: int) -> Iterator[Rays]:
    """Yields the rays of an image, some rows at a time."""
    for start in range(0, cameras.height, rows):
        row, column = np.indices((min(rows, cameras.height - start), cameras.width))
        yield pixel_rays(cameras, np.full(row.shape, view), start + row, column)
