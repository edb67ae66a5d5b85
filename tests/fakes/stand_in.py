"""Stands in for the commands of a job: trains by counting, in steps that outlive a kill.

    python stand_in.py COMMAND --scene=... --out=...

A run counts to `--steps` in its file `count`, one every PACE seconds of the environment; it stops,
as the real one does, when its standard input ends. What it "measures" follows from its options
alone. `FAIL`, a regular expression, names the runs that end with an error.
"""

import hashlib
import json
import os
import re
import sys
import threading
import time
from pathlib import Path


def main():
    command, words = sys.argv[1], sys.argv[2:]
    if stray := [word for word in words if not word.startswith("--")]:
        sys.exit(f"error: {stray[0]} is no option.")
    options = dict(word.lstrip("-").partition("=")[::2] for word in words)
    run = Path(options.get("out") or options["run"])
    if os.environ.get("REFREF_STOP_WITH_INPUT"):
        threading.Thread(target=_end_with_input, daemon=True).start()
    with Path(os.environ["CALLS"]).open("a") as file:
        file.write(f"{command} {run.parts[-3]}/{run.parts[-2]} {os.getpid()}\n")
    if re.search(os.environ.get("FAIL", "^$"), str(run)) and command == "train":
        sys.exit("error: The stand-in was told to fail. Tell it not to.")
    run.mkdir(parents=True, exist_ok=True)
    {"train": _train, "evaluate": _evaluate, "reconstruct": _reconstruct}[command](run, options)


def _end_with_input():
    while os.read(0, 1):
        pass
    os._exit(143)


def _train(run, options):
    path, steps = run / "count", int(options["steps"])
    count = int(path.read_text()) if path.exists() else 0
    while count < steps:
        time.sleep(float(os.environ.get("PACE", "0")))
        count += 1
        _write(path, str(count))
    lines = [{"step": n, "seconds": 1.0 + n, "loss": 1.0 / n, "psnr": 9.0} for n in (1, steps)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    _write(run / "config.json", '{"schedule": {"batch": 100}}')
    (run / "trained_with").write_text(" ".join(f"{k}={v}" for k, v in sorted(options.items())))


def _evaluate(run, options):
    words = " ".join(
        word
        for word in (run / "trained_with").read_text().split()
        if word.partition("=")[0] not in ("out", "scene", "reconstruction", "log_every", "resume")
    )
    base = int(hashlib.sha256(words.encode()).hexdigest()[:4], 16) / 6553.6
    scene = Path(options["scene"])
    names = [Path(frame["file_path"]).name for frame in _frames(scene)]
    names = names[: int(options.get("limit", len(names)))]
    per_image = [
        {"name": name, "psnr": base + i, "psnr_masked": base, "ssim": 0.5, "lpips": None}
        for i, name in enumerate(names)
    ]
    results = {
        key: None if key == "lpips" else sum(image[key] for image in per_image) / len(per_image)
        for key in ("psnr", "psnr_masked", "ssim", "lpips")
    }
    folder = run / "eval" / "test"
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "results": results
        | {"distance_mae": 0.1, "distance_mae_masked": "inf", "seconds_per_image": 2.0},
        "per_image": per_image,
        "learned": None,
    }
    _write(folder / "metrics.json", json.dumps(content))


def _reconstruct(run, options):
    index = {"source": "estimated", "index": 1.5, "error": 0.01, "loss": 0.1}
    config = dict.fromkeys(("index", "space", "radius"))
    config |= {"geometry": "hull", "resolution": 16, "outliers": 0, "refinement": "none", "seed": 0}
    record = {"scene": "made", "inputs": "", "config": config, "index": index}
    _write(run / "reconstruction.json", json.dumps(record))


def _frames(scene):
    return json.loads((scene / "transforms_test.json").read_text())["frames"]


def _write(path, text):
    draft = path.with_suffix(".draft")
    draft.write_text(text)
    draft.replace(path)


if __name__ == "__main__":
    main()
