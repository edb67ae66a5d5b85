"""Jobs on a Ray cluster, which is this machine. Commands are stood in for, in its workers too."""

import os
import time

import pytest

from experiments.benchmarking import methods, plan, results, settings, worker
from experiments.benchmarking.worker import LocalEngine, RayEngine
from tests.factories.made_benchmark import SETTINGS, write_scene
from tests.fakes.job_commands import run_with_stand_in

pytestmark = pytest.mark.slow


@pytest.fixture
def planned(tmp_path, stand_in, monkeypatch):
    pytest.importorskip("ray")
    # Else workers wait for all that a busy machine does besides.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    for name in ("cube_smcvx_ball", "env_mmncvx_cup"):
        write_scene(tmp_path / "scenes" / name)
    scenes = plan.find_scenes([str(tmp_path / "scenes" / "*")])
    return plan.plan_jobs(scenes, methods.parse(["straight", "r3f", "tree"]), SETTINGS)[0]


def _work(todo, engine):
    done = {}
    worker.run_in_order(todo, engine, lambda job, reason: done.update({job.name: reason}))
    return done


def _metrics(out):
    found = results.read_all(out, settings.asked(SETTINGS, [], []))
    return {(record.scene, record.method): (record.metrics, record.per_image) for record in found}


def test_a_cluster_comes_to_the_same_results_and_a_failure_is_told(tmp_path, planned, monkeypatch):
    here, there = tmp_path / "here", tmp_path / "there"
    assert set(_work(planned, LocalEngine(here, 2, run_with_stand_in)).values()) == {None}
    monkeypatch.setenv("FAIL", "cup/tree")
    engine = RayEngine(there, "local", cpus=0.25, gpus=0.0, run=run_with_stand_in)
    done = _work(planned, engine)
    failed = {name: reason for name, reason in done.items() if reason is not None}
    assert list(failed) == ["env_mmncvx_cup/tree"]
    assert "The stand-in was told to fail" in failed["env_mmncvx_cup/tree"]
    monkeypatch.setenv("FAIL", "^$")
    missing = [job for job in planned if not plan.is_done(there, job)]
    assert [job.name for job in missing] == list(failed)
    engine = RayEngine(there, "local", cpus=1.0, gpus=0.0, run=run_with_stand_in)
    assert _work(missing, engine) == {"env_mmncvx_cup/tree": None}
    assert _metrics(there) == _metrics(here) and len(_metrics(here)) == len(planned)
    # Its commands ran in processes of others.
    pids = {line.split()[2] for line in (tmp_path / "calls.txt").read_text().splitlines()}
    assert str(os.getpid()) not in pids


def test_what_no_machine_has_is_refused(tmp_path, planned):
    with pytest.raises(ValueError, match=r"No job can start.*--job_gpus"):
        RayEngine(tmp_path, "local", cpus=1.0, gpus=99.0, run=run_with_stand_in)


def test_a_job_that_is_interrupted_stops_its_command(tmp_path, planned, monkeypatch):
    monkeypatch.setenv("PACE", "60")
    engine = RayEngine(tmp_path / "out", "local", cpus=1.0, gpus=0.0, run=run_with_stand_in)
    engine.submit(planned[1])
    calls = tmp_path / "calls.txt"
    for _ in range(3000):
        if calls.exists() and calls.read_text().endswith("\n"):
            break
        engine._ray.wait(list(engine._taken), timeout=0.1)
    pid = int(calls.read_text().split()[2])
    start = time.monotonic()
    engine.stop()
    assert time.monotonic() - start < 50.0  # else it gave up waiting after a minute
    with pytest.raises(ProcessLookupError):
        for _ in range(600):
            os.kill(pid, 0)
            time.sleep(0.1)
    assert not plan.is_done(tmp_path / "out", planned[1])
