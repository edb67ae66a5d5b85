"""The command: killed, repeated, extended and merged. Its own commands are stood in for."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from experiments.benchmarking import plan, summary, worker
from refref_jax import atomic_files
from tests.experiments.benchmarking.serving import MODULES, calls, environment
from tests.experiments.command import ROOT

_BUNDLED = f"--scenes={ROOT / 'experiments' / 'data' / 'cube_smcvx_ball'}"


def _start(tmp_path, *options, pace):
    """Starts the command in a process of its own."""
    words = [sys.executable, "-m", f"{MODULES}.run_with_stand_in", f"--out={tmp_path / 'out'}"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(
        [*words, "--steps=5", *options], cwd=ROOT, env=environment(tmp_path, pace), **quiet
    )


# Seconds that a busy machine may take to start Python.
_LONG = 300.0


def _trainings(folder):
    return [call for call in calls(folder) if call[0] == "train"]


def _wait_for(condition, seconds=_LONG):
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


def _is_running(pid):
    stat = f"/proc/{pid}/stat"
    try:
        with open(stat) as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _texts(out):
    """All that a benchmark comes to, but for what it cost."""
    found = {
        path.name: path.read_text() for path in [*(out / "tables").iterdir(), out / summary.FILE]
    }
    index = json.loads((out / summary.RESULTS).read_text())
    for job in index["jobs"]:
        del job["costs"], job["curve"]
    return found | {"index": index}


_NEEDS_PROC = pytest.mark.skipif(not os.path.exists("/proc/self"), reason="looks into /proc")


def _kill(folder, scenes, *, victim, after):
    """Starts the command, and kills it or what it runs, in the training after so many others."""
    count = len(_trainings(folder)) + after
    process = _start(folder, scenes, "--methods=straight,tree", pace=1.0)
    pid = int(_wait_for(lambda: _trainings(folder)[count:])[0][2])
    time.sleep(1.2)
    os.kill(process.pid if victim == "benchmark" else pid, signal.SIGKILL)
    # A command does not outlive its benchmark.
    _wait_for(lambda: not _is_running(pid))
    return process.wait(_LONG)


@_NEEDS_PROC
def test_killed_while_it_trains_it_goes_on_and_its_command_ends_with_it(tmp_path, serve, scenes):
    _kill(tmp_path, scenes, victim="benchmark", after=0)
    counted = list((tmp_path / "out").glob("jobs/*/*/run/count"))
    assert len(counted) <= 1 and not list((tmp_path / "out").glob("jobs/*/*/result.json"))
    serve(tmp_path, scenes, "--methods=straight,tree")
    trained = [call[1] for call in _trainings(tmp_path)]
    assert trained[0] == trained[1] and len(trained) == 5


@_NEEDS_PROC
@pytest.mark.slow
def test_killed_at_any_time_it_comes_to_the_same_tables(tmp_path, serve, scenes):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    whole.mkdir()
    cut.mkdir()
    serve(whole, scenes, "--methods=straight,tree")
    _kill(cut, scenes, victim="benchmark", after=0)
    assert _kill(cut, scenes, victim="command", after=1) == 1  # the other jobs were done
    _kill(cut, scenes, victim="benchmark", after=0)
    serve(cut, scenes, "--methods=straight,tree")
    assert _texts(cut / "out") == _texts(whole / "out")
    count = len(calls(cut))
    assert "All jobs are done already" in serve(cut, scenes, "--methods=straight,tree").stdout
    assert len(calls(cut)) == count


def test_a_failure_is_listed_and_the_rest_goes_on(tmp_path, serve, scenes):
    result = serve(tmp_path, scenes, "--methods=straight,tree", status=1, fail="ball/tree")
    assert "failed: cube_smcvx_ball/tree: experiments.train: error: The stand-in" in result.stderr
    assert "run.log" in result.stderr and "Traceback" not in result.stderr
    text = (tmp_path / "out" / summary.FILE).read_text()
    assert "- cube_smcvx_ball/tree: experiments.train" in text and "Results: 3," in text
    index = json.loads((tmp_path / "out" / summary.RESULTS).read_text())
    assert list(index["failed"]) == ["cube_smcvx_ball/tree"] and len(index["jobs"]) == 3
    before = len(calls(tmp_path))
    result = serve(tmp_path, scenes, "--methods=straight,tree")
    # It was not trained, so that both commands are run, and no other.
    assert [call[:2] for call in calls(tmp_path)[before:]] == [
        ["train", "cube_smcvx_ball/tree"],
        ["evaluate", "cube_smcvx_ball/tree"],
    ]
    assert "benchmark 1/1  cube_smcvx_ball/tree done, about 0 min left" in result.stdout
    assert "Failed" not in (tmp_path / "out" / summary.FILE).read_text()


def test_scenes_and_methods_are_added_and_settings_stay(tmp_path, serve, scenes):
    ball = f"--scenes={tmp_path / 'scenes' / 'cube_smcvx_ball'}"
    serve(tmp_path, ball, "--methods=straight")
    serve(tmp_path, scenes, "--methods=tree")
    rows = list(csv.DictReader((tmp_path / "out" / "tables" / "scenes.csv").open()))
    assert [(row["scene"], row["method"]) for row in rows] == [
        ("cube_smcvx_ball", "straight"),
        ("cube_smcvx_ball", "tree"),
        ("env_mmncvx_cup", "tree"),
    ]
    before = (tmp_path / "out" / "benchmark.json").read_text()
    result = serve(tmp_path, scenes, "--methods=tree", "--seed=1", status=2)
    assert "was begun with seed 0, and is now asked for with seed 1" in result.stderr
    assert "Evaluating again" not in result.stderr
    assert (tmp_path / "out" / "benchmark.json").read_text() == before


def test_results_of_two_machines_are_merged_by_copying(tmp_path, serve, scenes):
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    serve(tmp_path, scenes, "--methods=straight,tree")
    serve(here, scenes, "--methods=straight")
    serve(there, scenes, "--methods=tree")
    for folder in (there / "out" / plan.FOLDER).glob("*/*"):
        shutil.copytree(folder, here / "out" / plan.FOLDER / folder.parent.name / folder.name)
    result = serve(here, "--tables_only")
    assert "summary.md" in result.stdout
    assert _texts(here / "out") == _texts(tmp_path / "out")
    index = json.loads((here / "out" / summary.RESULTS).read_text())
    assert set(index["methods"]) == {"straight", "tree"}
    for job in index["jobs"]:
        assert (here / "out" / job["folder"] / "result.json").is_file()
        assert [point["step"] for point in job["curve"]] == [1, 5]
        assert job["views"][0]["rgb"] == f"{job['folder']}/run/eval/test/rgb/r_000.png"


def test_two_do_not_work_in_one_folder(tmp_path, serve, scenes):
    (tmp_path / "out").mkdir()
    with atomic_files.hold(tmp_path / "out"):
        result = serve(tmp_path, scenes, "--methods=tree", status=2)
    assert "Another process works in" in result.stderr and not calls(tmp_path)


@pytest.mark.slow
def test_a_kill_that_can_be_caught_waits_for_the_command(tmp_path, scenes):
    process = _start(tmp_path, scenes, "--methods=tree", pace=0.3)
    (call,) = _wait_for(lambda: calls(tmp_path))
    process.send_signal(signal.SIGTERM)
    assert process.wait(_LONG) == 130
    with pytest.raises(ProcessLookupError):
        os.kill(int(call[2]), 0)
    assert len(calls(tmp_path)) == 1


def test_a_dry_run_lists_and_does_nothing(tmp_path, serve, scenes):
    shutil.rmtree(tmp_path / "scenes" / "env_mmncvx_cup" / "meshes")
    result = serve(tmp_path, scenes, "--methods=straight,tree,r3f", "--dry_run")
    lines = result.stdout.splitlines()
    assert lines[-1] == "7 jobs, 7 to do."
    assert any("cube_smcvx_ball/tree" in line and "--paths=tree" in line for line in lines)
    assert any("env_mmncvx_cup/tree: it has no meshes" in line for line in lines)
    assert not (tmp_path / "out").exists() and not calls(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--scenes=nowhere/*",), "names no scene"),
        (("--scenes=nowhere",), "nowhere/transforms_train.json does not exist"),
        (("--jobs=2", "--ray=local", _BUNDLED), "--jobs would have no effect on a Ray cluster"),
        (("--job_gpus=1", _BUNDLED), "--job_gpus would have no effect without --ray"),
        (("--job_cpus=1", "--job_gpus=1", _BUNDLED), "--job_cpus, --job_gpus would have no"),
        (("--methods=magic", _BUNDLED), "There is no method 'magic'"),
        (("--rays_per_pixel=3", _BUNDLED), "3 rays a pixel do not make a square"),
        (("--lpips_weights=none.npz", _BUNDLED), "none.npz can not be read as the weights"),
        (("--tables_only",), "holds no benchmark"),
    ],
)
def test_mistakes_end_before_anything_is_done(tmp_path, serve, options, message):
    assert message in serve(tmp_path, *options, status=2).stderr
    assert not (tmp_path / "out" / plan.FOLDER).exists()


def test_without_ray_its_option_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install -e '.\[cluster\]'"):
        worker.import_ray()


def test_no_cluster_at_an_address_is_said(tmp_path, serve, scenes):
    pytest.importorskip("ray")
    result = serve(tmp_path, scenes, "--methods=straight", "--ray=127.0.0.1:1", status=2)
    assert "There is no Ray cluster at 127.0.0.1:1" in result.stderr
