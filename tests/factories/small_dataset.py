"""Makes small scenes, and is killed at chosen moments."""

import dataclasses
import os
import signal
import sys
from pathlib import Path
from unittest import mock

import imageio.v3 as iio
import numpy as np
import trimesh

from experiments.dataset import backgrounds, frame_files, production, scene_record, scenes
from experiments.dataset.parts import Object, ObjectPart
from experiments.dataset.render_settings import PerSplit, RenderSettings
from refref_jax import atomic_files

SETTINGS = RenderSettings(size=6, spp=PerSplit(2, 2, 4), views=PerSplit(3, 1, 2))


def box(edge, name="body", material="glass", **options):
    mesh = trimesh.creation.box(3 * [edge])
    return ObjectPart(
        name, material, np.array(mesh.vertices), np.array(mesh.faces), False, **options
    )


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
    "box_opaque": Object(
        "box_opaque",
        "mmncvx",
        lambda detail: [
            box(2.0, "shell", "water", absorption=(0.1, 0.0, 0.2)),
            box(1.2, "core", "opaque", kind="opaque", albedo=(0.5, 0.2, 0.1)),
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


def make(out, blender, names="*_box,env_mmncvx_box_full", *, workers=2, **changes):
    """Makes small scenes, and returns whether all of it is there."""
    chosen = scenes.choose(names, SMALL_OBJECTS)
    settings = dataclasses.replace(SETTINGS, **changes)
    with mock.patch.object(backgrounds, "write_background", write_background):
        return production.produce(
            Path(out),
            chosen,
            settings,
            objects=SMALL_OBJECTS,
            blender=Path(blender),
            workers=workers,
            stopped=lambda: False,
        )


def _kill_at(moment, number):
    """Kills this process when it comes to a moment for the number-th time."""
    left = int(number)
    module, name = _MOMENTS[moment]
    function = getattr(module, name)

    def killing(*arguments, **options):
        nonlocal left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)

    setattr(module, name, killing)


_MOMENTS = {
    "mesh": (trimesh.exchange.ply, "export_ply"),
    "record": (scene_record, "describe"),
    "rename": (atomic_files, "move"),
    "read": (frame_files, "read_rendering"),
    "replace": (os, "replace"),
}


def main(out, blender, *moments):
    """Makes small scenes again and again, and kills each making at its moment, as `replace:3`."""
    for moment in moments:
        child = os.fork()
        if child == 0:
            _kill_at(*moment.split(":"))
            make(out, blender)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL, moment


if __name__ == "__main__":
    main(*sys.argv[1:])
