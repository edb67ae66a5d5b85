"""Measures the cost and the accuracy of light paths: the speed-accuracy curve.

python -m experiments.path_trade_off --scenes=experiments/data/cube_smcvx_ball --out=runs/paths

Renders views of scenes with a known background, like `experiments.render_known`: for every value of
--min_throughputs with the tree's max bends, for every value of --max_bends with the tree's
threshold, and with straight rays and the paper's paths. Writes a CSV with one row per rendering,
and two figures: masked PSNR over ray casts and over time. Casts, paths and seconds are those of one
camera ray per pixel.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.runs import refraction_indices
from refref_jax import choices
from refref_jax.data import scene_names
from refref_jax.optics import path_settings
from refref_jax.optics.path_settings import PATH_PRESETS, PathSettings

if TYPE_CHECKING:
    from experiments.runs.known_scene import KnownScene
    from experiments.sweeps.paths import Setting, Trial

with epy.lazy_imports():
    from experiments.runs import known_scene
    from experiments.sweeps import paths

_SCENES = flags.DEFINE_list(
    "scenes", None, f"Scenes, separated by commas: each {cli_flags.SCENES_FORMS}.", required=True
)
_THRESHOLDS = flags.DEFINE_list(
    "min_throughputs",
    ["0.2", "0.1", "0.05", "0.04", "0.03", "0.02", "0.01", "0.005", "0.002"],
    "Throughput thresholds.",
)
_MAX_BENDS = flags.DEFINE_list(
    "max_bends", ["1", "2", "4", "6", "10", "16", "24", "32"], "Maximum numbers of bends."
)
cli_flags.alias("cuts", "min_throughputs")
cli_flags.alias("bends", "max_bends")
_VIEWS = cli_flags.views("0,10")
_RULE = cli_flags.rule()
_PROPERTIES = cli_flags.properties()
_IOR = cli_flags.ior()
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(9)
_SPLIT = cli_flags.split("Views to render.")
_OUT = cli_flags.out("Folder to write to.")
_OVERWRITE = cli_flags.overwrite("the curves of an earlier call")

_TABLE = "path_trade_off.csv"
_WRITES = (_TABLE, *(f"path_trade_off_{sweep}.png" for sweep in ("min_throughput", "max_bends")))
cli_flags.allow_outside()


def main() -> None:
    """Renders all scenes with all path settings."""
    out = Path(_OUT.value)
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    settings, indices = chosen_settings(), refraction_indices.parse_named(_IOR.value)
    # All scenes are opened first, so that a broken one is reported before anything is rendered.
    chosen = [_read(folder, indices) for folder in _open_scenes()]
    with outputs.fresh(out, **place) as draft:
        trials = _measure(chosen, [paths.Setting(*each) for each in settings])
        paths.write_table(draft / _TABLE, trials)
        images = [out / path.name for path in paths.write_figures(draft, trials)]
    print(f"Figures:  {', '.join(map(str, images))}")
    print(f"Measures: {out / _TABLE}")
    print(
        "Next: choose a threshold, and use python -m experiments.render_known --min_throughput=..."
    )


def _measure(chosen: list[KnownScene], plan: list[Setting]) -> list[Trial]:
    """Measures all combinations, with a progress bar."""
    trials: list[Trial] = []
    side = choices.side_of(_RAYS_PER_PIXEL.value)
    with ProgressBar("trade-off", len(chosen) * len(plan)) as bar:
        for trial in paths.measure_all(chosen, plan, side):
            trials.append(trial)
            bar.show(
                len(trials),
                f"{trial.scene} {trial.name}: {trial.psnr_masked:.1f} dB, "
                f"{trial.casts_per_pixel:.2f} casts",
            )
    return trials


def _open_scenes() -> list[Path]:
    """Rejects an empty list of scenes, and scenes of the same name."""
    cli_scenes.check_all(_SCENES.value)
    folders = [cli_scenes.opened(scene) for scene in cli_scenes.expanded(_SCENES.value)]
    names = [scene_names.of_folder(folder) for folder in folders]
    if not names:
        raise ValueError("No scene is given. Add --scenes=FOLDER,FOLDER.")
    if len(set(names)) < len(names):
        raise ValueError(
            f"Two of the scenes have the same name: {', '.join(names)}. Rename a folder, or remove "
            "one."
        )
    return folders


def chosen_settings() -> list[tuple[str, str, PathSettings]]:
    """Returns sweep, name and path settings of all trials; equal ones are in both sweeps."""
    thresholds = sorted(_numbers("min_throughputs", _THRESHOLDS.value, float), reverse=True)
    most = sorted(_numbers("max_bends", _MAX_BENDS.value, int))
    swept = [
        ("min_throughput", f"{x:g}", path_settings.make_path_settings("tree", min_throughput=x))
        for x in thresholds
    ]
    swept += [
        ("max_bends", str(n), path_settings.make_path_settings("tree", max_bends=n)) for n in most
    ]
    points = [("settings", name, PATH_PRESETS[name]) for name in ("straight", "paper")]
    return points + swept


def _read(folder: Path, indices: dict[str, float]) -> KnownScene:
    scene = known_scene.read_scene(
        folder,
        split=_SPLIT.value,
        views=_VIEWS.value,
        rule=_RULE.value,
        indices=indices,
        overlay=_PROPERTIES.value,
    )
    if scene.masks is None:
        raise ValueError(
            f"The views of {folder} have no masks, which the error requires. Add mask_file_path to "
            "each frame of its transforms file."
        )
    return scene


def _numbers(option: str, words: list[str], kind: type) -> list:
    try:
        return [kind(word) for word in words]
    except ValueError as error:
        raise ValueError(
            f"--{option}={','.join(words)} is not a list of numbers. Separate them by commas."
        ) from error


app.check(_THRESHOLDS, lambda words: _numbers("min_throughputs", words, float))
app.check(_MAX_BENDS, lambda words: _numbers("max_bends", words, int))


if __name__ == "__main__":
    app.run(main, again="repeat the command to measure again; --overwrite replaces the curves.")
