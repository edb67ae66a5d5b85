"""Speaks as `blender_worker` does, and renders noise that depends on the job alone.

FAKE_DIES names a folder: in the middle of a rendering the process kills itself as often as there
are files in it, and takes one away each time.
"""

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import OpenEXR


def _write(path, layers):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.NO_COMPRESSION}
    parts = [OpenEXR.Part({**header, "name": name}, channels) for name, channels in layers.items()]
    OpenEXR.File(parts).write(path)


def _render(job, kind, size):
    random = np.random.default_rng([job["seed"], job["samples"], kind == "colour"])
    light = random.random((size, size, 4), np.float32)
    depth = random.uniform(2.0, 14.0, (size, size)).astype(np.float32)
    depth[0] = 1e10
    index = random.integers(0, 3, (size, size)).astype(np.float32)
    normal = random.normal(size=(3, size, size)).astype(np.float32)
    channels = {"ViewLayer.Combined": light, "ViewLayer.Depth.Z": depth}
    channels |= {f"ViewLayer.Normal.{axis}": normal[i] for i, axis in enumerate("XYZ")}
    path = job["geometry"] if kind == "geometry" else job["colours"][0]
    _write(path, {"all": channels | {"ViewLayer.Object Index.X": index}})


def main():
    print("chatter", file=sys.stderr)
    print(json.dumps({"blender": os.environ.get("FAKE_VERSION", "5.0.1")}), flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        record = json.loads((Path(job["scene"]) / "scene.json").read_text())
        if "FAKE_ERROR" in os.environ:
            print(json.dumps({"error": "RuntimeError: no light"}), flush=True)
            continue
        _render(job, "colour", record["size"])
        for left in sorted(Path(os.environ.get("FAKE_DIES", "nowhere")).glob("*"))[:1]:
            left.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        _render(job, "geometry", record["size"])
        print('{"written": 1}', flush=True)


if __name__ == "__main__":
    main()
