"""Makes a test capture: glass on a table in a furnished room, taken by a hand-held camera.

python -m experiments.dataset.make_capture --out=runs/handheld --object=ball

--out gets three folders: `perfect`, a scene with exact inputs; `capture`, the same views as
photographs with a lens, drifting exposure, noise, JPEG, and poses and masks that are a little
wrong; `truth`, what is true. docs/captures.md describes them. Blender requires a separate
environment, created by `make dataset-env`. To resume an interrupted command, repeat it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags

with epy.lazy_imports():
    from experiments.dataset import captures

_OUT = cli_flags.out("Output folder, with the folders perfect, capture and truth.")
_OBJECT = flags.DEFINE_string("object", "ball", "Object on the table, as dataset.make names it.")
_VIEWS = flags.DEFINE_integer(
    "views", 60, "Number of views; every eighth is for testing.", lower_bound=2
)
_SIZE = flags.DEFINE_integer("size", 160, "Width and height of images in pixels.", lower_bound=16)
_SPP = flags.DEFINE_integer("spp", 72, "Samples per pixel; of test views four times as many.", 1)
_SEED = cli_flags.seed("Seed of the walk around the object and of all faults.")
_DISTANCE = flags.DEFINE_float("distance", 4.2, "Mean distance of the camera.", 3.0, 4.6)
_DEGREES = flags.DEFINE_float("pose_degrees", 0.3, "Error of rotations, degrees.", 0.0)
_PERCENT = flags.DEFINE_float(
    "pose_percent", 0.5, "Error of positions, percent of the distance.", 0.0
)
_MASK = flags.DEFINE_float("mask_pixels", 2.0, "Largest error of masks' edges, pixels.", 0.0)
_MISSING = flags.DEFINE_integer(
    "missing_masks", 3, "Training images that have no mask.", lower_bound=0
)
_TEXTURE_SCALE = flags.DEFINE_float(
    "texture_scale",
    1.0,
    "Width of the room's textures; at 1, details are as fine as pixels of a view of 160 x 160.",
    0.1,
    10.0,
)
_WORKERS = flags.DEFINE_integer(
    "workers", None, "Number of Blender processes; one for each core if not given.", lower_bound=1
)
_BLENDER = flags.DEFINE_string(
    "blender", ".venv-dataset/bin/python", "Python of the environment that has Blender."
)


def main() -> None:
    """Makes the missing files."""
    settings = captures.CaptureSettings(
        object=_OBJECT.value,
        views=_VIEWS.value,
        size=_SIZE.value,
        spp=_SPP.value,
        seed=_SEED.value,
        distance=_DISTANCE.value,
        pose_degrees=_DEGREES.value,
        pose_percent=_PERCENT.value,
        mask_pixels=_MASK.value,
        missing_masks=_MISSING.value,
        texture_scale=_TEXTURE_SCALE.value,
    )
    blender = Path(_BLENDER.value).absolute()
    if not blender.is_file():
        raise ValueError(
            f"--blender={_BLENDER.value} does not exist. Run make dataset-env, or give "
            "the Python of an environment with bpy 5.0.1 as --blender."
        )
    out = Path(_OUT.value)
    with app.Interrupt() as interrupt:
        whole = captures.produce(
            out,
            settings,
            blender=blender,
            workers=_WORKERS.value,
            stopped=lambda: interrupt.requested,
        )
    outputs.note(out, __name__)
    if not whole:
        print("Stopped. The same command resumes from here.")
        sys.exit(app.INTERRUPTED)
    print(f"Capture: {out / captures.CAPTURE}")
    print(f"Perfect: {out / captures.PERFECT}")
    print(f"Truth:   {out / captures.TRUTH}")
    scene = out / captures.PERFECT
    print(f"Next: {app.shell('train', f'--scene={scene}', f'--out={out}/perfect_run')}")


if __name__ == "__main__":
    app.run(main, again="it resumes; existing views are not rendered again.")
