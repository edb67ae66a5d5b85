"""Wood: parquet, painted planks, and the grain of every board."""

import numpy as np
from jaxtyping import Int

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


def grain_of(n: int, along: Field, across: Field, board: Int[np.ndarray, "h w"]) -> Field:
    """Returns the darkness of wood: 0 to 1, year rings and pores, along `along`.

    Args:
      n: number of samples a side.
      along: position in the direction of the fibres, in edges of the image.
      across: position perpendicular to the fibres, likewise.
      board: index of the board; each has its own grain.
    """
    fibres = fbm(n, (3, 48), 301, octaves=5, gain=0.75)
    bends = fbm(n, (2, 5), 311, octaves=3)
    u, v = along + random_of(board, 321), across + random_of(board, 322)
    bend = lookup(bends, u, v)
    rings = np.sin(2.0 * np.pi * (v * (18.0 + 26.0 * random_of(board, 323)) + 0.9 * bend))
    fine = lookup(fibres, u, v)
    pores = smooth(1.1, 2.0, lookup(fibres, u, 2.0 * v + 0.3))
    return np.clip(0.42 + 0.26 * rings * (0.6 + 0.4 * bend) + 0.22 * fine + 0.4 * pores, 0.0, 1.0)


def parquet(n: int) -> Picture:
    """A herringbone floor of oak, walnut and cherry, polished."""
    x, y = coordinates(n)
    length, blocks = 5, 26.0
    a, b = (x + y) * blocks * np.sqrt(0.5), (y - x) * blocks * np.sqrt(0.5)
    i, j = np.floor(a).astype(np.int32), np.floor(b).astype(np.int32)
    phase = (i - j) % (2 * length)
    lies = phase < length
    behind = np.where(lies, phase, 2 * length - 1 - phase)
    board = np.where(lies, (i - behind) * 131 + j * 7, i * 17 + (j - behind) * 173 + 50021)
    fa, fb = a - i, b - j
    along = behind + np.where(lies, fa, fb)
    across = np.where(lies, fb, fa)
    rim = np.minimum(np.minimum(along, length - along), np.minimum(across, 1.0 - across))
    dark = grain_of(n, along / blocks, across / blocks, board)
    light = chosen(
        random_of(board, 1),
        "#c89158",
        "#a9683a",
        "#d9ab6c",
        "#7a4526",
        "#b97a45",
        "#8f5530",
        "#e0b67c",
    )
    deep = chosen(
        random_of(board, 1),
        "#7a4a22",
        "#5d2f17",
        "#8f6230",
        "#3b1d10",
        "#6b3c1c",
        "#4a2413",
        "#94673a",
    )
    wood = blend(light, deep, dark) * (0.86 + 0.28 * random_of(board, 2))[..., None]
    wood = wood * smooth(0.0, 0.06, rim)[..., None] ** 0.6
    scratches = smooth(2.3, 3.0, noise(n, (30, 400), 7)) + smooth(2.3, 3.0, noise(n, (400, 30), 8))
    wood = wood + (0.12 * scratches)[..., None]
    tilt = (random_of(board, 3) - 0.5) * across
    height = 0.0016 * smooth(0.0, 0.09, rim) - 0.0006 * dark + 0.0014 * tilt
    gleam = 1.0 + 0.10 * fbm(n, 3, 17, octaves=4)
    return lit(wood, height, gloss=0.10) * gleam[..., None]


def planks(n: int) -> Picture:
    """Boards of a fisherman's hut: bright peeling paint on grey wood, with knots and nails."""
    x, y = coordinates(n)
    count = 13
    board = np.floor(x * count).astype(np.int32)
    u = x * count - board
    knot_x, knot = _knots(board, u, y)
    bend = 0.35 * np.exp(-3.0 * knot) * np.sign(knot_x)
    dark = grain_of(n, 0.7 * y, (u + bend) / count, board)
    rings = 0.5 + 0.4 * np.sin(26.0 * knot + 3.0 * dark)
    dark = dark + smooth(0.7, 0.3, knot) * (rings - dark)
    dark = np.where(knot < 0.16, 0.95, dark)
    bare = graded(dark, (0.0, "#b9a78d"), (0.45, "#8a765c"), (1.0, "#3a2c20"))
    paints = (
        "#1f7a8c",
        "#e1dcc8",
        "#bf3b2b",
        "#e0a52e",
        "#2b4c7e",
        "#5a8f5b",
        "#d9764a",
        "#86b9b0",
    )
    paint = chosen(random_of(board + 3, 4), *paints)
    older = chosen(random_of(board + 3, 9), *paints[3:], *paints[:3])
    flakes = fbm(n, (14, 5), 33, octaves=7, gain=0.72) + 0.9 * (0.5 - dark)
    worn = 0.5 * noise(n, (5, 3), 44) + 1.1 * smooth(0.42, 0.5, np.abs(u - 0.5))
    cover, under = smooth(0.55, 0.48, flakes + worn - 0.5), smooth(0.9, 0.8, flakes + worn - 0.5)
    strokes = fbm(n, (70, 4), 55, octaves=5, gain=0.75)
    hue = 0.92 + 0.10 * strokes + 0.12 * (0.5 - dark) + 0.08 * noise(n, 9, 66)
    wood = blend(blend(bare, older * 0.8 * hue[..., None], under), paint * hue[..., None], cover)
    rust = np.exp(-90.0 * np.maximum(y % 0.25 - 0.06, 0.0)) * np.exp(-(((u - 0.5) / 0.07) ** 2))
    rust = rust * (y % 0.25 > 0.055) * 0.8
    wood = blend(wood, colour("#6b3414"), rust)
    nail = np.hypot((u - 0.5) / count, y % 0.25 - 0.055)
    wood = blend(wood, colour("#2c2723"), smooth(0.0056, 0.0042, nail))
    gap = smooth(0.0, 0.035, np.minimum(u, 1.0 - u))
    height = 0.007 * gap + 0.0011 * cover + 0.0007 * under - 0.0006 * dark + 0.00018 * strokes
    height += 0.0015 * smooth(0.0056, 0.002, nail)
    boards = lit(wood * (0.15 + 0.85 * gap)[..., None], height)
    return boards * hollows(height, 0.006, strength=0.7)[..., None]


def _knots(board: Int[np.ndarray, "h w"], u: Field, y: Field) -> tuple[Field, Field]:
    """Returns offset and distance to the nearest of three knots a board; unit: 0.4 widths."""
    nearest = np.full(u.shape, np.inf, np.float32)
    nearest_x = np.zeros_like(nearest)
    for each in range(3):
        dx = (u - 0.2 - 0.6 * random_of(board, 70 + each)) / 0.4
        dy = (y - (each + random_of(board, 80 + each)) / 3.0) * 13.0 / 0.7
        distance = np.hypot(dx, dy)
        nearer = distance < nearest
        nearest = np.where(nearer, distance, nearest)
        nearest_x = np.where(nearer, dx, nearest_x)
    return nearest_x, nearest
