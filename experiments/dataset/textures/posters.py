"""Posters on a hoarding."""

import math

import numpy as np
from PIL import Image, ImageDraw

from experiments.dataset.textures.fields import Picture, blend, fbm, noise, smooth
from experiments.dataset.textures.shading import colour, colours, lit
from experiments.dataset.textures.writing import Box, ink, write

Inks = tuple[tuple[int, int, int], ...]


def posters(n: int) -> Picture:
    """A hoarding: years of posters with figures and lines of type, torn and creased."""
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
    inks = colours(
        "#e63946",
        "#f1faee",
        "#1d3557",
        "#ffb703",
        "#219ebc",
        "#0b090a",
        "#fb8500",
        "#2a9d8f",
        "#f2cc8f",
        "#6d2e8c",
        "#ff5d8f",
        "#e9edc9",
    )[rng.permutation(12)[:4]]
    ground, first, second, third = (ink(each) for each in inks)
    draw.rectangle(box, fill=ground)
    _FIGURES[rng.integers(len(_FIGURES))](draw, box, rng, (first, second, third))
    head = 0.13 * high
    start = top + float(rng.choice([0.04, 0.66])) * high
    draw.rectangle((left, start - 0.2 * head, right, start + 1.2 * head), fill=second)
    write(
        draw,
        (left + 0.06 * wide, start, right - 0.03 * wide, start + head),
        rng,
        third,
        weight=0.19,
    )
    for line in range(4):
        y = top + (0.845 + 0.035 * line) * high
        write(
            draw,
            (left + 0.06 * wide, y, right - rng.uniform(0.05, 0.3) * wide, y + 0.022 * high),
            rng,
            first,
            weight=0.14,
        )
    draw.rectangle(box, outline=ink(colour("#efe9da")), width=max(int(0.02 * wide), 1))


def _rings(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator, inks: Inks) -> None:
    left, top, right, bottom = box
    wide, high = right - left, bottom - top
    x, y = left + rng.uniform(0.3, 0.7) * wide, top + rng.uniform(0.4, 0.6) * high
    for step, radius in enumerate(np.linspace(0.48, 0.04, 9) * wide):
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=inks[step % 3])


def _rays(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator, inks: Inks) -> None:
    left, top, right, bottom = box
    wide, high = right - left, bottom - top
    x, y = left + rng.uniform(0.3, 0.7) * wide, top + rng.uniform(0.4, 0.6) * high
    reach = 0.62 * wide
    for each in range(12):
        start = each * 30 + rng.uniform(0, 3)
        around = (x - reach, y - reach, x + reach, y + reach)
        draw.pieslice(around, start, start + 15, fill=inks[2 * (each % 2)])


def _stripes(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator, inks: Inks) -> None:
    left, top, right, bottom = box
    high, tilt = bottom - top, rng.uniform(0.6, 0.9)
    for each in range(9):
        near, far = top + each / 9.0 * high, top + tilt * each / 9.0 * high
        corners = [(left, near), (right, far), (right, far + 0.045 * high)]
        draw.polygon([*corners, (left, near + 0.07 * high)], fill=inks[each % 3])


def _dots(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator, inks: Inks) -> None:
    left, top, right, bottom = box
    wide, high, phase = right - left, bottom - top, rng.uniform(0.0, 3.0)
    for row in range(9):
        for column in range(7):
            x, y = left + (column + 0.5) * wide / 7, top + (row + 2.2) * high / 12
            radius = wide / 15 * (0.35 + 0.65 * abs(math.sin(0.7 * row + 0.5 * column + phase)))
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=inks[0])


def _shards(draw: ImageDraw.ImageDraw, box: Box, rng: np.random.Generator, inks: Inks) -> None:
    left, top, right, bottom = box
    for tone in (*inks, inks[0]):
        corners = rng.uniform(0.08, 0.92, (int(rng.integers(3, 6)), 2))
        points = corners * [right - left, 0.8 * (bottom - top)] + np.array([left, top])
        draw.polygon([tuple(point) for point in points], fill=tone)


_FIGURES = (_rings, _rays, _stripes, _dots, _shards)
