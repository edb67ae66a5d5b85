"""Shelves of books, and posters on a hoarding: what carries writing.

The writing is none: glyphs are drawn from a few strokes each.
"""

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from experiments.dataset.textures.fields import Field, Picture, blend, fbm, noise, smooth
from experiments.dataset.textures.shading import colour, colours, hollows, lit
from experiments.dataset.textures.timber import grain_of

Box = tuple[float, float, float, float]
"""Left, top, right, bottom, in samples."""

# The ends of a glyph's strokes, on a grid of 3 x 5 nodes.
_STROKES = (
    ((0, 0), (2, 0)), ((0, 2), (2, 2)), ((0, 4), (2, 4)), ((0, 0), (0, 2)), ((0, 2), (0, 4)),
    ((2, 0), (2, 2)), ((2, 2), (2, 4)), ((1, 0), (1, 4)), ((0, 0), (2, 4)), ((2, 0), (0, 4)),
    ((0, 2), (2, 0)), ((0, 2), (2, 4)),
)


def write(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator, ink: tuple, *,
          weight: float = 0.2) -> None:
    """Fills a box with one line of glyphs, as high as the box.

    Args:
      draw: of the image.
      box: of the line.
      rng: decides which glyphs.
      ink: their colour.
      weight: thickness of strokes, in heights of the line.
    """
    left, top, right, bottom = box
    high = bottom - top
    at, width = left, max(int(round(weight * high)), 1)
    while at + 0.62 * high <= right:
        if rng.random() < 0.14 and at > left:
            at += 0.45 * high
            continue
        strokes = rng.choice(len(_STROKES), int(rng.integers(3, 5)), replace=False)
        for stroke in strokes:
            ends = [(at + 0.26 * high * a, top + 0.25 * high * b) for a, b in _STROKES[stroke]]
            draw.line(ends, fill=ink, width=width)
        at += 0.52 * high + 1.6 * width


_SPINES = ("#7b1e22", "#1f3a5f", "#2e5339", "#d8c7a0", "#4a2c4d", "#9c5a24", "#20242b", "#b9892f",
           "#5d6f73", "#8a2f3c", "#e9e0cc", "#17494d", "#6b4a2f", "#c2512f", "#39507a", "#a3a38a")


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
    wood = blend(colour("#8a5a33"), colour("#3e2212"),
                 grain_of(n, x, y, np.floor(y * shelves).astype(np.int32)))
    rows = np.where(shelf[..., None], wood, rows)
    height = np.where(shelf, 0.006 * np.sqrt(np.clip(1.0 - (within / board * 2.0 - 1.0) ** 2, 0, 1)),
                      height + 0.0003 * wear).astype(np.float32)
    return lit(rows, height, gloss=0.10) * hollows(height, 0.006, strength=0.35)[..., None]


def _book(draw: ImageDraw.ImageDraw, height: Field, box: Box, rng: np.random.Generator) -> None:
    """Draws a spine: cloth, head and tail bands, ribs, a label, a title that reads upwards."""
    left, top, right, bottom = box
    n, wide, high = height.shape[0], right - left, bottom - top
    cloth = colour(_SPINES[rng.integers(len(_SPINES))]) * rng.uniform(0.75, 1.2)
    gilt = colour("#d9b75a") if cloth.mean() < 0.5 else colour("#3a2a1c")
    other = colour(_SPINES[rng.integers(len(_SPINES))])
    draw.rectangle(box, fill=_ink(cloth))
    style = rng.integers(4)
    for share in rng.choice([0.06, 0.09, 0.16, 0.84, 0.91, 0.95], 3, replace=False):
        at = top + share * high
        draw.rectangle((left, at, right, at + max(0.008 * high, 1.0)), fill=_ink(gilt))
    label = (left, top + 0.2 * high, right, top + rng.uniform(0.36, 0.5) * high)
    if style == 0:
        draw.rectangle(label, fill=_ink(other))
    if wide > 0.018 * n:
        lines = int(rng.integers(2, 4))
        for line in range(lines):
            start = label[1] + (line + 0.25) * (label[3] - label[1]) / lines
            stop = start + 0.55 * (label[3] - label[1]) / lines
            stop = min(stop, start + 0.36 * wide)
            write(draw, (left + 0.12 * wide, start, right - 0.06 * wide, stop), rng, _ink(gilt))
    else:
        step = max(0.5 * wide, 2.0)
        for at in np.arange(top + 0.2 * high, top + rng.uniform(0.5, 0.8) * high, 1.25 * step):
            glyph = (left + 0.2 * wide, at, left + 0.2 * wide + 0.9 * step, at + step)
            write(draw, glyph, rng, _ink(gilt), weight=0.22)
    if rng.random() < 0.5:
        middle, radius = (0.5 * (left + right), top + 0.72 * high), 0.25 * wide
        draw.ellipse((middle[0] - radius, middle[1] - radius, middle[0] + radius,
                      middle[1] + radius), outline=_ink(gilt), width=max(int(0.05 * wide), 1))
    columns = slice(max(int(left), 0), max(min(int(right) + 1, n), 0))
    rows = slice(max(int(top), 0), min(int(bottom) + 1, n))
    across = ((np.arange(columns.start, columns.stop) + 0.5 - left) / wide).clip(0, 1)
    spine = 0.35 * wide / n * np.sqrt(1.0 - (2.0 * across - 1.0) ** 2)
    down = ((np.arange(rows.start, rows.stop) + 0.5 - top) / high).clip(0, 1)
    ribs = np.exp(-(((down * 6.0 + 0.5) % 1.0 - 0.5) / 0.07) ** 2) * (0.004 if style < 2 else 0.0)
    height[rows, columns] = spine[None] + ribs[:, None] * np.sqrt(spine[None] * n / wide)


def posters(n: int) -> Picture:
    """A hoarding, posted over for years: posters with figures and lines of type, torn and creased."""
    rng = np.random.default_rng(23)
    image = Image.new("RGB", (n, n), (120, 110, 95))
    edges = Image.new("I", (n, n), 0)
    draw, marks = ImageDraw.Draw(image), ImageDraw.Draw(edges)
    for number in range(1, 95):
        wide = rng.uniform(0.12, 0.26) * n
        high = wide * rng.uniform(1.2, 1.5)
        left, top = rng.uniform(-0.1, 1.0, 2) * n - [0.05 * n, 0.1 * n]
        box = (float(left), float(top), float(left + wide), float(top + high))
        _poster(draw, box, rng)
        marks.rectangle(box, fill=number)
    paper = np.asarray(image, np.float32) / 255.0
    sheet = np.asarray(edges)
    rough, creases = fbm(n, 8, 3, octaves=8, gain=0.68), fbm(n, 5, 23, octaves=4, gain=0.5)
    older = np.roll(paper, (n // 5, n // 3), (0, 1)) * 0.9
    torn = rough + 0.5 * noise(n, 5, 33)
    paper = blend(paper, colour("#efe9da"), smooth(1.05, 1.1, torn))
    paper = np.where((torn > 1.28)[..., None], older, paper)
    fade = 1.0 + 0.05 * rough + 0.06 * fbm(n, 120, 43, octaves=3, gain=0.9)
    drips = smooth(1.2, 2.4, fbm(n, (60, 2), 53, octaves=5, gain=0.7))
    paper = blend(paper * fade[..., None], colour("#4c4335"), 0.5 * drips)
    fold = 0.0022 * np.abs(creases) + 0.0003 * rough
    order = np.random.default_rng(5).random(100).astype(np.float32)[sheet]
    height = 0.0022 * order + fold - 0.002 * smooth(1.05, 1.1, torn) - 0.002 * (torn > 1.28)
    return lit(paper, height.astype(np.float32), gloss=0.05)


def _poster(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator) -> None:
    """Draws one poster: ground, figure, headline, lines of small type."""
    left, top, right, bottom = box
    wide, high = right - left, bottom - top
    inks = colours("#e63946", "#f1faee", "#1d3557", "#ffb703", "#219ebc", "#0b090a", "#fb8500",
                   "#2a9d8f", "#f2cc8f", "#6d2e8c", "#ff5d8f", "#e9edc9")[rng.permutation(12)[:4]]
    ground, first, second, third = (_ink(each) for each in inks)
    draw.rectangle(box, fill=ground)
    middle = (left + rng.uniform(0.3, 0.7) * wide, top + rng.uniform(0.4, 0.6) * high)
    figure = rng.integers(5)
    if figure == 0:
        for step, radius in enumerate(np.linspace(0.48, 0.04, 9) * wide):
            draw.ellipse((middle[0] - radius, middle[1] - radius, middle[0] + radius,
                          middle[1] + radius), fill=(first, second, third)[step % 3])
    elif figure == 1:
        for each in range(12):
            start = each * 30 + rng.uniform(0, 3)
            reach = 0.62 * wide
            draw.pieslice((middle[0] - reach, middle[1] - reach, middle[0] + reach,
                           middle[1] + reach), start, start + 15, fill=(first, third)[each % 2])
    elif figure == 2:
        for each in range(9):
            shift = (each / 9.0) * high
            draw.polygon([(left, top + shift), (right, top + 0.75 * shift),
                          (right, top + 0.75 * shift + 0.045 * high),
                          (left, top + shift + 0.07 * high)], fill=(first, second, third)[each % 3])
    elif figure == 3:
        for row in range(9):
            for column in range(7):
                x, y = left + (column + 0.5) * wide / 7, top + (row + 2.2) * high / 12
                radius = wide / 15 * (0.35 + 0.65 * abs(np.sin(0.7 * row + 0.5 * column)))
                draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=first)
    else:
        for tone in (first, second, third, first):
            points = rng.uniform(0.08, 0.92, (int(rng.integers(3, 6)), 2)) * [wide, 0.8 * high]
            draw.polygon([tuple(point) for point in points + [left, top]], fill=tone)
    head = 0.13 * high
    start = top + float(rng.choice([0.04, 0.66])) * high
    draw.rectangle((left, start - 0.2 * head, right, start + 1.2 * head), fill=second)
    write(draw, (left + 0.06 * wide, start, right - 0.03 * wide, start + head), rng, third,
          weight=0.19)
    for line in range(4):
        y = top + (0.845 + 0.035 * line) * high
        write(draw, (left + 0.06 * wide, y, right - rng.uniform(0.05, 0.3) * wide,
                     y + 0.022 * high), rng, first, weight=0.14)
    draw.rectangle(box, outline=_ink(colour("#efe9da")), width=max(int(0.02 * wide), 1))


def _ink(tone: Float[np.ndarray, "3"]) -> tuple[int, int, int]:
    return tuple(int(round(255 * min(max(float(each), 0.0), 1.0))) for each in tone)
