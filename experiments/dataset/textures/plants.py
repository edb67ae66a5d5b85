"""Autumn leaves on a forest floor, and a meadow in flower."""

import math

import numpy as np
from jaxtyping import Float

from experiments.dataset.textures.fields import Field, Picture, blend, fbm, lookup, smooth
from experiments.dataset.textures.shading import colour, colours, graded
from experiments.dataset.textures.stamps import Place, Samples, stamp

_FALLEN = (
    "#b5341c",
    "#d9731a",
    "#e8a723",
    "#8c2318",
    "#c9581f",
    "#7a4a1e",
    "#a8842c",
    "#6b7a2a",
    "#e0c04a",
    "#5a2a1a",
    "#94a83a",
)
_PETALS = (
    "#e63946",
    "#f4d35e",
    "#f6f1eb",
    "#9d4edd",
    "#ff7096",
    "#3a86c8",
    "#ff9f1c",
    "#c9184a",
    "#b8c0ff",
    "#ffe8d6",
)

# Half a maple leaf: angle and length of its lobes.
_LOBES = ((0.0, 1.22), (0.8, 1.05), (1.72, 0.72))


def leaves(n: int) -> Picture:
    """Leaves of maple, beech and birch on dark soil, the upper ones larger."""
    rng = np.random.default_rng(31)
    cloud = fbm(n, 8, 4, octaves=7, gain=0.7)
    wood = np.ascontiguousarray(
        graded(cloud, (-2.0, "#14100a"), (0.3, "#3a2a1a"), (2.0, "#6b5232"))
    )
    sizes = np.linspace(0.028, 0.060, 950) * rng.uniform(0.8, 1.2, 950)
    for depth, size in enumerate(sizes):
        middle, angle = rng.random(2), rng.uniform(0.0, 2.0 * math.pi)
        tone = colour(_FALLEN[rng.integers(len(_FALLEN))]) * (0.55 + 0.5 * depth / sizes.size)
        _leaf(wood, Place(*middle.tolist(), float(size), angle), tone, rng, cloud)
    return wood


def _leaf(
    wood: Picture, place: Place, tone: np.ndarray, rng: np.random.Generator, cloud: Field
) -> None:
    """Lays a leaf with its stalk at `u = -1`: a lobed maple leaf, or an oval one."""
    maple, wide = rng.random() < 0.5, rng.uniform(0.42, 0.62)
    teeth, curl = rng.uniform(14.0, 26.0), rng.uniform(-0.25, 0.25)
    at, veins = rng.random(2).tolist(), int(rng.integers(6, 9))
    light = rng.uniform(-1.0, 1.0, 2).tolist()
    accent = colour(_FALLEN[rng.integers(len(_FALLEN))])

    def distance(u: Field, v: Field) -> Field:
        v = v - curl * u * u
        blade = _maple(u, v, teeth) if maple else _oval(u, v, teeth, wide)
        stalk = np.maximum(np.abs(v) - 0.022, np.maximum(-1.1 - u, u))
        return np.minimum(blade, stalk)

    def paint(u: Samples, v: Samples, outside: Samples) -> Float[np.ndarray, "samples 3"]:
        bent = v - curl * u * u
        if maple:
            turn = np.abs(np.arctan2(bent, u + 0.3))
            away = np.minimum.reduce([np.abs(turn - axis) for axis, _ in _LOBES])
            fold = np.clip(1.0 - away / 0.45, 0.0, 1.0)
            radius = np.hypot(u + 0.3, bent)
            rib = radius * away
            rib = np.minimum(rib, 0.01 + 0.3 * np.abs((radius * 7.0 - 3.0 * away) % 1.0 - 0.5))
        else:
            side = np.abs(bent)
            fold = np.abs(((u - 0.8 * side) * veins * 0.5) % 1.0 - 0.5) * 2.0
            rib = np.minimum(np.abs(bent), 0.045 + (1.0 - fold) * 0.12)
        spots = lookup(cloud, at[0] + 0.16 * u, at[1] + 0.16 * v)
        fine = lookup(cloud, at[1] + 0.7 * u, at[0] + 0.7 * v)
        skin = blend(tone, accent, 0.55 * smooth(0.2, 1.4, spots))
        skin = skin * (0.92 + 0.14 * fine + 0.12 * np.sign(bent) * light[0])[..., None]
        skin = skin * (1.0 + 0.22 * (light[1] * u + light[0] * v) + 0.14 * (fold - 0.5))[..., None]
        skin = blend(skin, 1.35 * tone + 0.12, 0.8 * smooth(0.035, 0.012, rib))
        skin = blend(skin, colour("#3a1f0e"), 0.75 * smooth(1.2, 1.9, spots + 0.3 * fine))
        return skin * (0.8 + 0.2 * smooth(0.0, -0.08, outside))[..., None]

    stamp(wood, place, distance, paint)


def _maple(u: Field, v: Field, teeth: float) -> Field:
    turn = np.abs(np.arctan2(v, u + 0.3))
    rim = np.full_like(u, 0.2)
    for axis, length in _LOBES:
        peak = np.maximum(1.0 - np.abs(turn - axis) / 0.48, 0.0)
        rim = np.maximum(rim, 0.2 + (length - 0.2) * peak**0.85)
    rim = rim * (1.0 + 0.13 * np.abs(np.sin(teeth * 0.5 * turn)))
    return 0.6 * (np.hypot(u + 0.3, v) - rim)


def _oval(u: Field, v: Field, teeth: float, wide: float) -> Field:
    share = np.clip(0.5 * (u + 0.85) / 0.925, 0.0, 1.0)
    half = wide * np.sin(np.pi * share**0.8) * (1.0 - 0.25 * share)
    return np.abs(v) - half - 0.02 * np.abs(np.sin(teeth * u)) * (half > 0.02)


def flowers(n: int) -> Picture:
    """A meadow from above: blades of grass, daisies, poppies and asters."""
    rng = np.random.default_rng(54)
    cloud = fbm(n, 8, 14, octaves=7, gain=0.7)
    meadow = np.ascontiguousarray(
        graded(cloud, (-2.0, "#06140a"), (0.5, "#163a1a"), (2.0, "#2f5a22"))
    )
    for depth in range(900):
        middle, angle = rng.random(2), rng.uniform(0.0, 2.0 * math.pi)
        green = colours("#1f6b2a", "#4f9a35", "#88b84a", "#2c7f5a", "#b5c95a")[rng.integers(5)]
        size = rng.uniform(0.03, 0.06)
        _blade(
            meadow,
            Place(*middle.tolist(), float(size), angle),
            green * (0.5 + 0.55 * depth / 900.0),
            rng,
        )
    sizes = np.linspace(0.016, 0.058, 400) * rng.uniform(0.75, 1.25, 400)
    for size in sizes:
        middle, angle = rng.random(2), rng.uniform(0.0, 2.0 * math.pi)
        _flower(meadow, Place(*middle.tolist(), float(size), angle), rng, cloud)
    return meadow


def _blade(meadow: Picture, place: Place, tone: np.ndarray, rng: np.random.Generator) -> None:
    wide, bend = rng.uniform(0.06, 0.2), rng.uniform(-0.5, 0.5)

    def distance(u: Field, v: Field) -> Field:
        return np.abs(v - bend * (u * u - 0.3)) - wide * (1.0 - np.abs(u) ** 1.7)

    def paint(u: Samples, v: Samples, outside: Samples) -> Float[np.ndarray, "samples 3"]:
        side = v - bend * (u * u - 0.3)
        light = 0.85 + 0.25 * np.sign(side) + 0.25 * u + 0.3 * smooth(0.02, 0.0, np.abs(side))
        stripes = 0.06 * np.sin(side * 110.0)
        return tone * (light + stripes)[..., None]

    stamp(meadow, place, distance, paint)


def _flower(meadow: Picture, place: Place, rng: np.random.Generator, cloud: Field) -> None:
    """Lays a flower: two whorls of petals around a disc of florets."""
    petals, sharp = int(rng.choice([5, 6, 8, 12, 17])), rng.uniform(0.45, 1.1)
    heart = rng.uniform(0.16, 0.34)
    base = colour(_PETALS[rng.integers(len(_PETALS))])
    inner = blend(base, colour(_PETALS[rng.integers(len(_PETALS))]), 0.75)
    disc = colours("#f2b705", "#3a2416", "#f6e27a", "#5a3e1b")[rng.integers(4)]
    at = rng.random(2).tolist()

    def whorl(u: Field, v: Field, shift: float) -> Field:
        turn = np.arctan2(v, u) + shift
        return 0.45 + 0.52 * np.abs(np.cos(0.5 * petals * turn)) ** sharp - 0.03 * np.cos(3 * turn)

    def distance(u: Field, v: Field) -> Field:
        rim = np.maximum(whorl(u, v, 0.0), 0.9 * whorl(u, v, np.pi / petals))
        return 0.7 * (np.hypot(u, v) - rim)

    def paint(u: Samples, v: Samples, outside: Samples) -> Float[np.ndarray, "samples 3"]:
        radius, turn = np.hypot(u, v), np.arctan2(v, u)
        upper = whorl(u, v, 0.0) - radius
        behind = upper < 0.0
        fold = np.abs(np.cos(0.5 * petals * (turn + behind * np.pi / petals)))
        fine = lookup(cloud, at[0] + 0.3 * u, at[1] + 0.3 * v)
        lines = 0.09 * np.cos(petals * 7.0 * turn) + 0.09 * fine
        light = 0.45 + 0.42 * fold + 0.25 * radius + lines - 0.25 * behind
        light = light - 0.3 * smooth(0.06, 0.0, np.abs(upper)) * behind
        light = light - 0.12 * (0.63 * u + 0.77 * v)
        skin = blend(inner, base, smooth(heart, 0.75, radius)) * light[..., None]
        florets = np.cos(42.0 * u) * np.cos(42.0 * v)
        dome = 0.75 + 0.3 * florets - 0.9 * (u + v) * heart / 0.3
        middle = disc * (dome * (1.0 - 0.35 * smooth(0.6, 1.0, radius / heart)))[..., None]
        skin = skin * (1.0 - 0.5 * smooth(1.45, 1.0, radius / heart))[..., None]
        return blend(skin, middle, smooth(heart, heart - 0.04, radius))

    stamp(meadow, place, distance, paint, shadow=0.6)
