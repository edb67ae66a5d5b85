"""Surfaces made of pieces: leaded glass, mosaic, Truchet tiles, Penrose's rhombs."""

import numpy as np
from jaxtyping import Int

from experiments.dataset.textures.cells import voronoi
from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    coordinates,
    fbm,
    lookup,
    noise,
    random_of,
    smooth,
)
from experiments.dataset.textures.shading import chosen, colour, graded, hollows, lit


def stained_glass(n: int) -> Picture:
    """A rose window: rings of petals, surrounded by shards, of streaky glass in lead."""
    x, y = coordinates(n)
    a, b = x - 0.5, y - 0.5
    border, piece = _rose(x, y)
    glasses = (
        "#0b3fa8",
        "#b3122a",
        "#f2b705",
        "#0f7a4d",
        "#5b1a8a",
        "#1aa7c4",
        "#e4572e",
        "#e8dfb0",
        "#102a6b",
        "#8c1c5a",
    )
    glass = chosen(random_of(piece, 4), *glasses)
    streak = fbm(n, (5, 26), 8, octaves=6, gain=0.62)
    swirl = fbm(n, 30, 18, octaves=4, gain=0.7)
    own = 6.283 * random_of(piece, 5)
    flow = lookup(streak, a * np.cos(own) + b * np.sin(own), b * np.cos(own) - a * np.sin(own))
    glow = 0.92 + 0.23 * flow + 0.08 * swirl + 0.30 * smooth(0.0, 0.05, border)
    glow = glow * (0.72 + 0.5 * random_of(piece, 6))
    glass = blend(glass * glow[..., None], colour("#fff3cf"), 0.35 * smooth(0.9, 2.0, flow))
    bubbles = voronoi(x, y, (70, 70), 9)
    dot = np.hypot(bubbles.dx, bubbles.dy) * 70.0 / (0.05 + 0.13 * random_of(bubbles.index, 7))
    glass = glass * (1.0 + 0.35 * (dot < 1.0) * (random_of(bubbles.index, 8) > 0.6))[..., None]
    lead = smooth(0.0008, -0.0008, border - 0.0039)
    height = 0.006 * np.sqrt(np.clip(1.0 - (border / 0.0045) ** 2, 0.0, 1.0))
    height = height + 0.0008 * flow + 0.0003 * swirl
    metal = colour("#2b2d31") * (1.0 + 0.15 * fbm(n, 120, 28, octaves=3))[..., None]
    return lit(blend(glass, metal, lead), height, gloss=0.16)


def _rose(x: Field, y: Field) -> tuple[Field, Int[np.ndarray, "h w"]]:
    """Returns the distance to the nearest lead, and the kind of piece of each sample."""
    a, b = x - 0.5, y - 0.5
    radius, turn = np.hypot(a, b), np.arctan2(b, a) / (2.0 * np.pi)
    border, piece = np.full(x.shape, np.inf, np.float32), np.zeros(x.shape, np.int32)
    rings = (0.0, 0.045, 0.11, 0.19, 0.275, 0.365, 0.46)
    petals = (1, 8, 16, 16, 32, 32)
    for ring, count in enumerate(petals):
        low, high = rings[ring], rings[ring + 1]
        inside = (radius >= low) & (radius < high)
        sector = turn * count + 0.5 * (ring % 2)
        bow = 0.012 * np.cos(2.0 * np.pi * sector) * (ring > 0)
        side = np.abs(sector - np.round(sector)) * 2.0 * np.pi * radius / count
        side = np.where(count > 1, side, 1.0)
        rim = np.minimum(high - radius, radius - low if ring else 1.0)
        arch = np.abs(radius - (low + 0.68 * (high - low)) - bow) if ring > 1 else rim
        here = np.minimum(np.minimum(side, rim), arch)
        index = ring * 400 + np.floor(sector).astype(np.int32) % count * 4
        # Every other petal has the same glass; the arch has a different one.
        index = (
            ring * 40
            + (index // 4 % 2) * 8
            + ((radius - (low + 0.68 * (high - low)) > bow) & (ring > 1)) * 3
        )
        border, piece = np.where(inside, here, border), np.where(inside, index, piece)
    shards = voronoi(x, y, (13, 13), 3, jitter=0.95)
    outer = radius >= rings[-1]
    border = np.where(outer, np.minimum(shards.border, radius - rings[-1]), border)
    piece = np.where(outer, 1000 + shards.index, piece)
    return border, piece


def mosaic(n: int) -> Picture:
    """A Roman pavement: a guilloche around waves and a sun, of stones set by hand."""
    x, y = coordinates(n)
    stones = 86
    wobble = 0.0028
    cells = voronoi(
        x + wobble * noise(n, 9, 1), y + wobble * noise(n, 9, 2), (stones, stones), 4, jitter=0.34
    )
    picture = _cartoon(x - cells.dx, y - cells.dy)
    stone = picture * (0.72 + 0.5 * random_of(cells.index, 3))[..., None]
    hue = 0.10 * (np.stack([random_of(cells.index, each) for each in (5, 6, 7)], -1) - 0.5)
    grain = fbm(n, 120, 8, octaves=3, gain=0.85)
    rough = fbm(n, 30, 9, octaves=4)
    stone = (stone + hue) * (1.0 + 0.10 * grain + 0.05 * rough)[..., None]
    cover = smooth(0.0006, 0.0015, cells.border + 0.0003 * rough)
    grout = colour("#8d8473") * (0.8 + 0.12 * grain)[..., None]
    tilt = (random_of(cells.index, 11) - 0.5) * cells.dx + (
        random_of(cells.index, 12) - 0.5
    ) * cells.dy
    height = 0.0022 * smooth(0.0003, 0.0026, cells.border) + 0.30 * tilt + 0.0001 * grain
    floor = lit(blend(grout, stone, cover), height, gloss=0.22, shininess=50.0)
    return 1.08 * floor * hollows(height, 0.004, strength=1.2)[..., None]


def _cartoon(x: Field, y: Field) -> Picture:
    """Returns the colours of the mosaic before it is split into stones."""
    a, b = x - 0.5, y - 0.5
    radius, turn = np.hypot(a, b), np.arctan2(b, a)
    sea = np.sin(2.0 * np.pi * (9.0 * y + 0.55 * np.sin(2.0 * np.pi * 4.0 * x + 5.0 * y)))
    picture = graded(sea, (-1.0, "#123c69"), (-0.3, "#1f7a8c"), (0.4, "#8ecae6"), (0.8, "#f1faee"))
    rays = 0.30 + 0.05 * np.cos(16.0 * turn + 2.0 * np.sin(14.0 * radius))
    for share, code in (
        (1.12, "#2b1d16"),
        (1.05, "#e9c46a"),
        (0.85, "#c1440e"),
        (0.72, "#f4a261"),
        (0.60, "#2b1d16"),
        (0.55, "#f3e5c0"),
    ):
        picture = np.where((radius < share * rays)[..., None], colour(code), picture)
    whorl = np.cos(5.0 * turn + 38.0 * radius)
    core = graded(whorl, (-1.0, "#8c1c13"), (0.0, "#d9822b"), (1.0, "#f8e9c0"))
    picture = np.where((radius < 0.5 * rays)[..., None], core, picture)
    out, along = np.maximum(np.abs(a), np.abs(b)), np.where(np.abs(a) > np.abs(b), b, a)
    frame = out > 0.385
    for low, code in ((0.385, "#2b1d16"), (0.397, "#f3e5c0"), (0.488, "#2b1d16")):
        picture = np.where((out > low)[..., None], colour(code), picture)
    # Three strands, each a third of a turn apart.
    for strand, code in enumerate(("#b23a2e", "#2a6f6b", "#d9a441")):
        middle = 0.441 + 0.026 * np.sin(2.0 * np.pi * (along * 7.0 + strand / 3.0))
        away = np.abs(out - middle)
        for width, tone in ((0.017, "#2b1d16"), (0.0115, code)):
            picture = np.where((frame & (away < width))[..., None], colour(tone), picture)
    return picture


def truchet(n: int) -> Picture:
    """Majolica of Truchet tiles of two sizes: winding bands, with blossoms between them."""
    x, y = coordinates(n)
    coarse = 9
    i, j = np.floor(x * coarse).astype(np.int32), np.floor(y * coarse).astype(np.int32)
    divided = random_of(i * 53 + j * 131, 1) < 0.45
    count = np.where(divided, 3 * coarse, coarse)
    i, j = np.floor(x * count).astype(np.int32), np.floor(y * count).astype(np.int32)
    tile = i * 71 + j * 193 + 7919 * divided
    u, v = x * count - i - 0.5, y * count - j - 0.5
    flip = random_of(tile, 2) < 0.5
    u = np.where(flip, -u, u)
    one, other = np.hypot(u - 0.5, v - 0.5), np.hypot(u + 0.5, v + 0.5)
    arc = np.minimum(one, other)
    # Bands a third of an edge wide: three small edges meet one large edge.
    band = np.abs(arc - 0.5) - 1.0 / 6.0
    inner = one < other
    ring = np.arctan2(np.where(inner, v - 0.5, v + 0.5), np.where(inner, u - 0.5, u + 0.5))
    paper = chosen(random_of(tile, 3), "#f4ead2", "#efe0bf", "#f8f1e0", "#e9e4cf")
    ground = np.where(divided[..., None], colour("#0f3d5e"), paper)
    ink = np.where(divided[..., None], colour("#f0c75e"), colour("#155e8a"))
    blossom = np.cos(8.0 * ring) * 0.5 + np.cos(40.0 * arc)
    ground = blend(
        ground,
        chosen(random_of(tile, 4), "#c8502f", "#d98b2b", "#2f7f6e", "#7a2f58"),
        smooth(0.35, 0.5, blossom) * (arc < 0.30),
    )
    picture = blend(ground, ink, smooth(0.01, -0.01, band))
    dots = np.cos(ring * 16.0) - 30.0 * np.abs(band + 0.166)
    trim = np.where(divided[..., None], colour("#a8321f"), colour("#f6d57a"))
    picture = blend(picture, trim, smooth(-0.1, 0.1, dots - 0.2) * (band < -0.02))
    picture = blend(picture, colour("#0b1f33"), smooth(0.022, 0.012, np.abs(band)))
    picture = blend(picture, trim, smooth(0.012, 0.006, np.abs(np.abs(band + 0.166) - 0.115)))
    grain, cloud = fbm(n, 50, 5, octaves=5, gain=0.7), fbm(n, 8, 6, octaves=5)
    picture = picture * (0.84 + 0.22 * random_of(tile, 8) + 0.035 * grain + 0.05 * cloud)[..., None]
    cracks = voronoi(x + 0.004 * cloud, y + 0.002 * grain, (60, 60), 7)
    picture = picture * (1.0 - 0.28 * smooth(0.0007, 0.0002, cracks.border))[..., None]
    rim = (0.5 - np.maximum(np.abs(u), np.abs(v))) / count
    joint = smooth(0.0022, 0.0010, rim)
    picture = blend(picture, colour("#6e655a") * (1.0 + 0.15 * grain)[..., None], joint)
    height = 0.003 * smooth(0.0, 0.006, rim) + 0.0007 * smooth(0.02, -0.06, band) / count * 12.0
    height += 0.04 * ((random_of(tile, 9) - 0.5) * u + (random_of(tile, 10) - 0.5) * v) / count
    return lit(picture, height + 0.0001 * grain, gloss=0.28, shininess=60.0)
