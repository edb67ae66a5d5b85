"""A map, a circuit board and an oil painting: images made of many lines."""

import math

import numpy as np
from jaxtyping import Bool
from PIL import Image, ImageDraw

from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    coordinates,
    fbm,
    noise,
    smooth,
)
from experiments.dataset.textures.shading import colour, graded, hollows, lit
from experiments.dataset.textures.writing import Box, write


def contours(n: int) -> Picture:
    """A map of mountains and fjords: tints of height, contour lines, woods, roads, a grid."""
    x, y = coordinates(n)
    ground = fbm(n, 3, 13, octaves=8, gain=0.5)
    ground = ground + 0.35 * np.abs(fbm(n, 5, 23, octaves=6, gain=0.5))
    sea = -0.25
    tint = graded(
        ground,
        (-2.2, "#0d3b66"),
        (-0.9, "#2a75a9"),
        (sea - 0.001, "#9fd3e6"),
        (sea, "#7fae5c"),
        (0.3, "#c9d48a"),
        (0.8, "#efd9a0"),
        (1.3, "#d69a5e"),
        (1.8, "#a05a3c"),
        (2.3, "#f7f3ec"),
    )
    slope_y, slope_x = np.gradient(ground * 1.0, 1.0 / n)
    steep = np.hypot(slope_x, slope_y)
    relief = np.where(ground > sea, ground, sea - 0.15 * (sea - ground))
    sheet = lit(tint, 0.013 * relief.astype(np.float32))
    woods = noise(n, 90, 3) + 1.1 * fbm(n, 7, 43, octaves=4) - 1.4 * np.abs(ground - 0.35)
    sheet = blend(sheet, colour("#2f6b3a"), 0.75 * smooth(0.55, 0.75, woods) * (ground > sea))
    for step, width, tone, strength in (
        (0.08, 0.0007, "#6b3f22", 0.65),
        (0.4, 0.0016, "#4a2614", 0.9),
    ):
        away = np.abs((ground - sea) / step - np.round((ground - sea) / step)) * step
        line = smooth(1.3, 0.5, away / np.maximum(steep, 1.5) / width)
        ink = np.where((ground > sea)[..., None], colour(tone), colour("#0e4f7d"))
        sheet = blend(sheet, ink, strength * line)
    shore = np.abs(ground - sea) / np.maximum(steep, 1.0)
    sheet = blend(sheet, colour("#0b2f4a"), smooth(0.0026, 0.0012, shore))
    sheet = _roads(sheet, ground, ground > sea)
    lines = np.minimum(np.abs(x * 8.0 - np.round(x * 8.0)), np.abs(y * 8.0 - np.round(y * 8.0)))
    sheet = blend(sheet, colour("#17324d"), 0.5 * smooth(0.012, 0.006, lines))
    names = _names(n)
    sheet = blend(sheet, colour("#14100c"), names)
    creases = np.minimum(np.abs(x * 4.0 - np.round(x * 4.0)), np.abs(y * 3.0 - np.round(y * 3.0)))
    paper = 0.97 + 0.035 * fbm(n, 150, 5, octaves=2, gain=0.9) - 0.12 * smooth(0.02, 0.0, creases)
    return sheet * paper[..., None]


def _roads(sheet: Picture, ground: Field, land: Bool[np.ndarray, "n n"]) -> Picture:
    """Returns a map with three kinds of roads, which avoid mountains."""
    n = ground.shape[0]
    for seed, width, tone in (
        (61, 0.0030, "#b3261e"),
        (71, 0.0022, "#f2b632"),
        (81, 0.0018, "#222222"),
    ):
        field = fbm(n, 4, seed, octaves=4, gain=0.4) + 0.25 * ground
        across = np.gradient(field, 1.0 / n)
        road = np.abs(field) / np.maximum(np.hypot(*across), 1.0)
        casing = smooth(1.7, 1.3, road / width) * land
        sheet = blend(sheet, colour("#2b1a12"), casing)
        sheet = blend(sheet, colour(tone), smooth(1.0, 0.7, road / width) * land)
    return sheet


def _names(n: int) -> Field:
    """Returns the amount of ink of names and symbols on the map."""
    rng = np.random.default_rng(7)
    image = Image.new("L", (n, n), 0)
    draw = ImageDraw.Draw(image)
    for _ in range(110):
        x, y = (rng.random(2) * n).tolist()
        high = float(rng.choice([0.008, 0.011, 0.017], p=[0.6, 0.3, 0.1])) * n
        write(draw, (x, y, x + high * rng.uniform(3.0, 8.0), y + high), rng, 255, weight=0.16)
        radius = 0.35 * high
        draw.ellipse((x - 3 * radius, y, x - radius, y + 2 * radius), fill=255)
    return np.asarray(image, np.float32) / 255.0


def circuit(n: int) -> Picture:
    """A printed circuit: buses of copper under green lacquer, chips, pads, gold and lettering."""
    rng = np.random.default_rng(41)
    copper, parts = Image.new("L", (n, n), 0), Image.new("RGB", (n, n), (0, 0, 0))
    traces, draw = ImageDraw.Draw(copper), ImageDraw.Draw(parts)
    raised = Image.new("L", (n, n), 0)
    rise = ImageDraw.Draw(raised)
    pitch = n / 128.0
    for _ in range(170):
        _bus(traces, rng, pitch)
    for _ in range(420):
        x, y = (np.round(rng.random(2) * 128) * pitch).tolist()
        traces.ellipse(
            (x - 0.62 * pitch, y - 0.62 * pitch, x + 0.62 * pitch, y + 0.62 * pitch), fill=255
        )
        traces.ellipse(
            (x - 0.28 * pitch, y - 0.28 * pitch, x + 0.28 * pitch, y + 0.28 * pitch), fill=20
        )
    for _ in range(150):
        _component(draw, rise, rng, pitch)
    taken: list[Box] = []
    for _ in range(90):
        _chip(draw, rise, rng, pitch, taken)
    metal, body = np.asarray(copper, np.float32) / 255.0, np.asarray(parts, np.float32) / 255.0
    high = np.asarray(raised, np.float32) / 255.0
    grain, weave = fbm(n, 90, 3, octaves=4, gain=0.8), fbm(n, 5, 13, octaves=5)
    lacquer = graded(
        metal + 0.05 * weave,
        (0.0, "#07331f"),
        (0.4, "#0d5a35"),
        (0.8, "#2e9a5a"),
        (0.95, "#e3bd58"),
        (1.0, "#ffe9a3"),
    )
    x, y = coordinates(n)
    cloth = np.sin(x * 1300.0) * np.sin(y * 1300.0)
    lacquer = lacquer * (1.0 + 0.05 * grain + 0.04 * cloth)[..., None]
    present = (body.max(-1) > 0.0)[..., None]
    board = np.where(present, body * (1.0 + 0.06 * grain)[..., None], lacquer)
    height = 0.0011 * metal * (1.0 - present[..., 0]) + 0.009 * high + 0.00007 * grain
    board = lit(board, height.astype(np.float32), gloss=0.22, shininess=36.0)
    return 1.1 * board * hollows(height, 0.008, strength=0.6)[..., None]


def _bus(draw: ImageDraw.ImageDraw, rng: np.random.Generator, pitch: float) -> None:
    """Draws parallel traces that turn by eighths of a circle."""
    lanes, tone = int(rng.integers(1, 9)), int(rng.integers(150, 185))
    at = np.round(rng.random(2) * 128)
    heading = int(rng.integers(4)) * 2
    path = [at]
    for _ in range(int(rng.integers(3, 7))):
        turn = heading * math.pi / 4.0
        step = np.round(np.array([math.cos(turn), math.sin(turn)]))
        at = at + step * int(rng.integers(5, 26))
        path.append(at)
        heading += int(rng.choice([-1, 1]))
    turns = np.array(path)
    for lane in range(lanes):
        shift = np.array([lane, -lane]) * 0.75
        points = [tuple(point) for point in (turns + shift) * pitch]
        draw.line(points, fill=tone, width=max(int(0.36 * pitch), 1), joint="curve")
        for x, y in (points[0], points[-1]):
            r = 0.42 * pitch
            draw.ellipse((x - r, y - r, x + r, y + r), fill=255)


def _component(
    draw: ImageDraw.ImageDraw, rise: ImageDraw.ImageDraw, rng: np.random.Generator, pitch: float
) -> None:
    """Draws a resistor, a capacitor or a can, with its pads."""
    x, y = (np.round(rng.random(2) * 128) * pitch).tolist()
    kind, lies = rng.integers(4), rng.random() < 0.5
    a, b = (2.2 * pitch, 1.1 * pitch) if lies else (1.1 * pitch, 2.2 * pitch)
    if kind == 3:
        r = 2.6 * pitch
        for share, tone in ((1.0, (40, 60, 110)), (0.82, (200, 204, 210)), (0.74, (150, 155, 165))):
            draw.ellipse((x - share * r, y - share * r, x + share * r, y + share * r), fill=tone)
        draw.pieslice((x - r, y - r, x + r, y + r), 250, 290, fill=(225, 228, 235))
        rise.ellipse((x - r, y - r, x + r, y + r), fill=220)
        return
    draw.rectangle((x - a, y - b, x + a, y + b), fill=(205, 208, 212))
    inner = 0.62
    ca, cb = (a * inner, b) if lies else (a, b * inner)
    tone = ((30, 30, 34), (150, 105, 60), (190, 160, 110))[kind]
    draw.rectangle((x - ca, y - cb, x + ca, y + cb), fill=tone)
    rise.rectangle((x - a, y - b, x + a, y + b), fill=90)
    write(
        draw,
        (x - a, y + b + 0.4 * pitch, x + 3.5 * pitch, y + b + 1.5 * pitch),
        rng,
        (235, 238, 230),
        weight=0.16,
    )


def _chip(
    draw: ImageDraw.ImageDraw,
    rise: ImageDraw.ImageDraw,
    rng: np.random.Generator,
    pitch: float,
    taken: list[Box],
) -> None:
    """Draws a chip with legs, a dot and three lines of lettering, unless its place is occupied."""
    x, y = (np.round(rng.random(2) * 128) * pitch).tolist()
    wide, high = (rng.integers(5, 17, 2) * pitch).tolist()
    room = 2.5 * pitch
    if any(
        x - room < right and left < x + wide + room and y - room < bottom and top < y + high + room
        for left, top, right, bottom in taken
    ):
        return
    taken.append((x, y, x + wide, y + high))
    legs = np.arange(0.6, 200.0)
    for reach_x, reach_y in (
        (1.3 * pitch, 0.0),
        (0.0, 1.3 * pitch) if rng.random() < 0.6 else (1.3 * pitch, 0.0),
    ):
        length = high if reach_x else wide
        for leg in legs[legs * pitch < length] * pitch:
            half = 0.27 * pitch
            box = (
                (x - reach_x, y + leg - half, x + wide + reach_x, y + leg + half)
                if reach_x
                else (x + leg - half, y - reach_y, x + leg + half, y + high + reach_y)
            )
            draw.rectangle(box, fill=(222, 220, 208))
            rise.rectangle(box, fill=60)
    draw.rectangle((x, y, x + wide, y + high), fill=(34, 35, 40))
    rise.rectangle((x, y, x + wide, y + high), fill=190)
    draw.ellipse(
        (x + pitch * 0.6, y + pitch * 0.6, x + pitch * 1.5, y + pitch * 1.5), fill=(90, 92, 98)
    )
    for line in range(3):
        top = y + (0.3 + 0.22 * line) * high
        write(
            draw,
            (x + 0.15 * wide, top, x + 0.9 * wide, top + min(0.13 * high, 1.6 * pitch)),
            rng,
            (206, 208, 204),
            weight=0.15,
        )
