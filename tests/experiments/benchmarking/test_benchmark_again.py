"""The command, asked again: what it remembers, and what it refuses. Commands are stood in for."""

import json
import shlex
import shutil

import numpy as np
import pytest

from experiments.benchmarking import plan, summary
from refref_jax import atomic_files
from tests import made_lpips
from tests.experiments.benchmarking.serving import calls
from tests.experiments.command import ROOT


def _ball(tmp_path):
    return f"--scenes={tmp_path / 'scenes' / 'cube_smcvx_ball'}"


def _results(tmp_path):
    return json.loads((tmp_path / "out" / summary.RESULTS).read_text())


def test_failures_of_an_earlier_command_stay_listed(tmp_path, serve, scenes):
    serve(tmp_path, scenes, "--methods=straight,tree", status=1, fail="ball/tree")
    answer = serve(tmp_path, scenes, "--methods=straight")
    assert "All jobs are done already" in answer.stdout
    assert (
        "- cube_smcvx_ball/tree: experiments.train" in (tmp_path / "out" / summary.FILE).read_text()
    )
    assert list(_results(tmp_path)["failed"]) == ["cube_smcvx_ball/tree"]
    assert "failed: cube_smcvx_ball/tree" in (tmp_path / "out/report.html").read_text()
    serve(tmp_path, "--tables_only")
    assert list(_results(tmp_path)["failed"]) == ["cube_smcvx_ball/tree"]
    serve(tmp_path, scenes, "--methods=tree")
    assert _results(tmp_path)["failed"] == {} and _results(tmp_path)["missing"] == []
    assert "All jobs that were asked for are done" in (tmp_path / "out/report.html").read_text()


def test_what_was_left_out_stays_listed_and_what_has_no_result_is_listed(tmp_path, serve, scenes):
    mesh = tmp_path / "scenes/cube_smcvx_ball/meshes/ball_glass.ply"
    mesh.unlink()
    serve(tmp_path, _ball(tmp_path), "--methods=tree")
    assert "All jobs are left out" in serve(tmp_path, _ball(tmp_path), "--methods=oracle").stdout
    serve(tmp_path, scenes, "--methods=straight")
    text = (tmp_path / "out" / summary.FILE).read_text()
    assert "- cube_smcvx_ball/tree: it has no meshes" in text
    assert "- cube_smcvx_ball/oracle: it has no meshes" in text
    assert "- tree, scenes: 1: env_mmncvx_cup" in text
    index = _results(tmp_path)
    assert [each["method"] for each in index["skipped"]] == ["tree", "oracle"]
    assert index["missing"] == ["env_mmncvx_cup/oracle", "env_mmncvx_cup/tree"]
    assert "not done: env_mmncvx_cup/tree" in (tmp_path / "out/report.html").read_text()


def test_results_of_several_versions_are_told(tmp_path, serve, scenes):
    serve(tmp_path, scenes, "--methods=straight")
    summary_ = tmp_path / "out" / summary.FILE
    assert "several versions" not in summary_.read_text()
    path = tmp_path / "out" / plan.FOLDER / "cube_smcvx_ball/straight/result.json"
    content = json.loads(path.read_text())
    content["versions"]["jax"] = "0.0"
    path.write_text(json.dumps(content))
    serve(tmp_path, "--tables_only")
    assert "several versions, which may differ: jax 0.0, refref_jax" in summary_.read_text()


def test_tables_are_not_made_while_another_works_there(tmp_path, serve, scenes):
    serve(tmp_path, scenes, "--methods=straight")
    with atomic_files.hold(tmp_path / "out"):
        answer = serve(tmp_path, "--tables_only", status=2)
    assert "Another process works in" in answer.stderr


@pytest.mark.parametrize(
    "option", ["--methods=tree", "--seed=0", "--scenes=/nope", "--dry_run", "--lpips_weights=x"]
)
def test_tables_only_refuses_what_it_does_not_use(tmp_path, serve, option):
    answer = serve(tmp_path, "--tables_only", option, status=2)
    assert f"--tables_only does not use {option.partition('=')[0]}:" in answer.stderr


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


def test_after_ablations_none_are_proposed(tmp_path, serve, scenes):
    for path in (tmp_path / "scenes").glob("*/transforms_test.json"):
        path.unlink()
    answer = serve(tmp_path, scenes, "--methods=ablations")
    assert "its test views can not be read" in answer.stdout
    assert "Next: open " in answer.stdout and not calls(tmp_path)
    assert "--methods=ablations" in serve(tmp_path, scenes, "--methods=tree,tree_cone").stdout


@pytest.mark.parametrize("kind", ["text", "zeros"])
def test_broken_weights_are_refused_before_anything_is_fixed(tmp_path, serve, scenes, kind):
    path = tmp_path / "weights.npz"
    if kind == "text":
        path.write_text("# Read me")
    else:
        arrays = dict(np.load(made_lpips.write(path)))
        np.savez(path, **arrays | {"features.0.weight": np.zeros((64, 3, 11, 11), np.float32)})
    answer = serve(tmp_path, scenes, "--methods=tree", f"--lpips_weights={path}", status=2)
    assert str(path) in answer.stderr and not (tmp_path / "out").exists()
    made_lpips.write(path)
    serve(tmp_path, scenes, "--methods=straight", f"--lpips_weights={path}")


def test_what_is_trained_is_evaluated_again_in_a_copy_without_results(tmp_path, serve, scenes):
    """As docs/benchmark.md has it."""
    serve(tmp_path, scenes, "--methods=straight,r3f")
    weights = made_lpips.write(tmp_path / "weights.npz")
    new = ["--methods=straight,r3f", scenes, f"--lpips_weights={weights}", "--limit=2"]
    refused = serve(tmp_path, *new[:3], status=2).stderr
    assert "was begun without LPIPS, and is now asked for with the weights of LPIPS" in refused
    assert "'Evaluating again' in docs/benchmark.md" in refused
    assert "was begun without --limit, and" in serve(tmp_path, scenes, new[3], status=2).stderr
    copy = tmp_path / "again"
    shutil.copytree(tmp_path / "out", copy)
    (copy / "benchmark.json").unlink()
    for path in copy.glob("jobs/*/*/result.json"):
        path.unlink()
    before = len(calls(tmp_path))
    serve(tmp_path, *new, f"--out={copy}")
    done = [call[:2] for call in calls(tmp_path)[before:]]
    # A reconstruction and its training are looked at again, for their folder is another.
    assert [name for name, job in done if job.endswith("straight")] == ["evaluate"] * 2
    for path in copy.glob("jobs/*/straight/result.json"):
        old = json.loads((tmp_path / "out" / path.relative_to(copy)).read_text())
        now = json.loads(path.read_text())
        assert now["settings"]["lpips"] is not None and len(now["per_image"]) == 2
        assert now["costs"] == old["costs"] and len(old["per_image"]) == 7
    assert len(list(copy.glob("jobs/*/r3f/result.json"))) == 2
    text = (ROOT / "docs" / "benchmark.md").read_text()
    assert "## Evaluating again" in text and "-name result.json -delete" in text


def test_without_weights_that_is_said_once(tmp_path, serve, scenes):
    answer = serve(tmp_path, scenes, "--methods=straight")
    assert answer.stdout.count("warning: LPIPS is not measured") == 1


@pytest.mark.parametrize("option", ["--methods=tree", "--tables_only"])
def test_a_file_in_place_of_the_folder_is_named(tmp_path, serve, scenes, option):
    (tmp_path / "out").write_text("mine")
    options = [option] if option == "--tables_only" else [option, scenes]
    answer = serve(tmp_path, *options, status=2)
    assert f"{tmp_path / 'out'} is a file, but a folder is needed" in answer.stderr


def test_a_scene_of_which_a_file_has_changed_is_refused(tmp_path, serve, scenes):
    serve(tmp_path, scenes, "--methods=straight")
    path = tmp_path / "scenes/cube_smcvx_ball/scene.json"
    path.write_text(path.read_text().replace("1.5", "1.9"))
    answer = serve(tmp_path, scenes, "--methods=oracle", status=2)
    assert "another scene named cube_smcvx_ball" in answer.stderr
