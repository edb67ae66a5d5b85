"""Scenes that a benchmark can list, of a few pixels; nothing in them could be trained on."""

import json

import numpy as np

from tests.data import small_scenes


def write_scene(folder, *, test_views=7, meshes=True, masks=True, colours=True):
    """Writes a scene: two training views, and test views ever farther from them."""
    small_scenes.write_scene(folder)
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    if not masks:
        for frame in content["frames"]:
            del frame["mask_file_path"]
        path.write_text(json.dumps(content))
    frames = []
    for i in range(test_views):
        pose = np.eye(4)
        pose[:3, 3] = [0.0, 10.0 + 0.5 * i, 20.0]
        frames.append({**content["frames"][0], "transform_matrix": pose.tolist()})
        name = f"test/r_{i:03d}"
        (folder / "test").mkdir(exist_ok=True)
        (folder / f"{name}.png").write_bytes((folder / "train/r_000.png").read_bytes())
        frames[-1]["file_path"] = f"./{name}"
    content["frames"] = frames
    (folder / "transforms_test.json").write_text(json.dumps(content))
    if meshes:
        (folder / "meshes").mkdir()
        (folder / "meshes" / "ball_glass.ply").write_text("not looked at")
        colour = {"colour_per_interface": [1.0, 1.0, 1.0]} if colours else {}
        parts = [{"mesh": "meshes/ball_glass.ply", "ior_inside": 1.5, **colour}]
        (folder / "scene.json").write_text(json.dumps({"parts": parts}))
    return folder
