"""What the summary tells while jobs are done, with an engine that does nothing."""

import pytest

from experiments.benchmarking import plan, results, settings, summary, worker
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.plan import Job, Skipped
from experiments.benchmarking.settings import Benchmark, Scene
from tests.experiments.benchmarking.made_records import SETTINGS, made_record

_SCENE = "cube_smcvx_ball"


class _Engine:
    """Leaves results of all jobs but those that fail, and is interrupted after so many."""

    def __init__(self, out, failing, most=10):
        self._out, self._failing, self._left, self._taken = out, failing, most, []

    def submit(self, job):
        self._taken.append(job)

    def next(self):
        if self._left == 0:
            raise KeyboardInterrupt
        self._left -= 1
        job = self._taken.pop(0)
        if job.name in self._failing:
            return job, self._failing[job.name]
        record = made_record(job.scene, job.method, psnr=20.0)
        folder = plan.job_folder(self._out, job)
        folder.mkdir(parents=True, exist_ok=True)
        results.write(folder, record)
        return job, None

    def stop(self):
        pass


@pytest.fixture
def work(tmp_path):
    """Does the jobs of some methods on one scene."""
    known = {_SCENE: Scene(_SCENE, "/nowhere", "")}

    def run(methods, failing=None, *, skipped=(), most=10):
        planned = [
            Job(_SCENE, "/nowhere", "", name, METHODS[name].train, False, SETTINGS, None)
            for name in methods
        ]
        benchmark = Benchmark(SETTINGS, known, {name: METHODS[name].train for name in METHODS})
        settings.write(tmp_path, benchmark)
        engine = _Engine(tmp_path, failing or {}, most)
        return worker.run_missing(tmp_path, benchmark, planned, skipped, engine=lambda: engine)

    return run


def _told(out):
    return summary.not_done(out)[0]


def test_a_failure_stays_listed_until_its_job_has_been_done_again(tmp_path, work):
    both = ["oracle", "tree"]
    first = {f"{_SCENE}/oracle": "out of memory", f"{_SCENE}/tree": "a broken mesh"}
    assert work(both, first) == first == _told(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        work(both, first, most=0)
    assert _told(tmp_path) == first and "a broken mesh" in (tmp_path / summary.FILE).read_text()
    with pytest.raises(KeyboardInterrupt):
        work(both, {f"{_SCENE}/oracle": "another reason"}, most=1)
    assert _told(tmp_path) == first | {f"{_SCENE}/oracle": "another reason"}
    assert work(both) == {} == _told(tmp_path)
    assert "a broken mesh" not in (tmp_path / summary.FILE).read_text()


def test_what_is_left_out_now_did_not_fail(tmp_path, work):
    work(["tree"], {f"{_SCENE}/tree": "a broken mesh"})
    assert work([], skipped=[Skipped(_SCENE, "tree", "it has no meshes")]) == {}
    failed, skipped = summary.not_done(tmp_path)
    assert failed == {} and [each.reason for each in skipped] == ["it has no meshes"]
