"""Bakes the light that arrives at the surfaces of a room (bpy, NumPy and standard library only).

PYTHON_OF_BLENDER experiments/dataset/blender_bake.py JOB.json OUT.npz

JOB is a `scene.json` as `blender_scene.build` reads it, with `folder`, `samples`, `seed` and
`threads`. Each surface of its background has its mean linear RGB `colour` and its `light_size`,
columns and rows, or a `radiance` that it emits. OUT has an array `[rows, columns, 3]` by the name
of each surface without radiance, row 0 at the top: irradiance over pi, of all light that reaches it
directly, through the object, or from other surfaces.
"""

import json
import sys
from pathlib import Path
from typing import Any

import blender_materials
import blender_scene
import bpy
import numpy as np


def main(job_file: str, out: str) -> None:
    """Bakes all surfaces."""
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    blender_scene.build(Path(job["folder"]), {**job, "background": {"type": "none"}})
    scene = bpy.context.scene
    scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.cycles.samples, scene.cycles.seed = job["samples"], job["seed"]
    made = {}
    for surface in job["background"]["surfaces"]:
        if "radiance" in surface:
            material, nodes, links = blender_materials.new_material(surface["name"])
            emission = nodes.new("ShaderNodeEmission")
            emission.inputs["Color"].default_value = (*surface["radiance"], 1.0)
            output = nodes.new("ShaderNodeOutputMaterial")
            links.new(emission.outputs["Emission"], output.inputs["Surface"])
            blender_scene.add_rectangle(surface, material)
        else:
            made[surface["name"]] = _add_reflector(surface)
    bpy.ops.object.select_all(action="DESELECT")
    for body, _ in made.values():
        body.select_set(True)
        bpy.context.view_layer.objects.active = body
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT", "INDIRECT"}, margin=0)
    np.savez(out, **{name: _pixels(image) for name, (_, image) in made.items()})


def _add_reflector(surface: dict[str, Any]) -> tuple[Any, Any]:
    """Adds a diffuse surface, and returns it with the image that takes its light."""
    material, nodes, links = blender_materials.new_material(surface["name"])
    bsdf = nodes.new("ShaderNodeBsdfDiffuse")
    bsdf.inputs["Color"].default_value = (*surface["colour"], 1.0)
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(bsdf.outputs["BSDF"], output.inputs["Surface"])
    image = bpy.data.images.new(surface["name"], *surface["light_size"], float_buffer=True)
    target = nodes.new("ShaderNodeTexImage")
    target.image = image
    nodes.active = target
    return blender_scene.add_rectangle(surface, material), image


def _pixels(image: Any) -> np.ndarray:
    columns, rows = image.size
    values = np.empty(4 * columns * rows, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(rows, columns, 4)[::-1, :, :3]


if __name__ == "__main__":
    main(*sys.argv[1:])
