"""Background spheres of space: a nebula among stars, and the clouds of a giant planet."""

import numpy as np

from experiments.dataset.textures.fields import Picture, blend, random_of, smooth
from experiments.dataset.textures.shading import colour, graded
from experiments.dataset.textures.sphere_fields import (
    angles,
    cells3,
    directions,
    fbm3,
    lit_sphere,
    noise3,
)


def nebula(height: int) -> Picture:
    """Clouds of gas, dust lanes and the band of a galaxy, sown with stars of all sizes."""
    points = directions(height)
    fold = np.stack([fbm3(points, 1.6, each, octaves=5) for each in (1, 11, 21)], -1)
    bent = points + 0.22 * fold
    gas, dust = fbm3(bent, 2.2, 31, octaves=8, gain=0.6), fbm3(bent, 3.5, 41, octaves=8, gain=0.6)
    axis = np.array([0.35, -0.55, 0.76], np.float32)
    band = np.exp(-((((points + 0.05 * fold) @ axis) / 0.24) ** 2))
    tone = graded(
        gas + 0.8 * band,
        (-1.8, "#050817"),
        (-0.4, "#16224f"),
        (0.5, "#4b2f86"),
        (1.3, "#c43d7f"),
        (2.0, "#ff8f6b"),
        (2.8, "#ffe6b8"),
    )
    teal = graded(dust, (-0.5, "#04121c"), (0.6, "#0e5a6e"), (1.6, "#3fd0c0"), (2.6, "#e2fff2"))
    sky = 1.0 - (1.0 - tone) * (1.0 - 0.75 * teal * smooth(-0.6, 1.2, fold[..., 0])[..., None])
    lanes = smooth(0.3, 1.2, fbm3(bent, 5.0, 51, octaves=7, gain=0.65)) * (0.35 + 0.65 * band)
    sky = sky * (1.0 - 0.8 * lanes)[..., None]
    for count, seed, size in ((9000, 5, 0.0016), (1600, 6, 0.0026), (160, 7, 0.0052)):
        stars = cells3(points, count, seed)
        # Stars smaller than a sample are dimmed by their area.
        shown = max(size, 1.1 * np.pi / height)
        dimmed, size = (size / shown) ** 2, shown
        bright = random_of(stars.index, seed) ** 2.0
        warmth = graded(
            random_of(stars.index, seed + 9), (0.0, "#9bb8ff"), (0.5, "#ffffff"), (1.0, "#ffcf9b")
        )
        glow = np.exp(-((stars.away / size) ** 2)) + 0.12 * np.exp(-stars.away / (3.0 * size))
        sky = sky + warmth * (2.2 * dimmed * (0.25 + bright) * glow)[..., None]
    return np.clip(sky, 0.0, 1.0)


def planet(height: int) -> Picture:
    """The bands, festoons and storms of a giant planet's clouds."""
    points = directions(height)
    _, elevation = angles(height)
    z = points[..., 2]
    stretched = points * np.array([1.0, 1.0, 3.2], np.float32)
    swirl = fbm3(stretched, 2.2, 1, octaves=7, gain=0.58)
    storms = cells3(stretched / np.linalg.norm(stretched, axis=-1, keepdims=True), 46, 3)
    strong = (random_of(storms.index, 4) > 0.6) * (0.5 + random_of(storms.index, 5))
    ring = storms.away / (0.06 + 0.13 * random_of(storms.index, 6))
    eye = strong * np.exp(-ring * ring)
    drift = 0.075 * swirl * (0.55 + np.abs(np.cos(9.0 * z))) + 0.10 * eye * np.cos(9.0 * ring)
    level = z + drift
    bands = noise3(np.stack([0.0 * level, 0.0 * level + 0.3, level], -1), 9.0, 11)
    bands = bands + 0.7 * noise3(np.stack([0.0 * level, 0.0 * level + 0.6, level], -1), 26.0, 12)
    warped = np.stack([points[..., 0] + drift, points[..., 1] - drift, 5.0 * level], -1)
    threads = fbm3(warped, 9.0, 21, octaves=6, gain=0.7)
    tone = graded(
        bands + 0.45 * threads,
        (-2.6, "#2b1720"),
        (-1.3, "#7a2f2a"),
        (-0.3, "#c9713f"),
        (0.4, "#e8b77e"),
        (1.1, "#f6e6c8"),
        (1.9, "#8fb3b5"),
        (2.8, "#2f5d73"),
    )
    tone = blend(tone, colour("#c8391f"), 0.75 * smooth(0.35, 0.8, eye))
    tone = blend(tone, colour("#fff3e0"), smooth(0.12, 0.03, np.abs(eye - 0.33)) * 0.7)
    poles = smooth(0.85, 1.25, np.abs(elevation) + 0.06 * swirl)
    tone = blend(
        tone, graded(threads, (-2.0, "#0f2036"), (0.3, "#2f5f8a"), (2.0, "#b8d8e8")), poles
    )
    return lit_sphere(tone, 0.004 * swirl + 0.003 * threads, strength=0.5)
