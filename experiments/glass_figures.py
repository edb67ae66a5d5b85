"""Draws the figures of docs/glass.md: the difficulty of glass, and the benefit of ray tracing it.

python -m experiments.glass_figures --scene=experiments/data/cube_smcvx_ball --out=runs/glass

`scene.json` must define a background cube. Nothing is trained. Each figure is a JPEG,
`{out}/glass_{figure}.jpg`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.runs import refraction_indices
from refref_jax import choices

with epy.lazy_imports():
    from experiments.figures import glass
    from experiments.runs import known_scene
    from refref_jax.data import scene_assembly, scene_properties
    from refref_jax.render import backgrounds
    from refref_jax.sampling import scene_bounds

FIGURES = ("views", "fan", "tree", "distances")

_SCENE = cli_flags.scene("The scene")
_OUT = cli_flags.out("Folder for the figures.")
_FIGURES = flags.DEFINE_multi_enum(
    "figure", list(FIGURES), list(FIGURES), "Figure to draw, all by default; may be repeated."
)
_VIEW = flags.DEFINE_integer("view", 0, "Number of the view of the split.", 0)
_RULE = cli_flags.rule()
_PROPERTIES = cli_flags.properties()
_IOR = cli_flags.ior()
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(9)
_SPLIT = cli_flags.split("Views to render.")
_OVERWRITE = cli_flags.overwrite("the figures of an earlier call")


def main() -> None:
    """Draws the selected figures."""
    out = Path(_OUT.value)
    wanted = {name: f"glass_{name}.jpg" for name in dict.fromkeys(_FIGURES.value)}
    place = {
        "module": __name__,
        "writes": tuple(wanted.values()),
        "overwrite": _OVERWRITE.value,
    }
    outputs.replaceable(out, **place)
    indices = refraction_indices.parse_named(_IOR.value)
    draw = _drawers(cli_scenes.opened(_SCENE.value), indices)
    with (
        outputs.fresh(out, **place) as draft,
        ProgressBar("draw", len(wanted)) as bar,
    ):
        for done, (name, file) in enumerate(wanted.items(), start=1):
            draw[name](draft / file)
            bar.show(done, name)
    print(f"Figures: {', '.join(str(out / file) for file in wanted.values())}")
    print(f"Next: {app.shell('render_known', f'--scene={_SCENE.value}', '--out=runs/known')}")


def _drawers(folder: Path, indices: dict[str, float]) -> dict[str, Callable[[Path], None]]:
    """Reads a scene, and returns functions that draw each figure into a file."""
    told = scene_properties.read(folder, overlay=_PROPERTIES.value)
    found = scene_assembly.read_background(folder, properties=told)
    if not isinstance(found, backgrounds.CubeBackground):
        raise ValueError(
            f"The background of {folder} is not a cube. Choose a scene with a background cube."
        )
    if found.centre is not None and "fan" in _FIGURES.value:
        raise ValueError(
            f"The background of {folder} is around {told.background.centre}, but the fan is "
            "drawn in a section through the origin. Choose the others with --figure."
        )
    half = float(found.half_extent)
    domain = scene_bounds.Domain(half, "bounded", told.background.centre or choices.ORIGIN)
    scene = known_scene.read_scene(
        folder,
        split=_SPLIT.value,
        views=str(_VIEW.value),
        rule=_RULE.value,
        indices=indices,
        overlay=_PROPERTIES.value,
    )
    side = choices.side_of(_RAYS_PER_PIXEL.value)
    return {
        "views": functools.partial(glass.draw_views, scene, side=side),
        "fan": functools.partial(glass.draw_fan, scene, folder, half),
        "tree": functools.partial(glass.draw_tree, scene, folder),
        "distances": functools.partial(glass.draw_distances, scene, domain),
    }


if __name__ == "__main__":
    app.run(main, again="existing figures are only replaced with --overwrite.")
