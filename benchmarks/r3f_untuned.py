"""Claim: models with objects found by light are 3 dB better than straight rays, on average.

    python -m benchmarks.r3f_untuned --scenes=FOLDER,FOLDER [--limit=N]

Each scene is reconstructed from its images and masks as `experiments.reconstruct` does. One model
is trained with the reconstruction in front of a backdrop, with a field where masks show the object
if the shape leaves an error, and another one along straight rays; fields, also those of opaque
parts, have the preset `tiny` and `--steps` steps. The table has the error of the validation pixels
(root mean square of the channels of a pixel, at most 0.15, sRGB; its mean over the pixels), where
the field is sampled, the masked PSNR of test views, and the gain. Finished reconstructions and
trainings are reused.

Asserted is the mean gain over all scenes that are given. docs/shape_from_light_results.md lists
scenes that led to no change of the code, and the command that renders them.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from absl import app, flags

from experiments.r3f import records
from experiments.runs import measured_runs, subprocesses
from refref_jax.training import run_folder

_SCENES = flags.DEFINE_list("scenes", None, "Folders of scenes.", required=True)
_STEPS = flags.DEFINE_integer("steps", 1250, "Training steps of each field.", 1)
_RAYS_PER_PIXEL = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel in evaluation.", 1)
_LIMIT = flags.DEFINE_integer("limit", 8, "Number of test images, evenly spaced.", 1)
_OUT = flags.DEFINE_string("out", "runs/r3f_untuned", "Output folder.")

_GAIN = 3.0
"""Least mean gain in masked PSNR, dB."""


class Row(NamedTuple):
    """One scene.

    Attributes:
      error: mean error of the validation pixels with the reconstructed object, sRGB.
      field: where the field is sampled: `around` the meshes, too, `inside` them only, or nowhere
        (`none`).
      found: masked PSNR with the reconstruction, dB.
      straight: masked PSNR along straight rays, dB.
    """

    error: float
    field: str
    found: float
    straight: float


def main(arguments: list[str]) -> None:
    del arguments
    scenes = [Path(scene) for scene in _SCENES.value]
    for scene in scenes:
        measured_runs.check_masks(scene)
    print("| scene | error | field | **found by light** | straight rays | gain |")
    print("|---|---|---|---|---|---|", flush=True)
    gains = []
    for scene in scenes:
        row = measure(scene)
        gains.append(row.found - row.straight)
        print(
            f"| {scene.resolve().name} | {row.error:.4f} | {row.field} | {row.found:.2f} | "
            f"{row.straight:.2f} | {gains[-1]:.2f} |",
            flush=True,
        )
    mean = statistics.mean(gains)
    print(f"\nMean gain of {len(gains)} scenes: {mean:.2f} dB; the runs are in {_OUT.value}.")
    assert mean >= _GAIN, f"mean gain {mean:.2f} dB, {_GAIN} wanted"


def measure(scene: Path) -> Row:
    """Reconstructs a scene and trains on it, with the reconstruction and along straight rays.

    Raises:
      ValueError: if the images show no backdrop, in front of which light finds shapes.
    """
    folder = Path(_OUT.value) / scene.resolve().name
    made = folder / "reconstruction"
    options = [f"--scene={scene}", f"--out={made}"]
    subprocesses.run("reconstruct", *options, log=folder / "reconstruct.log")
    light = records.read(made).light
    if light is None or light.after is None:
        raise ValueError(
            f"No backdrop explains the background of {scene}, so that nothing was refined by light "
            f"({made / 'report.md'}). Give scenes whose scene.json states their background."
        )
    field = ["--preset=tiny", f"--steps={_STEPS.value}"]
    found = [f"--reconstruction={made}", "--paths=tree", "--far_field=backdrop"]
    if light.leaves_error or any(part.radiance is not None for part in light.parts):
        found += field
    psnr = _masked(folder / "found", scene, found)
    return Row(
        error=light.after,
        field=_place_of_field(folder / "found"),
        found=psnr,
        straight=_masked(
            folder / "straight", scene, ["--far_field=field", "--paths=straight", *field]
        ),
    )


def _place_of_field(run: Path) -> str:
    model = run_folder.read_config(run).model
    if model.interior != "field":
        return "none"
    return "around" if model.field_ball else "inside"


def _masked(run: Path, scene: Path, options: Sequence[str]) -> float:
    measured_runs.train(run, scene=scene, options=options)
    looks = [f"--rays_per_pixel={_RAYS_PER_PIXEL.value}", f"--limit={_LIMIT.value}"]
    return measured_runs.evaluate(run, scene=scene, options=looks).psnr_masked


if __name__ == "__main__":
    app.run(main)
