"""The stage of R3F that finds the index of refraction: a background, then a search.

    {folder}/background/    a run: the field of what is behind the body, from pixels beside it
    {folder}/index.png      the error over the index

The background is learned along straight light from pixels that do not see the body, so that no
wrong index can have spoilt it. Where the body fills all images there is none: give the index then.
"""

import dataclasses
from pathlib import Path

from experiments.cli.progress import ProgressBar
from experiments.figures import style as plotting
from experiments.figures.style import COLOURS, pyplot
from experiments.r3f import body_pixels
from experiments.runs import trainer
from refref_jax.data import background, local_layout
from refref_jax.data.geometry import build_geometry
from refref_jax.optics.budgets import STRAIGHT
from refref_jax.reconstruct.index_search import (
    IndexEstimate,
    IndexSearch,
    estimate_index,
    most_looks,
)
from refref_jax.reconstruct.triangles import Mesh
from refref_jax.render import saved
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Model
from refref_jax.render.saved import SavedModel
from refref_jax.sampling.domains import Space
from refref_jax.training import presets, run_folder, run_lock
from refref_jax.training.config import SceneConfig, TrainingConfig

PRESET = "tiny"
"""Of the background: its field is only looked at."""

STEPS = 1000
"""Of the background's training; the index no longer moves by a thousandth."""

RAYS = 4096
"""Pixels that the index is fitted to."""

# What the body is told to be before its index is known.
_BEFORE = 1.5


def run(
    scene: Path,
    mesh: Mesh,
    folder: Path,
    *,
    seed: int,
    space: Space | None = None,
    radius: float | None = None,
    start: float | None = None,
    steps: int = STEPS,
    rays: int = RAYS,
) -> IndexEstimate:
    """Finds the index of refraction of a body; what is there of an earlier call is used.

    Args:
      scene: folder of the scene; its training images and masks are read.
      mesh: the body.
      folder: for the background's run and the figure.
      seed: of everything random.
      space: whether there are walls; what the scene says if not given.
      radius: of the walls' cube or sphere or the uncontracted ball, world units; likewise.
      start: an index to descend from besides those of the search.
      steps: of the background's training.
      rays: pixels to fit.

    Raises:
      ValueError: if the scene has no masks, or no pixel beside them.
      KeyboardInterrupt: if the background's training was stopped; it has been saved.
    """
    model = learn_background(scene, folder, seed=seed, space=space, radius=radius, steps=steps)
    evidence, views = body_pixels.look(scene, "train", model, seed=seed, rays=rays)
    search = IndexSearch()
    with ProgressBar("index", most_looks(search, start=start)) as bar:
        found = estimate_index(
            evidence,
            body_pixels.body_geometry(mesh, _BEFORE),
            views,
            part=0,
            config=model.config,
            search=search,
            start=start,
            progress=lambda done, _: bar.show(done, "looks at the pixels, at most"),
        )
    draw(folder / "index.png", found)
    return found


def learn_background(
    scene: Path,
    folder: Path,
    *,
    seed: int,
    space: Space | None = None,
    radius: float | None = None,
    steps: int = STEPS,
) -> Model:
    """Returns the field of what is behind the body; trains it first, or goes on with that.

    Args:
      scene: folder of the scene.
      folder: of the stage.
      seed: of everything random.
      space: see `run`.
      radius: likewise.
      steps: of its training.

    Raises:
      ValueError: if the scene has no masks, or no pixel beside them, or if a background was begun
        with other walls.
      KeyboardInterrupt: if its training was stopped; it has been saved.
    """
    run = folder / "background"
    config, model = _plan(scene, _bounds(scene, space, radius), seed=seed, steps=steps)
    wanted = SavedModel(model, STRAIGHT)
    if not run_folder.exists(run):
        run_folder.create(run, config, wanted, build_geometry([], [], rule="nested"))
    elif saved.read_static(run) != wanted:
        raise ValueError(
            f"{run} was begun with another --background or --radius than are given now. Give those "
            "again, or remove that folder to have the background learned anew."
        )
    with run_lock.hold(run):
        if not trainer.train(run, scene=str(scene)):
            raise KeyboardInterrupt
    return saved.load_model(run)


def draw(path: Path, found: IndexEstimate) -> None:
    """Draws the error over the index: the ladder, the ways down, and where they end."""
    figure, axis = pyplot.subplots(figsize=(6.4, 3.6), layout="constrained")
    axis.plot(*found.ladder, "o-", color=COLOURS[5], markersize=4, label="looked at")
    for way, label in zip(found.descents[::-1], ["descents"] + [None] * 9, strict=False):
        axis.plot(*way, ".-", color=COLOURS[1], linewidth=0.8, label=label)
    axis.axvline(found.index, color=COLOURS[0], linewidth=1.0)
    axis.set_title(f"index {found.index:.4f} ± {found.deviation:.4f}")
    axis.set_xlabel("index of refraction")
    axis.set_ylabel("mean error, sRGB")
    axis.legend(frameon=False)
    plotting.style(axis)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _bounds(scene: Path, space: Space | None, radius: float | None) -> presets.Bounds:
    cameras = local_layout.read_frames(scene, "train").cameras
    space = space or background.space(scene)
    told = background.half_extent(scene) if space != "unbounded" else None
    return presets.bounds(cameras, space=space, radius=radius or told)


def _plan(
    scene: Path, extent: presets.Bounds, *, seed: int, steps: int
) -> tuple[TrainingConfig, ModelConfig]:
    preset = presets.PRESETS[PRESET]
    model = preset.model(extent, "clear")
    config = TrainingConfig(
        scene=SceneConfig(str(scene), "nested", ()),
        paths="straight",
        loss=presets.loss(model),
        schedule=preset.schedule.over(steps),
        batch=preset.batch,
        pool=preset.pool,
        seed=seed,
        pixels="background",
    )
    return config, dataclasses.replace(model, footprint="cone")
