"""Who does the jobs of a benchmark: threads here that wait for commands, or a Ray cluster.

An engine takes jobs, and gives each back when it is done, with the reason if it failed. All do
`running.run`, and none knows of what a job waits for; see `schedule`.
"""

import socket
from collections.abc import Callable
from concurrent import futures
from pathlib import Path
from typing import Any, Protocol

from experiments.benchmarking import running
from experiments.benchmarking.jobs import Job
from experiments.cli import subprocesses as child_process

# Ray itself tries for many minutes, while nobody is told.
_SECONDS_TO_ANSWER = 10.0

Run = Callable[[Path, Job], str | None]
"""Does a job of the benchmark in a folder; returns why it failed, or `None`."""


class Engine(Protocol):
    """What does jobs."""

    def submit(self, job: Job) -> None:
        """Takes a job."""

    def next(self) -> tuple[Job, str | None]:
        """Waits for a job that was taken, and returns it and why it failed, if it did."""

    def stop(self) -> None:
        """Gives up all jobs that are not done; those that have begun may save first."""


class LocalEngine:
    """Some jobs at once on this machine."""

    def __init__(self, out: Path, workers: int, run: Run = running.run) -> None:
        """Starts threads, each of which does one job at a time.

        Args:
          out: folder of the benchmark.
          workers: how many.
          run: what they do.
        """
        self._out, self._run = out, run
        self._pool = futures.ThreadPoolExecutor(workers)
        self._taken: dict[futures.Future[str | None], Job] = {}

    def submit(self, job: Job) -> None:
        """Takes a job."""
        self._taken[self._pool.submit(self._run, self._out, job)] = job

    def next(self) -> tuple[Job, str | None]:
        """Waits for a job."""
        done, _ = futures.wait(self._taken, return_when=futures.FIRST_COMPLETED)
        future = next(future for future in self._taken if future in done)
        return self._taken.pop(future), future.result()

    def stop(self) -> None:
        """Asks all commands to stop, and waits until they have."""
        with child_process.stopping():
            self._pool.shutdown(cancel_futures=True)


class RayEngine:
    """Jobs on a Ray cluster, whose machines see this folder and these modules by the same paths."""

    def __init__(
        self, out: Path, address: str, *, cpus: float, gpus: float, run: Run = running.run
    ) -> None:
        """Connects to a cluster.

        Args:
          out: folder of the benchmark, on a file system that all machines share.
          address: of the cluster; `local` starts one on this machine.
          cpus: that a job takes of a machine's.
          gpus: the same of accelerators.
          run: what is done.

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
                f"No job will ever start: one takes {cpus:g} CPUs and {gpus:g} GPUs, and the "
                f"cluster has {resources.get('CPU', 0.0):g} and {resources.get('GPU', 0.0):g} in "
                "all. Lower --job_cpus or --job_gpus."
            )

    def submit(self, job: Job) -> None:
        """Takes a job."""
        self._taken[self._work.remote(self._out, job)] = job

    def next(self) -> tuple[Job, str | None]:
        """Waits for a job; one whose machine was lost has failed."""
        (done,), _ = self._ray.wait(list(self._taken), num_returns=1)
        job = self._taken.pop(done)
        try:
            return job, self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            return job, f"Ray: {' '.join(str(error).split())}"

    def stop(self) -> None:
        """Interrupts all jobs, whose commands may save, and leaves the cluster."""
        for task in self._taken:
            self._ray.cancel(task, force=False)
        if self._taken:
            self._ray.wait(list(self._taken), num_returns=len(self._taken), timeout=60.0)
        self._ray.shutdown()


def import_ray() -> Any:
    """Returns Ray.

    Raises:
      ValueError: if it is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            "Ray is not installed. Run pip install -e '.[cluster]', or leave out --ray to do "
            "the jobs on this machine."
        ) from error
    return ray


def connect(ray: Any, address: str) -> None:
    """Connects to a cluster, whose processes find these modules.

    Raises:
      ValueError: if there is none at that address.
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
            f"There is no Ray cluster at {address} ({error}). Start one with ray start --head, and "
            "give what it prints, or --ray=local."
        ) from error


def _await_answer(address: str) -> None:
    """Raises an `OSError` if nothing listens at `host:port` or `ray://host:port`."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), _SECONDS_TO_ANSWER).close()
