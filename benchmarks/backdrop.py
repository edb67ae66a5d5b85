"""Claim: where the world is a surface, solving for that surface beats training a field.

    python -m benchmarks.backdrop --scenes=experiments/data/cube_smcvx_ball

Trains each scene twice along the path tree, with the field of preset `tiny` and with a backdrop,
one after the other in processes of their own, and evaluates both on some test views with the same
rays. Prints seconds of training, PSNR and masked PSNR. Asserted is that the backdrop has a higher
masked PSNR, by `--margin`, in less time. With `--picture`, one test view of the last scene is drawn
for both, with its errors.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from absl import app, flags

from experiments.figures import glass
from refref_jax.data import image_files, scene_folder

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_STEPS = flags.DEFINE_integer("steps", 2500, "Steps of the field.", lower_bound=1)
_LIMIT = flags.DEFINE_integer("limit", 8, "Number of test views.", lower_bound=1)
_RAYS = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel of the test views.")
_RESOLUTION = flags.DEFINE_integer("resolution", 384, "Cells per side of a face of the backdrop.")
_MARGIN = flags.DEFINE_float("margin", 3.0, "Least gain in masked PSNR, dB.")
_PICTURE = flags.DEFINE_string("picture", None, "Image file to draw a test view into.")
_VIEW = flags.DEFINE_integer("view", 0, "Test view of the picture, counted in those evaluated.")


def _run(command: str, *options: str) -> None:
    subprocess.run([sys.executable, "-m", f"experiments.{command}", *options], check=True)


def measure(scene: str, out: Path, *options: str) -> dict[str, float]:
    """Returns seconds of training, PSNR and masked PSNR of one run."""
    _run("train", f"--scene={scene}", f"--out={out}", "--paths=tree", *options)
    _run("evaluate", f"--run={out}", f"--limit={_LIMIT.value}", f"--rays_per_pixel={_RAYS.value}")
    last = (out / "metrics.jsonl").read_text(encoding="utf-8").splitlines()[-1]
    found = json.loads((out / "eval" / "test" / "metrics.json").read_text(encoding="utf-8"))
    results = found["results"]
    return {
        "seconds": json.loads(last)["seconds"],
        "psnr": results["psnr"],
        "psnr_masked": results["psnr_masked"],
    }


def draw(scene: str, out: Path, rows: tuple[dict[str, float], dict[str, float]]) -> None:
    """Draws the true image of a test view, and what the field and the backdrop render."""
    shown = []
    for kind, row in zip(("field", "backdrop"), rows, strict=True):
        folder = out / kind / "eval" / "test"
        found = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        one = found["per_image"][_VIEW.value]
        rgb = image_files.read_rgb(folder / "rgb" / f"{one['name']}.png") / 255.0
        shown.append(glass.Shown(f"{kind}, {row['seconds']:.0f} s", rgb, one["psnr_masked"]))
    frames = scene_folder.read_frames(Path(scene), "test")
    index = frames.names.index(one["name"])
    truth = scene_folder.read_images(frames)[index] / 255.0
    glass.write_views(Path(_PICTURE.value), [glass.Shown("true image", truth), *shown])
    print(f"Picture: {_PICTURE.value}")


def main(arguments: list[str]) -> None:
    del arguments
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, scene in enumerate(_SCENES.value):
            out = Path(folder) / str(number)
            backdrop = ("--far_field=backdrop", f"--backdrop_resolution={_RESOLUTION.value}")
            rows[Path(scene).name] = (
                measure(scene, out / "field", f"--steps={_STEPS.value}"),
                measure(scene, out / "backdrop", *backdrop),
            )
            if _PICTURE.value:
                draw(scene, out, rows[Path(scene).name])
    print("scene,far_field,seconds,psnr,psnr_masked")
    for name, pair in rows.items():
        for kind, row in zip(("field", "backdrop"), pair, strict=True):
            print(f"{name},{kind},{row['seconds']:.0f},{row['psnr']:.2f},{row['psnr_masked']:.2f}")
    for name, (field, surface) in rows.items():
        gain = surface["psnr_masked"] - field["psnr_masked"]
        assert gain >= _MARGIN.value, f"{name}: {gain:.2f} dB"
        assert surface["seconds"] < field["seconds"], f"{name}: {surface['seconds']:.0f} s"


if __name__ == "__main__":
    app.run(main)
