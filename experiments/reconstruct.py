"""Reconstructs the object of a scene from images and masks: its surface, and its index (R3F).

python -m experiments.reconstruct --scene=experiments/data/cube_smcvx_ball --out=runs/ball_r3f

{out}/report.md shows what it came to; {out}/geometry/*.ply is the surface, {out}/index.json the
index of refraction, {out}/reconstruction.json has all figures. The scene's own meshes are looked at
by the report alone, which compares. Stages that are finished are not done again: the same command
goes on where it was stopped.
"""

from pathlib import Path

from absl import flags

from experiments import commands, reconstruction_options, scene_option, space_options
from experiments.r3f import body, chain, report

_SCENE = flags.DEFINE_string(
    "scene", None, f"The scene to reconstruct: {scene_option.FORMS}.", required=True
)
_OUT = flags.DEFINE_string("out", None, "Folder to write to.", required=True)
_IOR = flags.DEFINE_string(
    "ior", None, "Index of refraction of the body, as 1.5; estimated if not given."
)
flags.adopt_module_key_flags(reconstruction_options)
flags.adopt_module_key_flags(space_options)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of everything random.", 0, 2**32 - 1)


def main() -> None:
    """Reconstructs a scene, or goes on with it."""
    index = None if _IOR.value is None else reconstruction_options.parse_index(_IOR.value)
    config = reconstruction_options.chosen(index=index, seed=_SEED.value)
    scene, out = scene_option.opened(_SCENE.value), Path(_OUT.value)
    try:
        found = chain.reconstruct(scene, out, config, compare=True)
    except KeyboardInterrupt:
        print("Stopped. The same command goes on.")
        raise
    print(f"Report:  {out / report.FILE}, {out / report.FOLDER}")
    print(f"Surface: {body.surface_file(out, found)}")
    print(f"Index:   {out / chain.INDEX_FILE}")
    run = out.with_name(f"{out.name}_run")
    options = (f"--scene={_SCENE.value}", f"--reconstruction={out}", f"--out={run}")
    print(f"Next: {commands.shell('train', *options)}")


if __name__ == "__main__":
    commands.run(main)
