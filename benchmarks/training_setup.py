"""A training run on a scene, set up as `experiments.train` does, for benchmarks to step."""

from pathlib import Path

from experiments.presets import PRESETS, bounds
from refref_jax.data import background, containment, local_layout, meshes
from refref_jax.data.batches import PixelSampler
from refref_jax.data.geometry import build_geometry
from refref_jax.optics.budgets import BUDGETS
from refref_jax.training import loop
from refref_jax.training.config import SceneConfig, TrainingConfig
from refref_jax.training.state import TrainState, init_state
from refref_jax.training.steps import Pool


def set_up_training(scene: Path, *, preset: str, paths: str) -> tuple[loop.Setup, TrainState]:
    """Returns a run that has not begun, without absorption and tints.

    Args:
      scene: folder of the scene.
      preset: name of a preset.
      paths: name of a budget.
    """
    chosen = PRESETS[preset]
    frames = local_layout.read_frames(scene, "train")
    space, radius = background.space(scene), background.half_extent(scene)
    model = chosen.model(bounds(frames.cameras, space=space, radius=radius), "field")
    parts = meshes.without_colour(meshes.read_meshes(scene))
    parents = containment.find_containment(parts).parents
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
    geometry = build_geometry(parts, parents, rule="nested")
    setup = loop.set_up(config, model, BUDGETS[paths], geometry, sampler)
    return setup, init_state(0, model, config.schedule)


def trace_pool(setup: loop.Setup) -> Pool:
    """Draws and traces the first pool of a run, as its loop does."""
    return loop.trace_batches(setup, setup.sampler.numbers(0, setup.config.pool).tolist())
