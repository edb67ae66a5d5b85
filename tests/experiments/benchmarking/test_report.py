"""The report: what is in the page, that it needs nothing else, and that nothing breaks it."""

import json
import math
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image as Picture

from experiments.benchmarking import plan, summary
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.report import charts, data, images, page, sheets
from experiments.benchmarking.report.data import Result, Scene
from experiments.benchmarking.results import Image, Truth, View
from tests.factories.made_benchmark import QUALITY, made_record, write_benchmark

_ODD = "a'b\"c <script>alert(1) &amp;%2F#"
_SCENES = (_ODD, "cube_smcvx_ball")


class _Reader(HTMLParser):
    """Collects `(name, attributes, text)` of all elements; each must be closed, in order."""

    def __init__(self, text):
        super().__init__()
        self.found, self._open = [], []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), []))
        if tag not in ("img", "input", "meta"):
            self._open.append(self.found[-1])

    def handle_endtag(self, tag):
        assert self._open.pop()[0] == tag

    def handle_data(self, data):
        for _, _, text in self._open:
            text.append(data)


def _elements(text, name, **wanted):
    """Returns attributes and text of all elements of a name that have some attributes."""
    return [
        (attributes, "".join(words))
        for tag, attributes, words in _Reader(text).found
        if tag == name
        and {k.strip("_"): v for k, v in wanted.items()}.items() <= attributes.items()
    ]


def _pictures(text):
    return [attributes for attributes, _ in _elements(text, "img") if "src" in attributes]


def _absent(text):
    found = _elements(text, "p", class_="absent")
    return [words for attributes, words in found if "hidden" not in attributes]


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return write_benchmark(tmp_path_factory.mktemp("report"), _SCENES)


@pytest.fixture(scope="module")
def text(out):
    return page.write(out, views=2, edge=200).read_text("utf-8")


def _copy(out, tmp_path):
    """Copies results without pictures and scenes, as results.json and JSON files have them."""
    shutil.copytree(out, tmp_path / "copy", ignore=shutil.ignore_patterns("run"))
    for name in ("benchmark.json", summary.RESULTS):
        path = tmp_path / "copy" / name
        path.write_text(path.read_text().replace("/scene_", "/gone_"))
    return tmp_path / "copy"


def test_every_scene_method_view_and_metric_is_there(text):
    sections = _elements(text, "section", class_="scene")
    assert [attributes["data-scene"] for attributes, _ in sections] == list(_SCENES)
    # The worst of each method is its first view, and one is spread.
    views = [attributes["data-view"] for attributes, _ in _elements(text, "article")]
    assert views == ["r_0", "r_1"] * 2
    for _, words in sections:
        assert all(name in words for name in ("straight", "tree", "ground truth", "object's mask"))
        assert all(number in words for number in ("masked PSNR, dB", "15.00", "28.00", "30.00"))
    # Of each view the truth with its mask and distance, and three pictures of each method.
    assert len(_pictures(text)) == 4 * 9 and not _absent(text)
    assert len(_elements(text, "polyline")) == 2 * 2 * 2
    ((_, scenes),) = _elements(text, "section", id="scenes")
    ((_, tables),) = _elements(text, "section", id="tables")
    for name in ("straight", "tree"):
        assert METHODS[name].label in scenes and METHODS[name].label in tables
    assert "measured on its data" in tables and "No results yet" in tables
    rows = _elements(text, "tr", class_="published")
    assert rows and all("published" in words and "±" not in words for _, words in rows)
    assert "28.00" in [words for _, words in _elements(text, "strong")]
    ((_, jobs),) = _elements(text, "section", id="jobs")
    assert f"{_SCENES[0]}/r3fexperiments.train: error: <b>no</b> & never" in jobs
    assert f"{_SCENES[0]}/r3f_treeits training images have no masks" in jobs
    ((_, measured),) = _elements(text, "section", id="settings")
    assert all(word in measured for word in ("tiny", "jax 0.0", "--steps=6", "0.125", "noisy"))


def test_nothing_is_loaded_from_anywhere_and_links_lead_somewhere(text):
    found = _Reader(text).found
    for _, attributes, _ in found:
        for name, value in attributes.items():
            assert name not in ("srcset", "data", "poster", "action", "background")
            assert name != "src" or value.startswith("data:image/webp;base64,")
            assert not name.startswith("on")
    scripts = [words for name in ("style", "script") for _, words in _elements(text, name)]
    assert len(scripts) == 2
    for words in scripts:
        assert not re.search(r"url\(|@import|http|fetch\(|import\(", words)
    assert 'content="default-src &#x27;none&#x27;; img-src data:;' in text
    names = [attributes["id"] for _, attributes, _ in found if "id" in attributes]
    assert len(set(names)) == len(names)
    copies = {attributes["data-copy"] for _, attributes, _ in found if "data-copy" in attributes}
    assert copies and copies <= set(names)
    pages = {page.address(scene, view) for scene in _SCENES for view in ("r_0", "r_1", None)}
    links = {attributes["href"] for attributes, _ in _elements(text, "a")}
    assert links <= pages | {f"#{name}" for name in names} and pages <= links


def test_without_pictures_there_is_a_report_still(out, tmp_path):
    copy = _copy(out, tmp_path)
    text = page.write(copy, views=2, edge=200).read_text("utf-8")
    assert _pictures(text) == [] and _absent(text) == ["image not available"] * 4 * 9
    assert len(_elements(text, "svg", class_="chart")) == 4  # the curves are in results.json
    for file in (sheets.SHEET, sheets.GRID):
        (copy / file).write_bytes(b"of scenes that were there")
    assert sheets.write(copy) == []
    assert not (copy / sheets.SHEET).exists() and not (copy / sheets.GRID).exists()


def test_a_broken_picture_and_one_of_another_size_are_left_out(out, tmp_path):
    shutil.copytree(out, tmp_path / "copy")
    # The scene has moved, and is found where it is now.
    index = tmp_path / "copy" / summary.RESULTS
    index.write_text(re.sub(r'"scene_path": ".*"', '"scene_path": "/nowhere"', index.read_text()))
    folders = [tmp_path / "copy" / plan.FOLDER / name / "tree/run/eval/test" for name in _SCENES]
    (folders[0] / "rgb/r_0.png").write_bytes(b"no picture")
    Picture.new("RGB", (5, 5)).save(folders[1] / "rgb/r_0.png")
    (folders[1] / "distance/r_0.exr").write_bytes(b"")
    text = page.write(tmp_path / "copy", views=1, edge=200).read_text("utf-8")
    # An image and its error; all three.
    assert len(_absent(text)) == 2 + 3 and len(_pictures(text)) == 2 * 9 - 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "has no results.json. Create it with --tables_only."),
        ("{", "is not valid JSON"),
        ("{}", "is not a valid index (KeyError('jobs')"),
        ('{"jobs": [{}]}', "is not a valid index (ValueError('the file lacks scene')"),
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


def test_methods_that_this_version_does_not_know_are_shown_last(out, tmp_path):
    copy = _copy(out, tmp_path)
    index = json.loads(
        (copy / summary.RESULTS).read_text().replace('"straight"', '"of <tomorrow>"')
    )
    del index["methods"]["of <tomorrow>"]
    (copy / summary.RESULTS).write_text(json.dumps(index))
    methods = [result.record.method for result in data.read(copy).scenes[0].results]
    assert methods == ["tree", "of <tomorrow>"]
    text = page.write(copy, views=1, edge=20).read_text("utf-8")
    assert "of &lt;tomorrow&gt;" in text and "<tomorrow>" not in text


# --- which views are shown ---


def _result(scene, method, **values):
    """A result with a PSNR inside the mask for each view, by its name."""
    per_image = [
        Image(name, 0.1, None, {"psnr": 40.0, "psnr_masked": each}) for name, each in values.items()
    ]
    known = [value for value in values.values() if value is not None]
    record = made_record(scene, method, psnr_masked=sum(known) / max(1, len(known)))
    views = [View(name, Truth("", None, None), "", "") for name in values]
    return Result(record._replace(per_image=per_image, views=views), (), ())


def test_failures_are_sorted_by_the_error_in_the_mask():
    first = Scene("x", "", "", (_result("x", "tree", a=30.0, b=20.0, c=None),))
    results = _result("y", "tree", a=25.0), _result("y", "straight", a=10.0, b=50.0)
    scenes = [first, Scene("y", "", "", results)]
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


def test_views_are_the_worst_of_each_method_in_turn_and_some_between(out):
    tree = _result("x", "tree", a=30.0, b=31.0, c=32.0, d=33.0, e=34.0, f=35.0, g=29.0)
    straight = _result("x", "straight", a=12.0, b=13.0, c=14.0, d=15.0, e=10.0, f=11.0, g=16.0)
    scene = Scene("x", "", "", (straight, tree))
    # Tree's worst, straight's, tree's second; then the first and the last of b, c, d, f.
    assert data.choose_views(scene, 5) == ["a", "b", "e", "f", "g"]
    assert data.choose_views(scene, 1) == ["g"]
    assert data.choose_views(scene, 99) == list("abcdefg")
    assert data.choose_views(Scene("x", "", "", (_result("x", "tree"),)), 5) == []
    # The one in the middle is typical: those of each method are a decibel apart.
    made = data.read(out).scenes[0]
    assert data.typical_view(made) == "r_1"
    assert data.psnr_masked(made, "tree", "r_1") == QUALITY["tree"] + 1.0
    # Of many scenes fewer are shown, and never none.
    assert [page.shown_views((scene,) * n, 5) for n in (0, 6, 100, 1000)] == [5, 5, 3, 1]


def test_the_best_of_a_scene_is_none_that_is_no_number():
    values = {"tree": math.nan, "a": 1.0, "b": 2.0}
    results = [Result(made_record("x", k, psnr_masked=v), (), ()) for k, v in values.items()]
    scene = Scene("x", "", "", tuple(results))
    assert page._scores(scene, list(values)) == ["nan", "1.00", "<strong>2.00</strong>"]


def test_distances_share_the_scale_of_the_true_ones():
    truth = np.linspace(2.0, 12.0, 101, dtype=np.float32).reshape(1, 101)
    nowhere = np.full((1, 2), np.inf, np.float32)
    scale = images.distance_scale(truth, [np.array([[0.0, 500.0]], np.float32)])
    assert (scale.low, scale.high) == pytest.approx((2.1, 11.9), abs=1e-4)
    assert images.distance_scale(None, [nowhere]) is None
    flat = images.distance_scale(np.full((2, 2), 3.0, np.float32), [])
    assert flat.high > flat.low == 3.0


def test_the_methods_of_a_chart_look_different():
    together = charts.families([*METHODS, "external"])
    assert {name for names in together for name in names} == {*METHODS, "external"}
    assert {"straight", "msnerf", "tree", "external"} <= set(together[0])
    for names in together:
        assert len({charts.look(name) for name in names}) == len(names)
