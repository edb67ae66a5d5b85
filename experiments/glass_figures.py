"""Draws the figures of docs/glass.md: why glass is hard, and what following its light is worth.

python -m experiments.glass_figures --scene=experiments/data/cube_smcvx_ball --out=runs/glass

`scene.json` must tell the walls of a cube. Nothing is learned. Each figure is a JPEG,
`{out}/glass_{figure}.jpg`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import commands, known_options, options, output_folders, scene_option, scenes
from experiments.cli.late_imports import late

if TYPE_CHECKING:
    from experiments.figures import glass
    from experiments.runs import known_scene as known_scenes
    from refref_jax.data import background
    from refref_jax.render import backgrounds
else:
    glass = late("experiments.figures.glass")
    known_scenes = late("experiments.runs.known_scene")
    background = late("refref_jax.data.background")
    backgrounds = late("refref_jax.render.backgrounds")

FIGURES = ("views", "fan", "tree", "distances")

_SCENE = options.scene("The scene")
_OUT = options.out("Folder to write the figures to.")
_FIGURES = flags.DEFINE_multi_enum(
    "figure", list(FIGURES), list(FIGURES), "What to draw, all by default; may be repeated."
)
_VIEW = flags.DEFINE_integer("view", 0, "Number of the view of the split.", 0)
flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(known_options)
_OVERWRITE = options.overwrite("the figures of an earlier call")


def main() -> None:
    """Draws the figures that are asked for."""
    out = Path(_OUT.value)
    wanted = {name: f"glass_{name}.jpg" for name in dict.fromkeys(_FIGURES.value)}
    place = {
        "module": __name__,
        "writes": tuple(wanted.values()),
        "overwrite": _OVERWRITE.value,
    }
    output_folders.replaceable(out, **place)
    indices = scenes.given_indices()
    draw = _drawers(scene_option.opened(_SCENE.value), indices)
    with (
        output_folders.fresh(out, **place) as draft,
        commands.ProgressBar("draw", len(wanted)) as bar,
    ):
        for done, (name, file) in enumerate(wanted.items(), start=1):
            draw[name](draft / file)
            bar.show(done, name)
    print(f"Figures: {', '.join(str(out / file) for file in wanted.values())}")
    print(f"Next: {commands.shell('render_known', f'--scene={_SCENE.value}', '--out=runs/known')}")


def _drawers(folder: Path, indices: dict[str, float]) -> dict[str, Callable[[Path], None]]:
    """Reads a scene, and returns what draws each figure into a file."""
    walls = background.read_background(folder)
    if not isinstance(walls, backgrounds.CubeBackground):
        raise ValueError(
            f"The background of {folder} is no cube, whose walls are drawn. Choose a scene in one."
        )
    half = float(walls.half_extent)
    scene = known_scenes.read_scene(
        folder,
        split=known_options.SPLIT.value,
        views=str(_VIEW.value),
        rule=scenes.RULE.value,
        indices=indices,
    )
    side = options.side_of(known_options.RAYS_PER_PIXEL.value)
    return {
        "views": functools.partial(glass.draw_views, scene, side=side),
        "fan": functools.partial(glass.draw_fan, scene, folder, half),
        "tree": functools.partial(glass.draw_tree, scene, folder),
        "distances": functools.partial(glass.draw_distances, scene, half),
    }


if __name__ == "__main__":
    commands.run(main, again="a figure is replaced only with --overwrite, and the others stay.")
