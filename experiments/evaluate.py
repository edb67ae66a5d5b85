"""Renders a split of a scene with a trained model, and measures it.

python -m experiments.evaluate --run=runs/ball --split=test --rays_per_pixel=4

With several rays a pixel colours are averaged as linear light, and a pixel's distance is the median
of its rays'; see `refref_jax.render.supersampling`. What each metric is tells `docs/metrics.md`.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar

if TYPE_CHECKING:
    from jaxtyping import Float

    from refref_jax.render import Model

with epy.lazy_imports():
    import numpy as np

    from experiments.figures import comparison as figures
    from experiments.r3f import provenance
    from experiments.runs import perceptual as perceptual_metrics
    from refref_jax.data import files, scene_names
    from refref_jax.geometry import cameras
    from refref_jax.render import dyes, first_surface, saved, supersampling
    from refref_jax.training import evaluation as measures
    from refref_jax.training import run_folder

_RUN = cli_flags.run()
_SPLIT = cli_flags.split("Images to render.")
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(1)
_LIMIT = cli_flags.limit()
_STEP = cli_flags.step()
_SCENE = cli_flags.scene("The scene, if it has moved", required=False)
_CHUNK = cli_flags.chunk()
_OVERWRITE = cli_flags.overwrite("an earlier evaluation of that split")
_LPIPS_WEIGHTS = cli_flags.lpips_weights()

_WRITES = ("rgb", "distance", "metrics.json", "comparison.png")

_METHODS = {"paper": "oracle"}
_RECONSTRUCTED = {"paper": "r3f", "tree": "r3f_tree"}

_VIEWS_IN_COMPARISON = 4

# A share of light that 8 bits may show.
_WORTH_A_WARNING = 1e-3


def main() -> None:
    """Evaluates a run."""
    run = Path(_RUN.value)
    out = run / "eval" / _SPLIT.value
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    cli_flags.check_run(run)
    cli_scenes.check(_SCENE.value)
    perceptual = perceptual_metrics.chosen(_LPIPS_WEIGHTS.value)
    config = run_folder.read_config(run)
    # Resolved first, and once: training may be going on.
    step = _STEP.value if _STEP.value is not None else saved.latest_step(run)
    model = saved.load_model(run, step=step)
    scene = cli_scenes.opened(_SCENE.value or config.scene.path)
    truth = measures.read_truth(scene, _SPLIT.value)
    told = {
        "scene": scene_names.of_folder(scene),
        "method": _method(run, config.paths),
        "step": step,
        "rays_per_pixel": _RAYS_PER_PIXEL.value,
    }
    with outputs.fresh(out, **place) as draft:
        per_image, views = evaluate(model, truth, draft, perceptual)
        summary = told | _summary(per_image, model)
        text = json.dumps(app.string_safe(summary), indent=2, allow_nan=False)
        (draft / "metrics.json").write_text(text + "\n", encoding="utf-8")
        figures.write_comparison(draft / "comparison.png", views)
    for key, value in summary["results"].items():
        print(f"{key:>24}  {'-' if value is None else format(value, '.4f')}")
    if summary["results"]["lost"] > _WORTH_A_WARNING:
        print(
            "warning: some light found no room, and is missing from the pictures. Train with a "
            "larger --cut or fewer --bends."
        )
    print(f"Pictures: {out / 'comparison.png'}, {out / 'rgb'}, {out / 'distance'}")
    print(f"Metrics:  {out / 'metrics.json'}")
    print(f"Next: {app.shell('render', f'--run={run}', '--views=orbit')}")


def _summary(per_image: list[dict[str, Any]], model: Model) -> dict[str, Any]:
    """Returns the means over all images, what the model has learned of colours, and each image."""
    results = {key: measures.mean_of(per_image, key) for key in per_image[0] if key != "name"}
    results["seconds_per_image"] = results.pop("seconds")
    return {"results": results, "learned": learned_colours(model), "per_image": per_image}


def _method(run: Path, paths: str) -> str:
    """Returns what a run's geometry and light paths are called together."""
    names = _METHODS if provenance.read(run) is None else _RECONSTRUCTED
    return names.get(paths, paths)


def learned_colours(model: Model) -> dict[str, Any] | None:
    """Returns tints and absorptions of all parts, in the order of their file names, if learned."""
    colours = model.params.dyes
    if colours is None:
        return None
    absorptions = dyes.absorptions(colours, model.config.radius)
    return {
        "tints": np.asarray(dyes.tints(colours), float).round(4).tolist(),
        "absorptions": np.asarray(absorptions, float).round(4).tolist(),
    }


def evaluate(
    model: Model, truth: measures.Truth, out: Path, perceptual: measures.Perceptual
) -> tuple[list[dict[str, Any]], list[figures.Comparison]]:
    """Renders and measures each image, and writes what was rendered."""
    for folder in ("rgb", "distance"):
        (out / folder).mkdir()
    count = len(truth.images)
    chosen = np.unique(np.linspace(0, count - 1, min(_LIMIT.value or count, count)).astype(int))
    shown = set(chosen[np.linspace(0, chosen.size - 1, _VIEWS_IN_COMPARISON).astype(int)])
    per_image, views = [], []
    seen_by, chunk = truth.frames.cameras, _CHUNK.value
    side = cli_flags.side_of(_RAYS_PER_PIXEL.value)
    supersampling.warm_up(model, seen_by, chunk=chunk)
    with ProgressBar("evaluate", chosen.size) as bar:
        for i in chosen:
            name = truth.frames.names[i]
            start = time.monotonic()
            seen = supersampling.render_view(model, seen_by, i, side=side, chunk=chunk)
            seconds = time.monotonic() - start
            files.write_rgb(out / "rgb" / f"{name}.png", seen.rgb)
            files.write_exr(out / "distance" / f"{name}.exr", seen.distance)
            first = first_distances(model, seen_by, i)
            measured = measures.measure(seen, truth, i, first=first, perceptual=perceptual)
            per_image.append({"name": name, **measured, "seconds": seconds})
            if i in shown:
                target = truth.images[i] / 255.0
                views.append(figures.Comparison(name, target, seen.rgb, seen.distance))
            bar.show(len(per_image), f"{name}  PSNR {per_image[-1]['psnr']:.2f}")
    return per_image, views


def first_distances(
    model: Model, seen_by: cameras.Cameras, i: int
) -> Float[np.ndarray, "h w"] | None:
    """Returns the distance of the first surface that bends light, by the centres of pixels."""
    if model.budget.bends == 0:
        return None
    rays = cameras.image_rays(seen_by, i)
    return first_surface.find_first_surface(model.geometry.surfaces, rays).distances


if __name__ == "__main__":
    app.run(main, again="it evaluates anew; --overwrite replaces the results.")
