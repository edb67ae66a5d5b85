"""Shelves of books."""

import numpy as np
from PIL import Image, ImageDraw

from experiments.dataset.textures.fields import Field, Picture, blend, fbm, smooth
from experiments.dataset.textures.shading import colour, hollows, lit
from experiments.dataset.textures.timber import grain_of
from experiments.dataset.textures.writing import Box, ink, write

_SPINES = (
    "#7b1e22",
    "#1f3a5f",
    "#2e5339",
    "#d8c7a0",
    "#4a2c4d",
    "#9c5a24",
    "#20242b",
    "#b9892f",
    "#5d6f73",
    "#8a2f3c",
    "#e9e0cc",
    "#17494d",
    "#6b4a2f",
    "#c2512f",
    "#39507a",
    "#a3a38a",
)


def bookshelf(n: int) -> Picture:
    """Seven shelves of old and new books, some leaning, some lying, with ribs and gilt titles."""
    rng = np.random.default_rng(19)
    image = Image.new("RGB", (n, n), (14, 10, 8))
    height = np.full((n, n), -0.02, np.float32)
    draw = ImageDraw.Draw(image)
    shelves, board = 7, 0.011
    for shelf in range(shelves):
        top, floor = shelf / shelves + board, (shelf + 1) / shelves
        at = rng.uniform(-0.02, 0.0)
        while at < 1.0:
            wide = float(rng.choice([0.010, 0.015, 0.020, 0.027, 0.036])) * rng.uniform(0.8, 1.2)
            high = (floor - top) * rng.uniform(0.66, 0.97)
            if rng.random() < 0.03:
                at += rng.uniform(0.008, 0.03)
            _book(draw, height, (at * n, (floor - high) * n, (at + wide) * n, floor * n), rng)
            at += wide + 0.0006
    rows = np.asarray(image, np.float32) / 255.0
    y = ((np.arange(n) + 0.5) / n)[:, None] * np.ones((1, n), np.float32)
    x = y.T
    wear, fine = fbm(n, 9, 3, octaves=7, gain=0.7), fbm(n, (160, 40), 13, octaves=2, gain=0.9)
    rows = rows * (1.0 + 0.07 * wear + 0.07 * fine)[..., None]
    rows = blend(rows, 1.3 * rows + 0.10, smooth(1.3, 2.2, wear))
    within = (y * shelves) % 1.0 / shelves
    depth = smooth(0.0, 0.045, within - board)
    rows = rows * (0.35 + 0.65 * depth)[..., None]
    shelf = within < board
    wood = blend(
        colour("#8a5a33"),
        colour("#3e2212"),
        grain_of(n, x, y, np.floor(y * shelves).astype(np.int32)),
    )
    rows = np.where(shelf[..., None], wood, rows)
    height = np.where(
        shelf,
        0.006 * np.sqrt(np.clip(1.0 - (within / board * 2.0 - 1.0) ** 2, 0, 1)),
        height + 0.0003 * wear,
    ).astype(np.float32)
    return lit(rows, height, gloss=0.10) * hollows(height, 0.006, strength=0.35)[..., None]


def _book(draw: ImageDraw.ImageDraw, height: Field, box: Box, rng: np.random.Generator) -> None:
    """Draws a spine: cloth, head and tail bands, ribs, a label, a title that reads upwards."""
    left, top, right, bottom = box
    n, wide, high = height.shape[0], right - left, bottom - top
    cloth = colour(_SPINES[rng.integers(len(_SPINES))]) * rng.uniform(0.75, 1.2)
    gilt = colour("#d9b75a") if cloth.mean() < 0.5 else colour("#3a2a1c")
    other = colour(_SPINES[rng.integers(len(_SPINES))])
    draw.rectangle(box, fill=ink(cloth))
    style = rng.integers(4)
    for share in rng.choice([0.06, 0.09, 0.16, 0.84, 0.91, 0.95], 3, replace=False):
        at = top + share * high
        draw.rectangle((left, at, right, at + max(0.008 * high, 1.0)), fill=ink(gilt))
    label = (left, top + 0.2 * high, right, top + rng.uniform(0.36, 0.5) * high)
    if style == 0:
        draw.rectangle(label, fill=ink(other))
    if wide > 0.018 * n:
        lines = int(rng.integers(2, 4))
        for line in range(lines):
            start = label[1] + (line + 0.25) * (label[3] - label[1]) / lines
            stop = start + 0.55 * (label[3] - label[1]) / lines
            stop = min(stop, start + 0.36 * wide)
            write(draw, (left + 0.12 * wide, start, right - 0.06 * wide, stop), rng, ink(gilt))
    else:
        step = max(0.5 * wide, 2.0)
        for at in np.arange(top + 0.2 * high, top + rng.uniform(0.5, 0.8) * high, 1.25 * step):
            glyph = (left + 0.2 * wide, at, left + 0.2 * wide + 0.9 * step, at + step)
            write(draw, glyph, rng, ink(gilt), weight=0.22)
    if rng.random() < 0.5:
        middle, radius = (0.5 * (left + right), top + 0.72 * high), 0.25 * wide
        draw.ellipse(
            (middle[0] - radius, middle[1] - radius, middle[0] + radius, middle[1] + radius),
            outline=ink(gilt),
            width=max(int(0.05 * wide), 1),
        )
    columns = slice(max(int(left), 0), max(min(int(right) + 1, n), 0))
    rows = slice(max(int(top), 0), min(int(bottom) + 1, n))
    across = ((np.arange(columns.start, columns.stop) + 0.5 - left) / wide).clip(0, 1)
    spine = 0.35 * wide / n * np.sqrt(1.0 - (2.0 * across - 1.0) ** 2)
    down = ((np.arange(rows.start, rows.stop) + 0.5 - top) / high).clip(0, 1)
    ribs = np.exp(-((((down * 6.0 + 0.5) % 1.0 - 0.5) / 0.07) ** 2)) * (0.004 if style < 2 else 0.0)
    height[rows, columns] = spine[None] + ribs[:, None] * np.sqrt(spine[None] * n / wide)
