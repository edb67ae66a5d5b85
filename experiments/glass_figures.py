"""Draws the figures of docs/glass.md: the difficulty of glass, and the benefit of ray tracing it.

python -m experiments.glass_figures --scene=experiments/data/cube_smcvx_ball --out=runs/glass

`scene.json` must define a background cube. Nothing is trained. Each figure is a JPEG,
`{out}/glass_{figure}.jpg`.

--figure=samples is drawn of trained runs: where they have samples and weights along the ray of a
pixel. It compares the paper's two distortion losses, for example the benchmark's runs `oracle` and
`oracle_distortion`:

python -m experiments.glass_figures --figure=samples --runs=RUN,RUN --pixel=64,60 --scene=...
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.runs import refraction_indices, view_numbers
from refref_jax import choices

with epy.lazy_imports():
    from experiments.figures import glass, ray_samples
    from experiments.runs import known_scene
    from refref_jax.data import scene_assembly, scene_folder, scene_names, scene_properties
    from refref_jax.render import backgrounds, checkpoint_io
    from refref_jax.sampling import scene_bounds
    from refref_jax.training import run_folder

FIGURES = ("views", "fan", "tree", "distances")
OF_RUNS = "samples"

_LOSSES = {
    "everywhere": "distortion loss over all samples (original)",
    "outside": "distortion loss outside objects (corrected)",
}

_SCENE = cli_flags.scene("The scene")
_OUT = cli_flags.out("Folder for the figures.")
_FIGURES = flags.DEFINE_multi_enum(
    "figure",
    list(FIGURES),
    [*FIGURES, OF_RUNS],
    f"Figure to draw, by default all but {OF_RUNS}; may be repeated.",
)
_RUNS = flags.DEFINE_list(
    "runs", [], f"Trained runs of the scene for --figure={OF_RUNS}, a column for each."
)
_PIXEL = flags.DEFINE_string(
    "pixel",
    None,
    f"Column and row of the pixel of --figure={OF_RUNS}, as in 64,60; the middle by default.",
)
app.check(_PIXEL, view_numbers.parse_pixel)
_VIEW = flags.DEFINE_integer("view", 0, "Number of the view of the split.", 0)
_RULE = cli_flags.rule()
_PROPERTIES = cli_flags.properties()
_IOR = cli_flags.ior()
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(9)
_SPLIT = cli_flags.split("Views to render.")
_OVERWRITE = cli_flags.overwrite("the figures of an earlier call")
cli_flags.allow_outside()


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
    _check_runs(wanted)
    indices = refraction_indices.parse_named(_IOR.value)
    folder = cli_scenes.opened(_SCENE.value)
    draw = _drawers(folder, indices) if set(wanted) - {OF_RUNS} else {}
    if OF_RUNS in wanted:
        draw[OF_RUNS] = _drawer_of_runs(folder)
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


def _check_runs(wanted: Collection[str]) -> None:
    """Rejects runs that are missing, or that no figure shows."""
    given = [f"--{each.name}" for each in (_RUNS, _PIXEL) if each.present]
    if OF_RUNS not in wanted and given:
        raise ValueError(
            f"{', '.join(given)} would have no effect. Add --figure={OF_RUNS}, or remove it."
        )
    if OF_RUNS in wanted and not _RUNS.value:
        raise ValueError(
            f"--figure={OF_RUNS} shows trained runs. Give them, as in --runs=runs/a,runs/b."
        )
    for run in _RUNS.value:
        cli_flags.check_run(Path(run))


def _drawer_of_runs(folder: Path) -> Callable[[Path], None]:
    """Reads samples and weights of all runs along one ray, and returns a function that draws them.

    Raises:
      ValueError: if a run is of another scene, or the view or the pixel does not exist.
    """
    frames = scene_folder.read_frames(folder, _SPLIT.value)
    (view,) = view_numbers.choose(str(_VIEW.value), len(frames.names))
    width, height = frames.cameras.width, frames.cameras.height
    column, row = view_numbers.parse_pixel(_PIXEL.value) or (width // 2, height // 2)
    if column >= width or row >= height:
        raise ValueError(
            f"--pixel={column},{row} is outside the image. Choose a column below {width} and a row "
            f"below {height}."
        )
    ray = ray_samples.pixel_ray(frames.cameras, view, column, row)
    panels = []
    for run in map(Path, _RUNS.value):
        config = run_folder.read_config(run)
        if scene_names.of_folder(Path(config.scene.path)) != scene_names.of_folder(folder):
            raise ValueError(
                f"{run} was trained on {config.scene.path}, not on {folder}. Give its --scene."
            )
        name = run.parent.name if run.name == "run" else run.name  # as in a benchmark
        title = f"{_LOSSES[config.losses.distortion_over]}\n{name}"
        samples = ray_samples.sample_ray(checkpoint_io.load_model(run), ray)
        panels.append(ray_samples.Panel(title, samples))
    return lambda path: ray_samples.write(path, panels)


if __name__ == "__main__":
    app.run(main, again="existing figures are only replaced with --overwrite.")
