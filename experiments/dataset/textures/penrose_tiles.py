"""Penrose's rhombs."""

import math

import numpy as np
from jaxtyping import Complex, Float
from PIL import Image, ImageDraw

from experiments.dataset.textures.fields import (
    Picture,
    blend,
    coordinates,
    fbm,
    lookup,
    random_of,
    smooth,
)
from experiments.dataset.textures.shading import colour, colours, graded, lit


def penrose(n: int) -> Picture:
    """Penrose's rhombs in coloured stone, with inlaid arcs that continue from tile to tile."""
    pieces = _rhombs(5)
    scale = 0.82
    index = Image.new("I", (n, n), 0)
    draw = ImageDraw.Draw(index)
    across = Image.new("L", (n, n), 0)
    inlay = ImageDraw.Draw(across)
    kinds = []
    for number, (thick, corners) in enumerate(pieces, start=1):
        points = (np.stack([corners.real, corners.imag], -1) * scale + 0.5) * n
        draw.polygon([tuple(point) for point in points], fill=number)
        middle = points.mean(0)
        edge = np.linalg.norm(points[1] - points[0])
        shrunk = middle + 0.93 * (points - middle)
        inlay.polygon([tuple(point) for point in shrunk], fill=60)
        for corner, tone in ((0, 160), (2, 255)):
            radius = edge * ((0.30 if corner else 0.55) if thick else 0.28)
            box = [*(points[corner] - radius), *(points[corner] + radius)]
            ends = [points[(corner + each) % 4] - points[corner] for each in (1, 3)]
            turns = [math.degrees(math.atan2(end[1], end[0])) for end in ends]
            span = (turns[1] - turns[0]) % 360.0
            start, stop = turns if span < 180.0 else turns[::-1]
            stop = start + (stop - start) % 360.0
            inlay.arc(box, start, stop, fill=tone, width=max(int(0.09 * edge), 1))
        direction = np.angle(corners[2] - corners[0]) / math.pi % 1.0
        kinds.append((thick, round(direction * 10) % 10, np.abs(corners.mean())))
    piece, lines = np.asarray(index).astype(np.int64), np.asarray(across)
    thick, direction, far = (np.array([0, *each]) for each in zip(*kinds, strict=True))
    warm = colours("#b8432f", "#d9822b", "#8c2f39", "#e3b04b", "#a65a3a")
    cold = colours("#1d4e89", "#2a9d8f", "#264653", "#5b8e7d", "#3d348b")
    step = (direction.astype(int) + (far * 9.0).astype(int)) % 5
    stone = np.where(thick[:, None] > 0, warm[step], cold[step])[piece]
    return _inlaid(n, stone, piece, lines)


def _inlaid(n: int, stone: Picture, piece: np.ndarray, lines: np.ndarray) -> Picture:
    """Returns tiles with their joints (0), arcs (160, 255) and grain."""
    grain, cloud = fbm(n, 80, 2, octaves=4, gain=0.75), fbm(n, 6, 3, octaves=7, gain=0.6)
    x, y = coordinates(n)
    veins = lookup(cloud, 2.0 * x + random_of(piece, 4), 2.0 * y + random_of(piece, 5))
    stone = stone * (0.8 + 0.35 * random_of(piece, 6) + 0.14 * veins + 0.06 * grain)[..., None]
    stone = blend(stone, colour("#f4e8cf"), 0.5 * smooth(0.07, 0.01, np.abs(veins)))
    brass = graded(cloud, (-2.0, "#8a6a2b"), (0.0, "#d9b65a"), (2.0, "#fff0b8"))
    pearl = colour("#f2eee6") * (0.9 + 0.08 * veins)[..., None]
    stone = np.where((lines == 160)[..., None], brass, stone)
    stone = np.where((lines == 255)[..., None], pearl, stone)
    joint = lines == 0
    stone = np.where(joint[..., None], colour("#17130f") * np.ones(3), stone)
    height = np.where(joint, -0.0018, 0.0) + np.where(lines > 60, 0.0006, 0.0) + 0.0001 * grain
    return lit(stone, height.astype(np.float32), gloss=0.2, shininess=45.0)


def _rhombs(times: int) -> list[tuple[bool, Complex[np.ndarray, "4"]]]:
    """Returns thick and thin rhombs around the unit square.

    Robinson's triangles (de Bruijn 1981), subdivided `times` times by the golden ratio: each
    triangle is half a rhomb, which is completed by a reflection in its base.
    """
    golden = (1.0 + math.sqrt(5.0)) / 2.0
    turn = math.pi / 10.0
    halves: list[tuple[bool, complex, complex, complex]] = []
    for each in range(10):
        b, c = (
            complex(math.cos(at), math.sin(at))
            for at in ((2 * each - 1) * turn, (2 * each + 1) * turn)
        )
        halves.append((False, 0j, *((c, b) if each % 2 == 0 else (b, c))))
    for _ in range(times):
        finer = []
        for thick, a, b, c in halves:
            if thick:
                q, r = b + (a - b) / golden, b + (c - b) / golden
                finer += [(True, r, c, a), (True, q, r, b), (False, r, q, a)]
            else:
                p = a + (b - a) / golden
                finer += [(False, c, p, b), (True, p, c, a)]
        halves = finer
    whole: dict[tuple[float, float], tuple[bool, Float[np.ndarray, 4]]] = {}
    for thick, a, b, c in halves:
        middle = (b + c) / 2.0
        key = (round(middle.real, 6), round(middle.imag, 6))
        whole[key] = (thick, np.array([a, b, b + c - a, c]))
    return list(whole.values())
