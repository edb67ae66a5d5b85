"""Measures what light paths cost and what they give: the speed-accuracy curve.

python -m experiments.path_trade_off --scenes=experiments/data/cube_smcvx_ball --out=runs/paths

Renders views of scenes with a known background, as `experiments.render_known` does, once for every
value of --cuts at the tree's bends, once for every value of --bends at its cut, and with the
straight and the paper's paths. Writes a CSV, one row a rendering, and two figures: decibels inside
the mask against ray casts and against time. Casts, paths and seconds are of one camera ray a pixel.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import (
    command_line,
    commands,
    known_options,
    options,
    output_folders,
    scene_option,
    scenes,
    view_numbers,
)
from experiments.cli.late_imports import late
from refref_jax.data import scene_names
from refref_jax.optics import budgets
from refref_jax.optics.budgets import BUDGETS, Budget

if TYPE_CHECKING:
    from experiments.runs import known_scene as known_scenes
    from experiments.runs.known_scene import KnownScene
    from experiments.sweeps import paths
    from experiments.sweeps.paths import Setting, Trial
else:
    known_scenes = late("experiments.runs.known_scene")
    paths = late("experiments.sweeps.paths")

_SCENES = flags.DEFINE_list(
    "scenes", None, f"Scenes, with commas: each {options.SCENE_FORMS}.", required=True
)
_CUTS = flags.DEFINE_list(
    "cuts",
    ["0.2", "0.1", "0.05", "0.04", "0.03", "0.02", "0.01", "0.005", "0.002"],
    "Smallest throughputs worth following.",
)
_BENDS = flags.DEFINE_list(
    "bends", ["1", "2", "4", "6", "10", "16", "24", "32"], "Most bends of a path."
)
_VIEWS = flags.DEFINE_string("views", "0,10", "Numbers of views of the split, as 0,10, or all.")
command_line.check(_VIEWS, view_numbers.parse)
flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(known_options)
_OUT = options.out("Folder to write to.")
_OVERWRITE = options.overwrite("the curves of an earlier call")

_TABLE = "path_trade_off.csv"
_WRITES = (_TABLE, *(f"path_trade_off_{sweep}.png" for sweep in ("cut", "bends")))


def main() -> None:
    """Renders all scenes with all budgets."""
    out = Path(_OUT.value)
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    output_folders.replaceable(out, **place)
    budgets, indices = chosen_budgets(), scenes.given_indices()
    # All scenes first: a broken one is named before anything is rendered.
    chosen = [_read(folder, indices) for folder in _open_scenes()]
    with output_folders.fresh(out, **place) as draft:
        trials = _measure(chosen, [paths.Setting(*each) for each in budgets])
        paths.write_table(draft / _TABLE, trials)
        pictures = [out / path.name for path in paths.write_figures(draft, trials)]
    print(f"Figures:  {', '.join(map(str, pictures))}")
    print(f"Measures: {out / _TABLE}")
    print("Next: choose a cut, and render with python -m experiments.render_known --cut=...")


def _measure(chosen: list[KnownScene], plan: list[Setting]) -> list[Trial]:
    """Measures all there is to, with a bar of progress."""
    trials: list[Trial] = []
    side = options.side_of(known_options.RAYS_PER_PIXEL.value)
    with commands.ProgressBar("trade-off", len(chosen) * len(plan)) as bar:
        for trial in paths.measure_all(chosen, plan, side):
            trials.append(trial)
            bar.show(
                len(trials),
                f"{trial.scene} {trial.name}: {trial.psnr_masked:.1f} dB, "
                f"{trial.casts_per_pixel:.2f} casts",
            )
    return trials


def _open_scenes() -> list[Path]:
    """Refuses no scene at all, and names that plot and table could not tell apart."""
    scene_option.check_all(_SCENES.value)
    folders = [scene_option.opened(scene) for scene in _SCENES.value]
    names = [scene_names.of_folder(folder) for folder in folders]
    if not names:
        raise ValueError("No scene is given. Add --scenes=FOLDER,FOLDER.")
    if len(set(names)) < len(names):
        raise ValueError(
            f"Two of the scenes have the same name: {', '.join(names)}. Rename a folder, or leave "
            "one out."
        )
    return folders


def chosen_budgets() -> list[tuple[str, str, Budget]]:
    """Returns sweep, name and budget of all settings to try; equal ones are in both sweeps."""
    cuts = sorted(_numbers("cuts", _CUTS.value, float), reverse=True)
    bends = sorted(_numbers("bends", _BENDS.value, int))
    swept = [("cut", f"{cut:g}", budgets.budget_of("tree", cut=cut)) for cut in cuts]
    swept += [("bends", str(n), budgets.budget_of("tree", bends=n)) for n in bends]
    points = [("budget", name, BUDGETS[name]) for name in ("straight", "paper")]
    return points + swept


def _read(folder: Path, indices: dict[str, float]) -> KnownScene:
    scene = known_scenes.read_scene(
        folder,
        split=known_options.SPLIT.value,
        views=_VIEWS.value,
        rule=scenes.RULE.value,
        indices=indices,
    )
    if scene.masks is None:
        raise ValueError(
            f"The views of {folder} have no masks, inside which the error is measured. Add "
            "mask_file_path to each frame of its transforms file."
        )
    return scene


def _numbers(option: str, words: list[str], kind: type) -> list:
    try:
        return [kind(word) for word in words]
    except ValueError as error:
        raise ValueError(
            f"--{option}={','.join(words)} is not a list of numbers. Write them with commas."
        ) from error


command_line.check(_CUTS, lambda words: _numbers("cuts", words, float))
command_line.check(_BENDS, lambda words: _numbers("bends", words, int))


if __name__ == "__main__":
    commands.run(main, again="it measures anew; --overwrite replaces the curves.")
