"""The order of jobs, and the engines that do them, with jobs that are functions."""

import threading

import pytest

from experiments.benchmarking import worker
from experiments.benchmarking.methods import RECONSTRUCTION
from experiments.benchmarking.plan import Job
from experiments.benchmarking.worker import LocalEngine
from experiments.cli import subprocesses
from experiments.cli.subprocesses import RunFailedError
from tests.experiments.benchmarking.made_records import SETTINGS


def made_job(scene, method, *, reconstructed=False):
    return Job(scene, "/nowhere", "", method, (), reconstructed, SETTINGS, None)


_WITH_RECONSTRUCTION = [
    made_job("a", RECONSTRUCTION),
    made_job("a", "tree"),
    made_job("a", "r3f", reconstructed=True),
    made_job("b", "r3f", reconstructed=True),  # reconstructed by an earlier command
]


def _work(todo, run, workers=1):
    done = []
    engine = LocalEngine(None, workers, lambda out, job: run(job))
    worker.run_in_order(todo, engine, lambda job, reason: done.append((job.name, reason)))
    return done


def test_a_job_begins_after_the_one_that_it_waits_for():
    begun = []
    done = _work(_WITH_RECONSTRUCTION, lambda job: begun.append(job.name))
    assert begun == [f"a/{RECONSTRUCTION}", "a/tree", "b/r3f", "a/r3f"]
    assert done == [(name, None) for name in begun]


def test_who_waits_for_a_failure_fails_with_its_reason_and_the_others_go_on():
    done = dict(
        _work(
            _WITH_RECONSTRUCTION,
            lambda job: "no masks" if job.method == RECONSTRUCTION else None,
        )
    )
    assert done == {
        f"a/{RECONSTRUCTION}": "no masks",
        "a/r3f": "reconstruction failed: no masks",
        "a/tree": None,
        "b/r3f": None,
    }


def test_several_are_done_at_once():
    both = threading.Barrier(2, timeout=20.0)
    jobs = [made_job("a", "straight"), made_job("a", "tree")]
    assert len(_work(jobs, lambda job: both.wait() and None, workers=2)) == 2


def test_nothing_to_do_is_done():
    assert _work([], lambda job: None) == []


def test_an_interruption_stops_what_runs_and_begins_nothing_more():
    begun = []

    def run(job):
        begun.append(job.name)
        return "stopped"

    def interrupted(job, reason):
        raise KeyboardInterrupt

    jobs = [made_job(scene, "tree") for scene in "abcdef"]
    with pytest.raises(KeyboardInterrupt):
        worker.run_in_order(jobs, LocalEngine(None, 1, lambda out, job: run(job)), interrupted)
    assert len(begun) < len(jobs)


def test_commands_are_stopped_and_none_starts_while_stopping(tmp_path, monkeypatch):
    """A command that sleeps is asked to stop by another thread."""
    start = subprocesses.subprocess.Popen
    started = threading.Event()

    def popen(command, **options):
        process = start([command[0], "-c", "import time; time.sleep(60)"], **options)
        started.set()
        return process

    monkeypatch.setattr(subprocesses.subprocess, "Popen", popen)
    raised = []

    def wait():
        try:
            subprocesses.run("train", log=tmp_path / "log")
        except RunFailedError as error:
            raised.append(str(error))

    thread = threading.Thread(target=wait)
    thread.start()
    assert started.wait(20.0)
    with subprocesses.stopping():
        thread.join(20.0)
        assert not thread.is_alive()
        with pytest.raises(RunFailedError, match="stopped before it began"):
            subprocesses.run("train", log=tmp_path / "log")
    assert len(raised) == 1 and "killed by SIGTERM" in raised[0]
