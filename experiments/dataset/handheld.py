"""A hand-held camera and what it does to images, poses and masks (NumPy only).

    orbit            true poses of a walk around the object
    Lens, bent       OpenCV's radial and tangential distortion, and its inverse
    gains            exposure and white balance that drift from image to image
    photograph       an image through the lens, with noise, as 8-bit sRGB
    wobble           a mask whose edge is wrong by a few pixels
    disturb          poses as another program would estimate them

Everything is a function of its arguments and a seed. Poses are camera-to-world, x right, y up,
looking along -z; image coordinates have their origin in the upper left corner, x to the right.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from experiments.dataset import frame_files

# Elevation of the orbit, degrees; spread of distance (share) and aim (world units); roll, degrees.
_LOW, _HIGH = 14.0, 48.0
_DISTANCE, _AIM, _ROLL = 0.08, 0.15, 3.0

# Turns of the orbit, and how many views a smooth disturbance of the hand lasts.
_TURNS, _BREATH = 2.0, 2.5

# Exposure walks within a third of a stop, white balance within 5 %.
_STOP, _BALANCE = 1.0 / 3.0, 0.05

# Variance of the sensor's noise: of photons, per linear light, and of reading.
_PHOTONS, _READING = 2e-4, 4e-6

# Samples of the lens in a pixel, a side; iterations of its inverse, and their largest error.
_SAMPLES, _ROUNDS, _CONVERGED = 3, 40, 1e-10

# Pixels over which the error of a mask's edge varies.
_WAVE = 6.0


class Lens(NamedTuple):
    """OpenCV's camera: focal length and principal point in pixels, and distortion.

    Attributes:
      focal: focal length.
      centre_x, centre_y: principal point.
      k1, k2: radial coefficients.
      p1, p2: tangential coefficients.
    """

    focal: float
    centre_x: float
    centre_y: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


def usual_lens(size: int, focal: float) -> Lens:
    """Returns the lens of the generated captures: barrel distortion, a centre a little off."""
    return Lens(focal, 0.508 * size, 0.494 * size, k1=-0.11, k2=0.025, p1=8e-4, p2=-5e-4)


def bent(lens: Lens, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Returns where a lens images directions.

    Args:
      lens: the lens.
      points: directions `(x, y)` of unit depth, y downwards.

    Returns:
      Positions in the image divided by the focal length, from the principal point.

    Source: OpenCV's documentation of `calib3d`, with k3 = 0.
    """
    x, y = points[..., 0], points[..., 1]
    squared = x * x + y * y
    radial = 1.0 + squared * (lens.k1 + squared * lens.k2)
    return np.stack(
        [
            x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (squared + 2.0 * x * x),
            y * radial + lens.p1 * (squared + 2.0 * y * y) + 2.0 * lens.p2 * x * y,
        ],
        axis=-1,
    )


def straightened(lens: Lens, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Returns the inverse of `bent`, by fixed-point iteration.

    Raises:
      ValueError: if it does not converge, because the distortion is too strong.
    """
    found = points
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_ROUNDS):
            found = found + points - bent(lens, found)
        error = np.abs(bent(lens, found) - points).max()
    if not error <= _CONVERGED:
        raise ValueError(f"The distortion of {lens} has no inverse in the image. Weaken it.")
    return found


def orbit(views: int, *, distance: float, seed: int) -> Float[np.ndarray, "views 4 4"]:
    """Returns poses of a hand that carries a camera around the origin twice.

    Args:
      views: number of poses, in the order of the walk.
      distance: mean distance from the origin, world units.
      seed: non-negative integer.
    """
    rng = np.random.default_rng(seed)
    unsteady = _smooth_noise(rng, views, 6)
    share = (np.arange(views) + 0.5) / views
    azimuth = 2.0 * math.pi * _TURNS * share + 0.06 * unsteady[:, 0]
    middle, reach = 0.5 * (_LOW + _HIGH), 0.5 * (_HIGH - _LOW)
    # Low in the first turn, high in the second, with the unsteadiness of the hand.
    level = np.tanh(4.0 * (share - 0.5)) * 0.6 + 0.35 * np.tanh(unsteady[:, 1])
    elevation = np.radians(middle + reach * level)
    far = distance * (1.0 + _DISTANCE * np.tanh(unsteady[:, 2]))
    backward = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=-1,
    )
    position = far[:, None] * backward
    aim = _AIM * unsteady[:, 3:6]
    poses = _look(position, aim)
    roll = np.radians(_ROLL) * _smooth_noise(rng, views, 1)
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(roll * [[0.0, 0.0, 1.0]]).as_matrix()
    return poses


def gains(views: int, *, seed: int) -> Float[np.ndarray, "views 3"]:
    """Returns factors of linear RGB that drift slowly, with geometric mean 1 over all views.

    Exposure stays within a third of a stop around its mean, the balance of colours within 5 %.
    """
    rng = np.random.default_rng(seed)
    steps = rng.standard_normal((views, 3))
    walk = np.cumsum(steps, axis=0) if views > 1 else np.zeros((1, 3))
    walk = walk - walk.mean(axis=0)
    walk /= np.maximum(np.abs(walk).max(axis=0), 1e-12)
    stops = _STOP * walk[:, :1] * [[1.0, 1.0, 1.0]]
    balance = np.log2(1.0 + _BALANCE) * np.stack([walk[:, 1], np.zeros(views), walk[:, 2]], axis=-1)
    return np.exp2(stops + balance)


def photograph(
    linear: Float[np.ndarray, "h w 3"],
    lens: Lens,
    *,
    fine_focal: float,
    size: int,
    gain: Float[np.ndarray, "3"],
    seed: int,
) -> UInt8[np.ndarray, "size size 3"]:
    """Returns an image as a camera takes it.

    Args:
      linear: linear light of an ideal pinhole, at a finer resolution and with a margin.
      lens: lens of the camera.
      fine_focal: focal length of the pinhole, in its own pixels.
      size: width and height of the image.
      gain: exposure and white balance.
      seed: seed of the noise.

    Raises:
      ValueError: if the lens sees more than the pinhole.
    """
    light = _through(linear, lens, fine_focal, size) * gain
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(light.shape)
    light = light + noise * np.sqrt(_PHOTONS * np.maximum(light, 0.0) + _READING)
    return frame_files.to_srgb(light)


def photograph_mask(
    mask: Bool[np.ndarray, "h w"], lens: Lens, *, fine_focal: float, size: int
) -> Bool[np.ndarray, "size size"]:
    """Returns the exact mask of an image: the pixels of which the object covers at least half."""
    return _through(mask[..., None].astype(np.float64), lens, fine_focal, size)[..., 0] >= 0.5


def wobble(mask: Bool[np.ndarray, "h w"], *, pixels: float, seed: int) -> Bool[np.ndarray, "h w"]:
    """Returns a mask whose edge is moved in and out smoothly, by at most `pixels`."""
    if not mask.any() or mask.all():
        return mask.copy()
    inside = scipy.ndimage.distance_transform_edt(mask)
    outside = scipy.ndimage.distance_transform_edt(~mask)
    signed = np.where(mask, inside - 0.5, 0.5 - outside)
    rng = np.random.default_rng(seed)
    waves = scipy.ndimage.gaussian_filter(rng.standard_normal(mask.shape), _WAVE, mode="wrap")
    shift = np.clip(pixels * waves / (1.5 * waves.std()), -pixels, pixels)
    return signed + shift > 0.0


def disturb(
    poses: Float[np.ndarray, "views 4 4"], *, degrees: float, share: float, seed: int
) -> Float[np.ndarray, "views 4 4"]:
    """Returns poses with independent errors, normally distributed in all six directions.

    Args:
      poses: true poses.
      degrees: root mean square of the angle of the rotations, about any axis.
      share: root mean square of the displacements, as a share of the distance from the origin.
      seed: non-negative integer.
    """
    rng = np.random.default_rng(seed)
    turns, moves = rng.standard_normal((2, len(poses), 3)) / math.sqrt(3.0)
    found = poses.copy()
    turned = Rotation.from_rotvec(np.radians(degrees) * turns).as_matrix()
    found[:, :3, :3] = turned @ poses[:, :3, :3]
    distance = np.linalg.norm(poses[:, :3, 3], axis=-1, keepdims=True)
    found[:, :3, 3] += share * distance * moves
    return found


def _smooth_noise(rng: np.random.Generator, views: int, columns: int) -> np.ndarray:
    """Returns smooth sequences of about unit variance."""
    white = rng.standard_normal((views, columns))
    smoothed = scipy.ndimage.gaussian_filter1d(white, _BREATH, axis=0, mode="reflect")
    return smoothed * math.sqrt(2.0 * math.sqrt(math.pi) * _BREATH)


def _look(
    position: Float[np.ndarray, "views 3"], aim: Float[np.ndarray, "views 3"]
) -> Float[np.ndarray, "views 4 4"]:
    backward = position - aim
    backward /= np.linalg.norm(backward, axis=-1, keepdims=True)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    poses[:, :3] = np.stack([right, np.cross(backward, right), backward, position], axis=-1)
    return poses


def _through(
    image: Float[np.ndarray, "h w channels"], lens: Lens, fine_focal: float, size: int
) -> Float[np.ndarray, "size size channels"]:
    """Returns the mean of an ideal image over the pixels of a lens."""
    ticks = (np.arange(size * _SAMPLES) + 0.5) / _SAMPLES
    x, y = np.meshgrid(ticks, ticks)
    seen = np.stack([x - lens.centre_x, y - lens.centre_y], axis=-1) / lens.focal
    where = fine_focal * straightened(lens, seen)
    height, width = image.shape[:2]
    rows, columns = where[..., 1] + 0.5 * height - 0.5, where[..., 0] + 0.5 * width - 0.5
    low, high = min(rows.min(), columns.min()), max(rows.max(), columns.max())
    if low < 0.0 or high > min(height, width) - 1.0:
        raise ValueError("The lens sees more than the rendered image. Render a wider margin.")
    sampled = [
        scipy.ndimage.map_coordinates(image[..., channel], [rows, columns], order=1)
        for channel in range(image.shape[-1])
    ]
    stacked = np.stack(sampled, axis=-1)
    return stacked.reshape(size, _SAMPLES, size, _SAMPLES, -1).mean(axis=(1, 3))
