"""Does one job of a benchmark: the same function here, in another process, or on another machine.

A job is a chain of commands, each in a process of its own: `reconstruct`, or `train` and
`evaluate`. Killed at any time, it goes on where it was when it is done again, and one that has left
its result is not done again.
"""

import dataclasses
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import refref_jax
from experiments.benchmarking import fingerprints, jobs, pose_space, results
from experiments.benchmarking.jobs import SPLIT, Job
from experiments.benchmarking.methods import RECONSTRUCTION
from experiments.benchmarking.results import Costs, Image, Record, Truth, View, number
from experiments.cli import subprocesses as child_process
from experiments.cli.subprocesses import RunFailedError
from experiments.r3f import records as reconstructions
from experiments.runs import measured_runs as trained_runs
from refref_jax import atomic_files, configuration
from refref_jax.data import local_layout

# Seconds that a command which outlived its benchmark may take to save and end: where others work
# too, compiling alone takes minutes, and what compiles does not look up.
_PATIENCE = 600.0


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
        _check_scene(job)
        folder.mkdir(parents=True, exist_ok=True)
        record = _reconstruct(job, folder) if job.method == RECONSTRUCTION else _learn(job, folder)
        _check_scene(job)
        results.write(folder, record)
    except (RunFailedError, ValueError, OSError) as error:
        return str(error)
    except Exception as error:  # The others go on, whatever this is.
        log = folder / "error.txt"
        log.write_text(traceback.format_exc(), encoding="utf-8")
        return f"{type(error).__name__}: {error} (all of it: {log})"
    return None


def wait_until_free(folder: Path, patience: float = _PATIENCE) -> None:
    """Waits while a process that an earlier benchmark left behind works in a folder, and says so.

    Raises:
      ValueError: if it still does after so many seconds.
    """
    end, said = time.monotonic() + patience, False
    while folder.is_dir():
        try:
            with atomic_files.hold(folder):
                return
        except ValueError:
            if time.monotonic() > end:
                raise
            if not said:
                print(f"Waiting until the process ends that works in {folder} yet.", flush=True)
                said = True
            time.sleep(0.2)


def _check_scene(job: Job) -> None:
    """Refuses to measure a scene whose files are no longer those that the job was planned for."""
    if fingerprints.fingerprint(Path(job.path)) != job.fingerprint:
        raise ValueError(
            f"Cameras, meshes, images or scene.json of {job.path} have changed since the benchmark "
            "was begun. Restore them, or begin another benchmark."
        )


def _reconstruct(job: Job, folder: Path) -> Record:
    out = folder / "run"
    wait_until_free(out)
    options = jobs.options(job.method, job.train, job.settings)
    command = [f"--scene={job.path}", f"--out={out}", *options["reconstruct"]]
    seconds, peak = child_process.run("reconstruct", *command, log=folder / "run.log")
    found = reconstructions.read(out)
    return _record(job)._replace(
        options=options,
        costs=Costs(seconds=seconds, peak_host_mib=peak),
        facts={"index": dataclasses.asdict(found.index)},
    )


def _learn(job: Job, folder: Path) -> Record:
    run_, scene = folder / "run", Path(job.path)
    options = jobs.options(job.method, job.train, job.settings)
    objects = []
    if job.reconstructed:
        objects = [f"--reconstruction={folder.parent / RECONSTRUCTION / 'run'}"]
    weights = [] if job.lpips_weights is None else [f"--lpips_weights={job.lpips_weights}"]
    wait_until_free(run_)
    cost = trained_runs.train(run_, scene=scene, options=[*options["train"], *objects])
    trained_runs.evaluate(run_, scene=scene, options=[*options["evaluate"], *weights], split=SPLIT)
    summary = configuration.parse_json((run_ / "eval" / SPLIT / "metrics.json").read_text("utf-8"))
    metrics = {key: number(value, key) for key, value in summary["results"].items()}
    # Tables are of what does not change from one time to the next.
    seconds = metrics.pop("seconds_per_image")
    frames, apart = _frames(scene)
    per_image = [_image(image, apart) for image in summary["per_image"]]
    return _record(job)._replace(
        options=options,
        metrics=metrics,
        per_image=per_image,
        costs=Costs(**dataclasses.asdict(cost), seconds_per_image=seconds),
        views=[_view(image.name, frames, scene) for image in per_image],
        facts={key: summary[key] for key in ("learned",) if summary.get(key) is not None},
    )


def _image(told: dict[str, Any], apart: Mapping[str, float]) -> Image:
    """Returns what an evaluation says of an image, and how far it is from the training views."""
    metrics = {key: number(value, key) for key, value in told.items() if key != "name"}
    name, seconds = told["name"], metrics.pop("seconds", None)
    return Image(name, apart[name], seconds, metrics)


def _record(job: Job) -> Record:
    """Returns what any result of a job has."""
    category, background = results.category_and_background(job.scene)
    return Record(
        scene=job.scene,
        category=category,
        background=background,
        method=job.method,
        fingerprint=job.fingerprint,
        options={},
        settings=job.settings,
        metrics={},
        per_image=[],
        costs=Costs(),
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


def _view(name: str, frames: local_layout.Frames, scene: Path) -> View:
    """Returns where the files of a view are; see docs/benchmark.md."""
    i = frames.names.index(name)

    def of_scene(paths: tuple[Path, ...] | None) -> str | None:
        return None if paths is None else str(paths[i].relative_to(scene))

    return View(
        name,
        Truth(
            rgb=str(frames.images[i].relative_to(scene)),
            mask=of_scene(frames.masks),
            distance=of_scene(frames.depths),
        ),
        rgb=f"run/eval/{SPLIT}/rgb/{name}.png",
        distance=f"run/eval/{SPLIT}/distance/{name}.exr",
    )
