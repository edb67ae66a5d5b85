"""Claim: a capture that is resampled into one pinhole keeps its contrast down to eight pixels.

    python -m benchmarks.resampling

Photographs of gratings (linear light, periods of 4, 8 and 16 pixels, two directions) are computed
in closed form through lenses of COLMAP's models at 640 x 480 pixels, and resampled as
`import_capture` does. Prints, for each lens and period, the contrast that is left (the least of
both directions), the RMS error of linear light, the share of the photograph that is kept, and CPU
seconds per megapixel.
Asserted is that `--least_contrast` is left of a period of eight pixels.
"""

import time
from pathlib import Path

import numpy as np
from absl import app, flags

from experiments.captures import colmap, lenses, resampling
from experiments.captures.lenses import Lens
from experiments.captures.resampling import Frame, Pinhole

_LEAST = flags.DEFINE_float("least_contrast", 0.97, "Least share of the contrast that is left.")

_SIZE, _FOCAL = (640, 480), 520.0
_LENSES = {
    "none, shifted by 0.25 pixels": ("SIMPLE_PINHOLE", (_FOCAL, 320.25, 240.25)),
    "barrel": ("OPENCV", (_FOCAL, _FOCAL, 320.0, 240.0, -0.2, 0.05, 1e-3, -1e-3)),
    "cushion": ("RADIAL", (_FOCAL, 320.0, 240.0, 0.12, 0.02)),
    "fisheye": ("OPENCV_FISHEYE", (_FOCAL, _FOCAL, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0)),
}
_DIRECTIONS = (0.2, 1.2)


def towards(lens: Lens) -> np.ndarray:
    """Returns the point of the plane at distance 1 that each pixel shows, by Newton's method."""
    columns, rows = np.meshgrid(np.arange(_SIZE[0]) + 0.5, np.arange(_SIZE[1]) + 0.5)
    pixels = np.stack([columns, rows], axis=-1)
    points = (pixels - lens.intrinsics[2:4]) / lens.intrinsics[:2]
    for _ in range(12):
        off = lenses.to_pixels(lens, points) - pixels
        points = points - np.linalg.solve(lenses.slopes(lens, points), off[..., None])[..., 0]
    assert np.abs(lenses.to_pixels(lens, points) - pixels).max() < 1e-6
    return points


def wave(points: np.ndarray, angle: float, period: float) -> np.ndarray:
    """Returns a grating around 0; the period is in pixels of the pinhole."""
    along = points[..., 0] * np.cos(angle) + points[..., 1] * np.sin(angle)
    return np.cos(2.0 * np.pi * along * _FOCAL / period)


def seen(pinhole: Pinhole) -> np.ndarray:
    """Returns the point of the plane at distance 1 that each pixel of a pinhole shows."""
    x = (np.arange(pinhole.width) + 0.5 - 0.5 * pinhole.width) / pinhole.focal
    y = (np.arange(pinhole.height) + 0.5 - 0.5 * pinhole.height) / pinhole.focal
    return np.stack(np.meshgrid(x, y), axis=-1)


def measure(name: str, period: float) -> tuple[float, float, float, float]:
    """Returns contrast, RMS error, share that is kept and CPU seconds per megapixel."""
    model, parameters = _LENSES[name]
    frame = Frame(name, colmap.lens_of(model, _SIZE, list(parameters), Path(name)), False)
    shared = resampling.share([frame])
    shown, there = towards(frame.lens), seen(shared.pinhole)
    waves = np.stack([wave(shown, angle, period) for angle in _DIRECTIONS], axis=-1)
    begun = time.process_time()
    found = resampling.resample((0.5 + 0.45 * waves).astype(np.float32), frame, shared.pinhole)
    seconds = (time.process_time() - begun) / (found[..., 0].size / 1e6)
    true = np.stack([wave(there, angle, period) for angle in _DIRECTIONS], axis=-1)
    contrasts = np.sum((found - 0.5) * true, axis=(0, 1)) / np.sum(0.45 * true**2, axis=(0, 1))
    error = float(np.sqrt(np.mean((found - 0.5 - 0.45 * true) ** 2)))
    return float(contrasts.min()), error, float(shared.kept[0]), seconds


def main(arguments: list[str]) -> None:
    del arguments
    print("lens,period,contrast,rms_error,kept,cpu_seconds_per_megapixel")
    for name in _LENSES:
        for period in (4, 8, 16):
            contrast, error, kept, seconds = measure(name, period)
            shown = name.replace(",", ";")
            print(f"{shown},{period},{contrast:.4f},{error:.4f},{kept:.3f},{seconds:.2f}")
            assert period < 8 or contrast >= _LEAST.value, f"{name}: {contrast:.3f}"


if __name__ == "__main__":
    app.run(main)
