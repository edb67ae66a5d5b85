"""Claim: XLA's older code generator for CPUs compiles paths in 0.85 of the newer one's time.

    python -m benchmarks.code_generators [--rounds=N]

Programs of the bundled scene are compiled by both code generators (`compilation.jit_quickly`), and
run in turn: the paths of a pre-tracing along the tree, the ends of an image's paths on a backdrop,
and ten training steps of preset tiny. Only the last one takes the newer code generator by default.
Asserted are the sums of the first two: seconds to compile, and at most 1.1 times as long to run.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import app, flags

from benchmarks.training_setup import pretrace, set_up_training
from refref_jax.data import scene_folder
from refref_jax.geometry import cameras
from refref_jax.render import images
from refref_jax.render.model import path_detail
from refref_jax.training import loop

_SCENE = Path("experiments/data/cube_smcvx_ball")
_ROUNDS = flags.DEFINE_integer("rounds", 10, "Number of times that each program runs.")

_STEPS = 10
_RESOLUTION = 384
_LEAST_GAIN = 0.85
_MOST_LOSS = 1.1


@dataclasses.dataclass
class _Measured:
    """What a program costs: seconds of compilation, and of each run."""

    program: str
    older: bool
    compiling: float
    run: Callable[[], Any]
    seconds: list[float] = dataclasses.field(default_factory=list)


def _programs() -> dict[str, tuple[Any, tuple[Any, ...], dict[str, Any]]]:
    """Returns lowered programs and their arguments, by position and by name."""
    setup, state = set_up_training(_SCENE, preset="tiny", paths="tree")
    rays = setup.sampler.draw(setup.sampler.numbers(0, 16)).rays
    scene = jax.device_put(setup.scene)
    detail = path_detail(setup.model, setup.settings)
    lists = {"settings": setup.settings, "capacity": setup.capacity, "detail": detail}
    test = scene_folder.read_frames(_SCENE, "test").cameras
    image = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), cameras.image_rays(test, 0))
    _, hits, _ = images.split_by_hit(scene.surfaces, image)
    tile, _ = images.crop(hits, None, 0, images.tile_for(hits.radii.size))
    ends = {
        "settings": setup.settings,
        "domain": setup.model.domain,
        "resolution": _RESOLUTION,
        "most_taps": 3,
        "axes": 0,
        "tally": "none",
        "fields": (),
    }
    faint = {"faint": 0.0}
    steps = state, pretrace(setup), np.int32(0), np.int32(_STEPS)
    static = {"config": setup.config, "model": setup.model}
    return {
        "paths of a pre-tracing": (loop.pretrace.lower(scene, rays, **lists), (scene, rays), {}),
        "ends of an image's paths": (
            images.backdrop_ends.lower(scene, tile, **ends, **faint),
            (scene, tile),
            faint,
        ),
        f"{_STEPS} training steps": (loop.train_steps.lower(*steps, **static), steps, {}),
    }


def _compiled(
    name: str,
    lowered: Any,
    arguments: tuple[Any, ...],
    named: dict[str, Any],
    older: bool,
) -> _Measured:
    begun = time.perf_counter()
    program = lowered.compile({"xla_cpu_use_fusion_emitters": not older})
    compiling = time.perf_counter() - begun

    def run() -> Any:
        mine = jax.tree.map(lambda x: jax.device_put(np.array(x)), arguments)  # may be donated
        begun = time.perf_counter()
        jax.block_until_ready(program(*mine, **named))
        return time.perf_counter() - begun

    return _Measured(name, older, compiling, run)


def main(arguments: list[str]) -> None:
    del arguments
    measured = [
        _compiled(name, *program, older)
        for name, program in _programs().items()
        for older in (False, True)
    ]
    for each in measured:
        each.run()
    for _ in range(_ROUNDS.value):
        for each in measured:
            each.seconds.append(each.run())
    print("| program | code generator | compiling, s | running, ms (median, least) |")
    print("|---|---|---|---|")
    sums = {older: np.zeros(2) for older in (False, True)}
    for each in measured:
        median, least = 1e3 * np.median(each.seconds), 1e3 * np.min(each.seconds)
        generator = "older" if each.older else "newer"
        print(
            f"| {each.program} | {generator} | {each.compiling:.2f} | {median:.1f}, {least:.1f} |"
        )
        if "steps" not in each.program:
            sums[each.older] += each.compiling, median
    compiling, running = sums[True] / sums[False]
    print(f"\nOlder to newer, without steps: compiling {compiling:.2f}, running {running:.2f}")
    assert compiling <= _LEAST_GAIN, "the older code generator does not compile faster"
    assert running <= _MOST_LOSS, "programs of the older code generator are slower"


if __name__ == "__main__":
    app.run(main)
