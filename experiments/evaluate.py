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

from absl import flags

from experiments.cli import (
    commands,
    options,
    output_folders,
    perceptual_option,
    run_option,
    scene_option,
)
from experiments.cli.late_imports import late

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from experiments.figures import comparison as figures
    from experiments.r3f import provenance
    from refref_jax.data import files, scene_names
    from refref_jax.geometry import cameras
    from refref_jax.render import Model, dyes, first_surface, saved, supersampling
    from refref_jax.training import evaluation as measures
    from refref_jax.training import run_folder
else:
    np = late("numpy")
    figures = late("experiments.figures.comparison")
    measures = late("refref_jax.training.evaluation")
    supersampling = late("refref_jax.render.supersampling")
    provenance = late("experiments.r3f.provenance")
    cameras = late("refref_jax.geometry.cameras")
    files = late("refref_jax.data.files")
    scene_names = late("refref_jax.data.scene_names")
    dyes = late("refref_jax.render.dyes")
    first_surface = late("refref_jax.render.first_surface")
    saved = late("refref_jax.render.saved")
    run_folder = late("refref_jax.training.run_folder")

_RUN = options.run()
_SPLIT = options.split("Images to render.")
_RAYS_PER_PIXEL = options.rays_per_pixel(1)
_LIMIT = options.limit()
_STEP = options.step()
_SCENE = options.moved_scene()
_CHUNK = options.chunk()
_OVERWRITE = options.overwrite("an earlier evaluation of that split")
flags.adopt_module_key_flags(perceptual_option)

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
    output_folders.replaceable(out, **place)
    run_option.check(run)
    scene_option.check(_SCENE.value)
    perceptual = perceptual_option.chosen()
    config = run_folder.read_config(run)
    # Resolved first, and once: training may be going on.
    step = _STEP.value if _STEP.value is not None else saved.latest_step(run)
    model = saved.load_model(run, step=step)
    scene = scene_option.opened(_SCENE.value or config.scene.path)
    truth = measures.read_truth(scene, _SPLIT.value)
    told = {
        "scene": scene_names.of_folder(scene),
        "method": _method(run, config.paths),
        "step": step,
        "rays_per_pixel": _RAYS_PER_PIXEL.value,
    }
    with output_folders.fresh(out, **place) as draft:
        per_image, views = evaluate(model, truth, draft, perceptual)
        summary = told | _summary(per_image, model)
        text = json.dumps(commands.string_safe(summary), indent=2, allow_nan=False)
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
    print(f"Next: {commands.shell('render', f'--run={run}', '--views=orbit')}")


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
    side = options.side_of(_RAYS_PER_PIXEL.value)
    supersampling.warm_up(model, seen_by, chunk=chunk)
    with commands.ProgressBar("evaluate", chosen.size) as bar:
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
    commands.run(main, again="it evaluates anew; --overwrite replaces the results.")
