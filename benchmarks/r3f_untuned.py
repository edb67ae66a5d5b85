"""Claim: on scenes that nothing was tuned on, objects found by light gain 3 dB over straight rays.

    python -m benchmarks.r3f_untuned --scenes=FOLDER,FOLDER [--limit=N]

Each scene is reconstructed from its images and masks as `experiments.reconstruct` does. A model is
trained with the reconstruction in front of a backdrop, with a field inside if the shape leaves an
error, and another one along straight rays; both have the preset `tiny`. The table has the error of
the validation pixels (mean absolute difference, sRGB), the masked PSNR of test views, and the gain.
Finished reconstructions and trainings are reused.

Asserted is the mean gain over all scenes that are given. docs/shape_from_light.md lists the scenes
that led to no change of the code, and has the command that renders them.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from absl import app, flags

from experiments.r3f import records
from experiments.runs import measured_runs, subprocesses

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
      error: what the shape leaves of the validation pixels, sRGB; `None` if light found no shape.
      found: masked PSNR with the reconstruction, dB.
      straight: masked PSNR along straight rays, dB.
    """

    error: float | None
    found: float
    straight: float


def main(arguments: list[str]) -> None:
    del arguments
    print("| scene | error | **found by light** | straight rays | gain |")
    print("|---|---|---|---|---|", flush=True)
    gains = []
    for scene in map(Path, _SCENES.value):
        row = measure(scene)
        gains.append(row.found - row.straight)
        error = "" if row.error is None else f"{row.error:.4f}"
        print(
            f"| {scene.resolve().name} | {error} | {row.found:.2f} | {row.straight:.2f} | "
            f"{gains[-1]:.2f} |",
            flush=True,
        )
    mean = statistics.mean(gains)
    print(f"\nMean gain of {len(gains)} scenes: {mean:.2f} dB; the runs are in {_OUT.value}.")
    assert mean >= _GAIN, f"mean gain {mean:.2f} dB, {_GAIN} wanted"


def measure(scene: Path) -> Row:
    """Reconstructs a scene and trains on it, with the reconstruction and along straight rays."""
    folder = Path(_OUT.value) / scene.resolve().name
    made = folder / "reconstruction"
    options = [f"--scene={scene}", f"--out={made}"]
    subprocesses.run("reconstruct", *options, log=folder / "reconstruct.log")
    light = records.read(made).light
    field = ["--preset=tiny", f"--steps={_STEPS.value}"]
    found = [f"--reconstruction={made}", "--paths=tree", "--far_field=backdrop"]
    if light is not None and light.leaves_error:
        found += ["--interior=field", *field]
    return Row(
        error=None if light is None else light.after,
        found=_masked(folder / "found", scene, found),
        straight=_masked(
            folder / "straight", scene, ["--far_field=field", "--paths=straight", *field]
        ),
    )


def _masked(run: Path, scene: Path, options: Sequence[str]) -> float:
    measured_runs.train(run, scene=scene, options=options)
    looks = [f"--rays_per_pixel={_RAYS_PER_PIXEL.value}", f"--limit={_LIMIT.value}"]
    found = measured_runs.evaluate(run, scene=scene, options=looks).psnr_masked
    if found is None:
        raise ValueError(f"{scene} has no masks of its test views, in which gains are measured.")
    return found


if __name__ == "__main__":
    app.run(main)
