"""Writes Blender's own monkey as triangles. Run by a Python that has Blender as a module.

  PYTHON_OF_BLENDER experiments/dataset/export_monkey.py OUT.npz

The monkey, Suzanne, is part of Blender and under Blender's licence, so it is exported on the user's
machine and not distributed here. The file has `vertices` and `faces` (triangles, counter-clockwise
seen from outside) after two Catmull-Clark subdivisions: a head with open eye sockets, and two eyes
that are open at their backs. `objects.monkey` turns them into one closed mesh.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

_SUBDIVISIONS = 2


def main() -> None:
    """Writes the output file."""
    if len(sys.argv) != 2:
        raise SystemExit("The output file is missing. Give one name: export_monkey.py OUT.npz")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_monkey_add()
    monkey = bpy.context.object
    subdivision = monkey.modifiers.new("subdivision", "SUBSURF")
    subdivision.levels = _SUBDIVISIONS
    shape = monkey.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    shape.calc_loop_triangles()
    vertices = np.empty(3 * len(shape.vertices), np.float32)
    shape.vertices.foreach_get("co", vertices)
    faces = np.empty(3 * len(shape.loop_triangles), np.int32)
    shape.loop_triangles.foreach_get("vertices", faces)
    # NumPy appends a suffix to names, but not to open files.
    with Path(sys.argv[1]).open("wb") as file:
        np.savez(file, vertices=vertices.reshape(-1, 3), faces=faces.reshape(-1, 3))


if __name__ == "__main__":
    main()
