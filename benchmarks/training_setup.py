"""A training run on a scene, set up as `experiments.train` does, for benchmarks to step."""

import dataclasses
from pathlib import Path

from experiments import choices
from experiments.choices import Wishes
from experiments.presets import PRESETS, bounds
from refref_jax.data import background, containment, local_layout, meshes, needs
from refref_jax.data.batches import PixelSampler
from refref_jax.data.geometry import build_geometry
from refref_jax.training import loop
from refref_jax.training.config import SceneConfig, TrainingConfig
from refref_jax.training.state import TrainState, init_state
from refref_jax.training.steps import Pool


def set_up_training(scene: Path, *, preset: str, paths: str) -> tuple[loop.Setup, TrainState]:
    """Returns a run that has not begun, and models of the scene what it needs.

    Args:
      scene: folder of the scene.
      preset: name of a preset.
      paths: name of a budget.
    """
    chosen = PRESETS[preset]
    frames = local_layout.read_frames(scene, "train")
    space, radius = background.space(scene), background.half_extent(scene)
    parts = meshes.read_meshes(scene)
    tree = containment.find_containment(parts)
    found = needs.find_needs(parts, tree, frames.cameras, rule="nested", space=space)
    choice = choices.choose(found, Wishes(paths=paths))
    extent = bounds(frames.cameras, space=space, radius=radius if space == "bounded" else None)
    model = dataclasses.replace(
        chosen.model(extent, choice.interior), learned_tints=choice.learned_tints
    )
    if choice.tints != "given":
        parts = meshes.without_colour(parts)
    config = TrainingConfig(
        scene=SceneConfig(str(scene), "nested", ()),
        paths=paths,
        loss=chosen.loss,
        schedule=chosen.schedule,
        batch=chosen.batch,
        pool=chosen.pool,
        seed=0,
    )
    sampler = PixelSampler(
        local_layout.read_images(frames), frames.cameras, seed=0, batch=config.batch
    )
    geometry = build_geometry(parts, tree.parents, rule="nested")
    setup = loop.set_up(config, model, choice.budget, geometry, sampler)
    return setup, init_state(0, model, config.schedule)


def trace_pool(setup: loop.Setup) -> Pool:
    """Draws and traces the first pool of a run, as its loop does."""
    return loop.trace_batches(setup, setup.sampler.numbers(0, setup.config.pool).tolist())
