"""Measures what light paths cost and what they give: the speed-accuracy curve.

python -m experiments.path_trade_off --scenes=experiments/data/cube_smcvx_ball --out=runs/paths

Renders views of scenes with a known background, as `experiments.render_known` does, once for every
value of --cuts at the tree's bends, once for every value of --bends at its cut, and with the
straight and the paper's paths. Writes a CSV, one row a rendering, and two figures: decibels inside
the mask against ray casts and against time. Casts, paths and seconds are of one camera ray a pixel.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.runs import named_budgets, refraction_indices
from refref_jax.data import scene_names
from refref_jax.optics.budgets import BUDGETS, Budget

if TYPE_CHECKING:
    from experiments.runs.known_scene import KnownScene
    from experiments.sweeps.path_figures import Trial

with epy.lazy_imports():
    import numpy as np

    from experiments.runs import known_scene as known_scenes
    from experiments.sweeps import path_figures
    from refref_jax.training import evaluation as measures

_SCENES = flags.DEFINE_list(
    "scenes", None, f"Scenes, with commas: each {cli_flags.SCENE_FORMS}.", required=True
)
_CUTS = flags.DEFINE_list(
    "cuts",
    ["0.2", "0.1", "0.05", "0.04", "0.03", "0.02", "0.01", "0.005", "0.002"],
    "Smallest throughputs worth following.",
)
_BENDS = flags.DEFINE_list(
    "bends", ["1", "2", "4", "6", "10", "16", "24", "32"], "Most bends of a path."
)
_VIEWS = cli_flags.views("0,10")
_RULE = cli_flags.rule()
_IOR = cli_flags.ior()
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(9)
_SPLIT = cli_flags.split("Views to render.")
_OUT = cli_flags.out("Folder to write to.")
_OVERWRITE = cli_flags.overwrite("the curves of an earlier call")

_TABLE = "path_trade_off.csv"
_WRITES = (_TABLE, *(f"path_trade_off_{sweep}.png" for sweep in ("cut", "bends")))


class Setting(NamedTuple):
    """One light budget of a sweep.

    Attributes:
      sweep: what it varies, `cut` or `bends`; `budget` for a point alone.
      name: how figures call it.
      budget: which light is followed.
    """

    sweep: str
    name: str
    budget: Budget


def main() -> None:
    """Renders all scenes with all budgets."""
    out = Path(_OUT.value)
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    plan, indices = settings(), refraction_indices.parse_named(_IOR.value)
    # All scenes first: a broken one is named before anything is rendered.
    chosen = [_read(folder, indices) for folder in _open_scenes()]
    with outputs.fresh(out, **place) as draft:
        trials = _measure(chosen, plan)
        _write(draft / _TABLE, trials)
        pictures = [out / path.name for path in path_figures.write(draft, trials)]
    print(f"Figures:  {', '.join(map(str, pictures))}")
    print(f"Measures: {out / _TABLE}")
    print("Next: choose a cut, and render with python -m experiments.render_known --cut=...")


def _measure(chosen: list[KnownScene], plan: list[Setting]) -> list[Trial]:
    """Measures all there is to, with a bar of progress."""
    trials: list[Trial] = []
    side = cli_flags.side_of(_RAYS_PER_PIXEL.value)
    with ProgressBar("trade-off", len(chosen) * len(plan)) as bar:
        for trial in measure_all(chosen, plan, side):
            trials.append(trial)
            bar.show(
                len(trials),
                f"{trial.scene} {trial.name}: {trial.psnr_masked:.1f} dB, "
                f"{trial.casts_per_pixel:.2f} casts",
            )
    return trials


def _open_scenes() -> list[Path]:
    """Refuses no scene at all, and names that plot and table could not tell apart."""
    cli_scenes.check_all(_SCENES.value)
    folders = [cli_scenes.opened(scene) for scene in _SCENES.value]
    names = [scene_names.of_folder(folder) for folder in folders]
    if not names:
        raise ValueError("No scene is given. Add --scenes=FOLDER,FOLDER.")
    if len(set(names)) < len(names):
        raise ValueError(
            f"Two of the scenes have the same name: {', '.join(names)}. Rename a folder, or leave "
            "one out."
        )
    return folders


def settings() -> list[Setting]:
    """Returns all budgets to try; equal ones are listed in both sweeps."""
    cuts = sorted(_numbers("cuts", _CUTS.value, float), reverse=True)
    bends = sorted(_numbers("bends", _BENDS.value, int))
    swept = [("cut", f"{cut:g}", named_budgets.make_budget("tree", cut=cut)) for cut in cuts]
    swept += [("bends", str(n), named_budgets.make_budget("tree", bends=n)) for n in bends]
    points = [("budget", name, BUDGETS[name]) for name in ("straight", "paper")]
    return [Setting(*each) for each in points + swept]


def measure_all(chosen: list[KnownScene], plan: list[Setting], side: int) -> Iterator[Trial]:
    """Renders every scene with every budget; equal budgets are rendered once."""
    for scene in chosen:
        known: dict[Budget, Trial] = {}
        for setting in plan:
            if setting.budget not in known:
                known[setting.budget] = measure_one(scene, setting, side)
            yield known[setting.budget]._replace(sweep=setting.sweep, name=setting.name)


def measure_one(scene: KnownScene, setting: Setting, side: int) -> Trial:
    """Renders all views of a scene with one budget."""
    known_scenes.warm_up(scene, setting.budget)
    views, measured = [], []
    for i in range(len(scene.indices)):
        view = known_scenes.render_view(scene, i, budget=setting.budget, side=side)
        views.append(view)
        measured.append(known_scenes.measure(scene, i, view.rgb))
    pixels = scene.frames.cameras.height * scene.frames.cameras.width * side**2
    return path_figures.Trial(
        scene=scene.name,
        sweep=setting.sweep,
        name=setting.name,
        cut=setting.budget.cut,
        bends=setting.budget.bends,
        psnr=measures.mean_of(measured, "psnr"),
        psnr_masked=measures.mean_of(measured, "psnr_masked"),
        psnr_outside=measures.mean_of(measured, "psnr_outside"),
        casts_per_pixel=float(np.mean([view.casts for view in views])),
        paths_per_pixel=float(np.mean([view.paths for view in views])),
        seconds_per_pixel=sum(view.seconds for view in views) / (pixels * len(views)),
        lost_energy=float(np.mean([view.lost for view in views])),
    )


def _read(folder: Path, indices: dict[str, float]) -> KnownScene:
    scene = known_scenes.read_scene(
        folder,
        split=_SPLIT.value,
        views=_VIEWS.value,
        rule=_RULE.value,
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


app.check(_CUTS, lambda words: _numbers("cuts", words, float))
app.check(_BENDS, lambda words: _numbers("bends", words, int))


def _write(path: Path, trials: list[Trial]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(path_figures.Trial._fields)
        writer.writerows(trials)


if __name__ == "__main__":
    app.run(main, again="it measures anew; --overwrite replaces the curves.")
