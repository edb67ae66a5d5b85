"""The report: what is in the page, that it needs nothing else, and that nothing breaks it."""

import base64
import io
import json
import os
import shutil
import subprocess
import sys

import pytest
from PIL import Image

from experiments.benchmarking import plan, results, summary
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.report import data, page
from experiments.benchmarking.report.data import Result, Scene
from experiments.benchmarking.results import Image as Measured
from experiments.benchmarking.results import Truth, View
from tests.experiments.benchmarking import made_report
from tests.experiments.benchmarking.made_records import made_record
from tests.experiments.benchmarking.read_page import elements, named
from tests.experiments.command import ROOT

_ODD = "a'b\"c <script>alert(1) &amp;%2F#"
_SCENES = ("cube_smcvx_ball", "env_mmncvx_cup")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return made_report.write(tmp_path_factory.mktemp("report"), _SCENES)


@pytest.fixture(scope="module")
def found(out):
    return elements(page.write(out, views=2, edge=200).read_text("utf-8"))


def _copy(out, tmp_path):
    """Copies results without pictures and scenes, as results.json and JSON files have them."""
    shutil.copytree(out, tmp_path / "copy", ignore=shutil.ignore_patterns("run"))
    text = (tmp_path / "copy/benchmark.json").read_text()
    (tmp_path / "copy/benchmark.json").write_text(text.replace("scene_", "gone_"))
    index = tmp_path / "copy" / summary.RESULTS
    index.write_text(index.read_text().replace("/scene_", "/gone_"))
    return tmp_path / "copy"


def test_every_scene_method_and_view_is_there(found):
    sections = named(found, "section", class_="scene")
    assert [section.attributes["data-scene"] for section in sections] == list(_SCENES)
    # The worst of each method is its first view, and one is spread.
    views = [view.attributes["data-view"] for view in named(found, "article")]
    assert views == ["r_0", "r_1"] * 2
    for section in sections:
        text = " ".join(section.text)
        assert all(name in text for name in ("straight", "tree", "ground truth", "object's mask"))
    keys = [
        image.attributes["data-key"]
        for image in named(found, "img")
        if "data-key" in image.attributes
    ]
    assert keys == ["truth", "straight", "tree"] * 4
    assert not [e for e in named(found, "p", class_="absent") if "hidden" not in e.attributes]
    # Of each view the truth with its mask and distance, and three pictures of each method.
    assert len([e for e in named(found, "img") if "src" in e.attributes]) == 4 * 9


def test_nothing_is_loaded_from_anywhere(found):
    for element in found:
        for name, value in element.attributes.items():
            assert name not in ("srcset", "data", "poster", "action", "background")
            assert name != "src" or value.startswith("data:image/webp;base64,")
            assert name != "href" or value.startswith("#")
            assert not name.startswith("on")
    for element in named(found, "style") + named(found, "script"):
        text = "".join(element.text)
        assert all(word not in text for word in ("url(", "@import", "http", "fetch(", "import("))
    (policy,) = named(found, "meta", http_equiv="Content-Security-Policy")
    assert policy.attributes["content"].startswith("default-src 'none'; img-src data:;")


def test_pictures_decode_and_have_the_size_that_is_said(found):
    for image in [e.attributes for e in named(found, "img") if "src" in e.attributes]:
        data = base64.b64decode(image["src"].partition(",")[2], validate=True)
        with Image.open(io.BytesIO(data)) as opened:
            opened.load()
            assert opened.size == (12, 12) == (int(image["width"]), int(image["height"]))


def test_identifiers_are_unique_and_links_lead_somewhere(found):
    names = [element.attributes["id"] for element in found if "id" in element.attributes]
    assert len(set(names)) == len(names)
    copies = [e.attributes["data-copy"] for e in named(found, "img") if "data-copy" in e.attributes]
    assert copies and set(copies) <= set(names)
    pages = {page.address(scene, view) for scene in _SCENES for view in ("r_0", "r_1", None)}
    links = {link.attributes["href"] for link in named(found, "a")}
    assert links <= pages | {f"#{name}" for name in names} and pages <= links


def test_tables_mark_the_best_and_label_what_is_published(found):
    rows = named(found, "tr", class_="published")
    assert rows and all("published" in row.text for row in rows)
    assert not any("±" in "".join(row.text) for row in rows)
    (table,) = [e for e in named(found, "section", id="tables")]
    text = "".join(table.text)
    assert "<u>" not in text and "**" not in text and "measured on its data" in text
    assert "28.00" in {"".join(e.text) for e in named(found, "strong")}
    assert "Nothing is measured yet" in text  # of ablations


def test_scenes_are_listed_under_the_labels_of_the_tables(found):
    (section,) = named(found, "section", id="scenes")
    text = "".join(section.text)
    assert all(METHODS[name].label in text for name in ("straight", "tree"))


def test_what_failed_and_was_left_out_is_told(found):
    (section,) = named(found, "section", id="jobs")
    text = "".join(section.text)
    assert "failed: cube_smcvx_ball/r3fexperiments.train: error: <b>no</b> & never" in text
    assert "left out: cube_smcvx_ball/r3f_treeits training images have no masks" in text
    (section,) = named(found, "section", id="settings")
    text = "".join(section.text)
    assert all(word in text for word in ("tiny", "jax 0.0", "--steps=6", "0.125", "noisy"))


def test_odd_names_break_nothing(tmp_path):
    out = made_report.write(tmp_path, [_ODD], views=1)
    found = elements(page.write(out, views=1, edge=200).read_text("utf-8"))
    (section,) = named(found, "section", class_="scene")
    assert section.attributes["data-scene"] == _ODD
    assert len(named(found, "script")) == 1 and not named(found, "b")
    links = {link.attributes["href"] for link in named(found, "a")}
    assert page.address(_ODD) in links and len(page.address(_ODD).split("/")) == 2


def test_without_pictures_there_is_a_report_still(out, tmp_path):
    copy = _copy(out, tmp_path)
    found = elements(page.write(copy, views=2, edge=200).read_text("utf-8"))
    assert not [e for e in named(found, "img") if "src" in e.attributes]
    absent = [e for e in named(found, "p", class_="absent") if "hidden" not in e.attributes]
    assert len(absent) == 4 * 9 and {"".join(e.text) for e in absent} == {"picture not here"}
    assert len(named(found, "svg", class_="chart")) == 4  # the curves are in results.json


def test_a_broken_picture_and_one_of_another_size_are_left_out(out, tmp_path):
    shutil.copytree(out, tmp_path / "copy")
    folders = [tmp_path / "copy" / plan.FOLDER / name / "tree/run/eval/test" for name in _SCENES]
    (folders[0] / "rgb/r_0.png").write_bytes(b"no picture")
    Image.new("RGB", (5, 5)).save(folders[1] / "rgb/r_0.png")
    (folders[1] / "distance/r_0.exr").write_bytes(b"")
    found = elements(page.write(tmp_path / "copy", views=1, edge=200).read_text("utf-8"))
    captions = [e for e in named(found, "p", class_="absent") if "hidden" not in e.attributes]
    assert len(captions) == 2 + 3  # an image and its error; all three


def test_a_scene_that_has_moved_is_found_where_it_is_now(out, tmp_path):
    index = json.loads((out / summary.RESULTS).read_text())
    for job in index["jobs"]:
        job["scene_path"] = "/nowhere"
    shutil.copytree(out, tmp_path / "copy")
    (tmp_path / "copy" / summary.RESULTS).write_text(json.dumps(index))
    found = elements(page.write(tmp_path / "copy", views=2, edge=200).read_text("utf-8"))
    assert len([e for e in named(found, "img") if "src" in e.attributes]) == 4 * 9


def _result(scene, method, **values):
    """A result with a PSNR inside the mask for each view, by its name."""
    per_image = [
        Measured(name, 0.1, None, {"psnr": 40.0, "psnr_masked": value})
        for name, value in values.items()
    ]
    known = [value for value in values.values() if value is not None]
    record = made_record(scene, method, psnr_masked=sum(known) / max(1, len(known)))
    views = [View(name, Truth("", None, None), "", "") for name in values]
    return Result(record._replace(per_image=per_image, views=views), (), ())


def test_failures_are_sorted_by_the_error_in_the_mask():
    scenes = [
        Scene("x", "", "", (_result("x", "tree", a=30.0, b=20.0, c=None),)),
        Scene(
            "y", "", "", (_result("y", "tree", a=25.0), _result("y", "straight", a=10.0, b=50.0))
        ),
    ]
    ordered = [(case.scene, case.method, case.view) for case in data.failures(scenes, 99)]
    assert ordered == [
        ("y", "straight", "a"),
        ("x", "tree", "b"),
        ("y", "tree", "a"),
        ("x", "tree", "a"),
        ("y", "straight", "b"),
        ("x", "tree", "c"),
    ]
    # At most so many of each method.
    assert [case.view for case in data.failures(scenes, 1)] == ["a", "b"]
    assert data.failures([], 9) == []


def test_views_are_the_worst_of_each_method_in_turn_and_some_between():
    tree = _result("x", "tree", a=30.0, b=31.0, c=32.0, d=33.0, e=34.0, f=35.0, g=29.0)
    straight = _result("x", "straight", a=12.0, b=13.0, c=14.0, d=15.0, e=10.0, f=11.0, g=16.0)
    scene = Scene("x", "", "", (straight, tree))
    # Tree's worst, straight's, tree's second; then the first and the last of b, c, d, f.
    assert data.choose_views(scene, 5) == ["a", "b", "e", "f", "g"]
    assert data.choose_views(scene, 1) == ["g"]
    assert data.choose_views(scene, 99) == list("abcdefg")
    assert data.choose_views(Scene("x", "", "", (_result("x", "tree"),)), 5) == []


def test_a_report_of_many_scenes_shows_fewer_views_and_never_none():
    scene = Scene("x", "", "", (_result("x", "tree", a=1.0), _result("x", "straight", a=1.0)))
    assert page.shown_views((scene,) * 6, 5) == 5
    assert page.shown_views((scene,) * 100, 5) == 3  # 900 pictures for each view
    assert page.shown_views((scene,) * 1000, 5) == 1
    assert page.shown_views((), 5) == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "has no results.json. Make it with --tables_only."),
        ("{", "is not valid JSON"),
        ("{}", "is not that of a benchmark (KeyError('jobs')"),
        ('{"jobs": [{}]}', "is not that of a benchmark (ValueError('the file lacks scene')"),
    ],
)
def test_broken_results_are_named(out, tmp_path, text, message):
    shutil.copy(out / "benchmark.json", tmp_path)
    if text is not None:
        (tmp_path / summary.RESULTS).write_text(text)
    with pytest.raises(ValueError) as caught:
        page.write(tmp_path, views=1, edge=20)
    assert message in str(caught.value) and str(tmp_path) in str(caught.value)
    assert not (tmp_path / page.FILE).exists()


def test_a_benchmark_without_results_has_a_report(tmp_path):
    out = made_report.write(tmp_path, ["cube_smcvx_ball"], methods=())
    found = elements(page.write(out, views=1, edge=20).read_text("utf-8"))
    text = "".join("".join(e.text) for e in named(found, "main"))
    assert "No job is done yet." in text and "No view was measured." in text


def test_what_failed_before_is_known_until_it_is_done(out, tmp_path):
    failed, skipped = summary.not_done(out)
    assert list(failed) == ["cube_smcvx_ball/r3f"] and [e.method for e in skipped] == ["r3f_tree"]
    copy = _copy(out, tmp_path)
    for method in ("r3f", "r3f_tree"):
        folder = copy / plan.FOLDER / "cube_smcvx_ball" / method
        folder.mkdir()
        results.write(folder, made_record("cube_smcvx_ball", method))
    assert summary.not_done(copy) == ({}, [])
    assert summary.not_done(tmp_path / "nowhere") == ({}, [])


def test_methods_that_this_version_does_not_know_are_shown_last(out, tmp_path):
    copy = _copy(out, tmp_path)
    path = copy / summary.RESULTS
    path.write_text(path.read_text().replace('"straight"', '"of <tomorrow>"'))
    index = json.loads(path.read_text())
    del index["methods"]["of <tomorrow>"]
    path.write_text(json.dumps(index))
    everything = data.read(copy)
    methods = [result.record.method for result in everything.scenes[0].results]
    assert methods == ["tree", "of <tomorrow>"]
    text = page.show_overview(everything, "", {name: {} for name in _SCENES})
    assert "of &lt;tomorrow&gt;" in text and "<tomorrow>" not in text


def test_the_slider_begins_with_the_truth_and_the_last_main_method(out, tmp_path):
    copy = _copy(out, tmp_path)
    path = copy / summary.RESULTS
    text = path.read_text().replace('"tree"', '"tree_cone"').replace('"straight"', '"tree"')
    path.write_text(text)
    (first, *_) = data.read(copy).scenes
    shown = page.show_scene(copy, first, ["r_0"], edge=9, prefix="").html
    options = named(elements(shown), "option")
    assert [e.attributes["value"] for e in options] == ["truth", "tree", "tree_cone"] * 2
    chosen = [e.attributes["value"] for e in options if "selected" in e.attributes]
    assert chosen == ["truth", "tree"]


def test_the_command_makes_it_again_with_the_tables(out, tmp_path):
    shutil.copytree(out, tmp_path / "copy")
    words = ["-m", "experiments.benchmark", f"--out={tmp_path / 'copy'}", "--tables_only"]
    options = ["--report_views=1", "--report_edge=16"]
    result = subprocess.run(
        [sys.executable, *words, *options], cwd=ROOT, capture_output=True, text=True, check=True
    )
    report = tmp_path / "copy" / page.FILE
    assert f"Report:  {report} (" in result.stdout
    assert f"Picture: {tmp_path / 'copy' / 'pictures.jpg'}" in result.stdout
    found = elements(report.read_text("utf-8"))
    assert len(named(found, "article")) == len(_SCENES)
    assert "r3f_tree" in "".join(named(found, "section", id="jobs")[0].text)  # not forgotten
    assert os.listdir(tmp_path / "copy" / "tables")
