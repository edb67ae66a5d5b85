"""Known backgrounds in NumPy and float64, written from the text of `scene.json`.

Independent of `refref_jax.render.backgrounds`, which is tested against this.
"""

import json

import imageio.v3 as iio
import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.oracles.colours import srgb_to_linear


class CubeBackground:
    """Six textured walls, as `scene.json` describes them; linear RGB.

    Cycles interpolates 8-bit images before it decodes them, and repeats them.
    """

    def __init__(self, scene):
        """Reads the walls of a scene's folder."""
        background = json.loads((scene / "scene.json").read_text())["background"]
        self.half_extent = background["half_extent"]
        self.faces = [
            (
                iio.imread(scene / face["image"])[..., :3] / 255.0,
                *(np.array(face[key]) for key in ("normal", "u_axis", "v_axis")),
            )
            for face in background["faces"].values()
        ]

    def look(self, origins, directions):
        """Returns what rays see, and how far away."""
        rgb = np.zeros((len(origins), 3))
        distance = np.full(len(origins), np.inf)
        for texture, normal, u_axis, v_axis in self.faces:
            towards = directions @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (self.half_extent - origins @ normal) / towards
            nearer = np.flatnonzero((towards > 0) & (t < distance))
            points = (origins + t[:, None] * directions)[nearer] / self.half_extent
            u, v = 0.5 * (points @ u_axis + 1.0), 0.5 * (points @ v_axis + 1.0)
            rgb[nearer] = srgb_to_linear(bilinear(texture, u, v, rows="wrap"))
            distance[nearer] = t[nearer]
        return rgb, distance


def look_at_environment(texture, directions):
    """Returns what unit directions see of an equirectangular image."""
    x, y, z = directions.T
    u = (0.5 - np.arctan2(y, x) / (2.0 * np.pi)) % 1.0
    return bilinear(texture, u, 0.5 + np.arcsin(z) / np.pi, rows="edge")


def bilinear(texture, u, v, *, rows):
    """Samples a texture whose first row is its top, `v = 0` its bottom; columns wrap around."""
    height, width, _ = texture.shape
    padded = np.pad(texture, ((1, 1), (0, 0), (0, 0)), mode=rows)
    padded = np.pad(padded, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    places = np.stack([(1.0 - v) * height + 0.5, u * width + 0.5])
    return np.stack(
        [map_coordinates(channel, places, order=1) for channel in padded.T.swapaxes(1, 2)], -1
    )
