"""Does one job of a benchmark: the same function here, in another process, or on another machine.

A job is a chain of commands, each in a process of its own: `reconstruct`, or `train` and
`evaluate`. Killed at any time, it goes on where it was when it is done again, and one that has left
its result is not done again.
"""

import dataclasses
import json
import time
import traceback
from pathlib import Path
from typing import Any

import jax
import numpy as np

import refref_jax
from experiments import child_process, commands, trained_runs
from experiments.benchmarking import jobs, pose_space, records
from experiments.benchmarking.jobs import Job
from experiments.benchmarking.methods import RECONSTRUCTION
from experiments.benchmarking.records import Record
from experiments.child_process import RunFailedError
from experiments.r3f import records as reconstructions
from refref_jax.data import local_layout
from refref_jax.training import run_lock

SPLIT = "test"

# Seconds that a command which outlived its benchmark may take to save and end.
_PATIENCE = 120.0


def run(out: Path, job: Job) -> str | None:
    """Does a job, unless it is done.

    Args:
      out: folder of the benchmark.
      job: what to do.

    Returns:
      Why it failed, or `None` if it is done.
    """
    if jobs.is_done(out, job):
        return None
    folder = jobs.folder(out, job)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        record = _reconstruct(job, folder) if job.method == RECONSTRUCTION else _learn(job, folder)
        records.write(folder, record)
    except (RunFailedError, ValueError, OSError) as error:
        return str(error)
    except Exception as error:  # The others go on, whatever this is.
        log = folder / "error.txt"
        log.write_text(traceback.format_exc(), encoding="utf-8")
        return f"{type(error).__name__}: {error} (all of it: {log})"
    return None


def wait_until_free(folder: Path, patience: float = _PATIENCE) -> None:
    """Waits while a process that an earlier benchmark left behind works in a folder.

    Raises:
      ValueError: if it still does after so many seconds.
    """
    end = time.monotonic() + patience
    while folder.is_dir():
        try:
            with run_lock.hold(folder):
                return
        except ValueError:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def _reconstruct(job: Job, folder: Path) -> Record:
    out = folder / "run"
    wait_until_free(out)
    options = [f"--seed={job.settings.seed}"]
    command = [f"--scene={job.path}", f"--out={out}", *options]
    seconds, peak = child_process.run("reconstruct", *command, log=folder / "run.log")
    found = reconstructions.read(out)
    return _record(job)._replace(
        options={"reconstruct": options},
        costs={"seconds": seconds, "peak_host_mib": peak},
        facts={"index": dataclasses.asdict(found.index)},
    )


def _learn(job: Job, folder: Path) -> Record:
    run_, scene = folder / "run", Path(job.path)
    train = [*job.settings.training(), *job.train]
    objects = []
    if job.reconstructed:
        objects = [f"--reconstruction={folder.parent / RECONSTRUCTION / 'run'}"]
    evaluate = list(job.settings.evaluation())
    weights = [] if job.lpips_weights is None else [f"--lpips_weights={job.lpips_weights}"]
    wait_until_free(run_)
    cost = trained_runs.train(run_, scene=scene, options=[*train, *objects])
    trained_runs.evaluate(run_, scene=scene, options=[*evaluate, *weights], split=SPLIT)
    summary = commands.from_string_safe(
        json.loads((run_ / "eval" / SPLIT / "metrics.json").read_text("utf-8"))
    )
    costs = dataclasses.asdict(cost)
    # Tables are of what does not change from one time to the next.
    costs["seconds_per_image"] = summary["results"].pop("seconds_per_image")
    frames, apart = _frames(scene)
    return _record(job)._replace(
        options={"train": train, "evaluate": evaluate},
        metrics=summary["results"],
        per_image=[
            {**image, "pose_distance": apart[image["name"]]} for image in summary["per_image"]
        ],
        costs=costs,
        views=[_view(image["name"], frames, scene) for image in summary["per_image"]],
        facts={key: summary[key] for key in ("learned",) if summary.get(key) is not None},
    )


def _record(job: Job) -> Record:
    """Returns what any result of a job has."""
    category, background = records.category_and_background(job.scene)
    return Record(
        scene=job.scene,
        category=category,
        background=background,
        method=job.method,
        options={},
        settings=dataclasses.asdict(job.settings),
        metrics={},
        per_image=[],
        costs={},
        versions={"jax": jax.__version__, "refref_jax": refref_jax.__version__},
        views=[],
        scene_path=job.path,
        facts={},
    )


def _frames(scene: Path) -> tuple[local_layout.Frames, dict[str, float]]:
    """Returns the test views, and how far each is from the training views, by name."""
    frames = local_layout.read_frames(scene, SPLIT)
    training = local_layout.read_frames(scene, "train").cameras.poses
    apart = pose_space.distances(np.asarray(frames.cameras.poses), np.asarray(training))
    return frames, {
        name: float(distance) for name, distance in zip(frames.names, apart, strict=True)
    }


def _view(name: str, frames: local_layout.Frames, scene: Path) -> dict[str, Any]:
    """Returns where the files of a view are; see docs/benchmark.md."""
    i = frames.names.index(name)

    def of_scene(paths: tuple[Path, ...] | None) -> str | None:
        return None if paths is None else str(paths[i].relative_to(scene))

    return {
        "name": name,
        "truth": {
            "rgb": of_scene(frames.images),
            "mask": of_scene(frames.masks),
            "distance": of_scene(frames.depths),
        },
        "rgb": f"run/eval/{SPLIT}/rgb/{name}.png",
        "distance": f"run/eval/{SPLIT}/distance/{name}.exr",
    }
