"""Outdoor panoramas: a city by the water at night, and a wood in autumn."""

import math

import numpy as np
from jaxtyping import Float, Int

from experiments.dataset.textures import plants
from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    fbm,
    lookup,
    random_of,
    smooth,
)
from experiments.dataset.textures.shading import chosen, colour, colours, graded
from experiments.dataset.textures.sphere_fields import angles, cells3, directions, fbm3

Angle = Float[np.ndarray, "h w"]
Samples = Float[np.ndarray, " samples"]


def skyline(height: int) -> Picture:
    """A city by the water at night: lit towers, neon, the moon, and their reflections."""
    azimuth, elevation = angles(height)
    points = directions(height)
    ripple = fbm3(points * np.array([1.0, 1.0, 9.0], np.float32), 5.0, 3, octaves=6, gain=0.65)
    below = elevation < 0.0
    depth = np.clip(-elevation, 0.0, 1.6)
    mirrored = np.where(below, depth * (1.0 + 0.16 * ripple) + 0.01 * ripple, elevation)
    bent = azimuth + np.where(
        below, 0.022 * ripple * depth / np.maximum(np.cos(elevation), 0.25), 0
    )
    city, built = _towers(bent, mirrored)
    clouds = fbm3(
        points * np.where(below, -1.0, 1.0)[..., None] ** np.array([0, 0, 1]),
        2.6,
        21,
        octaves=7,
        gain=0.58,
    )
    glow = mirrored + 0.10 * clouds
    sky = graded(
        glow,
        (0.0, "#ff9a56"),
        (0.12, "#e0567a"),
        (0.35, "#6b3a8f"),
        (0.7, "#27307a"),
        (1.2, "#0f1a4a"),
        (1.6, "#0a1030"),
    )
    lit = graded(glow, (0.0, "#ffd9a0"), (0.3, "#f58fa8"), (0.8, "#6f6fc0"), (1.5, "#39437f"))
    sky = blend(sky, lit, smooth(0.1, 1.6, clouds))
    stars = cells3(points, 5200, 5)
    # Lights smaller than a sample are dimmed by their area.
    size = max(0.0028, 1.2 * math.pi / height)
    shine = (
        (0.0028 / size) ** 2
        * (0.2 + random_of(stars.index, 6))
        * np.exp(-((stars.away / size) ** 2))
    )
    shine = shine * smooth(0.25, 0.7, mirrored) * smooth(1.0, -0.2, clouds) * ~below
    sky = sky + shine[..., None] * colour("#fff5e0")
    sky = _fireworks(_moon(sky, bent, mirrored), bent, mirrored)
    picture = np.where(built[..., None], city, sky)
    water = picture * colour("#9db2cf") + colour("#060c1c")
    sparkle = smooth(0.9, 2.4, ripple)[..., None] * colour("#ffb98a") * 0.5
    return np.where(below[..., None], water + sparkle, picture)


def _moon(sky: Picture, azimuth: Angle, elevation: Angle) -> Picture:
    """Returns a sky with a full moon with seas, and its halo."""
    a, b = (azimuth - 0.9) * np.cos(elevation), elevation - 0.62
    away = np.hypot(a, b)
    seas = lookup(fbm(256, 5, 8, octaves=6, gain=0.6), 2.0 * a, 2.0 * b)
    moon = graded(seas, (-1.2, "#b9a98c"), (0.4, "#f3e6c4"), (1.5, "#fffbe9"))
    sky = sky + (0.45 * np.exp(-away / 0.14))[..., None] * colour("#ffe3b0")
    return blend(sky, moon, smooth(0.102, 0.098, away))


def _fireworks(sky: Picture, azimuth: Angle, elevation: Angle) -> Picture:
    """Adds bursts of sparks to the sky, in place."""
    rng = np.random.default_rng(3)
    tones = colours("#ff5d5d", "#ffd75e", "#7dffb2", "#7ab8ff", "#ff8af0", "#ffffff")
    for burst in range(22):
        at, up = rng.uniform(-2.7, 2.7), rng.uniform(0.55, 1.2)
        size, rays = rng.uniform(0.10, 0.24), int(rng.integers(9, 18))
        # Samples far from the burst are skipped.
        near = (np.abs(azimuth - at) * math.cos(up + 0.3) < size) & (np.abs(elevation - up) < size)
        row, column = np.nonzero(near)
        a = (azimuth[row, column] - at) * np.cos(elevation[row, column]) / size
        b = (elevation[row, column] - up) / size
        away, turn = np.hypot(a, b + 0.12 * a * a), np.arctan2(b + 0.12 * a * a, a)
        trail = np.abs(np.cos(rays * turn)) ** (4.0 + 60.0 * away)
        dots = 0.35 + 0.65 * (np.sin(34.0 * away + 3.0 * np.sin(rays * turn)) > 0.0)
        shine = trail * dots * smooth(1.0, 0.75, away) * smooth(0.0, 0.25, away)
        shine = shine + 1.2 * np.exp(-((away / 0.06) ** 2))
        tone, other = tones[burst % 6], tones[(burst + 2) % 6]
        sky[row, column] += shine[:, None] * blend(tone, other, smooth(0.45, 0.6, away)) * 1.2
    return sky


def _towers(azimuth: Angle, elevation: Angle) -> tuple[Picture, Float[np.ndarray, "h w"]]:
    """Returns four rows of buildings, the near ones last, and their mask."""
    city = np.zeros((*azimuth.shape, 3), np.float32)
    built = np.zeros(azimuth.shape, bool)
    turn = azimuth / (2.0 * math.pi) + 0.5
    for row, (count, tallest, haze) in enumerate(
        ((84, 1.0, 0.62), (60, 0.80, 0.40), (44, 0.52, 0.2), (30, 0.27, 0.0))
    ):
        at = turn * count + 0.37 * row
        index = np.floor(at).astype(np.int32) % count + 977 * row
        u = at - np.floor(at)
        share = random_of(index, 1)
        tall = tallest * (0.22 + 0.78 * share**1.6)
        step = np.where(random_of(index, 2) > 0.5, 0.18, 0.0)
        narrow = np.abs(u - 0.5) < 0.5 - step
        top = np.where(narrow, tall, 0.72 * tall)
        spire = (np.abs(u - 0.5) < 0.03) & (random_of(index, 3) > 0.6)
        top = np.where(spire, tall * 1.25, top)
        here = elevation < top
        columns = np.round(5.0 + 9.0 * random_of(index, 4))
        floors = 70.0 + 50.0 * random_of(index, 5)
        i, j = np.floor(u * columns), np.floor(elevation * floors)
        window = index * 7919 + (i * 31 + j * 173).astype(np.int32)
        inside = (np.abs(u * columns - i - 0.5) < 0.34) & (
            np.abs(elevation * floors - j - 0.5) < 0.3
        )
        on = inside & (random_of(window, 6) < 0.25 + 0.5 * random_of(index, 7)) & ~spire
        light = chosen(
            random_of(window, 8), "#ffd27a", "#ffe9b8", "#ffb84d", "#cfe8ff", "#fff6d6", "#8fd3ff"
        )
        wall = chosen(random_of(index, 9), "#1b2140", "#2a2238", "#16283a", "#33253a", "#20323f")
        wall = wall * (0.75 + 0.6 * u)[..., None]
        dark = wall + inside[..., None] * np.float32(0.05)
        front = np.where(
            on[..., None], light * (0.7 + 0.3 * random_of(window, 10))[..., None], dark
        )
        neon = (random_of(index, 11) > 0.62) & (np.abs(elevation - 0.93 * tall) < 0.006) & narrow
        sign = chosen(random_of(index, 12), "#ff2e88", "#25e6ff", "#fff04d", "#7dff6a", "#ff7a2e")
        front = np.where(neon[..., None], sign, front)
        front = blend(front, colour("#b0577f"), haze * 0.75)
        city, built = np.where(here[..., None], front, city), built | here
    return city, built


def wood(height: int) -> Picture:
    """A forest in autumn: trunks of birch and beech in mist, leaves above and on the ground."""
    azimuth, elevation = angles(height)
    points = directions(height)
    size = height // 2
    litter = plants.leaves(size)
    light = fbm3(points, 2.2, 1, octaves=6, gain=0.55)
    picture = graded(
        elevation + 0.16 * light,
        (-0.3, "#8a7a4a"),
        (0.0, "#e6cf8f"),
        (0.25, "#f3e3b0"),
        (0.7, "#cfe0c0"),
        (1.3, "#a9d0e0"),
    )
    bark = fbm(512, (6, 30), 5, octaves=5, gain=0.7)
    gold = litter * np.array([1.35, 1.35, 1.0], np.float32)
    drifts = [fbm3(points, 4.0 + 2.0 * row, 31 + 10 * row, octaves=6, gain=0.68) for row in (0, 1)]
    for row, (count, distance, haze) in enumerate(
        ((64, 14.0, 0.72), (40, 9.0, 0.52), (26, 6.0, 0.3), (15, 3.6, 0.08))
    ):
        picture = _trunks(picture, azimuth, elevation, bark, (count, distance, haze, row))
        gaps = drifts[row % 2] * (1.0 if row < 2 else -1.0)
        cover = gaps + 1.5 * (elevation - 0.62 + 0.09 * row) - 0.5 * np.maximum(elevation - 1.1, 0)
        scale = 1.4 - 0.25 * row
        covered = np.nonzero(cover > 0.35)
        radius = np.arccos(np.clip(points[..., 2][covered], -1.0, 1.0)) * scale
        u, v = radius * np.cos(azimuth[covered]), radius * np.sin(azimuth[covered])
        crown = lookup(gold, 0.31 * row + u, v)
        crown = blend(
            crown * (0.75 + 0.2 * gaps[covered])[..., None], colour("#f0dfa0"), 0.7 * haze
        )
        picture[covered] = crown
    reach = 1.7 / np.tan(np.clip(-elevation, 0.04, 1.57))
    x, y = reach * np.cos(azimuth), reach * np.sin(azimuth)
    ground = lookup(litter, x / 2.9, y / 2.9)
    rays = 0.85 + 0.3 * smooth(-0.5, 1.0, fbm3(points, 3.0, 91, octaves=4))
    ground = blend(ground * rays[..., None], colour("#e3cf94"), 0.85 * smooth(2.5, 16.0, reach))
    edge = elevation + 0.02 * fbm3(points, 12.0, 81, octaves=5)
    return np.where((edge < -0.085)[..., None], ground, picture)


def _trunks(
    picture: Picture,
    azimuth: Angle,
    elevation: Angle,
    bark: Field,
    row: tuple[int, float, float, int],
) -> Picture:
    """Draws a row of trunks, in place, from its count, distance, mist and index."""
    count, distance, haze, number = row
    up = distance * np.tan(np.clip(elevation, -1.5, 1.5))
    at = (azimuth / (2.0 * math.pi) + 0.5) * count
    for shift in (0, 1):
        index = (np.floor(at).astype(np.int32) + shift) % count + 101 * number
        middle = np.floor(at) + shift - 0.5 + 0.7 * (random_of(index, 1) - 0.5)
        bow = np.sin(0.35 * up + 6.0 * random_of(index, 3))
        lean = 0.05 * (random_of(index, 2) - 0.5) + 0.02 * bow
        side = (at - middle) * 2.0 * math.pi / count * distance - lean * up
        foot = 1.0 + 0.4 * np.exp(-np.maximum(up + 1.6, 0.0) / 0.35)
        u = side / ((0.13 + 0.20 * random_of(index, 4)) * foot)
        inside = np.nonzero((np.abs(u) < 1.0) & (up > -1.75 + 0.1 * np.abs(u)))
        tone = _bark(u[inside], up[inside], index[inside], bark)
        picture[inside] = blend(tone, colour("#ecd9a0"), haze)
    return picture


def _bark(
    u: Samples, up: Samples, index: Int[np.ndarray, " samples"], bark: Field
) -> Float[np.ndarray, "samples 3"]:
    """Returns the colours of trunks, `u` from -1 to 1 across: white birches and brown beeches."""
    turn = np.arcsin(np.clip(u, -1.0, 1.0))
    rough = lookup(bark, 0.1 * turn + random_of(index, 5), 0.25 * up + random_of(index, 6))
    ribs = lookup(bark, 0.25 * up + random_of(index, 8), 0.35 * turn)
    pale = graded(rough, (-1.9, "#1d1a18"), (-1.0, "#5a524a"), (-0.6, "#d9d2c4"), (1.5, "#f7f3ea"))
    brown = graded(ribs, (-1.8, "#1c120c"), (0.0, "#5b4330"), (1.2, "#8f7454"), (2.0, "#a8b06a"))
    tone = np.where((random_of(index, 7) < 0.45)[..., None], pale, brown)
    return tone * np.clip(0.35 + 0.75 * np.cos(turn - 0.7), 0.2, 1.1)[..., None]
