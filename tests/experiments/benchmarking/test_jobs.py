"""Which jobs there are, what decides them, and how one is done. Commands are stood in for."""

import dataclasses
import json
from pathlib import Path

import pytest

from experiments.benchmarking import methods, plan, results, settings, worker
from experiments.benchmarking.methods import METHODS, RECONSTRUCTION
from experiments.cli import scenes as cli_scenes
from refref_jax import atomic_files
from tests.experiments.benchmarking.made_records import SETTINGS
from tests.experiments.benchmarking.made_scenes import write_scene


def _scenes(tmp_path, *names, **options):
    for name in names:
        write_scene(tmp_path / "scenes" / name, **options)
    return plan.find_scenes([str(tmp_path / "scenes" / "*")])


def _chosen(text):
    return methods.parse(text.split(","))


def _benchmark(common=SETTINGS):
    return settings.asked(common, [], [])


def _calls(stand_in):
    return [line.rsplit(" ", 1)[0] for line in stand_in.read_text().splitlines()]


def test_methods_are_in_the_order_of_the_table_and_none_hides_a_reconstruction():
    assert [method.name for method in _chosen("tree,straight,tree")] == ["straight", "tree"]
    assert {method.name for method in _chosen("all")} == set(METHODS)
    assert {"oracle", "tree"} < {method.name for method in _chosen("ablations")}
    assert RECONSTRUCTION not in METHODS
    assert METHODS["oracle_no_tir"].train == ("--paths=paper_no_tir", "--interior=field")
    for method in METHODS.values():
        names = [word.partition("=")[0] for word in method.train]
        assert len(set(names)) == len(names), method.name
    with pytest.raises(ValueError, match="no method 'magic'"):
        methods.parse(["magic"])
    with pytest.raises(ValueError, match="--methods is empty"):
        methods.parse([""])


def test_there_is_a_job_for_each_scene_and_method_and_one_reconstruction_a_scene(tmp_path):
    scenes = _scenes(tmp_path, "cube_smcvx_ball", "env_smncvx_torus")
    planned, skipped = plan.plan_jobs(scenes, _chosen("straight,r3f,r3f_tree"), SETTINGS)
    assert skipped == []
    assert [job.name for job in planned[:4]] == [
        f"cube_smcvx_ball/{name}" for name in (RECONSTRUCTION, "straight", "r3f", "r3f_tree")
    ]
    assert len(planned) == 8
    assert [job.awaited for job in planned[:4]] == [
        None,
        None,
        f"cube_smcvx_ball/{RECONSTRUCTION}",
        f"cube_smcvx_ball/{RECONSTRUCTION}",
    ]


def test_what_a_scene_lacks_is_skipped_and_said(tmp_path):
    chosen = _chosen("straight,tree,tree_tints_given,r3f")
    for lacks, left, reasons in [
        ({"meshes": False}, ["straight", "r3f"], ["no meshes", "no meshes"]),
        ({"masks": False}, ["straight", "tree", "tree_tints_given"], ["no masks"]),
        ({"colours": False}, ["straight", "tree", "r3f"], ["scene.json does not tell"]),
    ]:
        folder = tmp_path / next(iter(lacks))
        planned, skipped = plan.plan_jobs(
            _scenes(folder, "cube_smcvx_ball", **lacks), chosen, SETTINGS
        )
        assert sorted(job.method for job in planned if job.method in METHODS) == sorted(left)
        assert len(skipped) == len(reasons)
        for each, reason in zip(skipped, reasons, strict=True):
            assert reason in each.reason


def test_an_ablation_that_a_scene_comes_to_anyway_is_left_out(tmp_path):
    insides = ["tree_clear", "tree_tints_given", "tree_tints_learned"]
    chosen = _chosen(",".join(["tree", "tree_field", *insides]))
    for folder, colour, same, told in [
        ("clear", [1.0, 1.0, 1.0], "tree_clear", "(interior clear)"),
        ("tinted", [0.9, 1.0, 1.0], "tree_tints_given", "(interior absorbing, tints given)"),
        ("untold", None, "tree_tints_learned", "(interior absorbing, tints learned)"),
    ]:
        (scene,) = _scenes(tmp_path / folder, "cube_smcvx_ball", colours=colour is not None)
        path = Path(scene.path) / "scene.json"
        content = json.loads(path.read_text())
        if colour is not None:
            content["parts"][0]["colour_per_interface"] = colour
            path.write_text(json.dumps(content))
        planned, skipped = plan.plan_jobs([scene], chosen, SETTINGS)
        reasons = {each.method: each.reason for each in skipped}
        assert reasons[same] == f"in this scene it is tree again {told}"
        left = {"tree", "tree_field", *insides} - set(reasons)
        assert {job.method for job in planned} == left >= {"tree", "tree_field"}
        # Given colours that are not told are wanting.
        assert set(reasons) - {same} <= ({"tree_tints_given"} if colour is None else set())


def test_a_broken_scene_is_left_to_its_jobs(tmp_path):
    scenes = _scenes(tmp_path, "cube_smcvx_ball")
    (tmp_path / "scenes" / "cube_smcvx_ball" / "scene.json").write_text("{")
    planned, skipped = plan.plan_jobs(scenes, _chosen("tree,tree_tints_given"), SETTINGS)
    assert [job.method for job in planned] == ["tree", "tree_tints_given"] and skipped == []


def test_scenes_are_found_by_wildcards_and_folders(tmp_path):
    write_scene(tmp_path / "a" / "cube_smcvx_ball")
    write_scene(tmp_path / "b" / "cube_smcvx_ball")
    write_scene(tmp_path / "a" / "mine")
    (tmp_path / "a" / "preview").mkdir()
    found = plan.find_scenes([str(tmp_path / "a" / "*"), str(tmp_path / "a" / "mine")])
    assert [scene.name for scene in found] == ["cube_smcvx_ball", "mine"]
    assert results.category_and_background("cube_smcvx_ball") == ("smcvx", "cube")
    assert results.category_and_background("mine") == (results.OTHER, results.OTHER)
    for words, message in [
        ([str(tmp_path / "*" / "cube_*")], "are named cube_smcvx_ball"),
        ([str(tmp_path / "a" / "preview")], r"preview/transforms_train\.json does not exist"),
        ([str(tmp_path / "nope")], r"nope/transforms_train\.json does not exist"),
        ([str(tmp_path / "c*")], "names no scene"),
        ([], "names no scene"),
    ]:
        with pytest.raises(ValueError, match=message):
            plan.find_scenes(words)


def test_a_folder_whose_name_looks_like_wildcards_is_taken_as_it_is(tmp_path):
    for name in ("ball[1]", "ball1"):
        write_scene(tmp_path / name)
    (found,) = plan.find_scenes([str(tmp_path / "ball[1]")])
    assert found.path == str(tmp_path / "ball[1]")
    (tmp_path / "ball[1]").rename(tmp_path / "other")
    (found,) = plan.find_scenes([str(tmp_path / "ball[1]")])  # a wildcard
    assert found.path == str(tmp_path / "ball1")
    (tmp_path / "no[1]scene").mkdir()
    with pytest.raises(ValueError, match=r"scene/transforms_train\.json does not exist"):
        cli_scenes.check_all([str(tmp_path / "no[1]scene")])


def test_a_benchmark_grows_but_does_not_change(tmp_path):
    out = tmp_path / "out"
    ball, torus = _scenes(tmp_path, "cube_smcvx_ball", "env_smncvx_torus")
    first = settings.asked(SETTINGS, [ball], _chosen("straight"))
    settings.write(out, settings.extended(out, first))
    assert settings.read(out) == first
    more = settings.extended(out, settings.asked(SETTINGS, [torus], _chosen("tree")))
    settings.write(out, more)
    assert set(more.scenes) == {ball.name, torus.name} and set(more.methods) == {"straight", "tree"}
    # The same scene, elsewhere.
    moved = dataclasses.replace(ball, path="/moved")
    assert settings.extended(out, settings.asked(SETTINGS, [moved], [])).scenes[ball.name] == moved
    for changed, message in [
        ({"steps": 7}, "begun with steps 6, and is now asked for with steps 7.*--steps"),
        ({"limit": 3}, "begun without --limit"),
        ({"lpips": "abc"}, "--lpips_weights"),
    ]:
        other = dataclasses.replace(SETTINGS, **changed)
        with pytest.raises(ValueError, match=message):
            settings.extended(out, settings.asked(other, [ball], []))
    another = dataclasses.replace(ball, fingerprint="other")
    with pytest.raises(ValueError, match="another scene named cube_smcvx_ball"):
        settings.extended(out, settings.asked(SETTINGS, [another], []))
    changed = dataclasses.replace(METHODS["tree"], train=("--paths=tree", "--cut=0.5"))
    with pytest.raises(ValueError, match=r"the method tree is --paths=tree, in this version"):
        settings.extended(out, settings.asked(SETTINGS, [], [changed]))
    assert settings.read(out) == more


def test_a_folder_without_a_benchmark_is_named(tmp_path):
    with pytest.raises(ValueError, match="holds no benchmark"):
        settings.read(tmp_path)
    (tmp_path / settings.FILE).write_text('{"settings": {}}')
    with pytest.raises(ValueError, match="is not that of a benchmark"):
        settings.read(tmp_path)


def test_a_job_leaves_a_result_that_says_all_and_is_done_once(tmp_path, stand_in):
    (scene,) = _scenes(tmp_path, "env_smcvx_ball")
    common = dataclasses.replace(SETTINGS, limit=6)
    (job,), _ = plan.plan_jobs([scene], _chosen("tree_cone"), common)
    out = tmp_path / "out"
    assert worker.run_job(out, job) is None and plan.is_done(out, job)
    assert worker.run_job(out, job) is None
    assert _calls(stand_in) == [f"train {job.name}", f"evaluate {job.name}"]
    (record,) = results.read_all(out, _benchmark(common))
    assert (record.category, record.background, record.method) == ("smcvx", "env", "tree_cone")
    assert record.options["train"] == [
        "--preset=tiny",
        "--steps=6",
        "--seed=0",
        "--paths=tree",
        "--footprint=cone",
    ]
    assert record.options["evaluate"] == ["--rays_per_pixel=1", "--limit=6"]
    assert record.metrics["lpips"] is None and record.metrics["distance_mae_masked"] == float("inf")
    assert record.costs.steps == 6 and record.costs.seconds_per_image == 2.0
    assert record.costs.peak_host_mib > 1.0
    assert set(record.versions) == {"jax", "refref_jax"}
    # Ever farther from the training view at their start, by 0.5 / 22.4 of a radius.
    apart = [image.pose_distance for image in record.per_image]
    scale = (500.0**0.5 + 501.0**0.5) / 2.0
    assert apart == pytest.approx([0.5 * i / scale for i in range(6)])
    view = record.views[2]
    assert view.rgb == "run/eval/test/rgb/r_002.png"
    truth = tmp_path / "scenes" / "env_smcvx_ball" / view.truth.rgb
    assert truth.is_file() and truth.name == "r_002.png"


def test_results_of_other_settings_or_places_are_refused(tmp_path, stand_in):
    (scene,) = _scenes(tmp_path, "cube_smcvx_ball")
    (job,), _ = plan.plan_jobs([scene], _chosen("tree"), SETTINGS)
    out = tmp_path / "out"
    worker.run_job(out, job)
    path = plan.job_folder(out, job) / plan.RESULT
    with pytest.raises(ValueError, match="made with other settings"):
        results.read_all(out, _benchmark(dataclasses.replace(SETTINGS, seed=1)))
    path.parent.rename(path.parent.with_name("straight"))
    with pytest.raises(ValueError, match="is the result of cube_smcvx_ball/tree"):
        results.read_all(out, _benchmark())
    (path.parent.with_name("straight") / plan.RESULT).write_text("{")
    with pytest.raises(ValueError, match="is not the result of a job"):
        results.read_all(out, _benchmark())


def test_a_reconstruction_is_given_to_the_methods_that_wait_for_it(tmp_path, stand_in):
    (scene,) = _scenes(tmp_path, "cube_smcvx_ball", meshes=False)
    planned, _ = plan.plan_jobs([scene], _chosen("r3f"), SETTINGS)
    out = tmp_path / "out"
    assert [worker.run_job(out, job) for job in planned] == [None, None]
    folder = plan.job_folder(out, planned[0])
    words = (plan.job_folder(out, planned[1]) / "run" / "trained_with").read_text()
    assert f"reconstruction={folder / 'run'}" in words
    everything = results.read_all(out, _benchmark())
    assert [record.method for record in results.compared(everything)] == ["r3f"]
    (found,) = [record for record in everything if record.method == RECONSTRUCTION]
    assert found.facts["index"]["index"] == 1.5 and found.costs.seconds > 0.0
    # Where the reconstruction lies is not of the result, which may move.
    assert str(tmp_path) not in json.dumps([record.options for record in everything])


def test_a_failure_is_a_reason_and_its_job_is_tried_again(tmp_path, stand_in, monkeypatch):
    (scene,) = _scenes(tmp_path, "cube_smcvx_ball")
    (job,), _ = plan.plan_jobs([scene], _chosen("tree"), SETTINGS)
    out = tmp_path / "out"
    monkeypatch.setenv("FAIL", "tree")
    assert "told to fail" in worker.run_job(out, job) and not plan.is_done(out, job)
    monkeypatch.setenv("FAIL", "^$")
    assert worker.run_job(out, job) is None and plan.is_done(out, job)


def test_a_mistake_of_ours_is_a_reason_too(tmp_path, stand_in, monkeypatch):
    (scene,) = _scenes(tmp_path, "cube_smcvx_ball")
    (job,), _ = plan.plan_jobs([scene], _chosen("tree"), SETTINGS)

    def broken(*arguments, **options):
        raise KeyError("psnr")

    monkeypatch.setattr(worker.measured_runs, "train", broken)
    reason = worker.run_job(tmp_path / "out", job)
    assert reason.startswith("KeyError: 'psnr'")
    log = plan.job_folder(tmp_path / "out", job) / "error.txt"
    assert str(log) in reason and "Traceback" in log.read_text()


def test_a_job_waits_for_who_still_works_in_its_run(tmp_path, capsys):
    worker.wait_until_free(tmp_path / "nothing")
    worker.wait_until_free(tmp_path)
    with atomic_files.hold(tmp_path), pytest.raises(ValueError, match="Another process works"):
        worker.wait_until_free(tmp_path, patience=0.3)
    line = f"Waiting until the process ends that works in {tmp_path} yet.\n"
    assert capsys.readouterr().out == line
