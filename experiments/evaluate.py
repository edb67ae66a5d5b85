"""Renders a split of a scene with a trained model, and computes metrics.

python -m experiments.evaluate --run=runs/ball --split=test --rays_per_pixel=4

With several rays per pixel, colours are averaged in linear radiance, and the distance of a pixel is
the median of its rays; see `refref_jax.render.images`. `docs/metrics.md` explains each metric.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from refref_jax import configuration

if TYPE_CHECKING:
    from refref_jax.render import Model

with epy.lazy_imports():
    from experiments.figures import comparison
    from experiments.r3f import object_source
    from experiments.runs import evaluation as reporting
    from experiments.runs import perceptual, residuals
    from refref_jax.data import image_files, scene_names
    from refref_jax.fields import registry
    from refref_jax.render import checkpoint_io
    from refref_jax.training import evaluation, run_folder

_RUN = cli_flags.run()
_SPLIT = cli_flags.split("Images to render.")
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(1)
_LIMIT = cli_flags.limit()
_STEP = cli_flags.step()
_SCENE = cli_flags.scene("The scene, if it has been moved", required=False)
_CHUNK = cli_flags.chunk()
_OVERWRITE = cli_flags.overwrite("an earlier evaluation of that split")
_LPIPS_WEIGHTS = cli_flags.lpips_weights()

_WRITES = ("rgb", "distance", "metrics.json", "comparison.png")

_METHODS = {"paper": "oracle"}
_RECONSTRUCTED = {"paper": "r3f", "tree": "r3f_tree"}
cli_flags.allow_outside()


def main() -> None:
    """Evaluates a run."""
    run = Path(_RUN.value)
    out = run / "eval" / _SPLIT.value
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    cli_flags.check_run(run)
    cli_scenes.check(_SCENE.value)
    lpips = perceptual.chosen(_LPIPS_WEIGHTS.value)
    config = run_folder.read_config(run)
    # Resolved once, at the start: the training may still be running.
    step = _STEP.value if _STEP.value is not None else checkpoint_io.latest_step(run)
    model = checkpoint_io.load_model(run, step=step)
    scene = cli_scenes.opened(_SCENE.value or config.scene.path)
    sources = {
        "scene": scene_names.of_folder(scene),
        "method": _method(run, config.paths.name, config.model.field),
        "step": step,
        "rays_per_pixel": _RAYS_PER_PIXEL.value,
    }
    with outputs.fresh(out, **place) as draft:
        found, views, told = evaluate(model, scene, draft, lpips)
        summary = sources | found._asdict() | {"warnings": told}
        text = json.dumps(configuration.string_safe(summary), indent=2, allow_nan=False)
        (draft / "metrics.json").write_text(text + "\n", encoding="utf-8")
        comparison.write_comparison(draft / "comparison.png", views)
    for key, value in summary["results"].items():
        print(f"{key:>24}  {'-' if value is None else format(value, '.4f')}")
    reporting.warn_of_dropped(
        summary["results"]["dropped"],
        advice="Train with a larger --min_throughput or a smaller --max_bends.",
    )
    for sentence in told:
        print(f"warning: {sentence}")
    print(f"Images:   {out / 'comparison.png'}, {out / 'rgb'}, {out / 'distance'}")
    print(f"Metrics:  {out / 'metrics.json'}")
    print(f"Next: {app.shell('render', f'--run={run}', '--views=orbit')}")


def _method(run: Path, paths: str, field: str) -> str:
    """Returns the name of a run's combination of geometry, light paths and kind of field."""
    names = _METHODS if object_source.read(run) is None else _RECONSTRUCTED
    name = names.get(paths, paths)
    if field == registry.USUAL:
        return name
    return field if paths == "straight" else f"{name}_{field}"


def evaluate(
    model: Model, scene: Path, out: Path, lpips: evaluation.Perceptual
) -> tuple[evaluation.Evaluation, list[comparison.Comparison], tuple[str, ...]]:
    """Evaluates a model, and writes each image as soon as it is rendered.

    Returns:
      The metrics, the views that are shown, and what the residuals look like.
    """
    for folder in ("rgb", "distance"):
        (out / folder).mkdir()
    views: list[comparison.Comparison] = []
    errors: list[residuals.Residuals] = []
    bars: list[ProgressBar] = []

    def write(view: evaluation.EvaluatedView) -> None:
        seen = view.rendering
        image_files.write_rgb(out / "rgb" / f"{view.name}.png", seen.rgb)
        image_files.write_exr(out / "distance" / f"{view.name}.exr", seen.distance)
        target = view.target / 255.0
        error = residuals.of_view(seen.rgb, target, view.mask)
        bends = model.settings.max_bends > 0
        errors.append(error if bends else error._replace(inside=None, rim=None))
        if view.place in reporting.shown_views(view.count):
            views.append(comparison.Comparison(view.name, target, seen.rgb, seen.distance))

    with contextlib.ExitStack() as stack:

        def progress(done: int, total: int, text: str) -> None:
            if not bars:
                bars.append(stack.enter_context(ProgressBar("evaluate", total)))
            bars[0].show(done, text)

        found = evaluation.evaluate(
            model,
            scene,
            split=_SPLIT.value,
            rays_per_pixel=_RAYS_PER_PIXEL.value,
            limit=_LIMIT.value,
            chunk=_CHUNK.value,
            perceptual=lpips,
            progress=progress,
            on_view=write,
        )
    return found, views, residuals.tell(errors)


if __name__ == "__main__":
    app.run(main, again="repeat the command to evaluate again; --overwrite replaces the results.")
