"""Renders views in Blender Cycles and times them (bpy, NumPy and the standard library only).

    PYTHON_OF_BLENDER benchmarks/renderers_cycles.py FOLDER_OF_EXPERIMENTS_DATASET

`benchmarks.renderers` starts this process. Every line of standard input is a job in JSON: `scene`,
`pose`, `angle_x`, `samples`, `seed`, and `file`, where the linear image is written as a multi-layer
EXR. Cycles is set up by the generator of the data set, with one thread and a box filter. Each job
is answered by a line with `seconds`, the CPU time of the process during the rendering. It includes
the update of Cycles' copy of the scene, most of which is kept from one view to the next.
"""

import json
import os
import sys
import time
from pathlib import Path


def main() -> None:
    """Renders until there are no more jobs."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # Blender prints
    sys.path.insert(0, sys.argv[1])
    import blender_scene
    import bpy

    built = ""
    for line in sys.stdin:
        job = json.loads(line)
        if built != job["scene"]:
            built = job["scene"]
            record = json.loads((Path(built) / "scene.json").read_text(encoding="utf-8"))
            blender_scene.build(Path(built), record)
            blender_scene.filter_over(blender_scene.WHOLE_PIXEL)
        scene = bpy.context.scene
        scene.render.threads_mode, scene.render.threads = "FIXED", 1
        scene.cycles.samples, scene.cycles.seed = job["samples"], job["seed"]
        scene.render.filepath, scene.render.use_file_extension = job["file"], False
        blender_scene.place_camera(job["pose"], job["angle_x"])
        begin = time.process_time()
        bpy.ops.render.render(write_still=True)
        answers.write(json.dumps({"seconds": time.process_time() - begin}) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
