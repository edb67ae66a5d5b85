"""Marble, rust, and the patterns of reaction and diffusion."""

import functools

import numpy as np
import scipy.ndimage

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
from experiments.dataset.textures.shading import colour, graded, hollows, lit


def marble(n: int) -> Picture:
    """Dark green marble, broken and healed with white, rose and golden veins."""
    x, y = coordinates(n)
    fold_x, fold_y = fbm(n, 3, 1, octaves=5), fbm(n, 3, 11, octaves=5)
    u, v = x + 0.07 * fold_x, y + 0.07 * fold_y
    body = lookup(fbm(n, 4, 21, octaves=8, gain=0.62), u, v)
    stone = graded(
        body,
        (-2.2, "#06130f"),
        (-0.8, "#0f2f27"),
        (0.1, "#23574a"),
        (0.9, "#4f8a74"),
        (1.7, "#a9c9b4"),
        (2.4, "#e9efe2"),
    )
    shards = voronoi(u + 0.02 * fold_y, v, (7, 7), 5)
    breaks = shards.border + 0.006 * fbm(n, 30, 91, octaves=4)
    stone = stone * (0.72 + 0.5 * random_of(shards.index, 2))[..., None]
    rose = (random_of(shards.index, 3) > 0.8) * 0.75
    stone = blend(stone, graded(body, (-2.0, "#4a1c28"), (0.0, "#8d4a4c"), (2.0, "#e3b5a4")), rose)
    stone = blend(stone, colour("#eef0e4"), 0.85 * smooth(0.007, 0.002, breaks))
    for turns, width, tone in (
        ((5, 2), 0.03, "#f4efe3"),
        ((-4, 7), 0.03, "#d9e4d6"),
        ((9, 5), 0.02, "#cfa04c"),
        ((-13, 10), 0.06, "#081813"),
        ((11, 14), 0.05, "#f2f5ea"),
        ((-15, 19), 0.05, "#e4eedd"),
    ):
        seed = 31 + turns[1]
        bend = lookup(fbm(n, 4, seed, octaves=7, gain=0.55), u, v)
        crack = np.abs(
            np.sin(np.pi * (turns[0] * x + turns[1] * y + (0.8 + 0.09 * abs(turns[0])) * bend))
        )
        swell = np.clip(0.35 + 0.9 * noise(n, 6, seed + 9), 0.02, 2.0)
        stone = blend(stone, colour(tone), 0.9 * smooth(width, 0.15 * width, crack / swell))
    fine = fbm(n, 150, 81, octaves=2, gain=0.9)
    return stone * (1.0 + 0.08 * fine)[..., None]


def rust(n: int) -> Picture:
    """The hull of a ship: seams and rivets, layers of paint, rust that flakes and runs."""
    x, y = coordinates(n)
    decay = fbm(n, 4, 1, octaves=8, gain=0.62)
    grain = fbm(n, 60, 21, octaves=5, gain=0.75)
    row = np.floor(y * 5.0)
    along = x * 3.0 + 0.5 * (row % 2)
    seam = np.minimum(
        np.abs(y * 5.0 - np.round(y * 5.0)) / 5.0, np.abs(along - np.round(along)) / 3.0
    )
    pitch = 1.0 / 45.0
    rivet = (
        np.hypot(
            (x / pitch) % 1.0 - 0.5, (np.abs(y * 5.0 - np.round(y * 5.0)) / 5.0 - 0.014) / pitch
        )
        * pitch
    )
    edge = decay + 0.8 * np.exp(-seam / 0.02) + 0.25 * grain
    runs = fbm(n, (110, 3), 31, octaves=4, gain=0.7) + 0.7 * decay
    metal = graded(
        grain + 0.6 * noise(n, 14, 41),
        (-2.6, "#1d0d08"),
        (-1.0, "#4c1f10"),
        (0.2, "#8a3d16"),
        (1.2, "#c46a22"),
        (2.4, "#e8a04a"),
    )
    sea = graded(fbm(n, 6, 51, octaves=5), (-2.0, "#0d4a57"), (0.0, "#1b7f86"), (2.0, "#57b3a8"))
    primer = colour("#c9bfa6") * (0.9 + 0.06 * grain)[..., None]
    band = smooth(0.004, -0.004, np.abs(y - 0.5) - 0.1)
    sea = blend(sea, colour("#d8d2bd") * (0.95 + 0.04 * grain)[..., None], band)
    top, under = smooth(0.45, 0.38, edge), smooth(0.75, 0.66, edge)
    hull = blend(blend(metal, primer, under), sea, top)
    hull = blend(hull, colour("#7a3413"), 0.75 * smooth(0.6, 2.0, runs))
    height = 0.0026 * top + 0.0018 * under + 0.0006 * grain * (1.0 - 0.8 * top)
    height += 0.003 * smooth(0.0, 0.004, seam) + 0.004 * np.sqrt(
        np.clip(1.0 - (rivet / 0.0062) ** 2, 0.0, 1.0)
    )
    return lit(hull, height, gloss=0.12) * hollows(height, 0.006, strength=1.2)[..., None]


def turing(n: int) -> Picture:
    """Coral-like reaction-diffusion patterns of many scales.

    Source: McCabe, Cyclic symmetric multi-scale Turing patterns (Bridges 2010): each point follows
    the scale at which activator and inhibitor differ least.
    """
    grown, scale = _grow(320, 90)
    zoom = [np.clip(each, -4.0, 4.0) for each in _resampled(np.stack([grown, scale]), n)]
    grown, scale = zoom
    tone = graded(
        grown,
        (-1.0, "#10122e"),
        (-0.55, "#31245f"),
        (-0.15, "#a3306a"),
        (0.15, "#ee6a4c"),
        (0.5, "#f8c46a"),
        (1.0, "#fff4d6"),
    )
    cool = graded(
        grown,
        (-1.0, "#03252e"),
        (-0.4, "#0b5d66"),
        (0.1, "#36a08f"),
        (0.5, "#b9dfae"),
        (1.0, "#fbfbe3"),
    )
    reef = blend(tone, cool, smooth(-0.5, 0.6, fbm(n, 3, 5, octaves=4) + 0.5 * (scale - 1.5)))
    grain = fbm(n, 100, 15, octaves=4, gain=0.8)
    height = 0.011 * grown + 0.00035 * grain
    reef = lit(reef * (1.0 + 0.04 * grain)[..., None], height, gloss=0.3, shininess=24.0)
    return reef * hollows(height, 0.01, strength=0.8)[..., None]


@functools.cache
def _grow(side: int, steps: int) -> tuple[Field, Field]:
    """Returns the pattern, -1 to 1, and the last scale of each point."""
    state = np.random.default_rng(12).uniform(-1.0, 1.0, (side, side)).astype(np.float32)
    radii, amounts = (2, 4, 8, 17, 34), (0.020, 0.026, 0.034, 0.042, 0.05)
    chosen_scale = np.zeros_like(state)
    for _ in range(steps):
        blurred = state
        least = np.full_like(state, np.inf)
        change = np.zeros_like(state)
        for scale, (radius, amount) in enumerate(zip(radii, amounts, strict=True)):
            # Two box filters approximate a Gaussian, at the same cost for every radius.
            active = scipy.ndimage.uniform_filter(blurred, 2 * radius + 1, mode="wrap")
            held = scipy.ndimage.uniform_filter(active, 4 * radius + 1, mode="wrap")
            differ = np.abs(active - held)
            leads = differ < least
            np.copyto(least, differ, where=leads)
            np.copyto(change, np.where(active > held, amount, -amount), where=leads)
            np.copyto(chosen_scale, np.float32(scale), where=leads)
        state = state + change
        state = 2.0 * (state - state.min()) / (state.max() - state.min()) - 1.0
    return state, scipy.ndimage.gaussian_filter(chosen_scale, 3.0, mode="wrap")


def _resampled(fields: np.ndarray, n: int) -> list[Field]:
    """Returns periodic fields with `n` samples a side, by cubic splines."""
    side = fields.shape[1]
    ticks = (np.arange(n) + 0.5) / n * side - 0.5
    at = np.stack(np.meshgrid(ticks, ticks, indexing="ij")).astype(np.float32)
    return [scipy.ndimage.map_coordinates(each, at, order=3, mode="grid-wrap") for each in fields]
