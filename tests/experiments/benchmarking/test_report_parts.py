"""Parts of the report, by hand: markup, pictures, charts, tables."""

import base64
import io
import math
import re

import matplotlib
import numpy as np
import pytest
from PIL import Image

from experiments.benchmarking import paper_tables, summary
from experiments.benchmarking.methods import FULL, METHODS
from experiments.benchmarking.report import charts, images, markup
from experiments.benchmarking.report.data import Point, Result
from experiments.benchmarking.report.images import Scale
from experiments.benchmarking.report.markup import Html, join, tag
from refref_jax.data import files
from tests.experiments.benchmarking.made_records import made_record
from tests.experiments.benchmarking.read_page import elements, named

# --- markup ---


def test_text_is_escaped_and_markup_is_not():
    inner = tag("b", 'a < b & "c"')
    assert inner == "<b>a &lt; b &amp; &quot;c&quot;</b>"
    assert tag("p", inner, None, "<i>", data_x="'\"<") == (
        '<p data-x="&#x27;&quot;&lt;"><b>a &lt; b &amp; &quot;c&quot;</b>&lt;i&gt;</p>'
    )
    assert tag("img", hidden=True, id=None, alt="", draggable=False) == '<img hidden alt="">'
    assert isinstance(join([inner, "<"]), Html) and join(["<", None]) == "&lt;"
    # Whatever is done to markup, it is text again, and escaped.
    assert tag("p", inner + "<").startswith("<p>&lt;b&gt;")


# --- pictures ---


def _decoded(picture):
    data = base64.b64decode(picture.uri.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float32)


def test_pictures_are_reduced_and_never_enlarged():
    pixels = np.zeros((40, 100, 3), np.uint8)
    pixels[:, 50:] = 200
    reduced = images.embed(pixels, 50)
    assert (reduced.width, reduced.height) == (50, 20)
    shown = _decoded(reduced)
    assert shown.shape == (20, 50, 3)
    np.testing.assert_allclose(shown[:, 30:], 200.0, atol=4.0)
    same = images.embed(pixels, 300)
    assert (same.width, same.height) == (100, 40)
    sliver = images.embed(np.zeros((1, 500, 3), np.uint8), 100)
    assert (sliver.width, sliver.height) == (100, 1)


def test_six_scenes_of_a_hundred_pixels_are_less_than_six_megabytes(ball_scene):
    # 6 scenes, 8 views, three pictures of the truth and of each of three methods.
    count, rgb = 6 * 8 * 3 * 4, files.read_rgb(ball_scene / "test/r_000.png")
    noise = np.random.default_rng(0).integers(0, 30, rgb.shape)
    noisy = np.clip(rgb.astype(int) + noise, 0, 255).astype(np.uint8)
    for pixels in (rgb, images.error_map(noisy, rgb, 100)):
        assert count * len(images.embed(pixels, 100).uri) < 6e6


def test_an_error_has_the_colour_of_its_mean_over_channels():
    target = np.zeros((2, 2, 3), np.uint8)
    rendered = target.copy()
    rendered[0, 0] = (0, 51, 0)  # a mean of 17/255 on a scale to 0.25
    rendered[1, 1] = 255
    shown = images.error_map(rendered, target, 2)
    colours = matplotlib.colormaps["magma"]
    expected = [[17 / 255 / 0.25, 0.0], [0.0, 1.0]]
    np.testing.assert_array_equal(shown, np.round(255.0 * colours(expected)[..., :3]))
    # Reduced to one pixel: the colour of the mean error, not the mean of colours.
    one = images.error_map(rendered, target, 1)
    mean = (17.0 + 255.0) / 255.0 / 4.0
    np.testing.assert_allclose(one[0, 0], 255.0 * np.array(colours(mean / 0.25)[:3]), atol=2.0)


def test_distances_share_the_scale_of_the_true_ones():
    truth = np.linspace(2.0, 12.0, 101, dtype=np.float32).reshape(1, 101)
    wild = np.array([[0.0, 500.0]], np.float32)
    scale = images.distance_scale(truth, [wild])
    assert (scale.low, scale.high) == pytest.approx((2.1, 11.9), abs=1e-4)
    nowhere = np.full((1, 2), np.inf, np.float32)
    assert images.distance_scale(nowhere, [wild])[:2] == pytest.approx((5.0, 495.0))
    assert images.distance_scale(None, [nowhere]) is None
    assert images.distance_scale(None, []) is None
    flat = images.distance_scale(np.full((2, 2), 3.0, np.float32), [])
    assert flat.high > flat.low == 3.0


def test_what_is_beyond_a_scale_has_its_last_colour_and_what_is_not_finite_is_grey():
    scale = Scale(1.0, 3.0, "viridis")
    values = np.array([[0.0, 1.0, 2.0, 3.0, 9.0, np.inf, np.nan]], np.float32)
    shown = images.distance_map(values, scale, 99)[0]
    colours = np.round(255.0 * matplotlib.colormaps["viridis"]([0.0, 0.0, 0.5, 1.0, 1.0])[:, :3])
    np.testing.assert_array_equal(shown[:5], colours)
    np.testing.assert_array_equal(shown[5:], 128)
    # Reduced, each distance is one that was there.
    reduced = images.distance_map(np.tile([[1.0, 3.0]], (2, 4)).astype(np.float32), scale, 4)
    assert {tuple(c) for c in reduced.reshape(-1, 3)} <= {tuple(colours[1]), tuple(colours[3])}
    stops = re.findall(r"rgb\((\d+) (\d+) (\d+)\)", images.gradient(scale))
    np.testing.assert_array_equal(np.array([stops[0], stops[-1]], int), colours[[0, 3]])


def test_outside_its_mask_the_truth_is_nearly_grey():
    pixels = np.full((1, 2, 3), 255, np.uint8)
    shown = images.dim_outside(pixels, np.array([[True, False]]))
    np.testing.assert_array_equal(shown[0, :, 0], [255, round(0.8 * 128 + 0.2 * 255)])


# --- charts ---


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 100.0, (0.0, 20.0, 40.0, 60.0, 80.0, 100.0)),
        (8.3, 29.1, (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)),
        (-3.0, 1.0, (-3.0, -2.0, -1.0, 0.0, 1.0)),
    ],
)
def test_ticks_are_round_numbers(low, high, expected):
    assert charts.ticks(low, high) == expected


def test_ticks_of_one_number_hold_it():
    marks = charts.ticks(7.0, 7.0)
    assert marks[0] <= 7.0 < marks[-1] and charts.ticks(0.0, 0.0)[-1] > 0.0


def _trained(method, *values):
    curve = tuple(Point(10.0 * i, 2.0 * i, value) for i, value in enumerate(values))
    return Result(made_record("x", method), curve, ())


def _charts(*results):
    return elements(charts.training_charts(results))


def test_a_line_goes_where_its_numbers_are():
    found = _charts(_trained("tree", 10.0, math.inf, 20.0))
    first, second = named(found, "polyline")
    points = [tuple(map(float, point.split(","))) for point in first.attributes["points"].split()]
    # Ticks of 0 to 20 steps and of 10 to 20 dB are the picture's corners; what is inf is left out.
    assert len(points) == 2 and points[0][0] < points[1][0] and points[0][1] > points[1][1]
    assert first.attributes["points"] == second.attributes["points"]  # seconds are as even
    texts = ["".join(text.text) for text in named(found, "text")]
    assert {
        "0",
        "20",
        "10",
        "steps",
        "seconds, compiling included; noisy",
        "PSNR, dB",
        "tree",
    } <= set(texts)


def test_names_at_the_ends_of_lines_do_not_touch():
    names = ("straight", "oracle", "tree", "r3f", "r3f_tree")
    found = _charts(*(_trained(name, 0.0, 0.01 * i) for i, name in enumerate(names)))
    heights = sorted(float(text.attributes["y"]) for text in named(found, "text", class_="name"))
    assert len(heights) == 10
    apart = np.diff(sorted(set(heights)))
    assert np.all(apart >= 13.9) and max(heights) <= 230.0 - 36.0


def test_without_curves_that_is_said():
    assert "No training has left a curve" in charts.training_charts([_trained("tree", 1.0)])
    found = _charts(_trained("tree", math.inf, math.inf))
    assert not named(found, "polyline")


def test_a_method_has_one_look_and_no_two_of_a_chart_have_the_same():
    for family in charts.families(list(METHODS)):
        looks = [charts.look(name) for name in family]
        assert len(set(looks)) == len(looks)
    families = charts.families(list(METHODS))
    assert [family[0] for family in families[1:]] == ["oracle", "tree"]
    assert len(families) == 1 + len(FULL)
    assert sorted({name for family in families for name in family}) == sorted(METHODS)
    assert charts.families(["tree", "of tomorrow"]) == [["tree", "of tomorrow"]]
    assert charts.families([]) == []


# --- tables ---


def test_a_table_is_the_same_after_json():
    results = [
        made_record("cube_smcvx_ball", "oracle", psnr=30.0, psnr_masked=math.inf),
        made_record("cube_smcvx_cube", "oracle", psnr=34.0, psnr_masked=28.0),
        made_record("cube_smcvx_ball", "tree", psnr=31.0, psnr_masked=None),
    ]
    for table in (paper_tables.main_table(results), paper_tables.main_table([])):
        assert summary.table_from_json(summary.table_as_json(table)) == table


def test_notes_are_read_as_they_are_meant():
    shown = markup.inline("a **b** *c* <u>d</u> `e` < 5 & |c - c'|²/s² <script>")
    assert shown == (
        "a <strong>b</strong> <em>c</em> <u>d</u> <code>e</code> &lt; 5 &amp; |c - c&#x27;|²/s² "
        "&lt;script&gt;"
    )


def test_numbers_that_are_not_known_are_a_dash():
    shown = [markup.number(value, 1) for value in (None, 1.25, math.inf)]
    assert shown == ["-", "1.2", "inf"]


def test_of_many_blocks_those_over_all_backgrounds_are_open():
    scenes = ("cube_smcvx_ball", "env_smncvx_torus")
    results = [made_record(scene, "tree", psnr=30.0) for scene in scenes]
    for shown, closed in ((results[:1], 0), (results, 4)):
        table = paper_tables.main_table(shown)
        blocks = named(elements(markup.show(table)), "details")
        assert len(blocks) == len(table.blocks)
        folded = ["".join(b.text) for b in blocks if "open" not in b.attributes]
        assert len(folded) == closed and not any("all backgrounds" in text for text in folded)
