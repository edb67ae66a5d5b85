"""Claim: a training step of the oracle costs at most 1.5 times a straight one.

    python -m benchmarks.step_cost [--scene=FOLDER] [--rounds=N]

Both models have the same samples and are stepped in turn, pool by pool, in one process: the
ratio holds when the machine's speed drifts. A step includes its share of tracing the pool and of
drawing its pixels.
"""

import time
from pathlib import Path

import jax
import numpy as np
from absl import app, flags

from experiments.presets import PRESETS, bounds
from refref_jax.data import background, containment, local_layout, meshes
from refref_jax.data.batches import PixelSampler
from refref_jax.data.geometry import build_geometry
from refref_jax.optics.budgets import BUDGETS
from refref_jax.training import loop
from refref_jax.training.config import SceneConfig, TrainingConfig
from refref_jax.training.state import init_state

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of both models.")
_ROUNDS = flags.DEFINE_integer("rounds", 8, "Pools of steps that are timed.")

_LIMIT = 1.5


class _Method:
    """One model in training, stepped a pool at a time."""

    def __init__(self, scene: Path, paths: str) -> None:
        preset = PRESETS[_PRESET.value]
        frames = local_layout.read_frames(scene, "train")
        space, radius = background.space(scene), background.half_extent(scene)
        model = preset.model(bounds(frames.cameras, space=space, radius=radius), "field")
        parts = meshes.without_colour(meshes.read_meshes(scene))
        parents = containment.find_containment(parts).parents
        config = TrainingConfig(
            scene=SceneConfig(str(scene), "nested", ()),
            paths=paths,
            loss=preset.loss,
            schedule=preset.schedule,
            batch=preset.batch,
            pool=preset.pool,
            seed=0,
        )
        sampler = PixelSampler(
            local_layout.read_images(frames), frames.cameras, seed=0, batch=config.batch
        )
        geometry = build_geometry(parts, parents, rule="nested")
        self._setup = loop.set_up(config, model, BUDGETS[paths], geometry, sampler)
        self._state = init_state(0, model, config.schedule)

    def seconds_per_step(self) -> float:
        """Takes the steps of one pool and returns the mean time of a step."""
        start, pool = int(self._state.step), self._setup.config.pool
        jax.block_until_ready(self._state)
        begin = time.perf_counter()
        for state, _ in loop.run_steps(self._setup, self._state, start + pool):
            self._state = state
        jax.block_until_ready(self._state)
        return (time.perf_counter() - begin) / pool


def main(arguments: list[str]) -> None:
    del arguments
    scene = Path(_SCENE.value)
    straight, oracle = _Method(scene, "straight"), _Method(scene, "paper")
    straight.seconds_per_step(), oracle.seconds_per_step()  # compiles
    pairs = np.array(
        [(straight.seconds_per_step(), oracle.seconds_per_step()) for _ in range(_ROUNDS.value)]
    )
    ratios = pairs[:, 1] / pairs[:, 0]
    print(f"straight  {1e3 * np.median(pairs[:, 0]):7.1f} ms a step")
    print(f"oracle    {1e3 * np.median(pairs[:, 1]):7.1f} ms a step")
    print(f"ratio     {np.median(ratios):7.2f}  (min {ratios.min():.2f}, max {ratios.max():.2f})")
    assert np.median(ratios) <= _LIMIT, f"the oracle's step costs more than {_LIMIT} straight ones"


if __name__ == "__main__":
    app.run(main)
