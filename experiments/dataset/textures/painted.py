"""An oil painting: thousands of strokes that follow a flow."""

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from experiments.dataset.textures.fields import (
    Picture,
    blend,
    coordinates,
    fbm,
    noise,
)
from experiments.dataset.textures.shading import colour, colours, graded, lit


def painting(n: int) -> Picture:
    """A starry night over hills in oil: the strokes follow the swirls of the sky."""
    rng = np.random.default_rng(17)
    image = Image.new("RGB", (n, n), (18, 26, 60))
    draw = ImageDraw.Draw(image)
    grid = 384
    scene, flow = _night(grid)
    for count, length, width, spread in (
        (2600, 0.075, 0.016, 0.05),
        (9000, 0.045, 0.008, 0.08),
        (26000, 0.028, 0.0042, 0.12),
    ):
        starts = rng.random((count, 2))
        tints = rng.normal(0.0, spread, (count, 1)) + rng.normal(0.0, 0.5 * spread, (count, 3))
        paths = _follow(flow, starts, length) * n
        x, y = (starts * grid).astype(int).T
        tones = np.clip((scene[y, x] + tints) * 255.0, 0, 255).astype(int)
        thick = max(int(width * n), 1)
        for path, tone in zip(paths.reshape(count, -1).tolist(), tones.tolist(), strict=True):
            draw.line(path, fill=tuple(tone), width=thick, joint="curve")
    canvas = np.asarray(image, np.float32) / 255.0
    grey = canvas @ np.array([0.3, 0.5, 0.2], np.float32)
    weave, grain = fbm(n, 170, 4, octaves=2, gain=0.9), fbm(n, 12, 14, octaves=5)
    height = 0.0045 * grey + 0.0002 * weave
    canvas = canvas * (1.0 + 0.03 * weave + 0.02 * grain)[..., None]
    return lit(canvas, height.astype(np.float32), gloss=0.08, shininess=20.0)


def _night(grid: int) -> tuple[Picture, Float[np.ndarray, "grid grid 2"]]:
    """Returns the colours of the painting, and the unit direction of strokes."""
    x, y = coordinates(grid)
    potential = 0.05 * fbm(grid, 3, 2, octaves=3)
    glow = np.zeros_like(x)
    stars = (
        (0.18, 0.16, 0.075),
        (0.42, 0.10, 0.045),
        (0.80, 0.17, 0.11),
        (0.60, 0.30, 0.05),
        (0.30, 0.38, 0.055),
        (0.08, 0.45, 0.04),
        (0.93, 0.44, 0.05),
        (0.52, 0.48, 0.035),
    )
    rings = np.zeros_like(x)
    for a, b, size in stars:
        away = np.hypot(x - a, y - b)
        potential += 0.16 * size / 0.07 * np.exp(-away / (1.4 * size))
        glow += np.exp(-((away / (0.42 * size)) ** 2))
        rings += np.exp(-away / size) * (0.5 + 0.5 * np.cos(away / size * 9.0))
    swirl = np.sin(26.0 * potential + 9.0 * y)
    sky = graded(swirl, (-1.0, "#0c1445"), (-0.2, "#1f4aa0"), (0.4, "#3f87c9"), (1.0, "#a9d6e5"))
    sky = blend(sky, colour("#f2c230"), np.clip(1.1 * rings, 0.0, 0.9))
    sky = blend(sky, colour("#fff6c8"), np.clip(glow, 0.0, 1.0))
    ridge = 0.62 + 0.05 * np.sin(7.0 * x + 0.6) + 0.03 * np.sin(17.0 * x) + 0.02 * noise(grid, 6, 8)
    folds = np.sin(60.0 * (y - ridge) + 9.0 * np.sin(6.0 * x) + 4.0 * noise(grid, 5, 9))
    hills = graded(folds, (-1.0, "#0b2b2e"), (-0.2, "#1f5a4a"), (0.5, "#5d8a3a"), (1.0, "#d6b84a"))
    scene = np.where((y > ridge)[..., None], hills, sky)
    town = (noise(grid, 48, 10) > 1.5) & (y > ridge + 0.05) & (y < ridge + 0.2)
    scene = np.where(town[..., None], colours("#ffd166")[0], scene)
    cypress = np.abs(x - 0.13 - 0.02 * np.sin(24.0 * y)) < 0.055 * np.sqrt(
        np.clip((y - 0.28) / 0.7, 0.0, 1.0)
    )
    dark = graded(np.sin(90.0 * x + 14.0 * np.sin(13.0 * y)), (-1.0, "#0a1512"), (1.0, "#3b5a2a"))
    scene = np.where(cypress[..., None], dark, scene)
    hill_potential = 0.03 * folds + (y - ridge)
    slope_y, slope_x = np.gradient(np.where(y > ridge, hill_potential, potential + 0.12 * y))
    along = np.stack([slope_y, -slope_x], -1)
    along = np.where(cypress[..., None], np.array([0.15, -1.0]), along)
    return scene, along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)


def _follow(
    flow: Float[np.ndarray, "grid grid 2"], starts: Float[np.ndarray, "strokes 2"], length: float
) -> Float[np.ndarray, "strokes 5 2"]:
    """Returns the strokes' points: four steps along the flow from each start."""
    grid = flow.shape[0]
    path = [starts]
    for _ in range(4):
        column, row = np.clip((path[-1] * grid).astype(int), 0, grid - 1).T
        path.append(path[-1] + 0.25 * length * flow[row, column])
    return np.stack(path, axis=1)
