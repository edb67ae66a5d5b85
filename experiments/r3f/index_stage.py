"""The stage of R3F that finds the index of refraction: a background, then a search.

    {folder}/background/    a run: the field of what is behind the body, from pixels beside it
    {folder}/index.png      the error over the index

The background is learned along straight light from pixels that do not see the body, so that no
wrong index can have spoilt it. Where the body fills all images there is none: give the index then.
`look` draws pixels that see the body, for this stage and for that of light.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from experiments.cli import app
from experiments.cli.progress import ProgressBar
from experiments.figures import style
from experiments.figures.style import COLOURS, pyplot
from refref_jax.choices import Space
from refref_jax.data import masks, scene_folder
from refref_jax.data.scene_assembly import build_geometry
from refref_jax.geometry.cameras import pixel_rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.scene import Scene
from refref_jax.reconstruct.refractive_index import (
    Evidence,
    IndexEstimate,
    IndexSearch,
    estimate_index,
    most_looks,
)
from refref_jax.render import checkpoint_io
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import Model, ModelConfig
from refref_jax.training import fit, run_folder
from refref_jax.training.config import TrainConfig
from refref_jax.training.resolve import read_facts, resolve

PRESET = "tiny"
"""Of the background: its field is only looked at."""

STEPS = 1000
"""Of the background's training; the index no longer moves by a thousandth."""

RAYS = 4096
"""Pixels that the index is fitted to."""

# What the body is told to be before its index is known.
_BEFORE = 1.5


class BodyPixels(NamedTuple):
    """Some pixels of a split.

    Attributes:
      evidence: rays, colours and the field.
      views: the image of each.
    """

    evidence: Evidence
    views: Int[np.ndarray, " rays"]


def look(scene: Path, split: str, model: Model, *, seed: int, rays: int) -> BodyPixels:
    """Draws pixels well inside of a split's masks, spread evenly over its views.

    Args:
      scene: its folder.
      split: of which images and masks are read.
      model: of the background.
      seed: of the choice.
      rays: how many, about; fewer where masks have no more.

    Raises:
      ValueError: if there are no masks, or they are too thin to have an inside.
    """
    frames = scene_folder.read_frames(scene, split)
    inside = masks.well_inside(scene_folder.read_masks(frames))
    if not inside.any():
        raise ValueError(
            f"No pixel of the {split} views of {scene} lies inside of a mask and off its outline. "
            "Use larger images, or check the masks."
        )
    generator = np.random.default_rng(seed)
    each = -(-rays // len(inside))
    chosen = []
    for view, mask in enumerate(inside):
        places = np.flatnonzero(mask)
        picked = generator.choice(places, min(each, len(places)), replace=False)
        chosen.append(picked + view * mask.size)
    view, row, column = np.unravel_index(np.concatenate(chosen), inside.shape)
    rgb = scene_folder.read_images(frames)[view, row, column].astype(np.float32) / 255.0
    seen = pixel_rays(frames.cameras, view, row, column)
    return BodyPixels(Evidence(model.params, *jax.device_put((seen, rgb))), view)


def body_geometry(mesh: Mesh, index: float) -> Scene:
    """Returns one clear body in air, on the device."""
    return jax.device_put(Scene(pack_meshes([mesh]), nested([index], [NO_PARENT])))


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
    evidence, views = look(scene, "train", model, seed=seed, rays=rays)
    search = IndexSearch()
    with ProgressBar("index", most_looks(search, start=start)) as bar:
        found = estimate_index(
            evidence,
            body_geometry(mesh, _BEFORE),
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
    config = TrainConfig().override(
        scene=str(scene.resolve()),
        pixels="background",
        background=space,
        radius=radius,
        paths="straight",
        preset=PRESET,
        footprint="cone",
        steps=steps,
        seed=seed,
    )
    wanted = resolve(config, read_facts(config.scene, parts=()))
    if not run_folder.exists(run):
        empty = build_geometry([], [], rule="nested")
        run_folder.create(run, wanted.config, wanted.model, empty)
    _refuse_another(run, checkpoint_io.read_static(run), wanted.model)
    with app.Interrupt() as interrupt, ProgressBar("train", steps) as bar:
        ended = fit.train(
            run,
            scene=scene,
            progress=lambda step, _, text: bar.show(step, text),
            stop=lambda: interrupt.requested,
        )
    if not ended:
        raise KeyboardInterrupt
    model = checkpoint_io.load_model(run)
    return model._replace(config=_as_background(model.config))


def _as_background(config: ModelConfig) -> ModelConfig:
    """Returns a model that was trained along straight light, for light that the body bends.

    The field knows nothing inside of the body, and single paths carry no derivatives across the
    pixel. Along straight light neither makes a difference, so that backgrounds of earlier versions,
    which had it otherwise, can be used.
    """
    return dataclasses.replace(config, interior="clear", footprint="cone")


def _refuse_another(run: Path, found: SavedModel, wanted: SavedModel) -> None:
    """Refuses a background that was begun with another model than is wanted now."""
    theirs, ours = _as_background(found.config), _as_background(wanted.config)
    if (theirs, found.budget) == (ours, wanted.budget):
        return
    remove = "remove that folder to have the background learned anew."
    if (theirs.space, theirs.radius) != (ours.space, ours.radius):
        raise ValueError(
            f"{run} was begun with another --background or --radius ({theirs.space}, "
            f"{theirs.radius:g}) than now ({ours.space}, {ours.radius:g}). Give those again, or "
            f"{remove}"
        )
    raise ValueError(
        f"{run} was begun by a version with other fields or samples. Use that version, or {remove}"
    )


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
    style.style(axis)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
