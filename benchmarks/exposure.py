"""Claim: images of different exposure cost hardly anything, if their gains are learned.

    python -m benchmarks.exposure --scene=experiments/data/cube_smcvx_ball
    python -m benchmarks.exposure --far_field=field --steps=800

Copies the scene, and multiplies the linear colours of each training image by three gains, drawn
log-normally. Trains a backdrop, or a field, on the original images, on the copy with
`exposure=fixed`, and on the copy with `exposure=per_image`, and evaluates all on the original test
views. Prints PSNR, masked PSNR, and the largest error of a gain. Asserted is that learned gains
lose at most `--largest_loss` dB inside the mask.
"""

import json
import shutil
import tempfile
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from absl import app, flags

from benchmarks import backdrop
from refref_jax.data import scene_folder
from refref_jax.render import pixels

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_FAR_FIELD = flags.DEFINE_enum(
    "far_field", "backdrop", ["backdrop", "field"], "Model of the world behind the object."
)
_SPREAD = flags.DEFINE_float("spread", 0.15, "Standard deviation of the gains' logarithms.")
_LOSS = flags.DEFINE_float("largest_loss", 0.5, "Largest loss in masked PSNR, dB.")


def expose(scene: Path, out: Path) -> np.ndarray:
    """Copies a scene, multiplies its training images by gains, and returns these."""
    shutil.copytree(scene, out)
    frames = scene_folder.read_frames(out, "train")
    draw = np.random.default_rng(0).normal(scale=_SPREAD.value, size=(len(frames.images), 3))
    gains = np.exp(draw - draw.mean(axis=0))
    for path, image, gain in zip(
        frames.images, scene_folder.read_images(frames), gains, strict=True
    ):
        linear = gain * np.asarray(pixels.srgb_to_linear(image.astype(np.float32) / 255.0))
        srgb = np.asarray(pixels.linear_to_srgb(linear.astype(np.float32)))
        imageio.imwrite(path, np.round(255.0 * np.clip(srgb, 0.0, 1.0)).astype(np.uint8))
    return gains


def main(arguments: list[str]) -> None:
    del arguments
    with tempfile.TemporaryDirectory() as folder:
        out, scene = Path(folder), Path(_SCENE.value)
        gains = expose(scene, out / scene.name)
        rows = {}
        for name, where, exposure in (
            ("original", scene, "fixed"),
            ("fixed", out / scene.name, "fixed"),
            ("per_image", out / scene.name, "per_image"),
        ):
            options = [f"--far_field={_FAR_FIELD.value}", f"--exposure={exposure}"]
            if _FAR_FIELD.value == "field":
                options.append(f"--steps={flags.FLAGS.steps}")
            rows[name] = backdrop.measure(str(where), out / "runs" / name, *options)
        found = json.loads((out / "runs" / "per_image" / "gains.json").read_text(encoding="utf-8"))
    error = float(np.max(np.abs(np.array(list(found.values())) / gains - 1.0)))
    print("images,psnr,psnr_masked,largest_error_of_a_gain")
    for name, row in rows.items():
        shown = f"{error:.4f}" if name == "per_image" else ""
        print(f"{name},{row['psnr']:.2f},{row['psnr_masked']:.2f},{shown}")
    loss = rows["original"]["psnr_masked"] - rows["per_image"]["psnr_masked"]
    assert loss <= _LOSS.value, f"{loss:.2f} dB"


if __name__ == "__main__":
    app.run(main)
