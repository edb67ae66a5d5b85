"""Trains a small model on rows of devices, and prints what each run measured.

    python -m tests.processes.sharded RUNS [COORDINATOR PROCESSES PROCESS]

`RUNS` is JSON, `{"name": {"devices": 8, "steps": 24, "budget": "paper", "kept": true}}`, and so is
what is printed: by name the `reports` of all steps, the `light` of each batch that was traced, the
`slots` for its paths, the `parts` that these lie in, and whether paths were `kept`. The last state
of a run with a `folder` is saved there, and a run with `resumed` goes on from there.
"""

import dataclasses
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from refref_jax.optics.path_settings import PATH_PRESETS
from refref_jax.training import devices, loop
from refref_jax.training.loop import init_state
from refref_jax.training.run_folder import Checkpoints
from tests.factories import scenes, small_model
from tests.factories.small_model import CONFIG, MODEL


def train(mesh, *, steps, settings, kept=True, folder=None, resumed=None):
    """Returns what a run on some devices measured."""
    schedule = dataclasses.replace(CONFIG.schedule, steps=40)
    config = dataclasses.replace(CONFIG, schedule=schedule)
    scene = scenes.build(scenes.ball(1.3, subdivisions=2))
    setup = loop.set_up(
        config, MODEL, PATH_PRESETS[settings], scene, small_model.sampler(), mesh=mesh
    )
    setup = setup if kept else setup._replace(epoch=None)
    pool = setup.epoch or loop.trace_batches(setup, range(config.schedule.pretraced_batches))
    state = devices.put_everywhere(init_state(config.seed, MODEL, schedule), mesh=mesh)
    if resumed is not None:
        with Checkpoints(Path(resumed), keep=1) as checkpoints:
            state = checkpoints.restore(state)
    reports = []
    for stepped, report in loop.run_steps(setup, state, steps):
        state = stepped
        reports.append(jax.device_get(report))
    if folder is not None:
        with Checkpoints(Path(folder), keep=1) as checkpoints:
            checkpoints.save(state)
    weights = pool.traced.paths.throughput
    return {
        "reports": [[float(x) for x in jax.tree.leaves(report)] for report in reports],
        "params": [float(jnp.sum(jnp.abs(leaf))) for leaf in jax.tree.leaves(state.params)],
        "light": jax.device_get(jax.jit(lambda x: jnp.sum(x, axis=(1, 2)))(weights)).tolist(),
        "slots": weights.shape[1],
        "parts": len(set(map(str, weights.sharding.devices_indices_map(weights.shape).values()))),
        "kept": setup.epoch is not None,
    }


def main(runs, *processes):
    if processes:
        coordinator, count, number = processes
        devices.connect(coordinator=coordinator, processes=int(count), process=int(number))
    found = {}
    for name, options in json.loads(runs).items():
        found[name] = train(devices.row(options.pop("devices")), **options)
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
