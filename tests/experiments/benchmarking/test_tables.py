"""Tables, by hand: means, errors, marks, differences, and how they are written."""

import csv
import io
import json
import math

import numpy as np
import pytest

from experiments.benchmarking import paper_tables, pose_space, summary, tables
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.results import Image
from experiments.benchmarking.tables import NOTHING, Cell, Column, mean_over
from tests.experiments.benchmarking.made_records import made_record


def _block(table, title):
    (found,) = [block for block in table.blocks if block.title == title]
    return {(row.label, row.origin): row for row in found.rows}


def _place(table, label):
    return [column.label for column in table.columns].index(label)


def test_a_mean_has_an_error_over_scenes_and_passes_over_what_is_not_known():
    assert mean_over([]) == mean_over([None]) == NOTHING
    assert mean_over([20.0, None]) == Cell(20.0, None, 1)
    # Standard deviation of 1, 2, 6 with n - 1: sqrt(7); over sqrt(3).
    mean, error, count, _ = mean_over([1.0, 2.0, 6.0, None])
    assert (mean, count) == (3.0, 3) and error == pytest.approx(math.sqrt(7.0 / 3.0))
    assert mean_over([math.inf, 1.0]) == Cell(math.inf, None, 2)


def test_the_farthest_views_are_those_of_the_largest_distance():
    def pose(angle, radius=4.0):
        c, s = math.cos(angle), math.sin(angle)
        rotation = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
        return np.column_stack([rotation, np.array([s, 0.0, c]) * radius])

    trainings = np.stack([pose(0.0), pose(2.0)])
    tests = np.stack([pose(0.3), pose(1.0), pose(1.8), pose(0.0), pose(0.0, 8.0)])
    found = pose_space.distances(tests, trainings)
    # By an angle a on a circle: the chord 2 sin(a / 2), and a.
    expected = [math.hypot(2.0 * math.sin(a / 2.0), a) for a in (0.3, 1.0, 0.2, 0.0)]
    np.testing.assert_allclose(found[:4], expected, atol=1e-6)
    np.testing.assert_allclose(found[4], 1.0, atol=1e-6)  # a radius away, not turned
    assert pose_space.farthest(found, 3) == [1, 4, 0]
    assert pose_space.farthest(found, 99) == [1, 4, 0, 2, 3]
    assert pose_space.farthest(np.zeros(3), 2) == [0, 1]


def test_a_turn_about_the_optical_axis_counts_and_half_a_turn_is_pi():
    still = np.column_stack([np.eye(3), [0.0, 0.0, 4.0]])
    rolled = np.column_stack([np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 4.0]])
    found = pose_space.distances(np.stack([still, rolled]), still[None])
    np.testing.assert_allclose(found, [0.0, math.pi], atol=1e-6)


_RESULTS = [
    made_record("cube_smcvx_ball", "oracle", psnr=30.0, psnr_masked=24.0, lpips=None),
    made_record("cube_smcvx_cube", "oracle", psnr=34.0, psnr_masked=28.0, lpips=None),
    made_record("cube_smcvx_ball", "tree", psnr=31.0, psnr_masked=30.0, lpips=None),
    made_record("cube_smcvx_cube", "tree", psnr=36.0, psnr_masked=30.0, lpips=None),
    made_record("cube_smcvx_ball", "straight", psnr=20.0, psnr_masked=None, lpips=None),
    made_record("cube_smcvx_cube", "straight", psnr=22.0, psnr_masked=16.0, lpips=None),
    made_record("cube_smcvx_ball", "r3f", psnr=99.0, psnr_masked=20.0, lpips=None),
    made_record("env_smncvx_torus", "tree", psnr=25.0, psnr_masked=20.0, lpips=None),
]


def test_the_main_table_by_hand():
    table = paper_tables.main_table(_RESULTS)
    assert [block.title for block in table.blocks] == [
        "convex, single material; cube background",
        "convex, single material; all backgrounds",
        "non-convex, single material; natural background",
        "non-convex, single material; all backgrounds",
        "all categories; cube background",
        "all categories; natural background",
        "all categories; all backgrounds",
    ]
    rows = _block(table, "convex, single material; cube background")
    psnr, masked = _place(table, "PSNR"), _place(table, "masked PSNR")
    tree = rows[METHODS["tree"].label, "ours"]
    oracle = rows[METHODS["oracle"].label, "ours"]
    straight = rows[METHODS["straight"].label, "ours"]
    r3f = rows[METHODS["r3f"].label, "ours"]
    assert tree.cells[psnr] == Cell(33.5, 2.5, 2) and tree.cells[masked] == Cell(30.0, 0.0, 2)
    assert oracle.cells[psnr] == Cell(32.0, 2.0, 2) and oracle.cells[masked].mean == 26.0
    assert straight.cells[masked] == Cell(16.0, None, 1) and straight.scenes == 2
    # R3F has one scene, which by chance is the best: it does not compare.
    assert (tree.marks[psnr], oracle.marks[psnr]) == ("best", "second")
    assert straight.marks[psnr] == "" and r3f.marks[psnr] == ""
    # Two that have all scenes: there is a best, but no second best worth the name.
    assert (tree.marks[masked], oracle.marks[masked]) == ("best", "")
    every = _block(table, "all categories; all backgrounds")
    assert every[METHODS["tree"].label, "ours"].cells[psnr].mean == pytest.approx(92.0 / 3.0)
    assert every[METHODS["tree"].label, "ours"].scenes == 3


def test_the_papers_rows_are_beside_ours_and_never_marked():
    table = paper_tables.main_table(_RESULTS)
    rows = _block(table, "convex, single material; cube background")
    theirs = {label: row for (label, origin), row in rows.items() if origin == "published"}
    assert len(theirs) == 9 and all(row.scenes is None for row in theirs.values())
    assert theirs["Oracle"].cells[_place(table, "PSNR")] == Cell(31.64, digits=2)
    assert theirs["RoseNeRF"].cells[_place(table, "DMAE, substituted")] == NOTHING
    assert all(set(row.marks) == {""} for row in theirs.values())
    # The paper's columns stay, though we know no LPIPS; FLIP, which nobody has, does not.
    labels = [column.label for column in table.columns]
    assert "LPIPS" in labels and "FLIP" not in labels and "DMAE, median" not in labels


def test_distances_before_natural_backgrounds_are_those_in_the_mask():
    metrics = {"distance_mae": 500.0, "distance_mae_masked": 0.25}
    assert tables.value(tables.DMAE_MEDIAN, metrics, "env") == 0.25
    assert tables.value(tables.DMAE_MEDIAN, metrics, "cube") == 500.0
    assert tables.value(tables.DMAE, metrics, "cube") is None


def test_equal_numbers_share_a_mark_and_lower_may_be_better():
    columns = [
        Column("a", "a", "higher", 1),
        Column("b", "b", "lower", 1),
        Column("c", "c", None, 1),
    ]
    cells = [(1.04, 2.0, 1.0), (1.01, 1.0, 2.0), (0.9, 3.0, 3.0), (0.8, 3.0, 4.0)]
    rows = [
        tables.row(str(i), "ours", 1, [Cell(x, None, 1) for x in c]) for i, c in enumerate(cells)
    ]
    marked = tables.mark(rows, columns, 1)
    assert [row.marks for row in marked] == [
        ("best", "second", ""),
        ("best", "best", ""),
        ("second", "", ""),
        ("", "", ""),
    ]
    alone = tables.mark(rows[:1], columns, 1)
    assert alone[0].marks == ("", "", "")


def test_top_views_are_means_over_the_five_farthest():
    views = [
        Image(str(i), d, None, {"psnr": 10.0 * d, "psnr_masked": None if i else 5.0})
        for i, d in enumerate([0.1, 0.6, 0.2, 0.5, 0.3, 0.4, 0.0])
    ]
    record = made_record("cube_smcvx_ball", "tree", psnr=1.0, psnr_masked=1.0)
    record = record._replace(per_image=views)
    found = paper_tables.top_metrics(record)
    assert found["psnr"] == pytest.approx((6.0 + 5.0 + 4.0 + 3.0 + 2.0) / 5.0)
    assert found["psnr_masked"] is None  # the only view that has one is near
    table = paper_tables.top_views_table([record])
    (block,) = table.blocks
    rows = {(row.label, row.origin): row for row in block.rows}
    assert rows[METHODS["tree"].label, "ours"].cells[0].mean == pytest.approx(4.0)
    assert (
        rows["R3F", "published"].cells[_place(table, "DRMSE, substituted, in the mask")].mean
        == 0.88
    )


@pytest.mark.parametrize(
    ("views", "told"), [([7], "the 5 rendered"), ([3], "the 3 rendered"), ([2, 9], "the 2 to 5 ")]
)
def test_the_farthest_views_are_as_many_as_there_were(views, told):
    found = [
        made_record(scene, "tree", psnr=1.0)._replace(
            per_image=[Image(str(i), 0.1 * i, None, {"psnr": 1.0}) for i in range(count)]
        )
        for scene, count in zip(("cube_smcvx_ball", "cube_smcvx_cube"), views, strict=False)
    ]
    assert told in paper_tables.top_views_table(found).notes[0]


def test_ablations_are_differences_over_common_scenes_beside_the_papers():
    results = [
        *_RESULTS,
        made_record("cube_smcvx_ball", "oracle_no_tir", psnr=25.0, psnr_masked=20.0),
        made_record("cube_smcvx_cube", "oracle_no_tir", psnr=33.0, psnr_masked=None),
        made_record("env_smncvx_torus", "oracle_no_tir", psnr=10.0, psnr_masked=10.0),
        made_record("cube_smcvx_ball", "tree_cone", psnr=30.5, psnr_masked=29.0),
    ]
    table = paper_tables.ablation_table(results)
    assert [block.title for block in table.blocks] == [
        "ablation of the oracle; convex, single material; cube background",
        "ablation of the oracle; all categories; all backgrounds",
        "ablation of the tree; convex, single material; cube background",
        "ablation of the tree; all categories; all backgrounds",
    ]
    rows = {row.label: row for row in table.blocks[0].rows}
    difference, published_one = _place(table, "Δ PSNR"), _place(table, "Δ PSNR, published")
    tir = rows["w/o TIR"]
    assert tir.cells[difference] == Cell(-3.0, 2.0, 2)  # -5 and -1
    assert tir.cells[_place(table, "Δ masked PSNR")] == Cell(-4.0, None, 1)
    assert tir.cells[published_one].mean == -5.79
    assert tir.cells[_place(table, "SSIM, published")].mean == 0.9084
    full = rows[METHODS["oracle"].label]
    assert full.cells[difference] == NOTHING and full.cells[0].mean == 32.0
    assert full.cells[_place(table, "PSNR, published")].mean == 31.64
    # Ours is substituted; which kind the paper's is, is not known.
    labels = [column.label for column in table.columns]
    assert "DMAE, substituted" in labels and "DMAE, published" in labels
    assert "DMAE, substituted, published" not in labels
    # Not run here: the paper's stands alone.
    assert rows["w/o first reflection"].cells[0] == NOTHING
    assert rows["w/o first reflection"].cells[published_one].mean == -1.99
    assert "no refraction past 2 bends" not in rows
    # Over all scenes the oracle lacks the torus, which then does not count in the difference.
    every = {row.label: row for row in table.blocks[1].rows}["w/o TIR"]
    assert every.cells[difference] == Cell(-3.0, 2.0, 2) and every.scenes == 3
    assert every.cells[published_one] == NOTHING
    cone = {row.label: row for row in table.blocks[2].rows}["footprint: cone"]
    assert cone.cells[difference].mean == -0.5


def test_ablations_are_in_their_own_table_alone():
    results = [*_RESULTS, made_record("cube_smcvx_ball", "oracle_no_tir", psnr=25.0)]
    for table in (paper_tables.main_table(results), paper_tables.top_views_table(results)):
        labels = {row.label for block in table.blocks for row in block.rows}
        assert METHODS["oracle"].label in labels and "w/o TIR" not in labels
    assert paper_tables.main_table(results[-1:]).blocks == ()


def test_without_ablations_their_table_says_that_nothing_is_measured():
    table = paper_tables.ablation_table(_RESULTS)
    assert table.blocks == () and "Nothing is measured yet" in summary.markdown(table)
    assert paper_tables.top_views_table([]).blocks == ()


def test_markdown_and_latex_mark_and_label():
    table = paper_tables.main_table(_RESULTS)
    text = summary.markdown(table)
    line = next(line for line in text.splitlines() if line.startswith("| Oracle (path tree) |"))
    assert "| 2 | **33.50** ± 2.50 | **30.00** ± 0.00 | - | - | - |" in line
    assert "| Oracle (paper's paths) | 2 | <u>32.00</u> ± 2.00 | 26.00 ± 2.00 |" in text
    assert "| Oracle, *published* | - | 31.64 | 25.37 | 0.96 |" in text
    assert "| method | scenes | PSNR ↑ | masked PSNR ↑ | SSIM ↑ | LPIPS ↓ |" in text
    assert "measured on its data, which is not ours" in " ".join(text.split())
    tex = summary.latex(table)
    assert r"\textbf{33.50} {\tiny$\pm$2.50}" in tex and r"\underline{32.00}" in tex
    assert r"Oracle \emph{(published)} & -- & 31.64" in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 1
    width = len(table.columns) + 2
    assert all(
        line.count("&") == width - 1 for line in tex.splitlines() if line.startswith("Oracle (path")
    )
    assert summary._escaped("a_b & 5%") == r"a\_b \& 5\%"


def test_csv_and_json_have_every_number():
    table = paper_tables.main_table(_RESULTS)
    lines = list(csv.DictReader(io.StringIO(summary.table_as_csv(table))))
    assert len(lines) == sum(len(block.rows) for block in table.blocks) * len(table.columns)
    (line,) = [
        line
        for line in lines
        if (line["block"], line["method"], line["quantity"])
        == ("convex, single material; cube background", METHODS["tree"].label, "PSNR")
    ]
    assert (line["mean"], line["standard_error"]) == ("33.5", "2.5")
    assert (line["scenes"], line["mark"], line["origin"]) == ("2", "best", "ours")
    assert {line["mean"] for line in lines if line["quantity"] == "LPIPS"} >= {"", "0.11"}
    record = json.loads(json.dumps(summary.table_as_json(table), allow_nan=False))
    assert record["blocks"][0]["rows"][0]["cells"][0]["mean"] == 21.0
    scenes = list(csv.DictReader(io.StringIO(summary.scenes_csv(_RESULTS))))
    assert len(scenes) == len(_RESULTS) and scenes[4]["psnr_masked"] == ""


def test_signed_columns_show_their_sign():
    column = Column("Δ", "Δ", None, 2, True)
    assert tables.number(Cell(1.5), column) == "+1.50" and tables.number(NOTHING, column) == "-"
    assert tables.error(Cell(1.5, 0.25, 2), column) == "0.25"
