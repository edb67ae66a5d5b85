"""Background spheres of materials: agate, leaded glass, coral, sandstone."""

import numpy as np

from experiments.dataset.textures.fields import Picture, blend, random_of, smooth
from experiments.dataset.textures.shading import chosen, colour, graded
from experiments.dataset.textures.sphere_fields import (
    angles,
    cells3,
    directions,
    fbm3,
    lit_sphere,
    noise3,
    waves3,
)


def agate(height: int) -> Picture:
    """Agates and malachite: nests of thin bands, with quartz between them."""
    points = directions(height)
    bent = points + 0.10 * np.stack(
        [fbm3(points, 2.5, each, octaves=3) for each in (1, 11, 21)], -1
    )
    nests = cells3(bent, 34, 3)
    rough = fbm3(points, 9.0, 41, octaves=5, gain=0.4)
    depth = nests.border + 0.004 * rough + 0.010 * fbm3(points, 4.0, 51, octaves=2)
    bands = 30.0 + 40.0 * random_of(nests.index, 1)
    wave = depth * bands + 0.6 * np.sin(depth * 31.0 + 6.0 * random_of(nests.index, 2))
    layer = np.floor(wave).astype(np.int32)
    tone = 0.5 + 0.5 * np.sin(2.0 * np.pi * wave) * (0.5 + 0.5 * random_of(layer, 3))
    stones = [
        graded(tone, (0.0, "#3b0d0c"), (0.35, "#a8321f"), (0.7, "#e8935a"), (1.0, "#fbe9d0")),
        graded(tone, (0.0, "#04261c"), (0.4, "#0b6b4c"), (0.75, "#3fae7c"), (1.0, "#c9f0d4")),
        graded(tone, (0.0, "#0a1538"), (0.4, "#274d9c"), (0.75, "#86a9d8"), (1.0, "#f2f5fb")),
        graded(tone, (0.0, "#2a0f33"), (0.4, "#6b3a86"), (0.75, "#bb93cc"), (1.0, "#faf0fb")),
        graded(tone, (0.0, "#1d1712"), (0.4, "#7a5a36"), (0.75, "#cfae7c"), (1.0, "#fbf3e0")),
    ]
    kind = np.minimum((random_of(nests.index, 4) * len(stones)).astype(np.int32), len(stones) - 1)
    stone = np.choose(kind[..., None], stones)
    crystals = cells3(points, 14000, 8)
    facet = 0.55 + 0.6 * random_of(crystals.index, 5)
    quartz = chosen(random_of(crystals.index, 6), "#e9e3f0", "#c9b8de", "#f7f2ea", "#a58cc4")
    quartz = quartz * facet[..., None]
    core = smooth(0.19, 0.21, depth + 0.05 * (random_of(nests.index, 7) - 0.5))
    stone = blend(stone, quartz, core)
    stone = blend(stone, colour("#f3ead8"), smooth(0.012, 0.006, depth))
    stone = stone * (1.0 + 0.06 * fbm3(points, 60.0, 61, octaves=3, gain=0.8))[..., None]
    return lit_sphere(stone, 0.004 * tone * (1.0 - core) + 0.01 * facet * core, strength=0.7)


def lantern(height: int) -> Picture:
    """A globe of leaded glass: large coloured panes, small ones between, jewels at the joints."""
    points = directions(height)
    bent = points + 0.02 * np.stack(
        [fbm3(points, 5.0, each, octaves=2) for each in (1, 11, 21)], -1
    )
    panes, splits = cells3(bent, 150, 3), cells3(bent, 1500, 4)
    split = random_of(panes.index, 5) < 0.5
    border = np.where(split, np.minimum(splits.border, panes.border), panes.border)
    piece = np.where(split, splits.index + 1000, panes.index)
    family = random_of(panes.index, 6)
    share = (0.6 * family + 0.4 * random_of(piece, 7)) % 1.0
    glass = chosen(
        share,
        "#0b3fa8",
        "#1aa7c4",
        "#0f7a4d",
        "#a3c94a",
        "#f2b705",
        "#ef7b2d",
        "#b3122a",
        "#8c1c5a",
        "#5b1a8a",
        "#e9dfc0",
    )
    streaks = fbm3(bent * np.array([1.0, 2.5, 1.0], np.float32), 7.0, 31, octaves=6, gain=0.62)
    ripple = fbm3(points, 40.0, 41, octaves=4, gain=0.7)
    glow = 0.68 + 0.22 * streaks + 0.09 * ripple + 2.6 * np.clip(border, 0.0, 0.12)
    glass = glass * (glow * (0.75 + 0.5 * random_of(piece, 8)))[..., None]
    glass = blend(glass, colour("#fff2cc"), 0.45 * smooth(1.0, 2.0, streaks))
    jewels = cells3(points, 700, 9)
    radius = 0.012 + 0.012 * random_of(jewels.index, 10)
    there = random_of(jewels.index, 11) > 0.35
    ring = np.where(there, jewels.away - radius, 1.0)
    gem = chosen(random_of(jewels.index, 12), "#ffd166", "#ef476f", "#06d6a0", "#e0fbfc", "#f78c6b")
    gem = gem * (1.15 - 0.6 * np.clip(jewels.away / radius, 0.0, 1.0) ** 2)[..., None]
    glass = np.where((ring < 0.0)[..., None], gem, glass)
    border = np.minimum(border, np.abs(ring))
    width = np.where(split, 0.0042, 0.0062)
    lead = smooth(0.001, -0.001, border - width)
    metal = colour("#2a2623") * (1.0 + 0.25 * ripple)[..., None]
    profile = np.sqrt(np.clip(1.0 - (border / 0.008) ** 2, 0.0, 1.0))
    return lit_sphere(blend(glass, metal, lead), 0.008 * profile + 0.0015 * ripple)


def coral(height: int) -> Picture:
    """Brain coral: winding ridges in a few scales and colours, with polyps."""
    points = directions(height)
    bent = points + 0.05 * np.stack(
        [fbm3(points, 3.0, each, octaves=3) for each in (1, 11, 21)], -1
    )
    region = fbm3(points, 1.7, 31, octaves=4)
    share = smooth(-0.15, 0.15, region)
    wide, fine = waves3(bent, 46.0, 41), waves3(bent, 82.0, 43)
    winding = np.abs(wide + share * (fine - wide))
    ridge = smooth(1.35, 0.15, winding)
    grain = fbm3(points, 50.0, 61, octaves=4, gain=0.8)
    tone = ridge + 0.10 * grain
    reds = graded(
        tone,
        (0.0, "#2a0a2e"),
        (0.3, "#8c1f54"),
        (0.6, "#e8505b"),
        (0.85, "#f9a36b"),
        (1.05, "#fff0cf"),
    )
    blues = graded(
        tone,
        (0.0, "#04182e"),
        (0.3, "#0d5c75"),
        (0.6, "#2fae9e"),
        (0.85, "#a9dd8a"),
        (1.05, "#fbfbd8"),
    )
    golds = graded(
        tone,
        (0.0, "#1d1330"),
        (0.3, "#5b3a8c"),
        (0.6, "#b87fd0"),
        (0.85, "#f5c86a"),
        (1.05, "#fffbe0"),
    )
    other = fbm3(points, 1.5, 71, octaves=4)
    reef = blend(blend(reds, blues, share), golds, smooth(0.35, 0.6, other))
    polyps = cells3(points, 9000, 5)
    dot = polyps.away / (0.006 + 0.004 * random_of(polyps.index, 6))
    here = (ridge < 0.35) & (random_of(polyps.index, 7) > 0.3)
    reef = blend(reef, colour("#ffe9a8"), 0.9 * here * smooth(1.0, 0.75, dot))
    reef = blend(reef, colour("#1b0f2b"), 0.8 * here * smooth(0.5, 0.35, dot))
    groove = smooth(0.85, 0.99, ridge) * smooth(0.10, 0.02, np.abs(winding - 0.08))
    reef = reef * (1.0 - 0.35 * groove)[..., None]
    return lit_sphere(reef, 0.022 * ridge + 0.0012 * grain + 0.01 * region)


_SANDSTONE = (
    (-2.6, "#4a1620"),
    (-1.2, "#93331f"),
    (-0.2, "#cb6a35"),
    (0.7, "#eba663"),
    (1.6, "#f7d9a8"),
    (2.6, "#fff3df"),
)


def canyon(height: int) -> Picture:
    """A slot canyon: strata of sandstone lit from above, sand on its floor."""
    points = directions(height)
    _, elevation = angles(height)
    fold = fbm3(points, 1.3, 1, octaves=4, gain=0.4)
    carved = np.abs(
        fbm3(points * np.array([1.0, 1.0, 0.45], np.float32), 2.4, 11, octaves=3, gain=0.4)
    )
    level = points[..., 2] + 0.06 * fold - 0.05 * carved
    level = level + 0.012 * fbm3(points, 9.0, 15, octaves=4)
    still = np.zeros_like(level)
    broad = noise3(np.stack([still, still, level], -1), 7.0, 21)
    strata = noise3(np.stack([still + 0.4, still, level], -1), 24.0, 22)
    fine = noise3(np.stack([0.2 * points[..., 0], 0.2 * points[..., 1], level], -1), 75.0, 23)
    crossed = noise3(
        np.stack([0.5 * points[..., 0], 0.2 * points[..., 1], level + 0.3 * points[..., 1]], -1),
        48.0,
        24,
    )
    grain = fbm3(points, 70.0, 31, octaves=3, gain=0.8)
    tone = broad + 0.65 * strata + 0.4 * fine + 0.25 * crossed + 0.12 * grain
    rock = graded(tone, *_SANDSTONE)
    varnish = smooth(
        0.7,
        1.6,
        fbm3(points * np.array([1.0, 1.0, 0.12], np.float32), 16.0, 41, octaves=4, gain=0.65),
    )
    rock = blend(rock, colour("#2b1420"), 0.7 * varnish)
    rock = lit_sphere(
        rock, 0.006 * broad + 0.004 * strata + 0.002 * fine - 0.12 * carved + 0.001 * grain
    )
    rock = rock * (0.62 + 0.5 * smooth(-0.9, 0.9, elevation + 0.2 * fold))[..., None]
    sand = graded(
        np.sin(60.0 * points[..., 0] + 9.0 * fbm3(points, 5.0, 51, octaves=4)) + grain,
        (-2.0, "#8a4a2c"),
        (0.0, "#c98a5a"),
        (2.0, "#f0c79a"),
    )
    rock = blend(rock, sand, smooth(-0.95, -1.05, elevation + 0.12 * fold))
    sky = fbm3(points, 3.0, 61, octaves=6)
    sky = graded(sky, (-1.5, "#1d5fa8"), (0.5, "#4a93d6"), (1.4, "#dfeefa"))
    return blend(rock, sky, smooth(0.98, 1.0, elevation + 0.16 * fold + 0.3 * carved))
