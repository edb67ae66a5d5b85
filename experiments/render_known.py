"""Renders a scene with a known background, without any training, and computes metrics.

python -m experiments.render_known --scene=experiments/data/cube_smcvx_ball --out=runs/known

`scene.json` must define the background. The remaining error is that of the light paths. The JSON
file contains the PSNR in dB over the image, inside the mask and outside, for each view and as means
over the views. For all views together it contains `casts_per_pixel` and `paths_per_pixel`, the
number of ray casts and light paths per camera ray, which does not depend on --rays_per_pixel;
`seconds`, the time to render them, without compiling, reading and writing; and `dropped`, the share
of the throughput that was dropped because buffers were full or, with --truncated_paths=black,
because paths were truncated.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.runs import refraction_indices
from refref_jax import choices, configuration
from refref_jax.optics import path_settings
from refref_jax.optics.path_settings import PATH_PRESETS, PathSettings

if TYPE_CHECKING:
    from experiments.runs.known_scene import KnownScene, View

with epy.lazy_imports():
    import numpy as np

    from experiments.figures import comparison
    from experiments.runs import evaluation as reporting
    from experiments.runs import known_scene
    from refref_jax.data import image_files
    from refref_jax.training import evaluation

_SCENE = cli_flags.scene("The scene")
_OUT = cli_flags.out("Folder for the images.")
_PATHS = flags.DEFINE_enum(
    "paths",
    "tree",
    list(PATH_PRESETS),
    "Light paths: 'straight' ignores the objects; 'paper' bends up to 10 times and reflects at the "
    "first surface; 'tree' follows every branch above the throughput threshold.",
)
_TRUNCATED_PATHS = cli_flags.enum(
    "truncated_paths",
    "background",
    ["background", "black"],
    "Paths that reach the maximum of bends: 'background' ends them on the background along their "
    "last direction; 'black' makes them black, as in path tracers.",
    formerly=path_settings.FORMER_TRUNCATION,
)
cli_flags.alias("unfinished", "truncated_paths")
_VIEWS = cli_flags.views("all")
_SETTINGS = cli_flags.settings()
_RULE = cli_flags.rule()
_PROPERTIES = cli_flags.properties()
_IOR = cli_flags.ior()
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(9)
_SPLIT = cli_flags.split("Views to render.")
_JSON = flags.DEFINE_string("json", None, "File for the metrics; {out}/metrics.json by default.")
_OVERWRITE = cli_flags.overwrite("an earlier rendering in that folder")

_WRITES = ("rgb", "comparison.png", "metrics.json")

# Keys that identify a file of this command.
_KEYS = {"scene", "paths", "views", "casts_per_pixel"}
cli_flags.allow_outside()


def main() -> None:
    """Renders and measures the selected views."""
    out = Path(_OUT.value)
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    metrics_file = None if _JSON.value is None else Path(_JSON.value)
    _check(metrics_file)
    settings = _chosen_settings()
    indices, folder = refraction_indices.parse_named(_IOR.value), cli_scenes.opened(_SCENE.value)
    scene = known_scene.read_scene(
        folder,
        split=_SPLIT.value,
        views=_VIEWS.value,
        rule=_RULE.value,
        indices=indices,
        overlay=_PROPERTIES.value,
    )
    with outputs.fresh(out, **place) as draft:
        summary = render(scene, settings, draft)
        text = json.dumps(configuration.string_safe(summary), indent=2, allow_nan=False) + "\n"
        if metrics_file is None:
            (draft / "metrics.json").write_text(text, encoding="utf-8")
    if metrics_file is not None:
        with outputs.fresh_file(metrics_file, overwrite=_OVERWRITE.value) as path:
            path.write_text(text, encoding="utf-8")
    _report(summary)
    print(f"Images:   {out / 'comparison.png'}, {out / 'rgb'}")
    print(f"Metrics:  {metrics_file or out / 'metrics.json'}")
    given = (f"--scenes={_SCENE.value}", f"--out={out}_trade_off")
    print(f"Next: {app.shell('path_trade_off', *given)}")


def render(scene: KnownScene, settings: PathSettings, out: Path) -> dict[str, Any]:
    """Renders and measures all views, writes the images, and returns the JSON content."""
    views, measured = [], []
    side = choices.side_of(_RAYS_PER_PIXEL.value)
    (out / "rgb").mkdir()
    print(f"Compiling for {scene.name}, {_PATHS.value} ...", flush=True)
    known_scene.warm_up(scene, settings)
    with ProgressBar("render", len(scene.indices)) as bar:
        for i, (index, name) in enumerate(zip(scene.indices, scene.frames.names, strict=True)):
            view = known_scene.render_view(scene, i, settings=settings, side=side)
            image_files.write_rgb(out / "rgb" / f"{name}.png", view.rgb)
            found = known_scene.measure(scene, i, view.rgb)
            views.append(view)
            measured.append({"index": index, "name": name, **found})
            bar.show(i + 1, f"{name}  PSNR {found['psnr']:.2f}")
    compared = [
        comparison.Comparison(scene.frames.names[i], scene.images[i] / 255.0, views[i].rgb)
        for i in reporting.shown_views(len(views))
    ]
    comparison.write_comparison(out / "comparison.png", compared)
    return summarise(scene, settings, views, measured)


def summarise(
    scene: KnownScene, settings: PathSettings, views: list[View], measured: list[dict[str, Any]]
) -> dict[str, Any]:
    """Returns the JSON content."""
    keys = ("psnr", "psnr_masked", "psnr_outside")
    return {
        "scene": scene.name,
        "paths": _PATHS.value,
        "min_throughput": settings.min_throughput,
        "max_bends": settings.max_bends,
        "truncated_paths": settings.truncated_paths,
        "views": measured,
        "mean": {key: evaluation.mean_of(measured, key) for key in keys},
        "casts_per_pixel": float(np.mean([view.casts for view in views])),
        "paths_per_pixel": float(np.mean([view.paths for view in views])),
        "seconds": sum(view.seconds for view in views),
        "dropped": float(np.mean([view.dropped for view in views])),
    }


def _chosen_settings() -> PathSettings:
    if _PATHS.value == "straight" and _TRUNCATED_PATHS.value == "black":
        raise ValueError(
            "--paths=straight has no bends, so no path is truncated. Remove --truncated_paths, or "
            "use --paths=tree."
        )
    return dataclasses.replace(
        _SETTINGS.chosen(_PATHS.value), truncated_paths=_TRUNCATED_PATHS.value
    )


def _check(metrics_file: Path | None) -> None:
    """Rejects a metrics file that was written by another program."""
    if metrics_file is None:
        return
    if metrics_file.is_file() and not _is_ours(metrics_file):
        raise ValueError(
            f"{metrics_file} is not from this command. Remove it, or give another --json."
        )
    outputs.check_file(metrics_file, overwrite=_OVERWRITE.value)


def _is_ours(path: Path) -> bool:
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8"))
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
    print(f"{'dropped':>16}  {summary['dropped']:.2g}")
    if summary["truncated_paths"] == "black":
        print("dropped: truncated paths, and paths dropped because buffers were full, if any.")
    else:
        reporting.warn_of_dropped(
            summary["dropped"],
            advice="Use a larger --min_throughput or a smaller --max_bends, or, as a library, "
            "PathSettings with larger capacity factors.",
        )


if __name__ == "__main__":
    app.run(
        main,
        again="repeat the command to render again; --overwrite replaces the results.",
    )
