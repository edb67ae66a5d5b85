"""The command: killed, repeated, extended, merged, refused. Its own commands are stood in for."""

import csv
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from experiments.benchmarking import plan, summary, worker
from refref_jax import atomic_files
from tests.factories import made_lpips
from tests.fakes.serving import COMMAND, calls
from tests.processes.command import ROOT

_BUNDLED = f"--scenes={ROOT / 'experiments' / 'data' / 'cube_smcvx_ball'}"

# Seconds that a busy machine may take to start Python.
_LONG = 300.0


def _start(tmp_path, *options, pace):
    """Starts the command in a process of its own."""
    words = [*COMMAND, f"--out={tmp_path / 'out'}", "--steps=5", *options]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = os.environ | {"CALLS": str(tmp_path / "calls.txt"), "PACE": str(pace)}
    return subprocess.Popen(words, cwd=ROOT, env=environment, **quiet)


def _trainings(folder):
    return [call for call in calls(folder) if call[0] == "train"]


def _wait_for(condition):
    end = time.monotonic() + _LONG
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


def _is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _text(folder, name=summary.FILE):
    return (folder / "out" / name).read_text()


def _index(folder):
    return json.loads(_text(folder, summary.RESULTS))


def _all_but_costs(folder):
    """All that a benchmark comes to, but for what it cost."""
    tables = {path.name: path.read_text() for path in (folder / "out/tables").iterdir()}
    index = _index(folder)
    for job in index["jobs"]:
        del job["costs"], job["curve"]
    return tables | {"summary": _text(folder), "index": index}


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


@pytest.mark.slow
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
    assert _all_but_costs(cut) == _all_but_costs(whole)
    count = len(calls(cut))
    assert "All jobs are already finished" in serve(cut, scenes, "--methods=straight,tree").stdout
    assert len(calls(cut)) == count


@pytest.mark.slow
def test_a_kill_that_can_be_caught_waits_for_the_command(tmp_path, scenes):
    process = _start(tmp_path, scenes, "--methods=tree", pace=0.3)
    (call,) = _wait_for(lambda: calls(tmp_path))
    process.send_signal(signal.SIGTERM)
    assert process.wait(_LONG) == 130
    with pytest.raises(ProcessLookupError):
        os.kill(int(call[2]), 0)
    assert len(calls(tmp_path)) == 1


def test_a_failure_is_listed_until_it_is_done_and_the_rest_goes_on(tmp_path, serve, scenes):
    result = serve(tmp_path, scenes, "--methods=straight,tree", status=1, fail="ball/tree")
    assert "failed: cube_smcvx_ball/tree: experiments.train: error: The stand-in" in result.stderr
    assert "run.log" in result.stderr and "Traceback" not in result.stderr
    assert "Results: 3," in _text(tmp_path) and len(_index(tmp_path)["jobs"]) == 3
    assert "failed: cube_smcvx_ball/tree" in _text(tmp_path, "report.html")
    for words in ([scenes, "--methods=straight"], ["--tables_only"]):
        serve(tmp_path, *words)
        assert "- cube_smcvx_ball/tree: experiments.train" in _text(tmp_path)
        assert list(_index(tmp_path)["failed"]) == ["cube_smcvx_ball/tree"]
    before = len(calls(tmp_path))
    result = serve(tmp_path, scenes, "--methods=straight,tree")
    # It was not trained, so that both commands are run, and no other.
    assert [call[:2] for call in calls(tmp_path)[before:]] == [
        ["train", "cube_smcvx_ball/tree"],
        ["evaluate", "cube_smcvx_ball/tree"],
    ]
    assert "benchmark 1/1  cube_smcvx_ball/tree done, about 0 min left" in result.stdout
    assert "Failed" not in _text(tmp_path) and _index(tmp_path)["failed"] == {}


def test_what_was_left_out_stays_listed_and_what_has_no_result_is_listed(tmp_path, serve, scenes):
    ball = scenes.replace("*", "cube_smcvx_ball")
    (tmp_path / "scenes/cube_smcvx_ball/meshes/ball_glass.ply").unlink()
    serve(tmp_path, ball, "--methods=tree")
    assert "All jobs are skipped" in serve(tmp_path, ball, "--methods=oracle").stdout
    serve(tmp_path, scenes, "--methods=straight")
    text = _text(tmp_path)
    assert "- cube_smcvx_ball/tree: it has no meshes" in text
    assert "- cube_smcvx_ball/oracle: it has no meshes" in text
    assert "- tree, scenes: 1: env_mmncvx_cup" in text
    index = _index(tmp_path)
    assert [each["method"] for each in index["skipped"]] == ["tree", "oracle"]
    assert index["missing"] == ["env_mmncvx_cup/oracle", "env_mmncvx_cup/tree"]
    assert "unfinished: env_mmncvx_cup/tree" in _text(tmp_path, "report.html")


def test_scenes_and_methods_are_added_and_settings_stay(tmp_path, serve, scenes):
    answer = serve(tmp_path, scenes.replace("*", "cube_smcvx_ball"), "--methods=straight")
    assert answer.stdout.count("warning: LPIPS is not measured") == 1
    serve(tmp_path, scenes, "--methods=tree")
    rows = csv.DictReader(_text(tmp_path, "tables/scenes.csv").splitlines())
    assert [(row["scene"], row["method"]) for row in rows] == [
        ("cube_smcvx_ball", "straight"),
        ("cube_smcvx_ball", "tree"),
        ("env_mmncvx_cup", "tree"),
    ]
    before = _text(tmp_path, "benchmark.json")
    result = serve(tmp_path, scenes, "--methods=tree", "--seed=1", status=2)
    assert "was started with seed 0, but is now requested with seed 1" in result.stderr
    assert "Evaluating again" not in result.stderr
    assert _text(tmp_path, "benchmark.json") == before


@pytest.mark.slow
def test_results_of_two_machines_are_merged_by_copying(tmp_path, serve, scenes):
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    serve(tmp_path, scenes, "--methods=straight,tree")
    serve(here, scenes, "--methods=straight")
    serve(there, scenes, "--methods=tree")
    shutil.copytree(there / "out" / plan.FOLDER, here / "out" / plan.FOLDER, dirs_exist_ok=True)
    told = serve(here, "--tables_only", "--report_views=1", "--report_edge=16").stdout
    assert f"Report:  {here / 'out/report.html'} (" in told
    assert f"Images:  {here / 'out/pictures.jpg'}" in told
    assert _text(here, "report.html").count("<article") == 2
    assert _all_but_costs(here) == _all_but_costs(tmp_path)
    assert "several versions" not in _text(here)
    for job in _index(here)["jobs"]:
        assert (here / "out" / job["folder"] / "result.json").is_file()
        assert [point["step"] for point in job["curve"]] == [1, 5]
        assert job["views"][0]["rgb"] == f"{job['folder']}/run/eval/test/rgb/r_000.png"
    path = here / "out" / plan.FOLDER / "cube_smcvx_ball/straight/result.json"
    content = json.loads(path.read_text())
    content["versions"]["jax"] = "0.0"
    path.write_text(json.dumps(content))
    serve(here, "--tables_only")
    assert "several versions, which may differ: jax 0.0, refref_jax" in _text(here)


def test_two_do_not_work_in_one_folder(tmp_path, serve, scenes):
    serve(tmp_path, scenes, "--methods=straight")
    before = len(calls(tmp_path))
    with atomic_files.hold(tmp_path / "out"):
        for words in ([scenes, "--methods=tree"], ["--tables_only"]):
            answer = serve(tmp_path, *words, status=2)
            assert "Another process works in" in answer.stderr
    assert len(calls(tmp_path)) == before


def test_a_dry_run_lists_and_does_nothing(tmp_path, serve, scenes):
    shutil.rmtree(tmp_path / "scenes" / "env_mmncvx_cup" / "meshes")
    lines = serve(tmp_path, scenes, "--methods=straight,tree,r3f", "--dry_run").stdout.splitlines()
    assert lines[-1] == "7 jobs, 7 to do."
    assert any("cube_smcvx_ball/tree" in line and "--paths=tree" in line for line in lines)
    assert any("env_mmncvx_cup/tree: it has no meshes" in line for line in lines)
    assert not (tmp_path / "out").exists() and not calls(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--scenes=nowhere/*",), "matches no scene"),
        (("--jobs=2", "--ray=local", _BUNDLED), "--jobs would have no effect on a Ray cluster"),
        (("--job_cpus=1", "--job_gpus=1", _BUNDLED), "--job_cpus, --job_gpus would have no"),
        (("--rays_per_pixel=3", _BUNDLED), "3 rays a pixel do not make a square"),
        (("--lpips_weights=none.npz", _BUNDLED), "none.npz cannot be read as weights"),
        (("--tables_only",), "has no benchmark"),
        (("--tables_only", "--methods=tree"), "--tables_only does not use --methods,"),
        (("--tables_only", "--scenes=/nope"), "--tables_only does not use --scenes,"),
        (("--tables_only", "--dry_run"), "--tables_only does not use --dry_run,"),
    ],
)
def test_mistakes_end_before_anything_is_done(tmp_path, serve, options, message):
    assert message in serve(tmp_path, *options, status=2).stderr
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").write_text("mine")
    assert f"{tmp_path / 'out'} is a file" in serve(tmp_path, "--tables_only", status=2).stderr


def test_broken_weights_are_refused_before_anything_is_fixed(tmp_path, serve, scenes):
    path = tmp_path / "weights.npz"
    arrays = dict(np.load(made_lpips.write(path)))
    np.savez(path, **arrays | {"features.0.weight": np.zeros((64, 3, 11, 11), np.float32)})
    answer = serve(tmp_path, scenes, "--methods=tree", f"--lpips_weights={path}", status=2)
    assert str(path) in answer.stderr and not (tmp_path / "out").exists()
    made_lpips.write(path)
    serve(tmp_path, scenes, "--methods=straight", f"--lpips_weights={path}")


def test_without_ray_its_option_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install -e '.\[cluster\]'"):
        worker.import_ray()


def test_no_cluster_at_an_address_is_said(tmp_path, serve, scenes):
    pytest.importorskip("ray")
    result = serve(tmp_path, scenes, "--methods=straight", "--ray=127.0.0.1:1", status=2)
    assert "There is no Ray cluster at 127.0.0.1:1" in result.stderr


def test_the_next_command_has_all_that_was_asked_for_and_can_be_given(tmp_path, serve, scenes):
    weights = made_lpips.write(tmp_path / "a b.npz")
    given = [
        *("--limit=2", "--rays_per_pixel=1", "--seed=3", f"--lpips_weights={weights}"),
        *("--jobs=2", "--report_edge=16"),
    ]
    answer = serve(tmp_path, scenes, "--methods=straight", *given)
    assert "LPIPS is not measured" not in answer.stdout
    (line,) = [line for line in answer.stdout.splitlines() if line.startswith("Next: ")]
    words = shlex.split(line)[4:]
    assert set(given) | {"--steps=5", "--methods=ablations", scenes} < set(words)
    listed = serve(tmp_path, *words, "--dry_run").stdout
    assert "cube_smcvx_ball/oracle_no_tir" in listed and "26 jobs, 26 to do." in listed
    # After them none are proposed. Here each is left out.
    for path in (tmp_path / "scenes").glob("*/transforms_test.json"):
        path.unlink()
    answer = serve(tmp_path, scenes, "--methods=ablations", f"--out={tmp_path / 'other'}")
    assert "its test views cannot be read" in answer.stdout and "Next: open " in answer.stdout


@pytest.mark.slow
def test_what_is_trained_is_evaluated_again_in_a_copy_without_results(tmp_path, serve, scenes):
    """As docs/benchmark.md has it."""
    scenes = scenes.replace("*", "cube_smcvx_ball")
    serve(tmp_path, scenes, "--methods=straight,r3f")
    weights = made_lpips.write(tmp_path / "weights.npz")
    new = ["--methods=straight,r3f", scenes, f"--lpips_weights={weights}", "--limit=2"]
    refused = serve(tmp_path, *new[:3], status=2).stderr
    assert "was started without LPIPS, but is now requested with the weights of LPIPS" in refused
    assert "'Evaluating again' in docs/benchmark.md" in refused
    copy = tmp_path / "again"
    shutil.copytree(tmp_path / "out", copy)
    (copy / "benchmark.json").unlink()
    for path in copy.glob("jobs/*/*/result.json"):
        path.unlink()
    before = len(calls(tmp_path))
    serve(tmp_path, *new, f"--out={copy}")
    done = [call[:2] for call in calls(tmp_path)[before:]]
    # A reconstruction and its training are looked at again, for their folder is another.
    assert [name for name, job in done if job.endswith("straight")] == ["evaluate"]
    (path,) = copy.glob("jobs/*/straight/result.json")
    old = json.loads((tmp_path / "out" / path.relative_to(copy)).read_text())
    now = json.loads(path.read_text())
    assert now["settings"]["lpips"] is not None and len(now["per_image"]) == 2
    assert now["costs"] == old["costs"] and len(old["per_image"]) == 7
    assert len(list(copy.glob("jobs/*/r3f/result.json"))) == 1
    text = (ROOT / "docs" / "benchmark.md").read_text()
    assert "## Evaluating again" in text and "-name result.json -delete" in text
