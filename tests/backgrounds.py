"""The exact background of a bundled scene, for tests that need no learning."""

import json

import imageio.v3 as iio
import numpy as np

from tests import reference


class CubeBackground:
    """Six textured walls, as `scene.json` describes them; linear RGB."""

    def __init__(self, scene):
        background = json.loads((scene / "scene.json").read_text())["background"]
        self.half_extent = background["half_extent"]
        self.faces = [
            (
                reference.srgb_to_linear(iio.imread(scene / face["image"])[..., :3] / 255.0),
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
            nearer = (towards > 0) & (t < distance)
            points = (origins + np.where(nearer, t, 0.0)[:, None] * directions) / self.half_extent
            u, v = 0.5 * (points @ u_axis + 1.0), 0.5 * (points @ v_axis + 1.0)
            rgb = np.where(nearer[:, None], _bilinear(texture, u, v), rgb)
            distance = np.where(nearer, t, distance)
        return rgb, distance


def _bilinear(texture, u, v):
    """Samples a texture whose first row is its top, `v = 0` its bottom; edges are extended."""
    height, width, _ = texture.shape
    x = np.clip(u * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - v) * height - 0.5, 0.0, height - 1.0)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = (1 - fx) * texture[top, left] + fx * texture[top, right]
    lower = (1 - fx) * texture[bottom, left] + fx * texture[bottom, right]
    return (1 - fy) * upper + fy * lower
