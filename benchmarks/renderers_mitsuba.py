"""Renders views in Mitsuba 3 and times them (Mitsuba, NumPy and the standard library only).

    PYTHON_WITH_MITSUBA benchmarks/renderers_mitsuba.py VARIANT

`benchmarks.renderers` starts this process; jobs and answers are those of `renderers_cycles`, with
`file` as a NumPy array. Walls are rectangles that emit their image, and objects are smooth
dielectrics with the indices of `scene.json`. The integrator `path` samples one branch at each
interface, without Russian roulette. One thread renders.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

_FLIP = np.diag([-1.0, 1.0, -1.0, 1.0])


def main() -> None:
    """Renders until there are no more jobs."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    import drjit
    import mitsuba

    mitsuba.set_variant(sys.argv[1])
    drjit.set_thread_count(1)
    scenes: dict[str, Any] = {}
    for line in sys.stdin:
        job = json.loads(line)
        view = json.dumps([job["scene"], job["pose"]])
        if view not in scenes:
            # Parallel loading never ends in a process that is pinned to one core.
            scenes[view] = mitsuba.load_dict(_content(mitsuba, job), parallel=False)
        begin = time.process_time()
        image = np.array(mitsuba.render(scenes[view], spp=job["samples"], seed=job["seed"]))
        seconds = time.process_time() - begin
        np.save(job["file"], image)
        answers.write(json.dumps({"seconds": seconds}) + "\n")
        answers.flush()


def _content(mitsuba: Any, job: dict[str, Any]) -> dict[str, Any]:
    """Returns a view of a scene as Mitsuba's dictionary."""
    folder = Path(job["scene"])
    record = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    bounces, size = record["render"]["bounces"], record["size"]
    pose = np.array(job["pose"]) @ _FLIP
    content = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": bounces + 2, "rr_depth": 10_000},
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(job["angle_x"])),
            "near_clip": 1e-3,
            "to_world": mitsuba.ScalarTransform4f(pose),
            "sampler": {"type": "multijitter"},
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
        },
    }
    for number, part in enumerate(record["parts"]):
        tint = {"type": "rgb", "value": part["colour_per_interface"]}
        content[f"part{number}"] = {
            "type": "ply",
            "filename": str(folder / part["mesh"]),
            "face_normals": not part["smooth_normals"],
            "bsdf": {
                "type": "dielectric",
                "int_ior": part["ior_inside"],
                "ext_ior": part["ior_outside"],
                "specular_reflectance": tint,
                "specular_transmittance": tint,
            },
        }
    half = record["background"]["half_extent"]
    for name, wall in record["background"]["faces"].items():
        content[f"wall {name}"] = _wall(mitsuba, folder, wall, half)
    return content


def _wall(mitsuba: Any, folder: Path, wall: dict[str, Any], half: float) -> dict[str, Any]:
    """Returns a rectangle that emits its image to the inside of the cube."""
    normal, across, along = (np.array(wall[key]) for key in ("normal", "u_axis", "v_axis"))
    third = np.cross(across, along)
    pose = np.eye(4)
    pose[:3] = half * np.stack([across, along, third, normal], axis=1)
    # The first row of an image is at v = 0 in Mitsuba.
    image = np.load((folder / wall["image"]).with_suffix(".npy"))[::-1]
    return {
        "type": "rectangle",
        "to_world": mitsuba.ScalarTransform4f(pose),
        "flip_normals": bool(third @ normal > 0.0),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {
            "type": "area",
            "radiance": {
                "type": "bitmap",
                "bitmap": mitsuba.Bitmap(np.ascontiguousarray(image)),
                "raw": True,
                "wrap_mode": "repeat",
                "filter_type": "bilinear",
            },
        },
    }


if __name__ == "__main__":
    main()
