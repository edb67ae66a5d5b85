"""Reconstructs the object of a scene from images and masks: its surface and its index (R3F).

python -m experiments.reconstruct --scene=experiments/data/cube_smcvx_ball --out=runs/ball_r3f

{out}/report.md shows the results; {out}/geometry/*.ply is the surface, {out}/index.json the index
of refraction, and {out}/reconstruction.json has all numbers. Only the report reads the scene's own
meshes, for comparison. Finished stages are skipped: repeat the command to resume an interrupted
reconstruction.
"""

from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.r3f import flags as r3f_flags
from experiments.runs import refraction_indices

with epy.lazy_imports():
    from experiments.r3f import chain, object_source, report

_SCENE = cli_flags.scene("The scene to reconstruct")
_OUT = cli_flags.out("Folder to write to.")
_IOR = flags.DEFINE_string(
    "ior", None, "Index of refraction of the object, as in 1.5; estimated by default."
)
_RECONSTRUCTION = r3f_flags.reconstruction()
_SPACE = r3f_flags.space()
_PROPERTIES = cli_flags.properties()
_EXPOSURE = flags.DEFINE_enum(
    "exposure",
    "fixed",
    ["fixed", "per_image"],
    "Exposure of the images: one, or a gain for each image and channel, learned from the pixels "
    "around the object.",
)
_SEED = cli_flags.seed()
cli_flags.allow_outside()


def _parse(word: str | None) -> float | None:
    return None if word is None else refraction_indices.parse(word)


app.check(_IOR, _parse)


def main() -> None:
    """Reconstructs a scene, or resumes its reconstruction."""
    cli_scenes.check(_SCENE.value)
    outputs.check_folder(Path(_OUT.value))
    index = _parse(_IOR.value)
    scene, out = cli_scenes.opened(_SCENE.value), Path(_OUT.value)
    space, radius, centre = chain.bounds_of(
        scene, _PROPERTIES.value or "", space=_SPACE.chosen(), radius=_SPACE.radius.value
    )
    config = _RECONSTRUCTION.chosen(
        index=index,
        seed=_SEED.value,
        space=space,
        radius=radius,
        centre=centre,
        exposure=_EXPOSURE.value,
    )
    found = chain.reconstruct(scene, out, config, compare=True)
    print(f"Report:  {out / report.FILE}, {out / report.FOLDER}")
    print(f"Surface: {object_source.surface_file(out, found)}")
    print(f"Index:   {out / chain.INDEX_FILE}")
    run = out.with_name(f"{out.name}_run")
    given = [f"--scene={_SCENE.value}", f"--reconstruction={out}", f"--out={run}"]
    given += [f"--properties={_PROPERTIES.value}"] if _PROPERTIES.value else []
    print(f"Next: {app.shell('train', *given)}")


if __name__ == "__main__":
    app.run(main, again="repeat the command to resume; finished stages are kept.")
