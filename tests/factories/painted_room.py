"""Photographs of the inside of a painted box, by closed form, with cameras that are known."""

import numpy as np
import scipy.ndimage

from experiments.cameras.bundle import Views
from experiments.cameras.refinement import Photo

_HALF = np.array([3.0, 2.6, 2.2])


def views(count, *, size, focal, seed=0):
    """Returns cameras on an arc in the box, which look across its middle."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 1.2, count)
    place = np.stack([1.7 * np.cos(angle), 1.7 * np.sin(angle), rng.uniform(-0.4, 0.6, count)], -1)
    back = place - rng.uniform(-0.2, 0.2, (count, 3))
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack([right, np.cross(back, right), back, place], axis=-1)
    return Views(poses, np.full(count, focal), np.full((count, 2), 0.5 * size))


def photographs(cameras, *, size, seed=1, fine=3):
    """Returns what cameras see of the box, averaged over pixels, with an object in the middle."""
    rng = np.random.default_rng(seed)
    spots = scipy.ndimage.gaussian_filter(rng.standard_normal((6, 240, 240)), (0.0, 3.0, 3.0))
    walls = 0.5 + 0.4 * np.tanh(spots / spots.std())[..., None] * [1.0, 0.9, 0.8]
    photos = []
    for pose, focal in zip(cameras.poses, cameras.focals, strict=True):
        ticks = (np.arange(size * fine) + 0.5) / fine - 0.5 * size
        x, y = np.meshgrid(ticks / focal, ticks / focal)
        towards = np.stack([x, -y, -np.ones_like(x)], -1) @ pose[:, :3].T
        colours = _colours(walls, pose[:, 3], towards)
        # A ball, which shows something else to each camera.
        along = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
        nearest = pose[:, 3] - (along @ pose[:, 3])[..., None] * along
        ball = (np.linalg.norm(nearest, axis=-1) < 0.35) & (along @ pose[:, 3] < 0.0)
        colours[ball] = rng.random(3)
        image = colours.reshape(size, fine, size, fine, 3).mean((1, 3))
        mask = ball[fine // 2 :: fine, fine // 2 :: fine]
        photos.append(Photo(np.rint(255.0 * image).astype(np.uint8), mask))
    return photos


def _colours(walls, start, towards):
    with np.errstate(divide="ignore"):
        away = (np.sign(towards) * _HALF - start) / towards
    axis = np.argmin(np.where(towards == 0.0, np.inf, away), axis=-1)
    hit = start + np.take_along_axis(away, axis[..., None], -1) * towards
    side = 2 * axis + (np.take_along_axis(towards, axis[..., None], -1)[..., 0] > 0.0)
    share = 0.5 + 0.5 * hit / _HALF
    first, second = (
        np.take_along_axis(share, ((axis + step) % 3)[..., None], -1)[..., 0] for step in (1, 2)
    )
    count = walls.shape[1]
    row, column = (np.clip((each * count).astype(int), 0, count - 1) for each in (first, second))
    return walls[side, row, column]
