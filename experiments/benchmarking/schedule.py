"""In which order the jobs of a benchmark are done: each after the one that it waits for."""

from collections.abc import Callable, Sequence

from experiments.benchmarking.engines import Engine
from experiments.benchmarking.jobs import Job

Done = Callable[[Job, str | None], None]
"""Is told of a job that is done, and why it failed, if it did."""


def work(todo: Sequence[Job], engine: Engine, done: Done) -> None:
    """Does jobs, as many at once as the engine does.

    A job that waits for another of these begins when that is done, and fails if that fails. The
    engine is stopped in the end, and at an interruption.
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
