"""Pinhole cameras and their rays (NumPy only).

Camera frame: x right, y up, looking along -z (OpenGL, Blender). World frame: that of the data set.
Pixel `(row, column)` has its centre at `(column + 0.5, row + 0.5)`, rows counted from the top.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Real

from refref_jax.choices import ORIGIN, Position
from refref_jax.geometry.rays import Rays
from refref_jax.numerics import host_array


class Cameras(NamedTuple):
    """Cameras that share their intrinsics.

    Attributes:
      poses: camera-to-world matrices; the first three columns rotate, the last is the position
        in world units.
      width: image width in pixels.
      height: image height in pixels.
      focal: focal length in pixels; the principal point is the image centre.
    """

    poses: Float[np.ndarray, "cameras 3 4"]
    width: int
    height: int
    focal: float


def focal_length(width: int, angle_x: float) -> float:
    """Returns the focal length in pixels for a horizontal field of view in radians."""
    return 0.5 * width / math.tan(0.5 * angle_x)


def pixel_rays(
    cameras: Cameras,
    camera: Int[np.ndarray, "*shape"],
    row: Real[np.ndarray, "*shape"],
    column: Real[np.ndarray, "*shape"],
) -> Rays:
    """Returns the rays through pixel centres, or other points of pixels, in single precision.

    The radius of a ray is that of a cone with the solid angle of the pixel, scaled so that a disc
    of this radius has the variance of the pixel (mip-NeRF: `2 / sqrt(12)` of its width).

    Args:
      cameras: the cameras.
      camera: index of the camera of each ray.
      row: pixel row, 0 at the top; a fraction is an offset down from the pixel's centre.
      column: pixel column, 0 at the left; a fraction is an offset to the right.
    """
    towards, cosine = _unit_directions(cameras, row, column)
    pose = cameras.poses[camera]
    directions = np.einsum("...ij,...j->...i", pose[..., :3], towards)
    # The solid angle of a pixel is the cube of its cosine over the squared focal length.
    width = cosine**1.5 / cameras.focal
    return Rays(
        host_array(np.ascontiguousarray(pose[..., 3], np.float32)),
        host_array(directions.astype(np.float32)),
        # An array for a single ray too.
        host_array(np.asarray(width * 2.0 / math.sqrt(12.0), np.float32)),
    )


def image_rays(cameras: Cameras, camera: int) -> Rays:
    """Returns the rays of all pixels of one camera, as `[height, width]`.

    Example:
      >>> import refref_jax
      >>> cameras = refref_jax.orbit(1, distance=4.0, elevation=0.0, size=3, angle_x=1.2)
      >>> refref_jax.image_rays(cameras, 0).directions[1, 1].tolist()  # the middle looks ahead
      [-1.0, 0.0, 0.0]
    """
    row, column = np.indices((cameras.height, cameras.width))
    return pixel_rays(cameras, np.full(row.shape, camera), row, column)


def bands(cameras: Cameras, view: int, *, rows: int) -> Iterator[Rays]:
    """Yields the rays of an image, `[rows, width]`, some rows of pixels at a time."""
    for start in range(0, cameras.height, rows):
        row, column = np.indices((min(rows, cameras.height - start), cameras.width))
        yield pixel_rays(cameras, np.full(row.shape, view), start + row, column)


class Projection(NamedTuple):
    """Points projected into the image of a camera.

    Attributes:
      pixels: column and row; the image centre for points behind the camera.
      depths: depth along the camera axis, world units, positive in front of the camera.
    """

    pixels: Float[np.ndarray, "points 2"]
    depths: Float[np.ndarray, " points"]


def project(
    points: Float[np.ndarray, "points 3"], pose: Float[np.ndarray, "3 4"], cameras: Cameras
) -> Projection:
    """Projects points, in world units, into the image of the camera with one pose."""
    x, y, z = pose[:, :3].T @ (points.T - pose[:, 3:])
    scale = np.divide(-cameras.focal, z, out=np.zeros_like(z), where=z < 0.0)
    middle = 0.5 * np.array([cameras.width, cameras.height])
    return Projection(middle + np.stack([scale * x, -scale * y], axis=-1), -z)


def projection_slopes(
    seen: Projection, pose: Float[np.ndarray, "3 4"], cameras: Cameras
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]]:
    """Returns the derivatives of the column and of the row of projected points by the points."""
    middle = 0.5 * np.array([cameras.width, cameras.height])
    x, y = (seen.pixels - middle).T / cameras.focal
    right, up, back = pose[:, 0], pose[:, 1], pose[:, 2]
    scale = cameras.focal / seen.depths
    # A pixel is middle + focal (x, -y) / depth, and depth is along minus the third axis.
    by_column = scale[:, None] * (right + x[:, None] * back)
    by_row = scale[:, None] * (-up + y[:, None] * back)
    return by_column, by_row


def supersample(cameras: Cameras, side: int) -> Cameras:
    """Returns the same cameras with every pixel split into `side x side` subpixels.

    Args:
      cameras: the cameras.
      side: number of subpixels along each edge of a pixel, at least 1.
    """
    return cameras._replace(
        width=side * cameras.width, height=side * cameras.height, focal=side * cameras.focal
    )


def rays_of_pixels(
    cameras: Cameras,
    camera: int,
    row: Int[np.ndarray, "*pixels"],
    column: Int[np.ndarray, "*pixels"],
    *,
    side: int,
) -> Rays:
    """Returns several rays of each pixel, as `[*pixels, side * side]`, with their strata.

    Every square of a pixel has one ray, and so have all `side * side` rows and columns of the
    pixel: an edge along them is resolved by as many steps as there are rays.

    Args:
      cameras: the cameras.
      camera: index of the camera.
      row: row of each pixel, 0 at the top.
      column: column of each pixel, 0 at the left.
      side: square root of the number of rays in a pixel; their squares are numbered row by row.

    Source: Kensler, Correlated Multi-Jittered Sampling (2013), the canonical arrangement, whose
    offsets are taken in steps of about the golden section, ours.
    """
    down, along = (x.ravel() for x in np.indices((side, side)))
    golden = 0.5 * (3.0 - math.sqrt(5.0)) * side
    coprime = [step for step in range(1, side + 1) if math.gcd(step, side) == 1]
    step = min(coprime, key=lambda step: abs(step - golden))
    up, right = ((step * x % side + 0.5) / side - 0.5 for x in (along, down))
    fine_row, fine_column = (
        side * row[..., None] + down - up,
        side * column[..., None] + along + right,
    )
    fine = supersample(cameras, side)
    rays = pixel_rays(fine, np.full(fine_row.shape, camera), fine_row, fine_column)
    pixel = np.broadcast_to((row * cameras.width + column)[..., None], fine_row.shape)
    subpixel = np.broadcast_to(np.arange(side**2), fine_row.shape)
    numbers = np.stack([pixel, subpixel, np.full(fine_row.shape, side**2)], axis=-1)
    return rays._replace(strata=host_array(numbers.astype(np.int32)))


def strata(cameras: Cameras, side: int) -> Int[np.ndarray, "height width 3"]:
    """Returns pixel, subpixel and number of subpixels of every ray of a supersampled camera.

    See `Rays.strata`.

    Args:
      cameras: the cameras before `supersample`.
      side: number of subpixels along each edge of a pixel.
    """
    row, column = np.indices((side * cameras.height, side * cameras.width), np.int32)
    pixel = (row // side) * cameras.width + column // side
    subpixel = (row % side) * side + column % side
    return np.stack([pixel, subpixel, np.full_like(pixel, side**2)], axis=-1)


def box_filter(
    pixels: Float[np.ndarray, "height width *channels"], side: int
) -> Float[np.ndarray, "h w *channels"]:
    """Averages the subpixels of `supersample` into pixels; colours must be linear.

    Args:
      pixels: image of a supersampled camera.
      side: subpixels along each edge of a pixel, as in `supersample`.
    """
    height, width, *channels = pixels.shape
    blocks = pixels.reshape(height // side, side, width // side, side, *channels)
    return blocks.mean(axis=(1, 3))


def lower_median(pixels: Float[np.ndarray, "height width"], side: int) -> Float[np.ndarray, "h w"]:
    """Returns the median of each pixel's subpixels, the lower of two middle values.

    Args:
      pixels: image of a supersampled camera.
      side: subpixels along each edge of a pixel, as in `supersample`.
    """
    height, width = pixels.shape
    blocks = pixels.reshape(height // side, side, width // side, side).swapaxes(1, 2)
    ordered = np.sort(blocks.reshape(*blocks.shape[:2], side**2), axis=-1)
    return ordered[..., (side**2 - 1) // 2]


def orbit(
    frames: int,
    *,
    distance: float,
    elevation: float,
    size: int,
    angle_x: float,
    centre: Position = ORIGIN,
) -> Cameras:
    """Returns cameras on a circle around a centre, all looking at it, with z up.

    Args:
      frames: number of cameras, evenly spaced.
      distance: distance to the centre, world units.
      elevation: angle above the horizontal plane in radians, strictly between -pi/2 and pi/2.
      size: width and height in pixels.
      angle_x: horizontal field of view in radians.
      centre: point that the cameras look at, world units.

    Example:
      >>> import refref_jax
      >>> cameras = refref_jax.orbit(8, distance=4.0, elevation=0.3, size=16, angle_x=1.2)
      >>> rays = refref_jax.image_rays(cameras, 0)
      >>> rays.directions.shape
      (16, 16, 3)
    """
    azimuth = 2.0 * np.pi * np.arange(frames) / frames
    zero = np.zeros_like(azimuth)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), zero], axis=-1)
    flat = np.stack([np.cos(azimuth), np.sin(azimuth), zero], axis=-1)
    back = np.cos(elevation) * flat + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
    up = np.cross(back, right)
    poses = np.stack([right, up, back, distance * back + centre], axis=-1)
    return Cameras(poses, size, size, focal_length(size, angle_x))


def planar_depth_to_distance(
    cameras: Cameras, depth: Float[np.ndarray, "*images h w"]
) -> Float[np.ndarray, "*images h w"]:
    """Converts depth along the optical axis to distance along each pixel's unit ray."""
    row, column = np.indices((cameras.height, cameras.width))
    _, cosine = _unit_directions(cameras, row, column)
    return (depth / cosine).astype(np.float32)


def distance_to_planar_depth(
    cameras: Cameras, distance: Float[np.ndarray, "*images h w"]
) -> Float[np.ndarray, "*images h w"]:
    """Converts distance along each pixel's unit ray to depth along the optical axis."""
    row, column = np.indices((cameras.height, cameras.width))
    _, cosine = _unit_directions(cameras, row, column)
    return (distance * cosine).astype(np.float32)


def rays_of_views(
    cameras: Cameras, views: Int[np.ndarray, " views"], side: int
) -> tuple[Rays, Int[np.ndarray, " rays"]]:
    """Returns all rays of some views, `side` times `side` in each pixel, and their pixels.

    The index of a pixel counts those of the views before.
    """
    fine = supersample(cameras, side)
    each = [image_rays(fine, int(view)) for view in views]
    rays = Rays(
        origins=host_array(np.concatenate([view.origins.reshape(-1, 3) for view in each])),
        directions=host_array(np.concatenate([view.directions.reshape(-1, 3) for view in each])),
        radii=host_array(np.concatenate([view.radii.reshape(-1) for view in each])),
    )
    pixel, count = strata(cameras, side)[..., 0].reshape(-1), cameras.height * cameras.width
    return rays, np.concatenate([number * count + pixel for number in range(len(views))])


def planar_directions(
    cameras: Cameras, row: Real[np.ndarray, "*shape"], column: Real[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape 3"]:
    """Returns directions to pixel centres in the camera frame, with unit depth."""
    x = (column + 0.5 - 0.5 * cameras.width) / cameras.focal
    y = -(row + 0.5 - 0.5 * cameras.height) / cameras.focal
    return np.stack([x, y, -np.ones_like(x)], axis=-1)


def _unit_directions(
    cameras: Cameras, row: Real[np.ndarray, "*shape"], column: Real[np.ndarray, "*shape"]
) -> tuple[Float[np.ndarray, "*shape 3"], Float[np.ndarray, "*shape"]]:
    """Returns unit directions in the camera frame, and their cosine with the optical axis."""
    planar = planar_directions(cameras, row, column)
    norm = np.linalg.norm(planar, axis=-1, keepdims=True)
    return planar / norm, (1.0 / norm)[..., 0]
