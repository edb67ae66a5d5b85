"""Which results are taken: of what scene, by what method, and with what contents."""

import json
import math
import shutil

import pytest

from experiments.benchmarking import methods, paper_tables, plan, results, settings, worker
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.report import page
from experiments.benchmarking.report.data import Result, Scene
from experiments.benchmarking.results import Image
from tests.experiments.benchmarking.made_records import SETTINGS, made_record
from tests.experiments.benchmarking.made_scenes import write_scene

# --- fingerprints ---


def _edit(name, old, new):
    def change(scene):
        path = scene / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    return change


def _append(name):
    def change(scene):
        with (scene / name).open("ab") as file:
            file.write(b"0")

    return change


@pytest.mark.parametrize(
    "change",
    [
        _edit("scene.json", "1.5", "1.9"),
        _edit("meshes/ball_glass.ply", "looked", "booked"),
        _edit("transforms_test.json", "10.5", "10.6"),
        _append("train/r_001.png"),
        _append("mask/train/r_000.png"),
        _append("depth/train/r_000.png"),
        lambda scene: (scene / "depth/train/r_000.exr").write_bytes(b"0"),
        lambda scene: (scene / "train/r_000.png").unlink(),
        lambda scene: (scene / "scene.json").unlink(),
        lambda scene: (scene / "meshes/ball_glass.ply").rename(scene / "meshes/ball_water.ply"),
    ],
)
def test_what_decides_results_changes_the_fingerprint(tmp_path, change):
    scene = write_scene(tmp_path / "ball")
    before = plan.fingerprint(scene)
    change(scene)
    assert plan.fingerprint(scene) != before


def test_where_a_scene_lies_and_what_else_is_there_does_not(tmp_path):
    scene = write_scene(tmp_path / "ball")
    before = plan.fingerprint(scene)
    shutil.copytree(scene, tmp_path / "elsewhere" / "other")
    (scene / "preview.png").write_bytes(b"0")
    assert plan.fingerprint(scene) == before
    assert plan.fingerprint(tmp_path / "elsewhere" / "other") == before


@pytest.mark.parametrize("text", ["{", "[]", '{"frames": 3}', '{"frames": [3, {"file_path": 1}]}'])
def test_a_broken_scene_has_a_fingerprint_too(tmp_path, text):
    scene = write_scene(tmp_path / "ball")
    (scene / "transforms_train.json").write_text(text)
    assert len(plan.fingerprint(scene)) == 16


def test_a_scene_that_changes_is_refused_by_the_benchmark_and_by_its_jobs(tmp_path, stand_in):
    folder = write_scene(tmp_path / "scenes" / "cube_smcvx_ball")
    (scene,) = plan.find_scenes([str(folder)])
    asked = settings.asked(SETTINGS, [scene], methods.parse(["tree"]))
    out = tmp_path / "out"
    settings.write(out, asked)
    (job,), _ = plan.plan_jobs([scene], methods.parse(["tree"]), SETTINGS)
    assert worker.run_job(out, job) is None
    _edit("scene.json", "1.5", "1.9")(folder)
    (changed,) = plan.find_scenes([str(folder)])
    with pytest.raises(ValueError, match="another scene named cube_smcvx_ball"):
        settings.extended(out, settings.asked(SETTINGS, [changed], methods.parse(["oracle"])))
    late = job._replace(method="straight", train=METHODS["straight"].train)
    assert "have changed since the benchmark" in worker.run_job(out, late)
    assert not plan.is_done(out, late) and len(stand_in.read_text().splitlines()) == 2


# --- what is compared when results are read ---


def _written(tmp_path, record):
    out = tmp_path / "out"
    folder = out / plan.FOLDER / record.scene / record.method
    folder.mkdir(parents=True)
    results.write(folder, record)
    return out


def _read(out, scenes=(), chosen=()):
    return results.read_all(out, settings.asked(SETTINGS, scenes, chosen))


_TREE = made_record("cube_smcvx_ball", "tree", psnr=30.0)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (
            _TREE._replace(options=_TREE.options | {"train": ["--preset=tiny"]}),
            "made by train --preset=tiny, and here tree is train --preset=tiny --steps=6",
        ),
        (_TREE._replace(options={**_TREE.options, "evaluate": []}), "made by evaluate"),
        (_TREE._replace(category="smncvx"), "its name says smcvx before cube"),
        (_TREE._replace(background="env"), "its name says smcvx before cube"),
        (_TREE._replace(method="magic"), "method magic, which this version does not know"),
        (_TREE._replace(fingerprint="other"), "another scene named cube_smcvx_ball"),
    ],
)
def test_results_that_do_not_compare_are_refused_by_name(tmp_path, record, message):
    scene = settings.Scene("cube_smcvx_ball", "/nowhere", "")
    out = _written(tmp_path, record)
    with pytest.raises(ValueError, match=message) as caught:
        _read(out, [scene])
    assert str(out) in str(caught.value)


def test_results_of_one_scene_that_is_not_known_here_are_compared_with_each_other(tmp_path):
    out = _written(tmp_path, _TREE)
    _written(tmp_path, made_record("cube_smcvx_ball", "straight")._replace(fingerprint="other"))
    with pytest.raises(ValueError, match="another scene named cube_smcvx_ball"):
        _read(out)


def test_the_options_of_a_method_are_those_that_the_benchmark_was_begun_with(tmp_path):
    out = _written(tmp_path, _TREE)
    assert _read(out) == [_TREE]
    begun = settings.asked(SETTINGS, [], [])
    begun.methods["tree"] = ("--paths=tree", "--cut=0.5")
    with pytest.raises(ValueError, match=r"here tree is train .*--cut=0\.5"):
        results.read_all(out, begun)


# --- contents ---


def _without(name):
    return lambda content: content["per_image"][0].pop(name)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_without("pose_distance"), "pose_distance of r_0 is None"),
        (_without("name"), "the name of an image is None"),
        (lambda c: c["per_image"][0].update(psnr="thirty"), "r_0.psnr is 'thirty'"),
        (lambda c: c["metrics"].update(psnr="thirty"), "metrics.psnr is 'thirty'"),
        (lambda c: c["metrics"].update(psnr=True), "metrics.psnr is True"),
        (lambda c: c.update(metrics=None), "metrics is None, which is no object"),
        (lambda c: c.update(per_image={}), "per_image is {}, which is no list"),
        (lambda c: c.update(costs={"price": 1.0}), "price, which is no cost"),
        (lambda c: c.update(views=[{"name": "r_0"}]), "rgb of a view is None"),
        (lambda c: c.update(scene=3.0), "scene is 3.0, which is no text"),
        (lambda c: c.pop("fingerprint"), "lacks fingerprint"),
        (lambda c: c["settings"].update(luck=1), "its settings are others"),
    ],
)
def test_contents_of_another_kind_are_named(tmp_path, spoil, message):
    out = _written(tmp_path, _TREE)
    (path,) = out.glob("jobs/*/*/result.json")
    content = json.loads(path.read_text())
    spoil(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="is not the result of a job") as caught:
        results.read(path)
    assert message in str(caught.value) and str(path) in str(caught.value)


def test_a_scene_may_be_called_as_a_number_is(tmp_path):
    metrics = {"psnr": math.inf, "psnr_masked": None, "flip": -math.inf}
    record = made_record("nan", "tree", **metrics)
    record = record._replace(per_image=[Image("inf", 0.5, 2.0, {**metrics, "ssim": 0.5})])
    assert _read(_written(tmp_path, record)) == [record]
    assert paper_tables.main_table([record]).blocks


def test_what_is_no_number_comes_back_and_is_not_the_best_of_a_report():
    record = results.from_json(results.to_json(made_record("nan", "tree", psnr_masked=math.nan)))
    assert math.isnan(record.metrics["psnr_masked"]) and record.scene == "nan"
    others = [made_record("nan", name, psnr_masked=1.0 + i) for i, name in enumerate("ab")]
    scene = Scene("nan", "", "", tuple(Result(each, (), ()) for each in (record, *others)))
    assert page._scores(scene, ["tree", "a", "b"]) == ["nan", "1.00", "<strong>2.00</strong>"]


# --- what is planned ---


@pytest.mark.parametrize("spoil", ["missing", "empty", "image"])
def test_a_scene_without_test_views_is_left_out_and_not_trained(tmp_path, spoil):
    folder = write_scene(tmp_path / "ball")
    if spoil == "missing":
        (folder / "transforms_test.json").unlink()
    elif spoil == "empty":
        (folder / "transforms_test.json").write_text('{"camera_angle_x": 1.0, "frames": []}')
    else:
        (folder / "test/r_003.png").unlink()
    planned, skipped = plan.plan_jobs(
        plan.find_scenes([str(folder)]), methods.parse(["main"]), SETTINGS
    )
    assert planned == [] and [each.method for each in skipped] == [
        name for name in METHODS if METHODS[name].group == "main"
    ]
    for each in skipped:
        assert "its test views can not be read" in each.reason
        assert ("r_003.png" if spoil == "image" else "transforms_test.json") in each.reason


@pytest.mark.parametrize(
    ("preset", "same"),
    [
        ("tiny", "tree_differential"),
        ("small", "tree_differential"),
        ("paper", "tree_cone"),
        ("best", "tree_differential"),
    ],
)
def test_an_ablation_that_the_preset_has_already_is_left_out(tmp_path, preset, same):
    scenes = plan.find_scenes([str(write_scene(tmp_path / "ball"))])
    common = settings.Settings(preset, 6, None, 1, 0, None)
    planned, skipped = plan.plan_jobs(scenes, methods.parse(["all"]), common)
    (left,) = [each for each in skipped if "preset" in each.reason]
    assert (left.method, left.reason) == (same, f"in the preset {preset} it is tree again")
    assert len([job for job in planned if job.method in METHODS]) == len(METHODS) - len(skipped)
