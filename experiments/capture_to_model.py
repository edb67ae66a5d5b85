"""Trains a model of photographs, from their capture to a report, in one command.

python -m experiments.capture_to_model --source=CAPTURE --out=runs/vase

    {out}/imported/   import_capture: photographs without their lens, around the object
    {out}/refined/    refine_cameras: the same with better poses
    {out}/object/     reconstruct: surface, index and what is inside (not with --meshes)
    {out}/model/      train, with a gain for each photograph, and evaluate
    {out}/logs/       what each command printed

Each command can be run by itself with other options; `docs/captures.md` explains them. To continue
an interrupted command, repeat it: finished steps are kept.
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.runs import capture_steps

_SOURCE = flags.DEFINE_string(
    "source", None, "Folder of a capture: transforms.json, or a model of COLMAP.", required=True
)
_OUT = cli_flags.out("Folder of all results.")
_IMAGES = flags.DEFINE_string("images", None, "Folder of the photographs of a model of COLMAP.")
_MASK_FOLDER = flags.DEFINE_string(
    "mask_folder", None, "Folder of masks that are named like the photographs, with ending .png."
)
_MESHES = flags.DEFINE_string(
    "meshes", None, "Folder of PLY meshes of the object, in the capture's world."
)
_REFINE = flags.DEFINE_bool("refine", True, "Refine the poses of the cameras.")
_PRESET = cli_flags.preset("Size of the model and length of its training.")
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; those of the preset if not given.", 1)
_FAR_FIELD = flags.DEFINE_enum(
    "far_field",
    "field",
    ["field", "backdrop"],
    "Model of what is behind the object: a field, for rooms and streets, or a backdrop, for what "
    "is far away on all sides.",
)
_EXPOSURE = flags.DEFINE_enum(
    "exposure",
    "per_image",
    ["per_image", "fixed"],
    "Gain of each training image and channel: learned, or 1.",
)
_BRIGHTEST = flags.DEFINE_float(
    "brightest",
    1.0,
    "Largest linear radiance of the field; above 1 (white), such as 2, where lamps shine.",
    1.0,
    8.0,
)
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(4)


def main() -> None:
    """Runs all steps that are not finished."""
    source, out = Path(_SOURCE.value), Path(_OUT.value)
    if not _SOURCE.value.endswith(".json"):
        cli_scenes.check_place(_SOURCE.value)
    outputs.check_folder(out)
    options = capture_steps.Options(
        images=_IMAGES.value,
        mask_folder=_MASK_FOLDER.value,
        meshes=_MESHES.value,
        refine=_REFINE.value,
        preset=_PRESET.value,
        steps=_STEPS.value,
        far_field=_FAR_FIELD.value,
        exposure=_EXPOSURE.value,
        brightest=_BRIGHTEST.value,
        rays_per_pixel=_RAYS_PER_PIXEL.value,
    )
    capture_steps.run(list(capture_steps.steps(source, out, options)), out)
    seen, model = out / "model" / "eval" / "test", out / "model"
    if _MESHES.value is None:
        print(f"Report:  {out / 'object' / 'report.md'}")
    print(f"Images:  {seen / 'comparison.png'}")
    print(f"Metrics: {seen / 'metrics.json'}")
    print(f"Next: {app.shell('view', f'--run={model}')}")


if __name__ == "__main__":
    app.run(main, again="repeat the command to continue; finished steps are kept.")
