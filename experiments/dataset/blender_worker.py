"""Renders views in Blender for another process (bpy, NumPy and the standard library only).

PYTHON_OF_BLENDER experiments/dataset/blender_worker.py --device=CPU --threads=2

Jobs are lines of JSON on standard input; each is answered by one line on standard output. The first
line of output is `{"blender": VERSION}`. A job is a `workers.Job`; its answer is `{"written":
COLOURS}` once its files are complete, or `{"error": TEXT}`. Multi-layer EXRs are written: the first
of `colours`, with all samples, and `geometry`, whose single sample goes through the pixel centres,
so that depth, normal and object index belong to one ray and are not averaged. Where parts disperse
light, there is one colour file per channel, with the indices of refraction of that channel.

The worker exits at the end of its input, also during a rendering: its parent process has ended.
"""

import argparse
import json
import os
import queue
import sys
import threading
from pathlib import Path
from typing import Any, TextIO


def main() -> None:
    """Renders until there are no more jobs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--device", choices=["CPU", "GPU"], default="CPU")
    options = parser.parse_args()
    answers = _take_over_output()
    jobs: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(jobs,), daemon=True).start()
    # Late, since Blender may print before this.
    import blender_scene
    import bpy

    _say(answers, {"blender": bpy.app.version_string})
    built, record = "", {}
    while True:
        job = json.loads(jobs.get())
        try:
            if built != job["scene"]:
                built = ""
                folder = Path(job["scene"])
                record = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
                blender_scene.build(folder, record)
                bpy.context.scene.render.threads_mode = "FIXED"
                bpy.context.scene.render.threads = options.threads
                if options.device == "GPU":
                    blender_scene.use_gpu()
                built = job["scene"]
            blender_scene.place_camera(job["pose"], job["angle_x"])
            blender_scene.filter_over(blender_scene.WHOLE_PIXEL)
            channels = range(3 if blender_scene.disperses(record) else 1)
            for channel in channels:
                blender_scene.tune_to(record, channel)
                _render(bpy, job["colours"][channel], job["samples"], job["seed"])
            blender_scene.filter_over(blender_scene.MIDDLE)
            _render(bpy, job["geometry"], 1, job["seed"])
            _say(answers, {"written": len(channels)})
        except Exception as error:  # whatever Blender runs into is for the other side to judge
            _say(answers, {"error": f"{type(error).__name__}: {error}"})


def _render(bpy: Any, path: str, samples: int, seed: int) -> None:
    scene = bpy.context.scene
    scene.cycles.samples = samples
    scene.cycles.seed = seed
    scene.render.filepath = path
    scene.render.use_file_extension = False
    Path(path).unlink(missing_ok=True)
    bpy.ops.render.render(write_still=True)
    if not Path(path).is_file():
        raise OSError(f"Blender did not write {path}")


def _take_over_output() -> TextIO:
    """Returns the original standard output, and redirects Blender's output to standard error."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return answers


def _read(jobs: "queue.SimpleQueue[str]") -> None:
    for line in sys.stdin:
        jobs.put(line)
    os._exit(0)


def _say(answers: TextIO, answer: dict[str, Any]) -> None:
    answers.write(json.dumps(answer) + "\n")
    answers.flush()


if __name__ == "__main__":
    main()
