"""A small scene of a ball in the local layout: masks by marching, photographs that show nothing."""

import json

import numpy as np

from refref_jax.data import image_files, scene_folder
from refref_jax.data.meshes import write_mesh
from tests.factories import bodies
from tests.factories.small_scenes import write_grey

RADIUS = 1.1


def write_scene(scene, *, views=24, size=40, meshes=True):
    """Writes train and test views, and the true mesh."""
    for split, count in {"train": views, "test": 5}.items():
        cameras = bodies.cameras_around(count, size=size)
        masks = bodies.masks_of(lambda points: bodies.ball(points, radius=RADIUS), cameras)
        frames = []
        for i, (mask, pose) in enumerate(zip(masks, cameras.poses, strict=True)):
            names = scene_folder.plain(split, i)
            (scene / names.image).parent.mkdir(parents=True, exist_ok=True)
            shade = np.linspace(0.2, 0.9, size)[:, None, None] * [1.0, 0.5 + 0.01 * i, 0.7]
            image_files.write_rgb(
                scene / f"{names.image}.png", np.where(mask[..., None], 0.5 * shade, shade)
            )
            write_grey(scene / names.mask, 255 * mask)
            whole = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]]).tolist()
            frames.append(scene_folder.frame_record(names, whole, masked=True, deep=False))
        content = {"camera_angle_x": bodies.ANGLE, "frames": frames}
        scene_folder.write_transforms(scene, split, content)
    if meshes:
        (scene / "meshes").mkdir()
        write_mesh(scene / "meshes" / "ball_glass.ply", *bodies.icosphere(3, radius=RADIUS))
    return scene


def without_masks(scene):
    """Takes the masks out of the transforms files."""
    for path in scene.glob("transforms_*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            del frame["mask_file_path"]
        path.write_text(json.dumps(content))
    return scene
