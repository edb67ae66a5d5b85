"""Claim: a field evaluated at the wall needs fewer samples than one evaluated before it.

    python -m benchmarks.wall_sample [--scene=FOLDER] [--steps=1280] [--seeds=0]

In a bounded scene, the last interval of a path is opaque. The field is evaluated in the
middle of the interval, or where the path ends, on the wall (`ModelConfig.last_sample`). Trains the
preset along the tree in both ways, with the preset's samples and with fewer, from the same
parameters on the same pixels, and evaluates some test views: PSNR, masked PSNR, and the mean error
of distances around the object. All models are stepped in turn in one process, so that ratios of
times hold when the machine's speed drifts. Asserted is that with few samples the wall gains
`--margin` in masked PSNR over the middle.
"""

import dataclasses
import itertools
import time
from pathlib import Path

import jax
import numpy as np
from absl import app, flags

from benchmarks.training_setup import usual_samples
from refref_jax.render.model import Model
from refref_jax.training import evaluation, loop
from refref_jax.training.config import TrainConfig
from refref_jax.training.fit import prepare, read_pixels

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of all models.")
_FEWER = flags.DEFINE_list("fewer", ["16", "8"], "Samples of each level, where they are few.")
_STEPS = flags.DEFINE_integer("steps", 1280, "Steps of each training.", lower_bound=1)
_LIMIT = flags.DEFINE_integer("limit", 8, "Number of test views.", lower_bound=1)
_RAYS = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel of the test views.")
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Seeds; each trains all models again.")
_MARGIN = flags.DEFINE_float("margin", 0.0, "Least gain in masked PSNR with few samples, dB.")

_PLACES = ("middle", "end")


class _Training:
    """One model in training, stepped through two groups of pre-traced batches at a time."""

    def __init__(self, setup: loop.Setup, samples: tuple[int, ...], place: str) -> None:
        *proposals, final = samples
        model = dataclasses.replace(
            setup.model,
            proposals=tuple(
                dataclasses.replace(proposal, samples=count)
                for proposal, count in zip(setup.model.proposals, proposals, strict=True)
            ),
            samples=final,
            last_sample=place,
        )
        self._setup = setup._replace(model=model)
        self._state = loop.init_state(setup.config.seed, model, setup.config.schedule)
        self.seconds: list[float] = []

    def turn(self) -> int:
        """Takes the steps of a turn, and returns the number of the last."""
        schedule = self._setup.config.schedule
        begin, first = time.perf_counter(), int(self._state.step)
        until = min(first + 2 * schedule.pretraced_batches, schedule.steps)
        for state, _ in loop.run_steps(self._setup, self._state, until, every=(10,)):
            self._state = state
        jax.block_until_ready(self._state)
        self.seconds.append((time.perf_counter() - begin) / (until - first))
        return until

    def evaluate(self) -> tuple[float, float, float]:
        """Returns PSNR, masked PSNR and the error of the wall's distance, of the test views."""
        setup = self._setup
        model = Model(setup.model, setup.settings, setup.scene, self._state.params)
        found = evaluation.evaluate(
            model, _SCENE.value, rays_per_pixel=_RAYS.value, limit=_LIMIT.value
        )
        return tuple(found.results[x] for x in ("psnr", "psnr_masked", "substituted_mae"))


def _set_up(seed: int) -> loop.Setup:
    asked = TrainConfig().override(
        scene=_SCENE.value,
        preset=_PRESET.value,
        paths="tree",
        far_field="field",
        steps=_STEPS.value,
        seed=seed,
    )
    (config, model, *_), objects = prepare(asked, report=lambda line: None)
    pixels = read_pixels(config, Path(config.scene.path))
    return loop.set_up(config, model.config, model.settings, objects, pixels)


def train_all(seed: int) -> dict[tuple[tuple[int, ...], str], _Training]:
    """Trains all models in turn, and returns them by their samples and place."""
    setup = _set_up(seed)
    counts = (usual_samples(_PRESET.value), tuple(map(int, _FEWER.value)))
    trainings = {
        (samples, place): _Training(setup, samples, place)
        for samples, place in itertools.product(counts, _PLACES)
    }
    done = 0
    while done < _STEPS.value:
        for training in trainings.values():
            done = training.turn()
        costs = ", ".join(f"{1e3 * each.seconds[-1]:.0f}" for each in trainings.values())
        print(f"seed {seed}, step {done}: {costs} ms per step", flush=True)
    return trainings


def main(arguments: list[str]) -> None:
    del arguments
    rows, gains = ["seed,samples,last_sample,speed,psnr,psnr_masked,distance_error"], []
    for seed in map(int, _SEEDS.value):
        trainings = train_all(seed)
        base = next(iter(trainings.values())).seconds
        masked = []
        for (samples, place), training in trainings.items():
            # The first turn compiles.
            speed = np.median(np.divide(base[1:], training.seconds[1:]))
            psnr, inside, distance = training.evaluate()
            masked.append(inside)
            name = " + ".join(map(str, samples))
            row = f"{seed},{name},{place},{speed:.2f},{psnr:.2f},{inside:.2f},{distance:.4f}"
            rows.append(row)
            print(row, flush=True)
        gains.append(masked[-1] - masked[-2])
    print("\n".join(rows))
    for gain in gains:
        assert gain >= _MARGIN.value, f"few samples: {gain:+.2f} dB at the wall"


if __name__ == "__main__":
    app.run(main)
