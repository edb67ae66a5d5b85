"""Round halls seen from their middle: a rotunda under a dome, and a circus tent."""

import math

import numpy as np
from jaxtyping import Float

from experiments.dataset.textures import (
    cloth,
    masonry,
    minerals,
    painted,
    penrose_tiles,
    tilings,
)
from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    fbm,
    lookup,
    random_of,
    reflected,
    smooth,
)
from experiments.dataset.textures.shading import chosen, colour, graded
from experiments.dataset.textures.sphere_fields import angles, directions, fbm3


def rotunda(height: int) -> Picture:
    """A domed hall: arcades with mosaics, a frieze, a coffered dome, and a pavement of rhombs."""
    azimuth, elevation = angles(height)
    size = height // 2
    turn = azimuth / (2.0 * math.pi) + 0.5
    up = np.tan(np.clip(elevation, -1.54, 1.54)) * 3.0
    bay = turn * 12.0
    number = np.floor(bay).astype(np.int32) % 12
    u = (bay - np.floor(bay) - 0.5) * (2.0 * math.pi * 3.0 / 12.0)
    arch = np.where(up < 0.4, np.abs(u) - 0.5, np.hypot(u, up - 0.4) - 0.5)
    tile = lookup(tilings.truchet(size), turn * 6.0, -up / 3.14)
    marble = lookup(minerals.marble(size), turn * 4.0, -up / 4.7)
    inner = [
        lookup(make(size), 0.5 + u / 1.1, 0.62 - (up + 0.3) / 2.4)
        for make in (tilings.mosaic, tilings.stained_glass, painted.painting)
    ]
    wall = np.where((arch < 0.0)[..., None], np.choose((number % 3)[..., None], inner), tile)
    band = (arch > 0.0) & (arch < 0.16) & (up > -1.5)
    stripes = np.floor(np.where(up < 0.4, up * 7.0, np.arctan2(up - 0.4, u) * 5.1)) % 2
    voussoir = np.where(stripes[..., None] > 0, colour("#a23b2a"), colour("#efe2c4"))
    wall = np.where(band[..., None], voussoir, wall)
    pillar = (np.abs(np.abs(u) - 0.785) < 0.10) & (up < 0.95)
    round_ = np.sqrt(np.clip(1.0 - ((0.785 - np.abs(u)) / 0.10) ** 2, 0.0, 1.0))
    wall = np.where(pillar[..., None], marble * (0.35 + 1.0 * round_)[..., None], wall)
    frieze = (up > 0.98) & (up < 1.45)
    wave = np.sin(turn * 2.0 * math.pi * 48.0 + 4.0 * np.sin((up - 0.98) * 13.0))
    knots = graded(wave, (-1.0, "#0f2f57"), (-0.3, "#1b5f8c"), (0.2, "#e3b34c"), (0.9, "#fff0c0"))
    wall = np.where(frieze[..., None], knots, wall)
    wall = np.where((np.abs(up - 0.98) < 0.025)[..., None], colour("#f4e6bd"), wall)
    picture = np.where((up > 1.45)[..., None], _dome(azimuth, elevation), wall)
    reach = 1.6 / np.tan(np.clip(-elevation, 0.02, 1.57))
    x, y = reach * np.cos(azimuth), reach * np.sin(azimuth)
    floor = lookup(penrose_tiles.penrose(size), reflected(0.5 + x / 4.0), reflected(0.5 + y / 4.0))
    star = np.cos(12.0 * azimuth) * 0.1 + 0.8
    medal = lookup(tilings.mosaic(size), 0.5 + x / 2.2, 0.5 + y / 2.2)
    floor = np.where((reach < star)[..., None], medal, floor)
    picture = np.where((up < -1.6)[..., None], floor, picture)
    shade = 1.0 - 0.35 * np.exp(-np.abs(up + 1.6) / 0.2) - 0.3 * np.exp(-np.abs(up - 1.45) / 0.1)
    return picture * (1.12 * shade)[..., None]


def _dome(azimuth: Float[np.ndarray, "h w"], elevation: Float[np.ndarray, "h w"]) -> Picture:
    """Returns a coffered dome, with a star in each coffer, around an opening to the sky."""
    low = math.atan(1.45 / 3.0)
    share = (elevation - low) / (0.5 * math.pi - low)
    # Rings get lower towards the top as the coffers get narrower.
    ring_at = 6.0 * (1.0 - np.sqrt(np.clip(1.0 - share, 0.0, 1.0))) / (1.0 - math.sqrt(0.08))
    ring = np.floor(ring_at).astype(np.int32)
    bay = (azimuth / (2.0 * math.pi) + 0.5) * 24.0 + 0.5 * (ring % 2)
    u, v = bay - np.floor(bay) - 0.5, ring_at - ring - 0.5
    coffer = np.maximum(np.abs(u), np.abs(v))
    index = ring * 37 + np.floor(bay).astype(np.int32) % 24 % 4
    field = chosen(random_of(index, 3), "#12356b", "#1d6b63", "#7a1f33", "#3b2a6b", "#b5651d")
    star = np.hypot(u, v) - 0.16 - 0.10 * np.cos(8.0 * np.arctan2(v, u))
    field = blend(field, colour("#f6d98b"), smooth(0.02, -0.02, star))
    field = blend(field, colour("#8a2f1f"), smooth(0.02, -0.02, star + 0.12))
    ribs = graded(
        coffer + 0.05 * np.cos(60.0 * (u + v)),
        (0.38, "#7a5a2a"),
        (0.43, "#f3dca0"),
        (0.5, "#b08b4a"),
    )
    dome = np.where((coffer > 0.38)[..., None], ribs, field)
    dome = dome * (1.1 - 0.5 * (v + 0.5) * (coffer <= 0.38))[..., None]
    sky = graded(v, (-0.5, "#9fd0f5"), (0.5, "#dff0ff"))
    return np.where((share > 0.92)[..., None], sky, dome)


def tent(height: int) -> Picture:
    """A circus tent: striped canvas with stars, pennants, garlands of lamps, tiers of people."""
    azimuth, elevation = angles(height)
    points = directions(height)
    size = height // 2
    turn = azimuth / (2.0 * math.pi) + 0.5
    weave = lookup(fbm(size, 90, 5, octaves=3, gain=0.9), turn * 4.0, elevation)
    canvas = _canvas(points, turn, elevation, weave)
    pennant = (elevation < 0.20) & (elevation > 0.06 + 0.28 * np.abs(turn * 64.0 % 1.0 - 0.5))
    flags = chosen(
        random_of(np.floor(turn * 64.0).astype(np.int32), 7),
        "#e63946",
        "#ffd166",
        "#06a77d",
        "#3a6ea5",
        "#f4f1de",
        "#8e44ad",
    )
    canvas = np.where(pennant[..., None], flags * (0.9 + 0.1 * weave)[..., None], canvas)
    crowd = _crowd(turn, elevation)
    picture = np.where(
        (elevation < 0.06)[..., None], np.where(pennant[..., None], canvas, crowd), canvas
    )
    reach = 1.0 / np.tan(np.clip(-elevation, 0.02, 1.57))
    x, y = reach * np.cos(azimuth), reach * np.sin(azimuth)
    saw = lookup(masonry.terrazzo(size), reflected(x / 0.9), reflected(y / 0.9)) * colour("#e3b273")
    rug = lookup(cloth.carpet(size), 0.5 + x / 1.5, 0.5 + y / 1.5)
    ground = np.where((np.maximum(np.abs(x), np.abs(y)) < 0.75)[..., None], rug, saw)
    kerb = (reach > 1.45) & (reach < 1.8)
    blocks = np.where(
        np.floor(turn * 48.0)[..., None] % 2 > 0, colour("#d62828"), colour("#fcf3dc")
    )
    ground = np.where(kerb[..., None], blocks, ground)
    return np.where((elevation < -0.5)[..., None], ground, picture)


def _canvas(
    points: Float[np.ndarray, "h w 3"], turn: Field, elevation: Field, weave: Field
) -> Picture:
    """Returns striped cloth with stars and two garlands of lamps."""
    stripe = turn * 32.0
    index = np.floor(stripe).astype(np.int32) % 32
    u = stripe - np.floor(stripe) - 0.5
    tones = chosen((index % 4 + 0.5) / 4.0, "#b81f2d", "#f4e4bd", "#1c4f8c", "#f0b429")
    folds = fbm3(points, 6.0, 3, octaves=6, gain=0.6)
    canvas = tones * (0.78 + 0.28 * np.cos(np.pi * u) + 0.07 * folds + 0.06 * weave)[..., None]
    ring = elevation * 5.2
    v = ring - np.floor(ring) - 0.5
    star = np.hypot(u * np.cos(elevation) * 0.9, v * 0.8)
    star = star - 0.13 - 0.06 * np.cos(5.0 * np.arctan2(v, u) + 1.57)
    canvas = np.where((star < 0.0)[..., None], tones[..., ::-1] * 0.9 + 0.1, canvas)
    sag = 0.06 * np.abs(np.sin(32.0 * math.pi * turn))
    for level, count in ((0.28, 96), (0.72, 64)):
        height_of = level - sag * (1.0 + level)
        lamp = np.hypot(
            (turn * count % 1.0 - 0.5) * 6.283 / count * np.cos(level), elevation - height_of
        )
        canvas = blend(
            canvas, colour("#2b1a12"), smooth(0.006, 0.003, np.abs(elevation - height_of))
        )
        canvas = canvas + colour("#ffcf70") * (0.9 * np.exp(-lamp / 0.012))[..., None]
    # Where stripes would be narrower than samples, the cloth is gathered by a ring.
    crown = graded(np.cos(70.0 * elevation), (-1.0, "#5a1420"), (0.0, "#c99a3a"), (0.7, "#fff0c0"))
    return blend(canvas, crown, smooth(1.30, 1.32, elevation))


def _crowd(turn: Field, elevation: Field) -> Picture:
    """Returns tiers of spectators: heads over shoulders, each in other colours."""
    picture = np.ones((*turn.shape, 3), np.float32) * colour("#1d130f")
    tiers = 11
    for tier in range(tiers):
        base = 0.045 - 0.05 * tier
        seats = turn * 110.0 + 0.5 * (tier % 2)
        index = tier * 131 + np.floor(seats).astype(np.int32) % 110
        u = (seats - np.floor(seats) - 0.5) * 6.283 / 110.0
        v = elevation - base + 0.012 * random_of(index, 9)
        shirt = chosen(
            random_of(index, 1),
            "#c1121f",
            "#1d4e89",
            "#e9c46a",
            "#2a9d8f",
            "#f1faee",
            "#6d597a",
            "#264653",
            "#e76f51",
            "#3d3d3d",
        )
        skin = chosen(random_of(index, 2), "#f1c9a5", "#c98f66", "#8d5a3b", "#5a3825")
        hair = chosen(random_of(index, 3), "#1c120c", "#5a3a1e", "#b98a4a", "#8a8a88", "#c1121f")
        light = (1.1 - 0.045 * tier) * (0.8 + 8.0 * u)[..., None]
        body = (np.hypot(u / 0.023, (v + 0.035) / 0.034) < 1.0) | (v < -0.035)
        head = np.hypot(u / 0.0125, (v - 0.009) / 0.015)
        picture = np.where(body[..., None], shirt * light, picture)
        picture = np.where((head < 1.0)[..., None], skin * light, picture)
        picture = np.where(((head < 1.05) & (v > 0.013))[..., None], hair * light, picture)
    return picture
