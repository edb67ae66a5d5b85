"""Claim: a step along the paper's paths costs at most 1.25 straight ones, along the tree 1.5.

    python -m benchmarks.step_cost [--scene=FOLDER] [--rounds=N] [--variants=NAME,NAME] \
        [--samples=N,N]

All models have the same samples per path, and the scene analysis of training. They are stepped in
turn in one process, so that ratios hold when the machine's speed drifts. A step includes its share
of drawing and tracing; if paths are cached, that is the cost of tracing all of them once, spread
over the steps of the preset. Tracing must take at most a tenth of a step.

With `--variants`, steps along the tree are compared instead, and nothing is asserted: `few` takes
16 + 8 samples, `devices` shares the paths between two virtual devices of the CPU, and in
`proposals` the proposals learn nothing.
"""

import dataclasses
import time
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import jax
import numpy as np
from absl import app, flags

from benchmarks.training_setup import set_up_training
from refref_jax.optics.light_paths import LightPaths
from refref_jax.render import pixels
from refref_jax.training import devices, loop, objective
from refref_jax.training.config import LossConfig

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of all models.")
_ROUNDS = flags.DEFINE_integer(
    "rounds", 8, "Number of times that each model steps the batches of two pre-tracings."
)

_SAMPLES = flags.DEFINE_list("samples", None, "Samples of each level; by default the preset's.")

_KNOWN = ("few", "devices", "proposals")
_VARIANTS = flags.DEFINE_list("variants", [], f"Variants of steps: {', '.join(_KNOWN)}.")
flags.register_validator(
    "variants", lambda names: set(names) <= set(_KNOWN), f"Choose from {', '.join(_KNOWN)}."
)

_STRAIGHT = "straight"
_LIMITS = {_STRAIGHT: 1.0, "paper": 1.25, "tree": 1.5}
_MOST_TRACING = 0.1

# The default of `experiments.train`.
_STRIDE = 10

_FEW = (16, 8)

_TOTAL = objective.total


class _Cost(NamedTuple):
    """Seconds per step, and the part spent on tracing."""

    step: float
    tracing: float


class _Method:
    """One model in training, stepped through the batches of two pre-tracings at a time."""

    def __init__(self, scene: Path, paths: str, variant: str = "") -> None:
        self._setup, self._state = set_up_training(
            scene,
            preset=_PRESET.value,
            paths=paths,
            samples=_FEW if variant == "few" else _samples(),
            mesh=devices.row(2) if variant == "devices" else None,
        )
        self._total = objective.total
        if variant == "proposals":
            # JAX would take the program of a usual step for an equal configuration.
            config = dataclasses.replace(self._setup.config, seed=self._setup.config.seed + 1)
            self._setup, self._total = self._setup._replace(config=config), _without_proposals
        self.paths_per_ray = self._setup.capacity / self._setup.config.schedule.batch

    def cost(self) -> _Cost:
        """Pre-traces batches, and takes the steps of two pre-tracings."""
        pretraced, batches = (
            self._setup.config.schedule.pretraced_batches,
            self._setup.sampler.batches,
        )
        begin = time.perf_counter()
        jax.block_until_ready(loop.trace_batches(self._setup, range(pretraced)))
        tracing = (time.perf_counter() - begin) / pretraced
        start = int(self._state.step)
        begin = time.perf_counter()
        steps = loop.run_steps(self._setup, self._state, start + 2 * pretraced, every=(_STRIDE,))
        with mock.patch.object(objective, "total", self._total):  # when the first turn compiles
            for state, _ in steps:
                self._state = state
        jax.block_until_ready(self._state)
        step = (time.perf_counter() - begin) / (2 * pretraced)
        if self._setup.epoch is None:
            return _Cost(step, tracing)
        share = -(-batches // pretraced) * pretraced / self._setup.config.schedule.steps
        return _Cost(step + share * tracing, share * tracing)


def _samples() -> tuple[int, ...] | None:
    return None if _SAMPLES.value is None else tuple(map(int, _SAMPLES.value))


def _without_proposals(
    light: pixels.Light, paths: LightPaths, config: LossConfig
) -> objective.Totals:
    """Returns the losses without derivatives by the proposals."""
    *proposals, final = light.paths.histograms
    histograms = (*jax.lax.stop_gradient(proposals), final)
    return _TOTAL(light._replace(paths=light.paths._replace(histograms=histograms)), paths, config)


def main(arguments: list[str]) -> None:
    del arguments
    scene = Path(_SCENE.value)
    if "devices" in _VARIANTS.value:
        jax.config.update("jax_num_cpu_devices", 2)
    if _VARIANTS.value:
        names = ("tree", *_VARIANTS.value)
        _compare({name: _Method(scene, "tree", name) for name in names}, to="tree")
        return
    medians = _compare({paths: _Method(scene, paths) for paths in _LIMITS}, to=_STRAIGHT)
    for name, (ratio, tracing) in medians.items():
        assert ratio <= _LIMITS[name], f"{name}: {ratio:.2f} straight steps"
        assert tracing <= _MOST_TRACING, f"{name}: tracing takes {tracing:.2f} of a step"


def _compare(methods: dict[str, _Method], *, to: str) -> dict[str, tuple[float, float]]:
    """Steps methods in turn; returns each one's cost and the share of tracing."""
    for method in methods.values():
        method.cost()  # compiles
    rounds = [{name: each.cost() for name, each in methods.items()} for _ in range(_ROUNDS.value)]
    print(f"| steps | capacity per ray | ms per step | tracing, ms | to {to} (least, most) |")
    print("|---|---|---|---|---|")
    medians = {}
    for name, method in methods.items():
        step, tracing = np.median([row[name] for row in rounds], axis=0)
        ratios = np.array([row[name].step / row[to].step for row in rounds])
        medians[name] = np.median(ratios), tracing / step
        print(
            f"| {name} | {method.paths_per_ray:.2f} | {1e3 * step:.1f} | {1e3 * tracing:.1f} "
            f"| {np.median(ratios):.2f} ({ratios.min():.2f}, {ratios.max():.2f}) |"
        )
    return medians


if __name__ == "__main__":
    app.run(main)
