"""Pictures of a trained model with several rays in every pixel.

A pixel is cut into `side x side` smaller ones. Each has a ray of its own, whose footprint is as
much smaller, so the fields are asked for finer detail too. Colours are averaged as linear light and
encoded afterwards: what a camera does, and what the true images were made with.
"""

from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Float

from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays
from refref_jax.render import Model, Rendering, colour, render_image, tiles

RAYS_OF_A_BAND = 1 << 18
"""Most rays that are held at once, where a row of pixels has no more."""


def render_view(
    model: Model, views: Cameras, view: int, *, side: int, chunk: int, band: int = RAYS_OF_A_BAND
) -> Rendering:
    """Renders one camera's image with `side x side` rays in every pixel.

    Rows of pixels are rendered band by band, so that memory does not grow with the image.

    Args:
      model: the scene.
      views: cameras, of pixels as they are wanted.
      view: which camera.
      side: rays along each edge of a pixel.
      chunk: paths rendered at once.
      band: rays held at once; at least one row of pixels is.

    Returns:
      A rendering as `[height, width]`, see `average`.
    """
    fine = cameras.supersample(views, side)
    bands = [
        average(render_image(model, rays, chunk=chunk), side)
        for rays in _bands(fine, view, rows=side * max(1, band // (side * fine.width)))
    ]
    return tiles.join(bands)


def warm_up(model: Model, views: Cameras, *, chunk: int) -> None:
    """Compiles all that rendering takes, so that what is timed afterwards is rendering alone."""
    zero = np.zeros(1, np.int64)
    render_image(model, cameras.pixel_rays(views, zero, zero, zero), chunk=chunk)


def average(fine: Rendering, side: int) -> Rendering:
    """Averages the small pixels of a supersampled camera.

    Colours are averaged as linear light, without clipping, and then encoded and clipped; mean
    distances and accumulations are averaged as they are. The distance is the median of the small
    pixels', the lower of the two middle ones if their number is even: at an edge it is that of one
    of the two surfaces, never a place between them where nothing is.
    """
    linear = cameras.box_filter(fine.linear, side)
    return Rendering(
        rgb=np.clip(jax.device_get(colour.linear_to_srgb(jax.device_put(linear))), 0.0, 1.0),
        distance=_lower_median(fine.distance, side),
        mean_distance=cameras.box_filter(fine.mean_distance, side),
        accumulation=cameras.box_filter(fine.accumulation, side),
        linear=linear,
        lost=cameras.box_filter(fine.lost, side),
    )


def _lower_median(fine: Float[np.ndarray, "height width"], side: int) -> Float[np.ndarray, "h w"]:
    height, width = fine.shape
    blocks = fine.reshape(height // side, side, width // side, side).swapaxes(1, 2)
    ordered = np.sort(blocks.reshape(*blocks.shape[:2], side**2), axis=-1)
    return ordered[..., (side**2 - 1) // 2]


def _bands(views: Cameras, view: int, *, rows: int) -> Iterator[Rays]:
    """Yields the rays of an image, some rows at a time."""
    for start in range(0, views.height, rows):
        row, column = np.indices((min(rows, views.height - start), views.width))
        yield cameras.pixel_rays(views, np.full(row.shape, view), start + row, column)
