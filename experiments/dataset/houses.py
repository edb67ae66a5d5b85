"""A ring of gabled houses around a square, seen from its middle."""

import math

import numpy as np
from jaxtyping import Int

from experiments.dataset.sky import Weather
from experiments.dataset.textures.fields import Field, Picture, blend, random_of, smooth
from experiments.dataset.textures.shading import chosen, colour, linear
from experiments.dataset.textures.sphere_fields import fbm3


def row_of_houses(
    azimuth: Field, elevation: Field, points: np.ndarray, weather: Weather
) -> tuple[Picture, np.ndarray]:
    """Returns a ring of fronts with windows, doors and gables, and the mask of its samples."""
    count, away = 26, 11.0
    turn = (azimuth / (2.0 * math.pi) + 0.5) * count
    index = np.floor(turn).astype(np.int32) % count
    wide = 2.0 * math.pi * away / count
    u = (turn - np.floor(turn) - 0.5) * wide
    up = away * np.tan(np.clip(elevation, 0.0, 1.3))
    eaves = 4.6 + 3.4 * random_of(index, 1)
    slope = 0.75 + 0.5 * random_of(index, 2)
    roof = np.where(
        random_of(index, 3) < 0.65, eaves + slope * (0.5 * wide - np.abs(u)), eaves + 0.5
    )
    plaster = chosen(
        random_of(index, 4),
        "#d9a066",
        "#c8553d",
        "#e8d8b0",
        "#7f9c8a",
        "#b5838d",
        "#8fa9bf",
        "#e0b13f",
        "#a4684a",
    )
    grain = fbm3(points, 40.0, 41, octaves=4, gain=0.8)
    front = linear(plaster) * (0.9 + 0.09 * grain)[..., None]
    front = _openings(front, index, u, up, (wide, eaves))
    tiles = 0.7 + 0.3 * np.sin(up * 26.0) * np.sin(u * 22.0) + 0.1 * grain
    thatch = linear(chosen(random_of(index, 7), "#8c3b25", "#6e2f26", "#54525a", "#a14a2a"))
    front = np.where((up > eaves)[..., None], thatch * tiles[..., None], front)
    front = np.where((np.abs(up - eaves) < 0.08)[..., None], linear(colour("#efe6d2")), front)
    seam = smooth(0.0, 0.10, 0.5 * wide - np.abs(u))
    sun = 0.75 + 0.45 * np.cos(azimuth - weather.azimuth + math.pi)
    return front * ((0.4 + 0.6 * seam) * sun)[..., None] * 1.15, (up < roof) & (elevation >= 0.0)


def _openings(
    front: Picture,
    index: Int[np.ndarray, "h w"],
    u: Field,
    up: Field,
    extent: tuple[float, Field],
) -> Picture:
    """Returns fronts with three windows on each floor, shuttered, and a door below.

    Args:
      front: colours of the plaster.
      index: index of the house.
      u: position to the right of the house's middle, in metres.
      up: height above the ground, in metres.
      extent: width of the house and height of its eaves, in metres.
    """
    wide, eaves = extent
    pitch, floor = wide / 3.0, 1.45
    column, row = np.floor((u + 0.5 * wide) / pitch), np.floor(up / floor)
    a, b = (u + 0.5 * wide) % pitch - 0.5 * pitch, up % floor - 0.62
    window = index * 997 + (column * 17 + row * 131).astype(np.int32)
    pane = np.maximum(np.abs(a) / 0.26, np.abs(b) / 0.44)
    bars = np.minimum(np.abs(a), np.abs(b % 0.3 - 0.15))
    glass = blend(
        linear(colour("#223244")), linear(colour("#a9c9e6")), 0.2 + 0.6 * random_of(window, 5)
    )
    glass = np.where((bars < 0.03)[..., None], linear(colour("#f3efe4")), glass)
    frame = (pane >= 1.0) & (pane < 1.25)
    shutters = (np.abs(np.abs(a) - 0.43) < 0.13) & (np.abs(b) < 0.46)
    paint = linear(chosen(random_of(index, 6), "#2e5e4e", "#2b4a7a", "#7c2d2d", "#4a3a2a"))
    paint = paint * (0.75 + 0.35 * np.sin(50.0 * b))[..., None]
    present = (up < eaves - 0.5) & ((up > floor) | (column == 1))
    for here, tone in ((shutters, paint), (frame, linear(colour("#efe6d2"))), (pane < 1.0, glass)):
        front = np.where((here & present)[..., None], tone, front)
    return front
