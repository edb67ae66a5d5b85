"""Random fields on the unit sphere, and light on its reliefs.

An image of a sphere has `[h, 2h]` samples: the middle column looks along +x, the seam along -x, row
0 at the zenith (+z). Fields are evaluated at the samples' directions in space, so that neither the
seam nor the poles are visible. Noise has about mean 0 and variance 1; `frequency` is the number of
nodes per unit of length.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.spatial
from jaxtyping import Float, Int
from PIL import Image

from experiments.dataset.textures.fields import Field, Picture

Directions = Float[np.ndarray, "h w 3"]

_NODES = 48  # a side of the lattice, which repeats

# Mean square of a weight in one dimension, for trilinear interpolation with a smooth step.
_VARIANCE = 0.74285


def directions(height: int) -> Directions:
    """Returns the unit vectors of all samples."""
    azimuth, elevation = angles(height)
    around = np.cos(elevation)
    parts = (around * np.cos(azimuth), around * np.sin(azimuth), np.sin(elevation))
    return np.stack(parts, -1).astype(np.float32)


def angles(height: int) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Returns azimuth (pi at the left edge, falling to -pi) and elevation, radians."""
    width = 2 * height
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2.0 * math.pi
    elevation = (0.5 - (np.arange(height) + 0.5) / height) * math.pi
    return tuple(np.meshgrid(azimuth.astype(np.float32), elevation.astype(np.float32)))


def noise3(points: Directions, frequency: float, seed: int) -> Field:
    """Returns one octave of noise in space, on a randomly rotated lattice."""
    rng = np.random.default_rng(seed)
    nodes = rng.standard_normal((_NODES, _NODES, _NODES), np.float32)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0].astype(np.float32)
    at = np.moveaxis(points @ (turn * np.float32(frequency)), -1, 0)
    at = at + rng.uniform(0.0, _NODES, (3, 1, 1)).astype(np.float32)
    low = np.floor(at)
    t = at - low
    eased = low + t * t * t * (t * (6.0 * t - 15.0) + 10.0)
    found = scipy.ndimage.map_coordinates(nodes, eased, order=1, mode="grid-wrap", prefilter=False)
    return found / np.float32(_VARIANCE**1.5)


def fbm3(
    points: Directions,
    frequency: float,
    seed: int,
    *,
    octaves: int = 6,
    gain: float = 0.5,
    rows: int | None = None,
) -> Field:
    """Returns octaves of noise up to the sampling limit of an image with the rows of `points`."""
    finest = (rows or points.shape[0]) / math.pi / 2.0
    total = np.zeros(points.shape[:2], np.float32)
    for octave in range(octaves):
        if frequency * 2.0**octave <= finest:
            total += gain**octave * noise3(points, frequency * 2.0**octave, seed + octave)
    return total / math.sqrt(sum(gain ** (2 * octave) for octave in range(octaves)))


def waves3(points: Directions, number: float, seed: int) -> Field:
    """Returns plane waves of one wave number in all directions; the zeros form winding lines.

    Args:
      points: positions on the sphere.
      number: wave number, radians per unit of length.
      seed: seed of directions and phases.
    """
    rng = np.random.default_rng(seed)
    towards = rng.standard_normal((28, 3))
    towards *= number / np.linalg.norm(towards, axis=-1, keepdims=True)
    total = np.zeros(points.shape[:2], np.float32)
    for wave, phase in zip(towards, rng.uniform(0.0, 2.0 * math.pi, 28), strict=True):
        total += np.cos(points @ wave.astype(np.float32) + np.float32(phase))
    return total / np.float32(math.sqrt(14.0))


def averaged(paint: Callable[[int], Picture], height: int) -> Float[np.ndarray, "height width 3"]:
    """Returns an image painted with 1.5 times as many rows and columns, and averaged."""
    fine = paint((3 * height + 1) // 2).astype(np.float32)
    channels = [
        Image.fromarray(np.ascontiguousarray(fine[..., each])).resize(
            (2 * height, height), Image.Resampling.BOX
        )
        for each in range(3)
    ]
    return np.stack([np.asarray(channel) for channel in channels], -1)


class SphereCells(NamedTuple):
    """Cell of every sample.

    Attributes:
      index: index of the cell.
      border: distance to the nearest border, on the unit sphere.
      away: distance to the cell's seed.
    """

    index: Int[np.ndarray, "h w"]
    border: Field
    away: Field


def cells3(points: Directions, count: int, seed: int) -> SphereCells:
    """Returns the Voronoi cells of random seeds with limited density."""
    rng = np.random.default_rng(seed)
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    around = np.sqrt(1.0 - height**2)
    seeds = np.stack([around * np.cos(turn), around * np.sin(turn), height], -1)
    seeds += rng.normal(0.0, 0.75 / math.sqrt(count), seeds.shape)
    seeds /= np.linalg.norm(seeds, axis=-1, keepdims=True)
    distance, index = scipy.spatial.cKDTree(seeds).query(points, k=2)
    between = np.linalg.norm(seeds[index[..., 1]] - seeds[index[..., 0]], axis=-1)
    border = (distance[..., 1] ** 2 - distance[..., 0] ** 2) / (2.0 * between)
    return SphereCells(
        index[..., 0].astype(np.int32),
        border.astype(np.float32),
        distance[..., 0].astype(np.float32),
    )


_SUN = (0.45, 0.35, 0.82)


def lit_sphere(picture: Picture, height: Field, *, strength: float = 1.0) -> Picture:
    """Returns an image as a relief lit from one direction of space.

    Args:
      picture: colours without light.
      height: height of the relief, in radii.
      strength: strength of light and shade.
    """
    rows = height.shape[0]
    azimuth, elevation = angles(rows)
    wrapped = np.concatenate([height[:, -1:], height, height[:, :1]], axis=1)
    eastward = -(wrapped[:, 2:] - wrapped[:, :-2]) * (rows / math.pi / 2.0)
    eastward = eastward / np.maximum(np.cos(elevation), np.float32(1e-3))
    upward = -np.gradient(height, axis=0) * (rows / math.pi)
    sun = np.asarray(_SUN, np.float32)
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    sun_east = -sun[0] * sin + sun[1] * cos
    level = sun[0] * cos + sun[1] * sin
    sun_up = sun[2] * np.cos(elevation) - level * np.sin(elevation)
    slope = eastward * sun_east + upward * sun_up
    steep = np.sqrt(1.0 + eastward**2 + upward**2)
    return picture * np.clip(1.0 + strength * slope / steep, 0.15, 2.2)[..., None]
