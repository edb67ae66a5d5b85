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

from benchmarks.training_setup import set_up_training
from refref_jax.training import loop

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of both models.")
_ROUNDS = flags.DEFINE_integer("rounds", 8, "Pools of steps that are timed.")

_LIMIT = 1.5


class _Method:
    """One model in training, stepped a pool at a time."""

    def __init__(self, scene: Path, paths: str) -> None:
        self._setup, self._state = set_up_training(scene, preset=_PRESET.value, paths=paths)

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
