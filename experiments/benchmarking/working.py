"""Does the jobs of a benchmark that are missing, and writes its summary after each."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.benchmarking import jobs, schedule, summary
from experiments.benchmarking.engines import Engine
from experiments.benchmarking.jobs import Job, Skipped
from experiments.benchmarking.settings import Benchmark
from experiments.cli.progress import ProgressBar


def work(
    out: Path,
    benchmark: Benchmark,
    planned: Sequence[Job],
    skipped: Sequence[Skipped],
    *,
    engine: Callable[[], Engine],
) -> dict[str, str]:
    """Does the jobs that are missing, and returns why some of them failed, by name.

    What failed or was left out before stays in the summary until that is otherwise: a job that
    failed, until it has been done again.

    Args:
      out: folder of the benchmark.
      benchmark: what it was begun with.
      planned: what it is to do now.
      skipped: what is left out now.
      engine: makes what does the jobs; it is not asked if there are none.
    """
    failed_before, skipped_before = summary.not_done(out)
    now = {each.name for each in (*planned, *skipped)}
    left_out = [*(each for each in skipped_before if each.name not in now), *skipped]
    names = {each.name for each in skipped}
    told = {name: reason for name, reason in failed_before.items() if name not in names}
    summary.write(out, benchmark, failed=told, skipped=left_out)
    missing = [job for job in planned if not jobs.is_done(out, job)]
    if not missing:
        print("All jobs are done already." if planned else "All jobs are left out.")
        return {}
    failed: dict[str, str] = {}
    start, count = time.monotonic(), 0
    doing = engine()
    with ProgressBar("benchmark", len(missing)) as bar:

        def done(job: Job, reason: str | None) -> None:
            nonlocal count
            count += 1
            told.pop(job.name, None)
            if reason is not None:
                failed[job.name] = told[job.name] = reason
            summary.write(out, benchmark, failed=told, skipped=left_out)
            left = (time.monotonic() - start) / count * (len(missing) - count)
            end = "failed" if reason is not None else "done"
            bar.show(count, f"{job.name} {end}, about {_duration(left)} left")

        schedule.work(missing, doing, done)
    return failed


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
