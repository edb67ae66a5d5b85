"""Renders a split of a scene with a trained model, and measures it.

python -m experiments.evaluate --run=runs/ball --split=test --rays_per_pixel=4

With several rays a pixel colours are averaged as linear light, and a pixel's distance is the median
of its rays'; see `experiments.supersampling`. What each metric is tells `docs/metrics.md`.
"""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags
from jaxtyping import Float

from experiments import (
    commands,
    figures,
    measures,
    perceptual_option,
    scene_option,
    supersampling,
)
from experiments.measures import Perceptual, Truth
from experiments.r3f import provenance
from refref_jax.data import files, local_layout, scene_names
from refref_jax.data.cameras import Cameras, image_rays
from refref_jax.render import Model, dyes, load_model
from refref_jax.render.first_surface import find_first_surface
from refref_jax.render.saved import latest_step
from refref_jax.training import run_folder

_RUN = flags.DEFINE_string("run", None, "Folder of a trained run.", required=True)
_SPLIT = flags.DEFINE_enum("split", "test", list(local_layout.SPLITS), "Images to render.")
_STEP = flags.DEFINE_integer("step", None, "Checkpoint to use; the newest if not given.", 0)
_SCENE = flags.DEFINE_string("scene", None, f"The scene, if it has moved: {scene_option.FORMS}.")
_LIMIT = flags.DEFINE_integer("limit", None, "Only this many images, evenly spread.", 1)
_RAYS_PER_PIXEL = flags.DEFINE_integer(
    "rays_per_pixel", 1, "Rays in each pixel, a square: 1, 4, 9, 16. They are averaged."
)
_CHUNK = flags.DEFINE_integer("chunk", 4096, "Paths at once: lower it if memory runs out.", 1)
flags.adopt_module_key_flags(perceptual_option)

_METHODS = {"paper": "oracle"}
_RECONSTRUCTED = {"paper": "r3f", "tree": "r3f_tree"}

_VIEWS_IN_COMPARISON = 4

# A share of light that 8 bits may show.
_WORTH_A_WARNING = 1e-3


def main() -> None:
    """Evaluates a run."""
    side = supersampling.side_of(_RAYS_PER_PIXEL.value)
    run = Path(_RUN.value)
    perceptual = perceptual_option.chosen()
    config = run_folder.read_config(run)
    # Resolved first, and once: training may be going on.
    step = _STEP.value if _STEP.value is not None else latest_step(run)
    model = load_model(run, step=step)
    scene = scene_option.opened(_SCENE.value or config.scene.path)
    truth = measures.read_truth(scene, _SPLIT.value)
    out = run / "eval" / _SPLIT.value
    per_image, views = evaluate(model, truth, out, side, perceptual)
    summary = {
        "scene": scene_names.of_folder(scene),
        "method": _method(run, config.paths),
        "step": step,
        "rays_per_pixel": _RAYS_PER_PIXEL.value,
        "results": {key: measures.mean_of(per_image, key) for key in per_image[0] if key != "name"},
        "learned": learned_colours(model),
        "per_image": per_image,
    }
    summary["results"]["seconds_per_image"] = summary["results"].pop("seconds")
    text = json.dumps(commands.string_safe(summary), indent=2, allow_nan=False)
    (out / "metrics.json").write_text(text + "\n", encoding="utf-8")
    figures.write_comparison(out / "comparison.png", views)
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
    model: Model, truth: Truth, out: Path, side: int, perceptual: Perceptual
) -> tuple[list[dict[str, Any]], list[figures.Comparison]]:
    """Renders and measures each image, and writes what was rendered.

    Pictures of an earlier evaluation go first, so that all of a folder are of one checkpoint.
    """
    for folder, kind in (("rgb", "*.png"), ("distance", "*.exr")):
        (out / folder).mkdir(parents=True, exist_ok=True)
        for earlier in (out / folder).glob(kind):
            earlier.unlink()
    count = len(truth.images)
    chosen = np.unique(np.linspace(0, count - 1, min(_LIMIT.value or count, count)).astype(int))
    shown = set(chosen[np.linspace(0, chosen.size - 1, _VIEWS_IN_COMPARISON).astype(int)])
    per_image, views = [], []
    cameras, chunk = truth.frames.cameras, _CHUNK.value
    supersampling.warm_up(model, cameras, chunk=chunk)
    with commands.ProgressBar("evaluate", chosen.size) as bar:
        for i in chosen:
            name = truth.frames.names[i]
            start = time.monotonic()
            seen = supersampling.render_view(model, cameras, i, side=side, chunk=chunk)
            seconds = time.monotonic() - start
            files.write_rgb(out / "rgb" / f"{name}.png", seen.rgb)
            files.write_exr(out / "distance" / f"{name}.exr", seen.distance)
            first = first_distances(model, cameras, i)
            measured = measures.measure(seen, truth, i, first=first, perceptual=perceptual)
            per_image.append({"name": name, **measured, "seconds": seconds})
            if i in shown:
                target = truth.images[i] / 255.0
                views.append(figures.Comparison(name, target, seen.rgb, seen.distance))
            bar.show(len(per_image), f"{name}  PSNR {per_image[-1]['psnr']:.2f}")
    return per_image, views


def first_distances(model: Model, cameras: Cameras, i: int) -> Float[np.ndarray, "h w"] | None:
    """Returns the distance of the first surface that bends light, by the centres of pixels."""
    if model.budget.bends == 0:
        return None
    return find_first_surface(model.geometry.surfaces, image_rays(cameras, i)).distances


if __name__ == "__main__":
    commands.run(main)
