"""Runs the jobs of a benchmark: a single one, or all missing ones on an engine.

A job is a sequence of commands in separate processes: `reconstruct`, or `train` and `evaluate`, or
`metrics` for given renderings. An interrupted job resumes where it stopped, and a finished one is
not repeated (`run_job`).

An engine accepts jobs and returns each when it is finished, with a reason if it failed: local
threads that wait for commands, or a Ray cluster. Engines ignore dependencies, which `run_in_order`
handles. `run_missing` also updates the summary after each job.
"""

import dataclasses
import socket
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

import refref_jax
from experiments.benchmarking import (
    externals,
    plan,
    pose_space,
    results,
    scene_lists,
    summary,
)
from experiments.benchmarking.methods import RECONSTRUCTION
from experiments.benchmarking.plan import SPLIT, Job, Skipped
from experiments.benchmarking.results import Costs, Image, Record, Truth, View, number
from experiments.benchmarking.settings import Benchmark
from experiments.cli.progress import ProgressBar
from experiments.r3f import records
from experiments.runs import measured_runs, renderings, subprocesses
from experiments.runs.subprocesses import RunFailedError
from refref_jax import atomic_files, configuration
from refref_jax.data import scene_folder

# Seconds that a command which outlived its benchmark may take to save and end: on a busy machine
# compilation alone takes minutes, and cannot be interrupted.
_PATIENCE = 600.0

# Ray itself tries for many minutes, without any output.
_SECONDS_TO_ANSWER = 10.0

Run = Callable[[Path, Job], str | None]
"""Runs a job of the benchmark in a folder; returns the reason if it failed, or `None`."""

Done = Callable[[Job, str | None], None]
"""Called with a finished job, and the reason if it failed."""


def run_job(out: Path, job: Job) -> str | None:
    """Runs a job, unless it is finished.

    Args:
      out: folder of the benchmark.
      job: job to run.

    Returns:
      The reason if it failed, otherwise `None`.
    """
    if plan.is_done(out, job):
        return None
    folder = plan.job_folder(out, job)
    try:
        _check_scene(job)
        folder.mkdir(parents=True, exist_ok=True)
        record = _worker_of(job)(job, folder)
        _check_scene(job)
        results.write(folder, record)
    except (RunFailedError, ValueError, OSError) as error:
        return str(error)
    except Exception as error:  # The other jobs continue, whatever the error is.
        log = folder / "error.txt"
        log.write_text(traceback.format_exc(), encoding="utf-8")
        return f"{type(error).__name__}: {error} (all of it: {log})"
    return None


def _worker_of(job: Job) -> Callable[[Job, Path], Record]:
    """Returns the function that does the work of a job in its folder."""
    if job.external:
        return _measure
    return _reconstruct if job.method == RECONSTRUCTION else _learn


def wait_until_free(folder: Path, patience: float = _PATIENCE) -> None:
    """Waits while a process of an earlier benchmark works in a folder, and prints a message.

    Raises:
      ValueError: if that process still works there after `patience` seconds.
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
                print(f"Waiting for the process that still works in {folder}.", flush=True)
                said = True
            time.sleep(0.2)


def _check_scene(job: Job) -> None:
    """Rejects a scene whose files have changed since the job was planned."""
    if plan.fingerprint(Path(job.path), job.properties, job.overlay) != job.fingerprint:
        raise ValueError(
            f"Cameras, meshes, images, scene.json or properties of {job.path} have changed since "
            "the benchmark was started. Restore them, or start another benchmark."
        )


def _reconstruct(job: Job, folder: Path) -> Record:
    out = folder / "run"
    wait_until_free(out)
    options = plan.options(job.method, job.train, job.settings)
    given = [*scene_lists.for_background(job.properties), *_overlay(job)]
    command = [f"--scene={job.path}", f"--out={out}", *options["reconstruct"], *given]
    seconds, peak = subprocesses.run("reconstruct", *command, log=folder / "run.log")
    found = records.read(out)
    return _record(job)._replace(
        options=options | _properties(job),
        costs=Costs(seconds=seconds, peak_host_mib=peak),
        facts={"index": dataclasses.asdict(found.index)},
    )


def _learn(job: Job, folder: Path) -> Record:
    run_, scene = folder / "run", Path(job.path)
    options = plan.options(job.method, job.train, job.settings)
    objects = [*job.properties, *_overlay(job)]
    if job.reconstructed:
        objects = [
            *scene_lists.for_object(objects),
            f"--reconstruction={folder.parent / RECONSTRUCTION / 'run'}",
        ]
    weights = _lpips_weights(job)
    wait_until_free(run_)
    cost = measured_runs.train(run_, scene=scene, options=[*options["train"], *objects])
    measured_runs.evaluate(run_, scene=scene, options=[*options["evaluate"], *weights], split=SPLIT)
    costs = Costs(**dataclasses.asdict(cost))
    made = _record(job)._replace(options=options | _properties(job), costs=costs)
    return _with_metrics(made, run_ / "eval" / SPLIT / "metrics.json", scene)


def _measure(job: Job, folder: Path) -> Record:
    """Copies the renderings of an external method, and measures the copies."""
    # A result of other renderings must not outlive them.
    (folder / plan.RESULT).unlink(missing_ok=True)
    out, scene = folder / "run" / "eval" / SPLIT, Path(job.path)
    frames, limit = scene_folder.read_frames(scene, SPLIT), job.settings.limit
    renderings.copy(renderings.find(Path(job.external), frames, limit=limit), out)
    if externals.digest(out, scene, split=SPLIT, limit=limit) != job.digest:
        raise ValueError(
            f"The files of {job.external} have changed since the benchmark was started. Repeat the "
            "command to measure them."
        )
    options = plan.external_options(job.settings, job.digest)
    words = [*options["metrics"], f"--out={out / 'metrics.json'}", "--overwrite"]
    words += _lpips_weights(job)
    subprocesses.run("metrics", str(out), job.path, *words, log=folder / "run.log")
    made = _record(job)._replace(options=options | _properties(job))
    return _with_metrics(made, out / "metrics.json", scene)


def _lpips_weights(job: Job) -> list[str]:
    return [] if job.lpips_weights is None else [f"--lpips_weights={job.lpips_weights}"]


def _with_metrics(record: Record, path: Path, scene: Path) -> Record:
    """Adds the metrics of an evaluation to a record."""
    summary = configuration.parse_json(path.read_text("utf-8"))
    metrics = {key: number(value, key) for key, value in summary["results"].items()}
    # Tables only contain reproducible numbers.
    seconds = metrics.pop("seconds_per_image", None)
    frames, apart = _frames(scene)
    per_image = [_image(image, apart) for image in summary["per_image"]]
    return record._replace(
        metrics=metrics,
        per_image=per_image,
        costs=record.costs._replace(seconds_per_image=seconds),
        views=[_view(image.name, frames, scene) for image in per_image],
        facts={key: summary[key] for key in ("learned",) if summary.get(key) is not None},
    )


def _overlay(job: Job) -> list[str]:
    return [f"--properties={job.overlay}"] if job.overlay else []


def _properties(job: Job) -> dict[str, list[str]]:
    """Returns the properties given with the scene of a job, for its record."""
    given = plan.given_properties(job)
    return {plan.PROPERTIES: given} if given else {}


def _image(entry: dict[str, Any], apart: Mapping[str, float]) -> Image:
    """Returns an image's entry of an evaluation, with its distance from the training views."""
    metrics = {key: number(value, key) for key, value in entry.items() if key != "name"}
    name, seconds = entry["name"], metrics.pop("seconds", None)
    return Image(name, apart[name], seconds, metrics)


def _record(job: Job) -> Record:
    """Returns a record with the fields that all jobs share."""
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


def _frames(scene: Path) -> tuple[scene_folder.Frames, dict[str, float]]:
    """Returns the test views, and the distance of each from the training views, by name."""
    frames = scene_folder.read_frames(scene, SPLIT)
    training = scene_folder.read_frames(scene, "train").cameras.poses
    apart = pose_space.distances(np.asarray(frames.cameras.poses), np.asarray(training))
    return frames, {
        name: float(distance) for name, distance in zip(frames.names, apart, strict=True)
    }


def _view(name: str, frames: scene_folder.Frames, scene: Path) -> View:
    """Returns the paths of a view's files; see docs/benchmark.md."""
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


class Engine(Protocol):
    """Interface of engines that run jobs."""

    def submit(self, job: Job) -> None:
        """Accepts a job."""

    def next(self) -> tuple[Job, str | None]:
        """Waits for an accepted job; returns it, and the reason if it failed."""

    def stop(self) -> None:
        """Stops all unfinished jobs; those that run may save their state first."""


class LocalEngine:
    """Runs several jobs at a time on this machine."""

    def __init__(self, out: Path, workers: int, run: Run = run_job) -> None:
        """Starts threads, each of which runs one job at a time.

        Args:
          out: folder of the benchmark.
          workers: number of threads.
          run: function that runs a job.
        """
        self._out, self._run = out, run
        self._pool = futures.ThreadPoolExecutor(workers)
        self._taken: dict[futures.Future[str | None], Job] = {}

    def submit(self, job: Job) -> None:
        """Accepts a job."""
        self._taken[self._pool.submit(self._run, self._out, job)] = job

    def next(self) -> tuple[Job, str | None]:
        """Waits for a job."""
        done, _ = futures.wait(self._taken, return_when=futures.FIRST_COMPLETED)
        future = next(future for future in self._taken if future in done)
        return self._taken.pop(future), future.result()

    def stop(self) -> None:
        """Stops all commands gracefully, and waits for them."""
        with subprocesses.stopping():
            self._pool.shutdown(cancel_futures=True)


class RayEngine:
    """Runs jobs on a Ray cluster, whose machines need the same paths of folder and modules."""

    def __init__(
        self, out: Path, address: str, *, cpus: float, gpus: float, run: Run = run_job
    ) -> None:
        """Connects to a cluster.

        Args:
          out: folder of the benchmark, on a file system that all machines share.
          address: address of the cluster; `local` starts one on this machine.
          cpus: number of CPUs per job.
          gpus: number of accelerators per job.
          run: function that runs a job.

        Raises:
          ValueError: if Ray is not installed, or there is no such cluster.
        """
        self._ray = import_ray()
        connect(self._ray, address)
        self._out = out
        self._work = self._ray.remote(num_cpus=cpus, num_gpus=gpus)(run)
        self._taken: dict[Any, Job] = {}
        resources = self._ray.cluster_resources()
        counts = [resources.get("CPU", 0.0) / cpus] if cpus else []
        counts += [resources.get("GPU", 0.0) / gpus] if gpus else []
        if any(count < 1.0 for count in counts):
            self._ray.shutdown()
            raise ValueError(
                f"No job can start: one needs {cpus:g} CPUs and {gpus:g} GPUs, but the "
                f"cluster has {resources.get('CPU', 0.0):g} and {resources.get('GPU', 0.0):g}. "
                "Reduce --job_cpus or --job_gpus."
            )

    def submit(self, job: Job) -> None:
        """Accepts a job."""
        self._taken[self._work.remote(self._out, job)] = job

    def next(self) -> tuple[Job, str | None]:
        """Waits for a job; it has failed if its machine was lost."""
        (done,), _ = self._ray.wait(list(self._taken), num_returns=1)
        job = self._taken.pop(done)
        try:
            return job, self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            return job, f"Ray: {' '.join(str(error).split())}"

    def stop(self) -> None:
        """Interrupts all jobs, whose commands may save, and disconnects from the cluster."""
        for task in self._taken:
            self._ray.cancel(task, force=False)
        if self._taken:
            self._ray.wait(list(self._taken), num_returns=len(self._taken), timeout=60.0)
        self._ray.shutdown()


def import_ray() -> Any:
    """Imports Ray.

    Raises:
      ValueError: if it is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            "Ray is not installed. Run pip install -e '.[cluster]', or remove --ray to run "
            "the jobs on this machine."
        ) from error
    return ray


def connect(ray: Any, address: str) -> None:
    """Connects to a cluster, and makes these modules importable in its processes.

    Raises:
      ValueError: if there is no cluster at that address.
    """
    root = str(Path(__file__).resolve().parents[2])
    try:
        _await_answer(address)
        ray.init(
            address=address,
            runtime_env={"env_vars": {"PYTHONPATH": root}},
            include_dashboard=False if address == "local" else None,
            logging_level="error",
            log_to_driver=False,
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"There is no Ray cluster at {address} ({error}). Start one with ray start --head and "
            "pass the address that it prints, or use --ray=local."
        ) from error


def _await_answer(address: str) -> None:
    """Raises an `OSError` if nothing listens at `host:port` or `ray://host:port`."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), _SECONDS_TO_ANSWER).close()


def run_in_order(todo: Sequence[Job], engine: Engine, done: Done) -> None:
    """Runs jobs on an engine in the order of their dependencies.

    A job that depends on another one starts when that is finished, and fails if that fails. The
    engine is stopped at the end, and at an interruption.
    """
    awaited = {job.name for job in todo}
    waiting = [job for job in todo if job.awaited in awaited]
    begun = 0
    try:
        for job in todo:
            if job.awaited not in awaited:
                engine.submit(job)
                begun += 1
        while begun:
            job, reason = engine.next()
            begun -= 1
            done(job, reason)
            for next_ in [each for each in waiting if each.awaited == job.name]:
                waiting.remove(next_)
                if reason is None:
                    engine.submit(next_)
                    begun += 1
                else:
                    done(next_, f"{job.method} failed: {reason}")
    finally:
        engine.stop()


def run_missing(
    out: Path,
    benchmark: Benchmark,
    planned: Sequence[Job],
    skipped: Sequence[Skipped],
    *,
    engine: Callable[[], Engine],
) -> dict[str, str]:
    """Runs the missing jobs, and returns the reasons of failures, by name.

    Earlier failed and skipped jobs remain in the summary until they have run again or are planned
    differently.

    Args:
      out: folder of the benchmark.
      benchmark: its settings, scenes and methods.
      planned: jobs to run now.
      skipped: methods skipped now.
      engine: function that creates the engine; not called if no jobs are missing.
    """
    failed_before, skipped_before = summary.not_done(out)
    now = {each.name for each in (*planned, *skipped)}
    left_out = [*(each for each in skipped_before if each.name not in now), *skipped]
    names = {each.name for each in skipped}
    reported = {name: reason for name, reason in failed_before.items() if name not in names}
    summary.write(out, benchmark, failed=reported, skipped=left_out)
    missing = [job for job in planned if not plan.is_done(out, job)]
    if not missing:
        print("All jobs are already finished." if planned else "All jobs are skipped.")
        return {}
    failed: dict[str, str] = {}
    start, count = time.monotonic(), 0
    doing = engine()
    with ProgressBar("benchmark", len(missing)) as bar:

        def done(job: Job, reason: str | None) -> None:
            nonlocal count
            count += 1
            reported.pop(job.name, None)
            if reason is not None:
                failed[job.name] = reported[job.name] = reason
            summary.write(out, benchmark, failed=reported, skipped=left_out)
            left = (time.monotonic() - start) / count * (len(missing) - count)
            end = "failed" if reason is not None else "done"
            bar.show(count, f"{job.name} {end}, about {_duration(left)} left")

        run_in_order(missing, doing, done)
    return failed


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
