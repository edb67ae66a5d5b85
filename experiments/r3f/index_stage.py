"""Estimates the index of refraction: learns the background, then searches for the index.

    {folder}/background/    a run: the background, from pixels outside the masks
    {folder}/index.png      the error as a function of the index

The background is learned with straight rays from pixels that do not see the object, so that no
wrong index can corrupt it. It is a backdrop where the world is the surface that the scene states
and the images agree, else a field. If the object fills all images there are no such pixels, and the
index must be set by the user. `photographs` draws pixels that see the object, for this stage and
for the refinement by light.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from experiments.cli import app
from experiments.cli.progress import ProgressBar
from experiments.figures import style
from experiments.figures.style import COLOURS, pyplot
from refref_jax.choices import SATURATED, Colour, Exposure, Position, Space, Split
from refref_jax.data import image_files, scene_folder
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.geometry.cameras import pixel_rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.media import Scene
from refref_jax.reconstruct.photometry import Backdrop, Photographs, make_backdrop
from refref_jax.reconstruct.refractive_index import (
    Evidence,
    IndexEstimate,
    IndexSearch,
    estimate_index,
    most_looks,
)
from refref_jax.reconstruct.shape_from_refraction import find_index, most_looks_at_backdrop
from refref_jax.render import checkpoint_io, pixels
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import Model, ModelConfig, surface_of
from refref_jax.training import fit, run_folder
from refref_jax.training.config import TrainConfig, require
from refref_jax.training.resolve import Resolved, read_facts, resolve

PRESET = "tiny"
"""Preset of the background's model, whose field is only queried."""

STEPS = 1000
"""Training steps of the background; more change the index by less than a thousandth."""

ITERATIONS = 24
"""Iterations of a backdrop's solver, of which 8 more gain 0.7 dB beside the masks of a torus."""

RAYS = 4096
"""Number of pixels that the index is fitted to in front of a field."""

MANY_RAYS = 60_000
"""The same in front of a backdrop."""

BACKGROUND = "background"
"""Name of the run of the background."""

# Placeholder for the index before it is known.
_BEFORE = 1.5


def photographs(
    scene: Path,
    split: Split,
    *,
    seed: int,
    rays: int | None = None,
    margin: int = 1,
    gains: Mapping[str, Colour] | None = None,
) -> Photographs:
    """Draws pixels well inside the masks of a split, evenly over its views.

    Args:
      scene: folder of the scene.
      split: split whose images and masks are read.
      seed: seed of the draw.
      rays: approximate number of pixels, fewer if the masks contain fewer; all by default.
      margin: distance from the outlines, in pixels.
      gains: gain of each image by its name, by which its linear colours are divided; saturated ones
        stay as they are, since nobody knows how bright they were.

    Raises:
      ValueError: if there are no masks, or if they have no interior, or an image has no gain.
    """
    frames = scene_folder.read_frames(scene, split)
    inside = image_files.well_inside(scene_folder.read_masks(frames), margin=margin)
    if not inside.any():
        raise ValueError(
            f"No pixel of the {split} views of {scene} lies inside a mask and off its outline. "
            "Use larger images, or check the masks."
        )
    generator = np.random.default_rng(seed)
    each = inside[0].size if rays is None else -(-rays // len(inside))
    chosen = []
    for view, mask in enumerate(inside):
        places = np.flatnonzero(mask)
        picked = generator.choice(places, min(each, len(places)), replace=False)
        chosen.append(picked + view * mask.size)
    view, row, column = np.unravel_index(np.concatenate(chosen), inside.shape)
    rgb = scene_folder.read_images(frames)[view, row, column].astype(np.float32) / 255.0
    if gains is not None:
        if unknown := [name for name in frames.names if name not in gains]:
            raise ValueError(
                f"The background has no gain of the image {unknown[0]}: images were added or "
                "renamed after it was learned. Undo that, or reconstruct in another folder."
            )
        of_views = np.array([gains[name] for name in frames.names], np.float32)
        rgb = _divided_by(of_views[view], rgb)
    return Photographs(pixel_rays(frames.cameras, view, row, column), rgb, view)


def _divided_by(
    gains: Float[np.ndarray, "pixels 3"], rgb: Float[np.ndarray, "pixels 3"]
) -> Float[np.ndarray, "pixels 3"]:
    linear = np.asarray(pixels.srgb_to_linear(jax.device_put(rgb))) / gains
    found = np.asarray(pixels.linear_to_srgb(jax.device_put(linear)))
    return np.where(rgb < SATURATED, found, rgb).astype(np.float32)


def object_scene(mesh: Mesh, index: float) -> Scene:
    """Returns a scene with one clear object in air, on the device."""
    return jax.device_put(Scene(pack_meshes([mesh]), nested([index], [NO_PARENT])))


def run(
    scene: Path,
    mesh: Mesh,
    folder: Path,
    *,
    seed: int,
    space: Space | None = None,
    radius: float | None = None,
    centre: Position | None = None,
    exposure: Exposure = "fixed",
    start: float | None = None,
    steps: int = STEPS,
    wanted: Resolved | None = None,
) -> IndexEstimate:
    """Estimates the index of refraction of an object; reuses the results of an earlier call.

    Args:
      scene: folder of the scene; its training images and masks are read.
      mesh: mesh of the object.
      folder: folder for the background's run and the figure.
      seed: random seed.
      space: type of the background; the scene's own if `None`.
      radius: half-extent of the background cube, or radius of the sphere or of the uncontracted
        ball, world units; the scene's own if `None`.
      centre: centre of the background, world units; the scene's own if `None`.
      exposure: whether the background learns a gain for each image.
      start: index from which to descend in addition to those of the search.
      steps: training steps of the background, if it is a field.
      wanted: resolved options of the background (`resolve_background`), in place of those above;
        resolving them takes seconds.

    Raises:
      ValueError: if the scene has no masks, or no pixel outside of them.
      KeyboardInterrupt: if the background's training was stopped; it has been saved.
    """
    background = {"space": space, "radius": radius, "centre": centre, "exposure": exposure}
    model = learn_background(scene, folder, seed=seed, steps=steps, wanted=wanted, **background)
    surface, gains = backdrop_of(folder, model), read_gains(folder)
    rays = RAYS if surface is None else MANY_RAYS
    seen = photographs(scene, "train", seed=seed, rays=rays, gains=gains)
    if surface is None:
        found = _find_before_field(mesh, model, seen, start)
    else:
        search = IndexSearch(descents=2)
        with ProgressBar("index", most_looks_at_backdrop(search, start=start)) as bar:
            found = find_index(
                mesh,
                surface,
                seen,
                search=search,
                start=start,
                seed=seed,
                progress=lambda done, _: bar.show(done, "looks"),
            )
    draw(folder / "index.png", found)
    return found


def _find_before_field(
    mesh: Mesh, model: Model, seen: Photographs, start: float | None
) -> IndexEstimate:
    """Searches for the index in front of a field, whose colours are at most white.

    Saturated pixels, which may be brighter, are left out if there are others.
    """
    search, dark = IndexSearch(), np.flatnonzero(np.all(seen.rgb < SATURATED, axis=-1))
    seen = seen.chosen(dark) if len(dark) else seen
    evidence = Evidence(model.params, *jax.device_put((seen.rays, seen.rgb)))
    with ProgressBar("index", most_looks(search, start=start)) as bar:
        return estimate_index(
            evidence,
            object_scene(mesh, _BEFORE),
            seen.views,
            part=0,
            config=model.config,
            search=search,
            start=start,
            progress=lambda done, _: bar.show(done, "evaluations, at most"),
        )


def backdrop_of(folder: Path, model: Model) -> Backdrop | None:
    """Returns the backdrop of a background; `None` if it is a field.

    Args:
      folder: folder of the stage.
      model: model of the background.
    """
    if model.config.backdrop is None:
        return None
    coverage = run_folder.read_coverage(folder / BACKGROUND)
    bounds = model.config.domain
    return make_backdrop(bounds, surface_of(model.params), coverage)


def read_gains(folder: Path) -> dict[str, Colour] | None:
    """Returns the gain of each training image by its name, if the background has learned them.

    Args:
      folder: folder of the stage.
    """
    return run_folder.read_gains(folder / BACKGROUND)


def learn_background(
    scene: Path,
    folder: Path,
    *,
    seed: int,
    space: Space | None = None,
    radius: float | None = None,
    centre: Position | None = None,
    exposure: Exposure = "fixed",
    steps: int = STEPS,
    wanted: Resolved | None = None,
) -> Model:
    """Returns the background, which is learned first or resumed if necessary.

    A backdrop where the scene says what surface is behind the object and the images agree, else a
    field; a background that was begun as a field stays one.

    Args:
      scene: folder of the scene.
      folder: folder of the stage.
      seed: random seed.
      space: type of the background, see `run`.
      radius: size of the background, see `run`.
      centre: centre of the background, see `run`.
      exposure: whether it learns a gain for each image.
      steps: number of training steps of a field.
      wanted: resolved options (`resolve_background`), in place of those above.

    Raises:
      ValueError: if the scene has no masks, or no pixel outside of them, or if the training was
        started with another background.
      KeyboardInterrupt: if its training was stopped; it has been saved.
    """
    given = {"space": space, "radius": radius, "centre": centre, "exposure": exposure}
    wanted = wanted or resolve_background(scene, folder, steps=steps, seed=seed, **given)
    return _learned(scene, folder / BACKGROUND, wanted)


def learn_backdrop(
    scene: Path, folder: Path, *, wanted: Resolved | None = None, **given: Any
) -> Backdrop | None:
    """Returns the backdrop, which is solved for first if necessary; `None` if it must be a field.

    Arguments and errors are those of `learn_background`, but no field is trained.
    """
    wanted = wanted or resolve_background(scene, folder, **given)
    if wanted.model.config.backdrop is None:
        return None
    return backdrop_of(folder, _learned(scene, folder / BACKGROUND, wanted))


def resolve_background(
    scene: Path,
    folder: Path,
    *,
    seed: int,
    space: Space | None = None,
    radius: float | None = None,
    centre: Position | None = None,
    exposure: Exposure = "fixed",
    steps: int = STEPS,
) -> Resolved:
    """Returns how the background is to be learned; see `learn_background`."""
    config = TrainConfig().override(
        **{"scene": str(scene.resolve()), "pixels": "background", "paths": "straight"},
        **{"background": space, "radius": radius, "centre": centre, "seed": seed},
        exposure=exposure,
    )
    facts, run = read_facts(config.scene, parts=()), folder / BACKGROUND
    wanted = resolve(config, facts)
    begun = checkpoint_io.read_static(run).config if run_folder.exists(run) else wanted.model.config
    if wanted.model.config.backdrop is not None and begun.backdrop is not None:
        solver = dataclasses.replace(wanted.config.model, iterations=ITERATIONS)
        return wanted._replace(config=dataclasses.replace(wanted.config, model=solver))
    field = {"far_field": "field", "preset": PRESET, "footprint": "cone", "steps": steps}
    return resolve(config.override(**field), facts)


def learned(scene: Path, run: Path, wanted: Resolved) -> Model:
    """Trains a model of a scene without objects, or resumes its training.

    Args:
      scene: folder of the scene.
      run: folder of the run.
      wanted: resolved options.

    Raises:
      ValueError: if the training was started with another model.
      KeyboardInterrupt: if its training was stopped; it has been saved.
    """
    if not run_folder.exists(run):
        empty = assemble_scene([], [], rule="nested")
        run_folder.create(run, wanted.config, wanted.model, empty)
    _refuse_another(run, checkpoint_io.read_static(run), wanted.model)
    solves = wanted.model.config.backdrop is not None
    config = run_folder.read_config(run)  # an earlier version may have begun it
    total = require(config.model.iterations if solves else config.schedule.steps)
    with app.Interrupt() as interrupt, ProgressBar("solve" if solves else "train", total) as bar:
        ended = fit.train(
            run,
            scene=scene,
            progress=lambda step, _, text: bar.show(step, text),
            stop=lambda: interrupt.requested,
        )
    if not ended:
        raise KeyboardInterrupt
    return checkpoint_io.load_model(run)


def _learned(scene: Path, run: Path, wanted: Resolved) -> Model:
    """Learns the background, or resumes it."""
    model = learned(scene, run, wanted)
    return model._replace(config=_as_background(model.config))


def _as_background(config: ModelConfig) -> ModelConfig:
    """Adapts the configuration of a model that was trained along straight rays to bent paths.

    The field was not trained inside the object, so the interior is `clear`. Single paths carry no
    derivatives across the pixel, so the footprint is `cone`. Neither matters for straight rays, so
    backgrounds that earlier versions trained with other values can be used.
    """
    return dataclasses.replace(config, interior="clear", footprint="cone")


def _refuse_another(run: Path, found: SavedModel, wanted: SavedModel) -> None:
    """Rejects a run that was started with another model."""
    theirs, ours = _as_background(found.config), _as_background(wanted.config)
    if (theirs, found.settings) == (ours, wanted.settings):
        return
    remove = "remove that folder to train the background again."
    if (theirs.space, theirs.radius) != (ours.space, ours.radius):
        raise ValueError(
            f"{run} was started with another --background or --radius ({theirs.space}, "
            f"{theirs.radius:g}) than now ({ours.space}, {ours.radius:g}). Repeat these flags, or "
            f"{remove}"
        )
    if theirs.centre != ours.centre:
        raise ValueError(
            f"{run} was started with a background around {theirs.centre}, which is now around "
            f"{ours.centre}. Give the earlier centre in scene.json, or {remove}"
        )
    raise ValueError(
        f"{run} was started by a version with other fields or samples. Use that version, or "
        f"{remove}"
    )


def draw(path: Path, found: IndexEstimate) -> None:
    """Plots the error over the index: the ladder, the descents, and their minima."""
    figure, axis = pyplot.subplots(figsize=(6.4, 3.6), layout="constrained")
    axis.plot(*found.ladder, "o-", color=COLOURS[5], markersize=4, label="ladder")
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
