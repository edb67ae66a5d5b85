"""Claim: a backdrop costs time and memory in proportion to its rays, and 64 million pixels fit.

    python -m benchmarks.backdrop_cost
    python -m benchmarks.backdrop_cost --scene=FOLDER --enlarge=4

Solves the backdrop of a scene for two iterations, each point in a process of its own, around a base
of all training views, one ray per pixel and 384 cells: with a fraction of the views, with more rays
per pixel, and with other numbers of cells. With `--enlarge`, only the base is run, with training
images that are enlarged by this factor: their content does not matter to the cost. Prints seconds
of tracing, seconds of the second iteration, and the peak memory of the process. Asserted is that
the peak stays below `--most_gib`.
"""

import functools
import json
import multiprocessing
import resource
import sys
import time
from pathlib import Path

import numpy as np
from absl import app, flags

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_ENLARGE = flags.DEFINE_integer(
    "enlarge", 1, "Factor of the width of the training images; above 1, a single point is run."
)
_MOST = flags.DEFINE_float("most_gib", 24.0, "Largest peak memory of a process, GiB.")

_BASE = {"views": 1.0, "rays_per_pixel": 1, "cells": 384}
_POINTS = (
    _BASE,
    *({**_BASE, "views": views} for views in (0.25, 0.5)),
    *({**_BASE, "rays_per_pixel": rays} for rays in (4, 9)),
    *({**_BASE, "cells": cells} for cells in (96, 192, 768)),
)


def measure(scene: str, enlarge: int, point: dict[str, float]) -> dict[str, float]:
    """Returns what one point costs; to be called in a process of its own."""
    from refref_jax import TrainConfig
    from refref_jax.data import scene_folder
    from refref_jax.training import backdrop_equations, backdrop_solver, fit

    config = TrainConfig().override(scene=scene, far_field="backdrop", paths="tree")
    resolved, objects = fit.prepare(config, report=lambda line: None)
    frames = scene_folder.read_frames(Path(scene), "train")
    chosen = slice(0, max(1, round(point["views"] * len(frames.cameras.poses))))
    images = scene_folder.read_images(frames)[chosen]
    images = images.repeat(enlarge, axis=1).repeat(enlarge, axis=2)
    cameras = frames.cameras._replace(
        poses=frames.cameras.poses[chosen],
        height=images.shape[1],
        width=images.shape[2],
        focal=enlarge * frames.cameras.focal,
    )
    cells, domain = int(point["cells"]), resolved.model.config.domain
    start = time.monotonic()
    blocks = backdrop_equations.read(
        objects,
        cameras,
        images,
        settings=resolved.model.settings,
        domain=domain,
        resolution=cells,
        side=round(point["rays_per_pixel"] ** 0.5),
        progress=functools.partial(print, "view", file=sys.stderr),
    )
    traced = time.monotonic() - start
    times = [
        time.monotonic()
        for _ in backdrop_solver.solve(
            blocks, space=domain.space, resolution=cells, iterations=2, thinned_rounds=0
        )
    ]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "pixels": int(np.prod(images.shape[:3])),
        "tracing": traced,
        "iteration": times[1] - times[0],
        "peak_gib": peak,
    }


def main(arguments: list[str]) -> None:
    del arguments
    context = multiprocessing.get_context("spawn")
    print("pixels,rays_per_pixel,cells,tracing,iteration,peak_gib")
    for point in _POINTS if _ENLARGE.value == 1 else (_BASE,):
        with context.Pool(1) as pool:
            found = pool.apply(measure, (_SCENE.value, _ENLARGE.value, point))
        print(
            f"{found['pixels']},{point['rays_per_pixel']},{point['cells']},{found['tracing']:.1f},"
            f"{found['iteration']:.2f},{found['peak_gib']:.1f}",
            flush=True,
        )
        assert found["peak_gib"] < _MOST.value, json.dumps({**point, **found})


if __name__ == "__main__":
    app.run(main)
