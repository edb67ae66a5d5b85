"""Reconstructs the object of a scene from images and masks: its surface, and its index (R3F).

python -m experiments.reconstruct --scene=experiments/data/cube_smcvx_ball --out=runs/ball_r3f

{out}/report.md shows what it came to; {out}/geometry/*.ply is the surface, {out}/index.json the
index of refraction, {out}/reconstruction.json has all figures. The scene's own meshes are looked at
by the report alone, which compares. Stages that are finished are not done again: the same command
goes on where it was stopped.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import (
    command_line,
    commands,
    options,
    reconstruction_options,
    scene_option,
    space_options,
)
from experiments.cli.late_imports import late

if TYPE_CHECKING:
    from experiments.r3f import chain, object_source, report
else:
    object_source = late("experiments.r3f.object_source")
    chain = late("experiments.r3f.chain")
    report = late("experiments.r3f.report")

_SCENE = options.scene("The scene to reconstruct")
_OUT = options.out("Folder to write to.")
_IOR = flags.DEFINE_string(
    "ior", None, "Index of refraction of the body, as 1.5; estimated if not given."
)
flags.adopt_module_key_flags(reconstruction_options)
flags.adopt_module_key_flags(space_options)
_SEED = options.seed()


def _parse(word: str | None) -> float | None:
    return None if word is None else reconstruction_options.parse_index(word)


command_line.check(_IOR, _parse)


def main() -> None:
    """Reconstructs a scene, or goes on with it."""
    scene_option.check(_SCENE.value)
    index = _parse(_IOR.value)
    config = reconstruction_options.chosen(
        index=index,
        seed=_SEED.value,
        space=space_options.chosen_space(),
        radius=space_options.RADIUS.value,
    )
    scene, out = scene_option.opened(_SCENE.value), Path(_OUT.value)
    found = chain.reconstruct(scene, out, config, compare=True)
    print(f"Report:  {out / report.FILE}, {out / report.FOLDER}")
    print(f"Surface: {object_source.surface_file(out, found)}")
    print(f"Index:   {out / chain.INDEX_FILE}")
    run = out.with_name(f"{out.name}_run")
    given = (f"--scene={_SCENE.value}", f"--reconstruction={out}", f"--out={run}")
    print(f"Next: {commands.shell('train', *given)}")


if __name__ == "__main__":
    commands.run(main, again="it goes on where it was stopped; what is finished stays.")
