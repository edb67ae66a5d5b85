"""Which results are taken: of what scene, by what method, and with what contents."""

import dataclasses
import json
import math

import pytest

from experiments.benchmarking import paper_tables, plan, results, settings
from experiments.benchmarking.results import Costs, Image, Truth, View
from tests.factories.made_benchmark import SETTINGS, made_record

_TREE = made_record("cube_smcvx_ball", "tree", psnr=30.0)


def _written(tmp_path, record, method=None):
    out = tmp_path / "out"
    folder = out / plan.FOLDER / record.scene / (method or record.method)
    folder.mkdir(parents=True)
    results.write(folder, record)
    return out


def _read(out, scenes=()):
    return results.read_all(out, settings.asked(SETTINGS, scenes, []))


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (
            _TREE._replace(options=_TREE.options | {"train": ["--preset=tiny"]}),
            "made by train --preset=tiny, but here tree is train --preset=tiny --steps=6",
        ),
        (_TREE._replace(options={**_TREE.options, "evaluate": []}), "made by evaluate"),
        (_TREE._replace(settings=dataclasses.replace(SETTINGS, seed=1)), "with other settings"),
        (_TREE._replace(category="smncvx"), "its name has smcvx and cube"),
        (_TREE._replace(background="env"), "its name has smcvx and cube"),
        (_TREE._replace(method="magic"), "method magic, which is unknown in this version"),
        (_TREE._replace(fingerprint="other"), "another scene named cube_smcvx_ball"),
    ],
)
def test_results_that_do_not_compare_are_refused_by_name(tmp_path, record, message):
    scene = settings.Scene("cube_smcvx_ball", "/nowhere", "")
    out = _written(tmp_path, record)
    with pytest.raises(ValueError, match=message) as caught:
        _read(out, [scene])
    assert str(out) in str(caught.value)


def test_a_result_in_the_folder_of_another_is_refused(tmp_path):
    out = _written(tmp_path, _TREE, method="straight")
    with pytest.raises(ValueError, match="is the result of cube_smcvx_ball/tree"):
        _read(out)


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


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c["per_image"][0].pop("pose_distance"), "pose_distance of r_0 is None"),
        (lambda c: c["per_image"][0].pop("name"), "the name of an image is None"),
        (lambda c: c["per_image"][0].update(psnr="thirty"), "r_0.psnr is 'thirty'"),
        (lambda c: c["metrics"].update(psnr=True), "metrics.psnr is True"),
        (lambda c: c.update(metrics=None), "metrics is None, which is not an object"),
        (lambda c: c.update(per_image={}), "per_image is {}, which is not a list"),
        (lambda c: c.update(costs={"price": 1.0}), "price, which is not a cost"),
        (lambda c: c.update(views=[{"name": "r_0"}]), "rgb of a view is None"),
        (lambda c: c.update(scene=3.0), "scene is 3.0, which is not text"),
        (lambda c: c.pop("fingerprint"), "lacks fingerprint"),
        (lambda c: c["settings"].update(luck=1), "its settings differ"),
    ],
)
def test_contents_of_another_kind_are_named(tmp_path, spoil, message):
    content = results.to_json(_TREE)
    spoil(content)
    path = tmp_path / plan.RESULT
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="is not the result of a job") as caught:
        results.read(path)
    assert message in str(caught.value) and str(path) in str(caught.value)


def test_a_record_comes_back_whole_though_its_scene_is_called_as_a_number_is(tmp_path):
    metrics = {"psnr": math.inf, "psnr_masked": None, "flip": -math.inf}
    record = made_record("nan", "tree", **metrics)._replace(
        per_image=[Image("inf", 0.5, 2.0, {**metrics, "ssim": 0.5})],
        costs=Costs(steps=6, seconds=0.5),
        versions={"jax": "0.0"},
        views=[View("inf", Truth("a.png", None, "d.exr"), "rgb.png", "distance.exr")],
        facts={"learned": [1.0]},
    )
    assert _read(_written(tmp_path, record)) == [record]
    assert paper_tables.main_table([record]).blocks
    again = results.from_json(results.to_json(made_record("nan", "tree", psnr=math.nan)))
    assert math.isnan(again.metrics["psnr"]) and again.scene == "nan"
