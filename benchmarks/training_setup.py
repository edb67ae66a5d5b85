"""A training run on a scene, set up as `experiments.train` does, for benchmarks to step."""

from pathlib import Path

from jax.sharding import Mesh

from refref_jax.fields import registry
from refref_jax.training import devices, loop
from refref_jax.training.config import TrainConfig
from refref_jax.training.fit import prepare, read_pixels
from refref_jax.training.loop import PretracedBatches, TrainState, init_state


def set_up_training(
    scene: Path,
    *,
    preset: str,
    paths: str,
    samples: tuple[int, ...] | None = None,
    mesh: Mesh | None = None,
) -> tuple[loop.Setup, TrainState]:
    """Returns a run before its first step, with the scene analysis of training.

    Args:
      scene: folder of the scene.
      preset: name of a preset.
      paths: name of path settings.
      samples: samples of each level; by default the preset's usual ones, whatever the scene needs,
        so that only the paths differ.
      mesh: devices that train together; `None` for a single one.
    """
    samples = samples or usual_samples(preset)
    asked = TrainConfig().override(
        scene=str(scene), preset=preset, paths=paths, samples_per_ray=samples
    )
    (config, model, *_), objects = prepare(asked)
    pixels = read_pixels(config, scene)
    setup = loop.set_up(config, model.config, model.settings, objects, pixels, mesh=mesh)
    state = init_state(config.seed, model.config, config.schedule)
    return setup, devices.put_everywhere(state, mesh=mesh)


def usual_samples(preset: str) -> tuple[int, ...]:
    """Returns the samples of each level of a preset, where walls are not the only thing seen."""
    return registry.KINDS[registry.USUAL].sizes[preset].samples


def pretrace(setup: loop.Setup) -> PretracedBatches:
    """Draws and pre-traces the first batches of a run, as its loop does."""
    return loop.trace_batches(
        setup, setup.sampler.numbers(0, setup.config.schedule.pretraced_batches).tolist()
    )
