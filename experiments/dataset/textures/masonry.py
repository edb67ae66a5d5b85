"""Walls, roads and roofs: brick, cobbles, pebbles, shingles, terrazzo."""

import math

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

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
from experiments.dataset.textures.stamps import Place, Samples, stamp


def brick(n: int) -> Picture:
    """Old bricks of many firings in sandy mortar, with soot, chalk and moss."""
    x, y = coordinates(n)
    rows, across = 18, 6
    row = np.floor(y * rows).astype(np.int32)
    shift = 0.5 * (row % 2) + 0.16 * (random_of(row, 5) - 0.5)
    along = x * across + shift
    index = row * 97 + np.floor(along).astype(np.int32) % across
    u, v = along - np.floor(along) - 0.5, y * rows - row - 0.5
    rough = fbm(n, 40, 21, octaves=4, gain=0.6)
    corner = 0.09
    inside_x = np.abs(u) * rows / across - (0.5 * rows / across - 0.075 - corner)
    inside_y = np.abs(v) - (0.5 - 0.075 - corner)
    gap = np.hypot(np.maximum(inside_x, 0.0), np.maximum(inside_y, 0.0)) - corner + 0.035 * rough
    cover = smooth(0.04, -0.05, gap)
    grain, stains = fbm(n, 96, 31, octaves=4, gain=0.75), fbm(n, 5, 41, octaves=6, gain=0.6)
    kinds = ("#8e3b2a", "#a84e34", "#6f2c25", "#b8613f", "#54292a", "#c98b5c", "#7d4436", "#3f2a2e")
    clay = chosen(random_of(index, 1), *kinds) * (0.75 + 0.5 * random_of(index, 2))[..., None]
    clay = clay * (1.0 + 0.11 * grain + 0.10 * stains)[..., None]
    clay = blend(clay, colour("#e2d6c4"), 0.55 * smooth(0.9, 2.2, stains + 0.7 * grain))
    mortar = colour("#b9ac97") * (0.8 + 0.14 * fbm(n, 200, 51, octaves=2, gain=0.9))[..., None]
    wall = blend(mortar, clay, cover)
    moss = smooth(0.6, 1.7, -stains + 0.5 * rough) * (1.0 - 0.6 * cover)
    wall = blend(wall, colour("#4a5a24") * (1.0 + 0.25 * grain)[..., None], moss)
    pits = smooth(1.5, 2.3, grain)
    tilt = u * (random_of(index, 3) - 0.5) + v * (random_of(index, 4) - 0.5)
    height = 0.006 * cover * (1.0 + 0.5 * tilt) + 0.0005 * rough + 0.0003 * grain - 0.001 * pits
    return lit(wall, height) * hollows(height, 0.008, strength=1.6)[..., None]


def cobbles(n: int) -> Picture:
    """A road of wet rounded stones of granite and basalt."""
    x, y = coordinates(n)
    bend = 0.012
    bent_x, bent_y = x + bend * noise(n, 6, 3), y + bend * noise(n, 6, 4)
    cells = voronoi(bent_x, bent_y, (15, 15), 11, jitter=0.62)
    rough, grain = fbm(n, 24, 61, octaves=5, gain=0.6), fbm(n, 110, 71, octaves=3, gain=0.8)
    border = cells.border * 15.0 - 0.055 - 0.02 * rough
    dome = 1.0 - np.exp(-np.maximum(border, 0.0) / 0.11)
    kinds = ("#5f666e", "#8a8178", "#3d434b", "#a09a8d", "#75584a", "#4f5d66", "#b3a48c", "#6d7480")
    stone = chosen(random_of(cells.index, 1), *kinds)
    stone = stone * (0.8 + 0.4 * random_of(cells.index, 2) + 0.13 * rough)[..., None]
    speckle = smooth(0.7, 1.5, grain) - 0.8 * smooth(0.6, 1.5, -grain)
    stone = stone + (0.24 * speckle * smooth(0.2, 0.6, random_of(cells.index, 3)))[..., None]
    vein = np.abs(noise(n, 7, 5) + 0.2 * rough) < 0.05
    stone = stone + (0.22 * vein * (random_of(cells.index, 6) > 0.6))[..., None]
    damp = fbm(n, 4, 91, octaves=5)
    sand = graded(damp + 0.4 * grain, (-1.5, "#2b2620"), (0.2, "#5d5140"), (1.0, "#4d5b27"))
    road = blend(sand, stone, smooth(0.0, 0.05, border))
    height = 0.013 * dome + 0.0009 * rough + 0.0003 * grain
    road = lit(road, height, gloss=0.55, shininess=26.0)
    return road * hollows(height, 0.012, strength=1.5)[..., None]


def pebbles(n: int) -> Picture:
    """A shore of pebbles of all sizes, striped and speckled, the small ones at the bottom."""
    rng = np.random.default_rng(77)
    grain, bands = fbm(n, 128, 1, octaves=3, gain=0.8), fbm(n, 16, 9, octaves=5)
    sand = graded(grain + bands, (-2.5, "#3c3027"), (0.0, "#8f7a5f"), (2.5, "#d9c8a4"))
    shore = np.ascontiguousarray(sand)
    kinds = (
        "#d8d0c0",
        "#7d3b2b",
        "#40464a",
        "#8f9a94",
        "#b98c5a",
        "#56624f",
        "#a5673f",
        "#23262b",
        "#c9b7a8",
        "#5c4a60",
        "#e8e4da",
        "#6e7f8c",
    )
    sizes = np.concatenate(
        [np.full(900, 0.012), np.full(620, 0.02), np.full(240, 0.034), np.full(55, 0.056)]
    )
    for size in sizes * rng.uniform(0.8, 1.25, sizes.size):
        middle, angle = rng.random(2), rng.uniform(0.0, 2.0 * math.pi)
        _pebble(
            shore,
            Place(*middle.tolist(), float(size), angle),
            rng,
            colour(kinds[rng.integers(len(kinds))]),
            (grain, bands),
        )
    return shore


def _pebble(
    shore: Picture,
    place: Place,
    rng: np.random.Generator,
    base: np.ndarray,
    fields: tuple[Field, Field],
) -> None:
    """Lays one pebble with stripes, speckles or neither; the light is that of `shading.lit`."""
    grain, bands = fields
    squash, power = rng.uniform(0.55, 0.85), rng.uniform(2.0, 2.7)
    stripes, speckles = rng.random() < 0.4, rng.random() < 0.5
    pitch, phase, tilt = rng.uniform(2.0, 7.0), rng.uniform(0.0, 9.0), rng.uniform(-0.6, 0.6)
    other = blend(base, colour("#f2ede2"), 0.7) if base.mean() < 0.6 else 0.55 * base
    shade = rng.uniform(0.8, 1.15)
    at = rng.random(2).tolist()

    def distance(u: Field, v: Field) -> Field:
        rim = (np.abs(u) ** power + np.abs(v / squash) ** power) ** (1.0 / power)
        return (rim - 1.0) * squash

    def paint(u: Samples, v: Samples, outside: Samples) -> Float[np.ndarray, "samples 3"]:
        scale = 1.2 * place.size
        fine = lookup(grain, at[0] + scale * u, at[1] + scale * v)
        broad = lookup(bands, at[1] + scale * u, at[0] + scale * v)
        skin = base * (shade + 0.08 * broad + 0.06 * fine)[..., None]
        if stripes:
            wave = np.sin(pitch * (v + tilt * u + 0.12 * broad) + phase)
            skin = blend(skin, other, 0.75 * smooth(0.45, 0.8, wave))
        if speckles:
            skin = blend(skin, other, 0.6 * smooth(0.8, 1.3, fine))
        inward = np.clip(1.0 + outside / squash, 0.0, 1.0) ** 2
        height = np.sqrt(np.maximum(1.0 - inward, 0.0))
        cos, sin = math.cos(place.angle), math.sin(place.angle)
        world_x, world_y = cos * u - sin * v / squash, sin * u + cos * v / squash
        bright = 0.55 * height + 0.45 - 0.34 * (0.63 * world_x + 0.77 * world_y)
        shine = np.exp(-14.0 * ((world_x + 0.34) ** 2 + (world_y + 0.42) ** 2))
        return skin * bright[..., None] + (0.4 * shine)[..., None]

    stamp(shore, place, distance, paint, shadow=0.65)


def shingles(n: int) -> Picture:
    """Glazed roof tiles like fish scales, in rows, each with its own glaze."""
    x, y = coordinates(n)
    across, rows = 14, 20
    picture = np.zeros((n, n, 3), np.float32)
    height = np.full((n, n), -1.0, np.float32)
    grain, run = fbm(n, 64, 5, octaves=4, gain=0.7), fbm(n, (40, 8), 15, octaves=4)
    kinds = ("#0f5e5c", "#1c8a7d", "#c9a227", "#16405b", "#2f6e3b", "#7b2d26", "#d9c27a", "#0c3340")
    base = np.floor(y * rows).astype(np.int32)
    # A tile covers parts of the two rows below, so upper rows are laid last.
    for above in (0, 1, 2):
        row = base - above
        along = x * across + 0.5 * (row % 2)
        column = np.floor(along).astype(np.int32)
        index = (row % rows) * 61 + column % across
        u, v = 2.0 * (along - column) - 1.0, y * rows - row
        bow = 0.72 * np.sqrt(np.maximum(1.0 - u * u, 0.0))
        rim = np.minimum(1.43 + bow - v + 0.015 * grain, 1.3 * (1.0 - np.abs(u)) + 0.1 * (v < 1.4))
        bend = 0.25 * np.sin(4.0 * np.pi * row / rows)
        wave = 0.5 + 0.5 * np.sin(2.0 * np.pi * (2.0 * (column - 0.5 * (row % 2)) / across + bend))
        share = 0.45 * random_of(index, 1) + 0.55 * wave
        glaze = chosen(np.clip(share, 0.0, 0.999), *kinds)
        glaze = glaze * (0.7 + 0.4 * random_of(index, 2) + 0.12 * run + 0.06 * grain)[..., None]
        glaze = blend(glaze, colour("#e9dcae"), 0.7 * smooth(0.05, 0.02, np.abs(rim - 0.14)))
        veins = np.cos(np.arctan2(u, 2.3 - v) * 22.0)
        glaze = glaze * (1.0 + 0.13 * veins * smooth(0.2, 0.4, rim))[..., None]
        local = 0.010 * np.sqrt(np.clip(rim, 0.0, 0.35)) + 0.008 * (v - 2.0) + 0.004 * bow
        visible = 1.43 + bow - v > 0.0
        picture = np.where(visible[..., None], glaze, picture)
        height = np.where(visible, local + 0.004 * above, height)
    height += 0.0003 * grain
    roof = lit(picture, height, gloss=0.5, shininess=40.0)
    return roof * hollows(height, 0.01, strength=1.4)[..., None]


def terrazzo(n: int) -> Picture:
    """Chips of marble of all sizes and colours, ground flat in a pale cement."""
    rng = np.random.default_rng(8)
    kinds = (
        "#c8553d",
        "#2d3142",
        "#e8b04a",
        "#588b8b",
        "#f28f3b",
        "#8d6a9f",
        "#1f5673",
        "#93b5c6",
        "#6b4226",
        "#f5ead6",
        "#3c6e47",
        "#d98f9b",
        "#111418",
    )
    grain, clouds = fbm(n, 160, 3, octaves=2, gain=0.9), fbm(n, 6, 13, octaves=6, gain=0.6)
    image = Image.new("I", (n, n), 0)
    draw = ImageDraw.Draw(image)
    sizes = np.sort(0.0035 * rng.pareto(1.25, 9000) + 0.003)
    for index, size in enumerate(np.minimum(sizes, 0.055)[::1], start=1):
        corners = rng.integers(4, 8)
        turns = np.sort(rng.random(corners)) * 2.0 * math.pi
        radii = size * rng.uniform(0.65, 1.1, corners)
        middle = rng.random(2)
        points = middle + np.stack([np.cos(turns), 0.8 * np.sin(turns)], -1) * radii[:, None]
        # A rim of cement separates chips.
        rim = middle + (points - middle) * (1.0 + 0.0028 / size)
        draw.polygon([tuple(point) for point in rim * n], fill=0)
        draw.polygon([tuple(point) for point in points * n], fill=int(index))
    chip = np.asarray(image).astype(np.int64)
    stone = chosen(random_of(chip, 1), *kinds) * (0.8 + 0.35 * random_of(chip, 2))[..., None]
    x, y = coordinates(n)
    turn = 6.283 * random_of(chip, 4)
    veins = lookup(clouds, 3.0 * (x * np.cos(turn) + y) + random_of(chip, 5), 3.0 * y + turn)
    stone = stone * (1.0 + 0.16 * veins + 0.05 * grain)[..., None]
    stone = blend(stone, colour("#f6f1e4"), 0.55 * smooth(0.10, 0.02, np.abs(veins)))
    cement = colour("#d6cdbd") * (0.92 + 0.07 * grain + 0.03 * clouds)[..., None]
    return blend(cement, stone, (chip > 0).astype(np.float32))
