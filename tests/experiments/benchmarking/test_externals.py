"""Methods whose renderings are given: what is refused, what is measured, and when again."""

import json
import shutil

import numpy as np
import pytest

from experiments.benchmarking import (
    externals,
    methods,
    paper_tables,
    plan,
    results,
    settings,
    summary,
    tables,
    worker,
)
from experiments.benchmarking.externals import External
from experiments.benchmarking.report import data, page, sheets
from refref_jax.data import image_files
from tests.factories.made_benchmark import (
    SETTINGS,
    made_record,
    write_benchmark,
    write_renderings,
    write_scene,
)
from tests.fakes.serving import calls

_SCENES = ("cube_smcvx_ball", "env_mmncvx_cup")


@pytest.fixture
def both(tmp_path):
    """Two scenes, and renderings of both by one method; the folder of each."""
    for name in _SCENES:
        scene = write_scene(tmp_path / "scenes" / name)
        write_renderings(tmp_path / "mine" / name, scene, level=0.2, distance=9.0)
    return tmp_path / "scenes", tmp_path / "mine"


def _planned(folders, given, chosen=()):
    scenes = plan.find_scenes([str(folder) for folder in folders])
    return plan.plan_jobs(scenes, chosen, SETTINGS, given=given)[0]


def _read(out, given):
    return results.read_all(out, settings.asked(SETTINGS, [], [], given))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["mine"], "--external=mine is not NAME=FOLDER"),
        (["=renders"], "--external==renders is not NAME=FOLDER"),
        (["mine="], "--external=mine= is not NAME=FOLDER"),
        (["a/b=renders"], "has the name 'a/b'. Use at most 64 letters"),
        (["..=renders"], "has the name '..'. Use"),
        (["a b=renders"], "has the name 'a b'. Use"),
        (["Tree=renders"], "The name Tree of --external=Tree=renders is taken by ours"),
        (["reconstruction=r"], "is taken by ours"),
        (["truth=r"], "is taken by ours"),
        (["mine=a", "Mine=b"], "The name Mine of --external=Mine=b is taken by another --external"),
    ],
)
def test_names_that_are_unsafe_or_taken_are_refused(words, message):
    with pytest.raises(ValueError, match="external") as caught:
        externals.parse(words)
    assert message in str(caught.value)


def test_folders_are_those_of_scenes_or_of_the_only_one(tmp_path, both):
    scenes, mine = both
    (given,) = externals.parse([f"mine={mine}"])
    jobs = _planned(scenes.iterdir(), [given], methods.parse(["tree"]))
    assert [job.name for job in jobs if job.external] == [f"{name}/mine" for name in _SCENES]
    assert {job.external for job in jobs} == {"", *(str(mine / name) for name in _SCENES)}
    alone = External("mine", str(mine / _SCENES[0]))
    (job,) = _planned([scenes / _SCENES[0]], [alone])
    assert job.external == alone.folder and job.digest == jobs[1].digest
    with pytest.raises(ValueError, match=f"has no folder {_SCENES[0]}. Save the rend"):
        _planned(scenes.iterdir(), [alone])
    with pytest.raises(ValueError, match="nowhere of --external=mine is not a folder"):
        _planned(scenes.iterdir(), [External("mine", str(tmp_path / "nowhere"))])
    (mine / _SCENES[1] / "r_002.png").unlink()
    with pytest.raises(ValueError, match=r"env_mmncvx_cup lacks 1 of 7 views: r_002\.png"):
        _planned(scenes.iterdir(), [given])
    (scenes / _SCENES[1] / "transforms_test.json").unlink()
    found = plan.find_scenes([str(scenes / _SCENES[1])])
    ((skipped,),) = plan.plan_jobs(found, [], SETTINGS, given=[given])[1:]
    assert skipped.name == "env_mmncvx_cup/mine" and "test views cannot be read" in skipped.reason


@pytest.mark.slow
def test_a_job_measures_copies_and_again_when_a_file_has_changed(tmp_path, both, stand_in):
    scenes, mine = both
    given, out = External("mine", str(mine)), tmp_path / "out"
    (job,) = _planned([scenes / _SCENES[0]], [given])
    assert worker.run_job(out, job) is None and plan.is_done(out, job)
    (record,) = _read(out, [given])
    assert results.is_external(record) and record.facts == {}
    assert record.options == {
        "metrics": ["--split=test"],
        "external": [f"--renderings=sha256:{job.digest}"],
    }
    assert record.metrics["psnr"] == pytest.approx(-20.0 * np.log10(50.0 / 255.0), abs=1e-4)
    assert record.metrics["distance_mae"] > 2.5 and record.metrics["lpips"] is None
    assert record.costs == results.Costs() and len(record.per_image) == 7
    folder = plan.job_folder(out, job)
    assert (folder / record.views[0].rgb).is_file()
    assert (folder / record.views[0].distance).is_file()
    path = mine / _SCENES[0] / "r_001.exr"
    distance = np.full(image_files.read_exr(path).shape, 8.0, np.float32)
    image_files.write_exr(path, distance)
    # Changed after the plan was made: neither are they measured, nor does the old result stay.
    planned = job._replace(digest="0")
    assert "have changed since the benchmark" in worker.run_job(out, planned)
    assert _read(out, [given]) == []
    (again,) = _planned([scenes / _SCENES[0]], [given])
    assert again.digest != job.digest and not plan.is_done(out, again)
    assert worker.run_job(out, again) is None and plan.is_done(out, again)
    assert _read(out, [given])[0].metrics["distance_mae"] > record.metrics["distance_mae"]


def test_a_result_says_what_it_is_of_and_a_method_of_ours_is_not_that(tmp_path):
    options = plan.external_options(SETTINGS, "0")
    for method, kept, message in (
        ("mine", options, None),
        ("mine", plan.external_options(SETTINGS, "1"), None),
        ("mine", options | {"metrics": ["--split=val"]}, "was made by metrics --split=val"),
        ("mine", {}, "which is unknown in this version"),
        ("tree", options, "but this version trains a method of that name"),
    ):
        record = made_record("cube_smcvx_ball", method)._replace(options=kept)
        folder = tmp_path / plan.FOLDER / record.scene / method
        folder.mkdir(parents=True)
        results.write(folder, record)
        if message is None:
            assert _read(tmp_path, []) == [record]
        else:
            with pytest.raises(ValueError, match=message):
                _read(tmp_path, [])
        shutil.rmtree(folder)


def test_tables_rank_it_with_ours_and_say_where_it_is_from():
    options = plan.external_options(SETTINGS, "0")
    found = [
        made_record("cube_smcvx_ball", "tree", psnr=30.0, psnr_masked=24.0),
        made_record("cube_smcvx_ball", "a_b", psnr=31.0)._replace(options=options),
    ]
    table = paper_tables.main_table(found)
    tree, mine = table.blocks[0].rows[:2]
    assert (mine.label, mine.origin, mine.scenes) == ("a_b", "external", 1)
    assert mine.cells[0].mean == 31.0 and mine.marks[0] == "best" and tree.marks[0] == ""
    assert mine.cells[1] == tables.NOTHING and tree.marks[1] == ""
    text = summary.markdown(table)
    assert "| a_b, *external* | 1 | **31.00** | - |" in text and "renderings by other" in text
    assert r"a\_b \emph{(external)} & 1 & \textbf{31.00} & -" in summary.latex(table)
    top = paper_tables.top_views_table(found)
    assert [row.label for row in top.blocks[0].rows][1] == "a_b"
    assert "external" not in summary.markdown(paper_tables.main_table(found[:1]))
    assert paper_tables.ablation_table(found).blocks == ()


@pytest.mark.slow
def test_the_report_shows_it_like_the_others(tmp_path):
    out = write_benchmark(tmp_path, ["cube_smcvx_ball"])
    ours, theirs = (out / plan.FOLDER / "cube_smcvx_ball" / name for name in ("tree", "mine"))
    shutil.copytree(ours, theirs)
    shutil.rmtree(theirs / "run/eval/test/distance")
    (theirs / "run/metrics.jsonl").unlink()
    record = results.read(ours / plan.RESULT)
    options = plan.external_options(SETTINGS, "0")
    results.write(theirs, record._replace(method="mine", options=options))
    benchmark = settings.read(out)
    summary.write(out, benchmark, failed={}, skipped=[])
    scene = data.read(out).scenes[0]
    assert [result.record.method for result in scene.results] == ["straight", "tree", "mine"]
    text = page.write(out, views=1, edge=100).read_text("utf-8")
    assert 'mine<span class="badge">external</span>' in text
    assert 'alt="image of r_0, mine"' in text and 'alt="error of r_0, mine"' in text
    assert 'alt="distance of r_0, mine"' not in text
    assert sheets.write(out) == [out / sheets.SHEET, out / sheets.GRID]


@pytest.mark.slow
def test_the_command_adds_it_without_training_it(tmp_path, serve, scenes):
    for name in _SCENES:
        write_renderings(tmp_path / "mine" / name, tmp_path / "scenes" / name)
    given = f"--external=mine={tmp_path / 'mine'}"
    listed = serve(tmp_path, scenes, "--methods=straight", given, "--dry_run").stdout
    lines = listed.splitlines()
    assert lines[-1] == "4 jobs, 4 to do." and not (tmp_path / "out").exists()
    folder = tmp_path / "mine" / _SCENES[0]
    assert any(f"{_SCENES[0]}/mine" in x and f"--external=mine={folder}" in x for x in lines)
    serve(tmp_path, scenes, "--methods=", given, "--limit=2")
    assert calls(tmp_path) == []
    text = (tmp_path / "out" / summary.FILE).read_text()
    assert "| mine, *external* | 2 |" in text
    serve(tmp_path, scenes, "--methods=straight", "--limit=2")
    index = json.loads((tmp_path / "out" / summary.RESULTS).read_text())
    assert index["methods"]["mine"] == {"label": "mine", "group": "external"}
    assert index["missing"] == []
    told = serve(tmp_path, scenes, "--methods=straight", given, "--limit=2").stdout
    assert "All jobs are already finished." in told
    write_renderings(folder, tmp_path / "scenes" / _SCENES[0], level=0.9)
    listed = serve(tmp_path, scenes, "--methods=", given, "--limit=2", "--dry_run").stdout
    assert "2 jobs, 1 to do." in listed
    shutil.rmtree(folder)
    again = serve(tmp_path, scenes, "--methods=tree", given, "--limit=2", status=2)
    assert f"has no folder {_SCENES[0]}" in again.stderr and "tree" not in str(calls(tmp_path))
    refused = serve(tmp_path, "--tables_only", given, status=2).stderr
    assert "--tables_only does not use --external," in refused
    serve(tmp_path, "--tables_only")
    assert "| mine, *external* | 2 |" in (tmp_path / "out" / summary.FILE).read_text()
