"""Renders a scene whose background is known, with no learning, and measures it.

python -m experiments.render_known --scene=experiments/data/cube_smcvx_ball --out=runs/known

`scene.json` must tell the background. What is left of the error is that of the light paths. The
JSON holds, for each view and as the mean over views, the PSNR in dB over the image, inside the
mask and outside; `casts_per_pixel` and `paths_per_pixel`, which count ray casts and light paths of
one camera ray, so that they do not depend on --rays_per_pixel; `seconds`, that rendering all views
took, without compiling, reading and writing; and `lost_energy`, the share of light that found no
room.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from experiments import (
    budget_options,
    commands,
    figures,
    known_scenes,
    scene_option,
    scenes,
    supersampling,
)
from experiments.known_scenes import KnownScene, View
from experiments.measures import mean_of
from refref_jax.data import files
from refref_jax.optics.budgets import BUDGETS, Budget

_SCENE = flags.DEFINE_string("scene", None, f"The scene: {scene_option.FORMS}.", required=True)
_PATHS = flags.DEFINE_enum(
    "paths",
    "tree",
    list(BUDGETS),
    "Light paths: 'straight' ignores the objects; 'paper' bends up to 10 times and reflects at the "
    "first surface; 'tree' follows every branch that carries light.",
)
_VIEWS = flags.DEFINE_string("views", "all", "Numbers of views of the split, as 0,10,20, or all.")
flags.adopt_module_key_flags(budget_options)
flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(known_scenes)
_OUT = flags.DEFINE_string("out", None, "Folder to write the pictures to.", required=True)
_JSON = flags.DEFINE_string("json", None, "File for the measures; {out}/metrics.json by default.")

_VIEWS_IN_COMPARISON = 4

# A share of light that 8 bits may show.
_WORTH_A_WARNING = 1e-3

# Marks a folder whose pictures this command wrote, and may replace.
_OWN = ".render_known"

# By what a file of ours is known.
_KEYS = {"scene", "paths", "views", "casts_per_pixel"}


def main() -> None:
    """Renders and measures the chosen views."""
    budget = budget_options.chosen(_PATHS.value)
    side = supersampling.side_of(known_scenes.RAYS_PER_PIXEL.value)
    scene = known_scenes.read_scene(
        scene_option.opened(_SCENE.value),
        split=known_scenes.SPLIT.value,
        views=_VIEWS.value,
        rule=scenes.RULE.value,
        indices=scenes.given_indices(),
    )
    out = Path(_OUT.value)
    metrics_file = Path(_JSON.value) if _JSON.value else out / "metrics.json"
    _prepare(out, metrics_file)
    views, measures = render(scene, budget, side, out)
    shown = np.unique(np.linspace(0, len(views) - 1, _VIEWS_IN_COMPARISON).astype(int))
    figures.write_comparison(
        out / "comparison.png",
        [
            figures.Comparison(scene.frames.names[i], scene.images[i] / 255.0, views[i].rgb)
            for i in shown
        ],
    )
    summary = summarise(scene, budget, views, measures)
    text = json.dumps(commands.string_safe(summary), indent=2, allow_nan=False)
    metrics_file.write_text(text + "\n", encoding="utf-8")
    _report(summary)
    print(f"Pictures: {out / 'comparison.png'}, {out / 'rgb'}")
    print(f"Metrics:  {metrics_file}")
    options = (f"--scenes={_SCENE.value}", f"--out={out / 'trade_off'}")
    print(f"Next: {commands.shell('path_trade_off', *options)}")


def render(
    scene: KnownScene, budget: Budget, side: int, out: Path
) -> tuple[list[View], list[dict[str, Any]]]:
    """Renders and measures all views, and writes the pictures."""
    views, measures = [], []
    print(f"Compiling for {scene.name}, {_PATHS.value} ...", flush=True)
    known_scenes.warm_up(scene, budget)
    with commands.ProgressBar("render", len(scene.indices)) as bar:
        for i, (index, name) in enumerate(zip(scene.indices, scene.frames.names, strict=True)):
            view = known_scenes.render_view(scene, i, budget=budget, side=side)
            files.write_rgb(out / "rgb" / f"{name}.png", view.rgb)
            measured = known_scenes.measure(scene, i, view.rgb)
            views.append(view)
            measures.append({"index": index, "name": name, **measured})
            bar.show(i + 1, f"{name}  PSNR {measured['psnr']:.2f}")
    return views, measures


def summarise(
    scene: KnownScene, budget: Budget, views: list[View], measures: list[dict[str, Any]]
) -> dict[str, Any]:
    """Returns what the JSON holds."""
    keys = ("psnr", "psnr_masked", "psnr_outside")
    return {
        "scene": scene.name,
        "paths": _PATHS.value,
        "cut": budget.cut,
        "bends": budget.bends,
        "views": measures,
        "mean": {key: mean_of(measures, key) for key in keys},
        "casts_per_pixel": float(np.mean([view.casts for view in views])),
        "paths_per_pixel": float(np.mean([view.paths for view in views])),
        "seconds": sum(view.seconds for view in views),
        "lost_energy": float(np.mean([view.lost for view in views])),
    }


def _prepare(out: Path, metrics_file: Path) -> None:
    """Makes room for results; those of an earlier call go first, and it is said."""
    if metrics_file.exists() and not _is_ours(metrics_file):
        raise ValueError(
            f"{metrics_file} exists and is not of this command. Remove it, or give another --json."
        )
    (out / "rgb").mkdir(parents=True, exist_ok=True)
    metrics_file.parent.mkdir(parents=True, exist_ok=True)
    known = out / _OWN
    strangers = sorted((out / "rgb").glob("*.png"))
    if strangers and not known.exists():
        raise ValueError(
            f"{out / 'rgb'} holds pictures that are not of this command, as {strangers[0].name}. "
            "Give another --out, or remove them."
        )
    known.touch()
    # A file that can not be written is found now, not after the rendering.
    with metrics_file.open("a", encoding="utf-8"):
        pass
    if strangers:
        print(f"Replacing the results of an earlier rendering in {out}.")
    for path in strangers:
        path.unlink()
    metrics_file.unlink()


def _is_ours(path: Path) -> bool:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        return False
    return isinstance(content, dict) and set(content) >= _KEYS


def _report(summary: dict[str, Any]) -> None:
    for key in ("psnr", "psnr_masked", "psnr_outside"):
        value = summary["mean"][key]
        print(f"{key:>16}  {'-' if value is None else format(value, '.2f') + ' dB'}")
    for key in ("casts_per_pixel", "paths_per_pixel"):
        print(f"{key:>16}  {summary[key]:.3f}")
    print(f"{'seconds':>16}  {summary['seconds']:.2f}")
    print(f"{'lost_energy':>16}  {summary['lost_energy']:.2g}")
    if summary["lost_energy"] > _WORTH_A_WARNING:
        print(
            "warning: some light found no room, and is missing from the pictures. Give a larger "
            "--cut or fewer --bends, or, as a library, a Budget with larger capacity factors."
        )


if __name__ == "__main__":
    commands.run(main)
