"""Runs `experiments.dataset.make` on small objects, and kills it at a chosen moment.

KILL is `MOMENT:NUMBER`: the process, or with GROUP set all of its group, is killed when it comes to
that moment for the NUMBER-th time.
"""

import json
import os
import signal
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import trimesh

from experiments import commands
from experiments.dataset import backgrounds, catalogue, frame_files, make, scene_setup
from experiments.dataset.parts import Object, Part


def box(edge, name="body", material="glass", **options):
    mesh = trimesh.creation.box(3 * [edge])
    return Part(name, material, np.array(mesh.vertices), np.array(mesh.faces), False, **options)


SMALL_OBJECTS = {
    "box": Object("box", "smcvx", lambda detail: [box(2.0, tint=(0.5, 1.0, 0.25))]),
    "box_full": Object(
        "box_full",
        "mmncvx",
        lambda detail: [
            box(2.0, "shell"),
            box(1.5, "liquid", "water", absorption=(0.1, 0.0, 0.2)),
        ],
    ),
}


def write_background(scene, kind, *, seed, size):
    (scene / "background").mkdir()
    grey = np.random.default_rng(seed).integers(0, 256, (2, 4, 3)).astype(np.uint8)
    iio.imwrite(scene / "background" / "image.png", grey, plugin="pillow")
    image = {"image": "background/image.png"}
    if kind != "cube":
        return (
            {"type": kind, "radius": 7.3, **image} if kind == "sphere" else {"type": kind, **image}
        )
    faces = {}
    for axis in range(3):
        for sign in (1.0, -1.0):
            rows = np.roll(np.eye(3), -axis, axis=0)
            normal, u_axis, v_axis = (sign * rows[0]).tolist(), rows[1].tolist(), rows[2].tolist()
            faces[f"{'-+'[sign > 0]}{'xyz'[axis]}"] = {
                **image,
                "normal": normal,
                "u_axis": u_axis,
                "v_axis": v_axis,
            }
    return {"type": "cube", "half_extent": 7.3, "faces": faces}


def _killing(moment, function):
    wanted, number = os.environ.get("KILL", ":0").split(":")
    left = int(number)

    def killing(*arguments, **options):
        nonlocal left
        left -= moment == wanted
        if moment == wanted and left == 0:
            if "GROUP" in os.environ:
                os.killpg(0, signal.SIGKILL)
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)

    return killing


def main():
    catalogue.OBJECTS = SMALL_OBJECTS
    backgrounds.write_background = _killing("background", write_background)
    Path.rename = _killing("rename", Path.rename)
    Path.replace = _killing("replace", Path.replace)
    frame_files.read_rendering = _killing("read", frame_files.read_rendering)
    json.dumps = _killing("json", json.dumps)
    make.main()


assert scene_setup.backgrounds is backgrounds

if __name__ == "__main__":
    commands.run(main)
