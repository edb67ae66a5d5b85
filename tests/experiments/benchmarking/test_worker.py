"""How jobs are done: one, several in order, and what the summary tells meanwhile.

Commands are stood in for, and jobs too where only their order matters.
"""

import dataclasses
import functools
import json
import threading

import pytest

from experiments.benchmarking import methods, plan, results, settings, summary, worker
from experiments.benchmarking.methods import METHODS, RECONSTRUCTION
from experiments.benchmarking.plan import Job
from experiments.benchmarking.worker import LocalEngine
from experiments.runs import subprocesses
from experiments.runs.subprocesses import RunFailedError
from refref_jax import atomic_files
from tests.factories.made_benchmark import SETTINGS, made_record, write_scene

# --- one job ---


@pytest.fixture
def job(tmp_path, stand_in):
    """A job that trains the tree with cones."""
    return _jobs(tmp_path, "tree_cone")[0]


def _jobs(tmp_path, method, common=SETTINGS, **options):
    folder = write_scene(tmp_path / "scenes" / "env_smcvx_ball", **options)
    scenes = plan.find_scenes([str(folder)])
    return plan.plan_jobs(scenes, methods.parse([method]), common)[0]


def _results(out, common=SETTINGS):
    return results.read_all(out, settings.asked(common, [], []))


def test_a_job_leaves_a_result_that_says_all_and_is_done_once(tmp_path, stand_in):
    common = dataclasses.replace(SETTINGS, limit=6)
    (job,) = _jobs(tmp_path, "tree_cone", common)
    out = tmp_path / "out"
    assert worker.run_job(out, job) is None and plan.is_done(out, job)
    assert worker.run_job(out, job) is None
    called = [line.rsplit(" ", 1)[0] for line in stand_in.read_text().splitlines()]
    assert called == [f"train {job.name}", f"evaluate {job.name}"]
    (record,) = _results(out, common)
    assert (record.category, record.background, record.method) == ("smcvx", "env", "tree_cone")
    assert record.options == {
        "train": ["--preset=tiny", "--steps=6", "--seed=0", "--paths=tree", "--footprint=cone"],
        "evaluate": ["--rays_per_pixel=1", "--limit=6"],
    }
    assert record.metrics["lpips"] is None and record.metrics["distance_mae_masked"] == float("inf")
    assert record.costs.steps == 6 and record.costs.seconds_per_image == 2.0
    assert record.costs.peak_host_mib > 1.0
    assert set(record.versions) == {"jax", "refref_jax"}
    # Ever farther from the training view at their start, by 0.5 / 22.4 of a radius.
    scale = (500.0**0.5 + 501.0**0.5) / 2.0
    apart = [image.pose_distance for image in record.per_image]
    assert apart == pytest.approx([0.5 * i / scale for i in range(6)])
    view = record.views[2]
    assert (view.rgb, view.truth.rgb) == ("run/eval/test/rgb/r_002.png", "test/r_002.png")


def test_a_reconstruction_is_given_to_the_methods_that_wait_for_it(tmp_path, stand_in):
    first, second = _jobs(tmp_path, "r3f", meshes=False)
    out = tmp_path / "out"
    assert [worker.run_job(out, job) for job in (first, second)] == [None, None]
    words = (plan.job_folder(out, second) / "run" / "trained_with").read_text()
    assert f"reconstruction={plan.job_folder(out, first) / 'run'}" in words
    everything = _results(out)
    assert [record.method for record in results.compared(everything)] == ["r3f"]
    (found,) = [record for record in everything if record.method == RECONSTRUCTION]
    assert found.facts["index"]["index"] == 1.5 and found.costs.seconds > 0.0
    # Where the reconstruction lies is not of the result, which may move.
    assert str(tmp_path) not in json.dumps([record.options for record in everything])


def test_a_failure_is_a_reason_and_its_job_is_tried_again(tmp_path, job, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setenv("FAIL", "tree")
    assert "told to fail" in worker.run_job(out, job) and not plan.is_done(out, job)
    with monkeypatch.context() as broken:
        broken.setattr(worker.measured_runs, "train", {}.__getitem__)  # a mistake of ours
        reason = worker.run_job(out, job)
    log = plan.job_folder(out, job) / "error.txt"
    assert reason.startswith("TypeError: ") and str(log) in reason
    assert "Traceback" in log.read_text()
    monkeypatch.setenv("FAIL", "^$")
    assert worker.run_job(out, job) is None and plan.is_done(out, job)


def test_a_scene_that_changes_is_refused_by_its_jobs(tmp_path, job, stand_in):
    (tmp_path / "scenes/env_smcvx_ball/scene.json").write_text("{}")
    assert "have changed since the benchmark" in worker.run_job(tmp_path / "out", job)
    assert not plan.is_done(tmp_path / "out", job) and not stand_in.exists()


def test_a_job_waits_for_who_still_works_in_its_run(tmp_path, capsys):
    worker.wait_until_free(tmp_path / "nothing")
    worker.wait_until_free(tmp_path)
    with atomic_files.hold(tmp_path), pytest.raises(ValueError, match="Another process works"):
        worker.wait_until_free(tmp_path, patience=0.3)
    line = f"Waiting for the process that still works in {tmp_path}.\n"
    assert capsys.readouterr().out == line


# --- in order ---


def _job(scene, method, *, reconstructed=False):
    return Job(scene, "/nowhere", "", method, (), reconstructed, SETTINGS, None)


_WITH_RECONSTRUCTION = [
    _job("a", RECONSTRUCTION),
    _job("a", "tree"),
    _job("a", "r3f", reconstructed=True),
    _job("b", "r3f", reconstructed=True),  # reconstructed by an earlier command
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
    assert _work([], lambda job: None) == []


def test_who_waits_for_a_failure_fails_with_its_reason_and_the_others_go_on():
    done = _work(
        _WITH_RECONSTRUCTION, lambda job: "no masks" if job.method == RECONSTRUCTION else None
    )
    assert dict(done) == {
        f"a/{RECONSTRUCTION}": "no masks",
        "a/r3f": "reconstruction failed: no masks",
        "a/tree": None,
        "b/r3f": None,
    }


def test_several_are_done_at_once():
    both = threading.Barrier(2, timeout=20.0)
    jobs = [_job("a", "straight"), _job("a", "tree")]
    assert len(_work(jobs, lambda job: both.wait() and None, workers=2)) == 2


def test_an_interruption_stops_what_runs_and_begins_nothing_more(tmp_path, monkeypatch):
    """A command that sleeps is asked to stop, and none starts while that is so."""
    started, ends = threading.Event(), []

    def line(name, options):
        started.set()
        return ["sleep", "60"]

    def run(job):
        try:
            subprocesses.run("train", log=tmp_path / "log")
        except RunFailedError as error:
            ends.append(str(error))

    class Interrupted(LocalEngine):
        def next(self):
            assert started.wait(20.0)
            raise KeyboardInterrupt

    monkeypatch.setattr(subprocesses, "command_line", line)
    jobs = [_job(scene, "tree") for scene in "abcdef"]
    with pytest.raises(KeyboardInterrupt):
        worker.run_in_order(jobs, Interrupted(None, 1, lambda out, job: run(job)), None)
    assert "killed by SIGTERM" in ends[0] or "stopped before it started" in ends[0]
    assert len(ends) < len(jobs)
    with subprocesses.stopping(), pytest.raises(RunFailedError, match="stopped before it started"):
        subprocesses.run("train", log=tmp_path / "log")


_SCENE = "cube_smcvx_ball"


@pytest.fixture
def work(tmp_path):
    """Does the jobs of some methods on one scene, until one is interrupted."""

    def run(names, failing=None, *, skipped=(), interrupted=None):
        def do(out, job):
            if job.method == interrupted:
                raise KeyboardInterrupt
            if job.name not in (failing or {}):
                plan.job_folder(out, job).mkdir(parents=True)
                record = made_record(job.scene, job.method, psnr=20.0)
                results.write(plan.job_folder(out, job), record)
            return (failing or {}).get(job.name)

        planned = [_job(_SCENE, name)._replace(train=METHODS[name].train) for name in names]
        scene = settings.Scene(_SCENE, "/nowhere", "")
        benchmark = settings.asked(SETTINGS, [scene], list(METHODS.values()))
        settings.write(tmp_path, benchmark)
        engine = functools.partial(LocalEngine, tmp_path, 1, do)
        return worker.run_missing(tmp_path, benchmark, planned, skipped, engine=engine)

    return run


def test_a_failure_stays_listed_until_its_job_has_been_done_again(tmp_path, work):
    both = ["oracle", "tree"]
    first = {f"{_SCENE}/oracle": "out of memory", f"{_SCENE}/tree": "a broken mesh"}
    assert work(both, first) == first == summary.not_done(tmp_path)[0]
    with pytest.raises(KeyboardInterrupt):
        work(both, first, interrupted="oracle")
    assert summary.not_done(tmp_path)[0] == first
    assert "a broken mesh" in (tmp_path / summary.FILE).read_text()
    again = {f"{_SCENE}/oracle": "another reason"}
    with pytest.raises(KeyboardInterrupt):
        work(both, again, interrupted="tree")
    assert summary.not_done(tmp_path)[0] == first | again
    assert work(both) == {} == summary.not_done(tmp_path)[0]
    assert "a broken mesh" not in (tmp_path / summary.FILE).read_text()
