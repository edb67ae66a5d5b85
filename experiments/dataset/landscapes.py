"""Outdoor environments: daylight over a meadow, a town square, a lake and dunes.

An image has `[h, 2h]` samples of linear RGB, laid out as in `textures.sphere_fields`; it is finite,
not negative, and at most `sky.SUN_RADIANCE`.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from experiments.dataset.houses import row_of_houses
from experiments.dataset.sky import SUN_RADIANCE, Weather, sky_of, sun_direction
from experiments.dataset.textures import masonry, plants
from experiments.dataset.textures.faces import require_size
from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    fbm,
    lookup,
    random_of,
    smooth,
)
from experiments.dataset.textures.shading import colour, graded, linear
from experiments.dataset.textures.sphere_fields import angles, averaged, directions, fbm3

_SOFT = 256  # rows above which images of the ground gain no detail


def meadow(height: int) -> Picture:
    """A flowering meadow between wooded hills, in the late morning."""
    points = directions(height)
    azimuth, elevation = angles(height)
    weather = Weather(math.radians(35.0), math.radians(42.0), 2.6, 0.46, 11)
    picture = sky_of(points, weather)
    haze = _horizon(picture)
    leaf = fbm3(points, 26.0, 21, octaves=5, gain=0.75)
    for row, (tall, rough, fog, tone) in enumerate(
        (
            (0.19, 1.6, 0.50, "#3f6347"),
            (0.13, 2.6, 0.28, "#3f6b2c"),
            (0.085, 4.5, 0.1, "#4f7a22"),
        )
    ):
        hill = tall * (1.0 + 0.32 * _around(azimuth, rough, 31 + 10 * row))
        crowns = np.maximum(_around(azimuth, 9.0 * (4 - row), 35 + 10 * row), -0.4)
        edge = elevation - hill - 0.011 * (row + 1) * crowns - 0.006 * (1 + row) * leaf
        bright = 0.8 + 0.45 * leaf + 0.7 * smooth(-0.05, 0.02, edge)
        slope = linear(colour(tone)) * np.clip(bright, 0.1, 3.0)[..., None] * 1.3
        picture = np.where((edge < 0.0)[..., None], blend(slope, haze, fog), picture)
    x, y, reach = _ground(azimuth, elevation, 1.5)
    bloom = plants.flowers(_side(height))
    near = linear(lookup(bloom, x / 3.1, y / 3.1))
    patches = fbm3(points, 5.0, 61, octaves=6, gain=0.65) + 0.6 * leaf
    grass = linear(
        graded(patches, (-2.0, "#3a5a1c"), (0.0, "#6f9433"), (1.2, "#b9b64a"), (2.2, "#e6d7e0"))
    )
    field = blend(near * 0.9, grass * 1.1, smooth(4.0, 13.0, reach))
    field = blend(field, haze, 0.35 * smooth(15.0, 60.0, reach))
    return _finished(np.where((elevation < -0.004 * (1.0 + leaf))[..., None], field, picture))


def square(height: int) -> Picture:
    """A cobbled square among gabled houses, in the afternoon."""
    points = directions(height)
    azimuth, elevation = angles(height)
    weather = Weather(math.radians(-140.0), math.radians(34.0), 3.4, 0.40, 71)
    picture = sky_of(points, weather)
    houses, built = row_of_houses(azimuth, elevation, points, weather)
    picture = np.where(built[..., None], houses, picture)
    x, y, reach = _ground(azimuth, elevation, 1.6)
    stones = linear(lookup(masonry.cobbles(_side(height)), x / 2.6, y / 2.6))
    ring = np.abs(np.hypot(x, y) % 3.2 - 1.6)
    stones = blend(
        stones * 1.15,
        linear(colour("#e8d8b8")) * (0.6 + 0.5 * stones.mean(-1))[..., None],
        0.5 * smooth(0.16, 0.13, ring),
    )
    far = linear(colour("#8d8475"))
    stones = blend(stones, far * np.ones(3), 0.6 * smooth(6.0, 18.0, reach))
    shade = 1.0 - 0.5 * smooth(0.10, 0.0, -elevation) * smooth(
        -0.2, 0.3, np.cos(azimuth - weather.azimuth)
    )
    return _finished(np.where((elevation < 0.0)[..., None], stones * shade[..., None], picture))


def lake(height: int) -> Picture:
    """Mountains with snow reflected in a lake, in the early morning, over a shore of pebbles."""
    points = directions(height)
    azimuth, elevation = angles(height)
    weather = Weather(math.radians(80.0), math.radians(31.0), 3.0, 0.5, 91)
    ripple = fbm3(points * np.array([1.0, 1.0, 8.0], np.float32), 7.0, 5, octaves=6, gain=0.65)
    down = np.maximum(-elevation, 0.0)
    wet = elevation < 0.0
    seen = np.where(wet, down * (1.0 + 0.10 * ripple), elevation)
    around = azimuth + np.where(wet, 0.03 * down * ripple, 0.0)
    flat = np.cos(seen)
    mirrored = np.stack([flat * np.cos(around), flat * np.sin(around), np.sin(seen)], -1)
    picture = _mountains(mirrored.astype(np.float32), around, seen, weather)
    x, y, reach = _ground(azimuth, elevation, 1.5)
    bed = linear(lookup(masonry.pebbles(_side(height)), x / 2.7, y / 2.7))
    # Fresnel's reflectance of water, after Schlick (1994).
    mirror = 0.02 + 0.98 * (1.0 - np.sin(np.clip(down, 0.0, 1.57))) ** 5
    shallow = bed * np.array([0.62, 0.80, 0.76], np.float32)
    deep = np.array([0.02, 0.09, 0.10], np.float32)
    body = blend(shallow, deep * np.ones(3), smooth(1.5, 7.0, reach))
    caustics = smooth(0.9, 2.0, ripple) * 0.35
    water = blend(body * (1.0 + caustics)[..., None], picture, np.clip(mirror + 0.18, 0.0, 1.0))
    shore = reach + 0.35 * fbm3(points, 3.0, 51, octaves=5)
    water = blend(bed, water, smooth(1.15, 1.25, shore))
    return _finished(np.where(wet[..., None], water, picture))


def _mountains(points: np.ndarray, azimuth: Field, elevation: Field, weather: Weather) -> Picture:
    """Returns the sky with two ranges of mountains and a seam of firs."""
    picture = sky_of(points, weather)
    haze = _horizon(picture)
    crag = fbm3(points, 5.0, 21, octaves=8, gain=0.55)
    light = fbm3(points + 0.012 * sun_direction(weather), 5.0, 21, octaves=8, gain=0.55)
    for row, (tall, rough, fog) in enumerate(((0.40, 1.5, 0.45), (0.27, 2.4, 0.15))):
        peak = tall * (0.8 + 0.5 * np.abs(_around(azimuth, rough, 31 + 10 * row)))
        edge = elevation - peak - 0.03 * crag
        snow = smooth(0.6, 0.75, elevation / tall + 0.22 * crag)
        bright = np.clip(0.55 + 1.6 * (crag - light), 0.12, 1.3)
        rock = linear(graded(crag, (-2.0, "#3a3f4a"), (0.2, "#6d6a68"), (2.0, "#a89a88")))
        face = blend(rock, np.array([0.82, 0.86, 0.95], np.float32), snow) * bright[..., None]
        picture = np.where((edge < 0.0)[..., None], blend(face, haze, fog), picture)
    pitch = 300.0
    turn = (azimuth / (2.0 * math.pi) + 0.5) * pitch
    index = np.floor(turn).astype(np.int32) % int(pitch)
    slim = 1.0 - 2.0 * np.abs(turn - np.floor(turn) - 0.5)
    firs = (0.030 + 0.045 * random_of(index, 3)) * (0.25 + slim)
    firs = firs * (1.0 + 0.35 * _around(azimuth, 3.0, 61)) + 0.012
    needles = linear(graded(crag + slim, (-1.0, "#0c1f14"), (1.0, "#27452a"), (2.5, "#5f7a3a")))
    return np.where((elevation < firs)[..., None], needles, picture)


def dunes(height: int) -> Picture:
    """Dunes with ripples of wind under a high sun, and red mesas far away."""
    points = directions(height)
    azimuth, elevation = angles(height)
    weather = Weather(math.radians(150.0), math.radians(55.0), 2.3, 0.33, 137)
    picture = sky_of(points, weather)
    haze = _horizon(picture)
    mesa = 0.06 + 0.13 * smooth(0.1, 0.35, _around(azimuth, 2.0, 21))
    edge = elevation - mesa - 0.012 * fbm3(points, 20.0, 31, octaves=5)
    layers = np.sin(elevation * 150.0 + 2.0 * fbm3(points, 8.0, 41, octaves=4))
    cliff = linear(graded(layers, (-1.0, "#7a2f1d"), (0.0, "#b4572f"), (1.0, "#e0a070")))
    picture = np.where((edge < 0.0)[..., None], blend(cliff, haze, 0.35), picture)
    grain = fbm3(points, 50.0, 51, octaves=4, gain=0.85)
    bends = fbm(512, 4, 55, octaves=7, gain=0.55)
    for row, (tall, rough) in enumerate(((0.05, 2.5), (-0.03, 1.6), (-0.16, 1.2), (-0.38, 1.0))):
        crest = tall + 0.05 * (row + 1) * _around(azimuth, rough, 61 + 10 * row)
        deep = np.maximum(crest - elevation, 0.0)
        # Each slope is a separate plane that starts at its crest.
        x, y, reach = _ground(azimuth, -(deep + 0.06), 1.2)
        bend = lookup(bends, x / 9.0, y / 9.0)
        wind = np.sin(9.0 * (x + 0.45 * y) + 5.0 * bend + row) * smooth(14.0, 5.0, reach)
        lee = lookup(bends, 0.3 + x / 31.0, y / 31.0) + 0.5 * np.sin(3.0 * azimuth + row)
        bright = 0.66 + 0.20 * wind + 0.08 * bend + 0.08 * grain + 0.35 * np.exp(-deep / 0.02)
        sand = linear(colour("#eab676")) * np.clip(bright, 0.08, 1.3)[..., None]
        shade = sand * np.array([0.34, 0.27, 0.36], np.float32)
        sand = blend(sand, shade, smooth(0.35, 0.5, lee))
        picture = np.where((elevation < crest)[..., None], sand, picture)
    return _finished(picture)


ENVIRONMENTS: dict[str, Callable[[int], Picture]] = {
    "meadow": meadow,
    "square": square,
    "lake": lake,
    "dunes": dunes,
}


def make_environment(name: str, height: int) -> Float[np.ndarray, "h w 3"]:
    """Returns an environment of `[height, 2 height]` samples, linear RGB in float32.

    Raises:
      ValueError: if the name does not exist, or the height is too small.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(
            f"There is no environment {name!r}. Choose from {', '.join(ENVIRONMENTS)}."
        )
    require_size(height)
    return averaged(ENVIRONMENTS[name], height)


def _finished(picture: Picture) -> Float[np.ndarray, "h w 3"]:
    return np.clip(picture, 0.0, SUN_RADIANCE).astype(np.float32)


def _ground(azimuth: Field, elevation: Field, eye: float) -> tuple[Field, Field, Field]:
    """Returns the visible point of flat ground, and its distance."""
    reach = eye / np.tan(np.clip(-elevation, 0.004, 0.5 * math.pi))
    return reach * np.cos(azimuth), reach * np.sin(azimuth), reach


def _around(azimuth: Field, frequency: float, seed: int) -> Field:
    """Returns noise along the horizon, periodic in azimuth."""
    rows = azimuth.shape[0]
    turn = np.linspace(-math.pi, math.pi, 4 * rows, endpoint=False)[None]
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], -1).astype(np.float32)
    line = fbm3(ring, frequency, seed, octaves=5, gain=0.5, rows=rows)
    return np.interp(azimuth, turn[0], line[0], period=2.0 * math.pi).astype(np.float32)


def _horizon(sky: Picture) -> Float[np.ndarray, "3"]:
    """Returns the mean colour of a sky's lowest part."""
    low = sky.shape[0] // 2
    return np.clip(sky[low - low // 8 : low - 1], 0.0, 1.0).mean((0, 1))


def _side(height: int) -> int:
    return max(height, _SOFT)
