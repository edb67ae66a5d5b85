"""Scenes whose renderings are known, and a process of Blender to render them with."""

import json

import numpy as np

from experiments.dataset import cameras, frame_files, scene_record, scene_setup, workers
from experiments.dataset.frame_files import Rendering
from experiments.dataset.render_settings import PerSplit, RenderSettings
from refref_jax.data import image_files
from refref_jax.data.scene_names import SceneName
from refref_jax.geometry.cameras import Cameras, focal_length
from tests.factories import small_dataset

SIZE = 48


def write_room(folder, kind, parts=(), *, white=False, rule="nested"):
    """Writes a scene; its background is smooth, or white."""
    (folder / "meshes").mkdir(parents=True)
    rows, columns = np.indices((96, 192))
    if kind != "cube":
        # What wraps around has to fit.
        phase = 2.0 * np.pi * (columns + 0.5) / 192.0
        waves = [np.cos(phase), np.sin(phase), np.cos(2.0 * phase)]
    else:
        waves = [np.sin(0.02 * columns), np.cos(0.03 * rows), np.sin(0.02 * (rows + columns))]
    image = 0.5 + 0.2 * np.stack(waves, -1) + 0.25 * (rows / 95.0 - 0.5)[..., None]
    background = small_dataset.write_background(folder, kind, seed=0, size=None)
    if kind == "env":
        background["image"] = "background/env.exr"
        image_files.write_exr(folder / background["image"], np.ones_like(image) if white else image)
    for number, wall in enumerate(background.get("faces", {}).values()):
        wall["image"] = f"background/wall_{number}.png"
        pixels = (
            np.ones_like(image) if white else np.roll(image[:, :96], number, -1) ** (1 + number)
        )
        image_files.write_rgb(folder / wall["image"], pixels)
    if kind == "sphere":
        image_files.write_rgb(folder / background["image"], np.ones_like(image) if white else image)
    settings = RenderSettings(SIZE, PerSplit(1, 1, 1), PerSplit(1, 1, 1), rule=rule)
    scene = SceneName(kind, "smcvx", "known")
    scene_setup.write_meshes(folder, scene, parts)
    record = scene_record.describe(scene, parts, background, settings)
    (folder / "scene.json").write_text(json.dumps(record))
    return folder


def pose(number):
    """Returns one of the helix's poses."""
    return cameras.helix_poses(10)[number]


def cameras_at(*poses):
    """Returns the cameras that a room is rendered with."""
    focal = focal_length(SIZE, cameras.ANGLE_X)
    return Cameras(np.stack(poses)[:, :3], SIZE, SIZE, focal)


class Blender:
    """One process of Blender."""

    def __init__(self, python, scratch, *, threads=2):
        script = workers.SCRIPT
        self._worker = workers.Worker(
            [str(python), str(script)], scratch=scratch, name="worker", threads=threads
        )
        self._worker.check_version()

    def render(self, folder, camera, *, samples=1, seed=0) -> Rendering:
        """Renders a view."""
        seen = []

        def finish(colours, geometry):
            seen.append(frame_files.read_rendering(colours, geometry))

        job = workers.Job(str(folder), camera.tolist(), cameras.ANGLE_X, samples, seed)
        self._worker.render(workers.Task("a view", job, finish))
        return seen[0]

    def close(self):
        self._worker.kill()
