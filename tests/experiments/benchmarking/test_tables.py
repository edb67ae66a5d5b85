"""Tables by hand: the paper's numbers, means, errors, marks, differences, how they are written."""

import csv
import io
import json
import math

import numpy as np
import pytest

from experiments.benchmarking import (
    methods,
    paper_tables,
    pose_space,
    published,
    summary,
    tables,
)
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.results import Costs, Image
from experiments.benchmarking.tables import NOTHING, Cell, Column, mean_over
from refref_jax.data import scene_names
from tests.factories.made_benchmark import made_record

_PSNR = Column("PSNR", "PSNR", "higher", 2)

_THEIRS = [
    *("NeuS", "Splatfacto", "Zip-NeRF", "TNSR", "MS-NeRF", "RayDef"),
    *("RoseNeRF", "R3F", "Oracle"),
]
_THEIRS_LATER = [*_THEIRS[:7], "NU-NeRF", "NeRRF", "TransparentGS", *_THEIRS[7:]]


def _rows(block, origin="ours", version=""):
    return {row.label: row for row in block.rows if (row.origin, row.version) == (origin, version)}


def _published(table, category, background, version=published.PAPER):
    rows = published.rows(table, category, background)
    return [row for row in rows if row.version == version]


def _place(table, label):
    return [column.label for column in table.columns].index(label)


def test_the_papers_tables_are_whole():
    for category in (*scene_names.CATEGORIES, published.ALL):
        for background in (*scene_names.BACKGROUNDS, published.ALL):
            rows = _published(published.MAIN, category, background)
            assert [row.method for row in rows] == _THEIRS
            for row in rows:
                missing = {name for name, number in row.numbers.items() if number is None}
                expected = {"drmse"} | ({"dmae"} if row.method == "RoseNeRF" else set())
                if row.method in ("NeuS", "TNSR") and background == "env":
                    expected = set(published.NUMBERS)
                assert missing == expected, row
    of_paper = [row for row in published.read() if row.version == published.PAPER]
    lines = [row.line for row in of_paper]
    assert lines == sorted(lines) and len(of_paper) == 16 * 9 + 5 + 5
    assert published.read()[: len(of_paper)] == tuple(of_paper)
    ablated = published.rows(published.ABLATION, "smcvx", "cube")
    named = {m.published for m in METHODS.values() if m.group == "ablation of the oracle"}
    assert {row.method for row in ablated} == (named - {None}) | {"Oracle"}
    top = published.rows(published.TOP_VIEWS, published.ALL, published.ALL)
    distances = {row.method: float(row.numbers["drmse"]) for row in top}
    assert list(distances) == ["Zip-NeRF", "MS-NeRF", "RayDef", "R3F", "Oracle"]
    assert list(distances.values()) == [1.21, 0.94, 1.98, 0.88, 0.0]
    for row in (*ablated, *top):
        assert None not in [row.numbers[name] for name in ("psnr", "psnr_masked", "ssim", "lpips")]
    ours = {m.published for m in METHODS.values() if m.group in ("main", "baseline")}
    assert ours - {None} <= set(_THEIRS) and "MS-NeRF" in ours


def test_the_later_table_is_whole():
    """It has twelve methods in three categories and in all, over all backgrounds."""
    later = [row for row in published.read() if row.version == published.PAGE]
    assert len(later) == 48 and {row.table for row in later} == {published.MAIN}
    for category in (*scene_names.CATEGORIES, published.ALL):
        rows = _published(published.MAIN, category, published.ALL, published.PAGE)
        assert [row.method for row in rows] == _THEIRS_LATER
        for row in rows:
            missing = {name for name, number in row.numbers.items() if number is None}
            assert missing == {"drmse"} | ({"dmae"} if row.method == "RoseNeRF" else set())
            assert row.line is None and 10.0 < float(row.numbers["psnr"]) < 35.0
            assert 0.0 < float(row.numbers["lpips"]) < 1.0 > float(row.numbers["ssim"]) > 0.4


@pytest.mark.parametrize(
    ("category", "method", "numbers"),
    [
        ("smcvx", "Oracle", (32.66, 26.12, 0.96, 0.05, 0.08)),
        ("smncvx", "R3F", (21.76, 16.32, 0.79, 0.20, 0.18)),
        ("mmncvx", "TransparentGS", (15.69, 10.62, 0.72, 0.31, 0.24)),
        ("mmncvx", "RoseNeRF", (18.48, 14.34, 0.65, 0.43, None)),
        ("all", "Zip-NeRF", (21.50, 16.68, 0.80, 0.24, 1.52)),
    ],
)
def test_numbers_of_the_later_table(category, method, numbers):
    rows = _published(published.MAIN, category, published.ALL, published.PAGE)
    (row,) = [row for row in rows if row.method == method]
    names = ("psnr", "psnr_masked", "ssim", "lpips", "dmae")
    found = tuple(row.numbers[name] for name in names)
    assert tuple(None if text is None else float(text) for text in found) == numbers


@pytest.mark.parametrize(
    ("table", "category", "background", "method", "numbers"),
    [
        ("result_quantitative", "smcvx", "cube", "Oracle", (31.64, 25.37, 0.96, 0.03, 0.04)),
        ("result_quantitative", "smncvx", "sphere", "R3F", (23.27, 15.03, 0.88, 0.11, 0.25)),
        ("result_quantitative", "mmncvx", "all", "RoseNeRF", (22.78, 18.27, 0.75, 0.30, None)),
        ("result_quantitative", "mmncvx", "cube", "Splatfacto", (24.70, 17.72, 0.86, 0.10, 11.03)),
        ("result_quantitative", "all", "sphere", "TNSR", (18.51, 11.28, 0.82, 0.18, 1.87)),
        ("ablation", "smcvx", "cube", "w/o Zip-NeRF", (24.68, 21.45, 0.8779, 0.1163, 0.2742)),
        ("top5", "all", "all", "RayDef", (19.99, 16.28, 0.72, 0.38, None)),
    ],
)
def test_numbers_of_the_paper(table, category, background, method, numbers):
    (row,) = [row for row in _published(table, category, background) if row.method == method]
    names = ("psnr", "psnr_masked", "ssim", "lpips", "dmae")
    found = tuple(row.numbers[name] for name in names)
    assert tuple(None if text is None else float(text) for text in found) == numbers


# --- means, distances of poses, marks ---


def test_a_mean_has_an_error_over_scenes_and_passes_over_what_is_not_known():
    assert mean_over([]) == mean_over([None]) == NOTHING
    assert mean_over([20.0, None]) == Cell(20.0, None, 1)
    # Standard deviation of 1, 2, 6 with n - 1: sqrt(7); over sqrt(3).
    mean, error, count, _ = mean_over([1.0, 2.0, 6.0, None])
    assert (mean, count) == (3.0, 3) and error == pytest.approx(math.sqrt(7.0 / 3.0))
    assert mean_over([math.inf, 1.0]) == Cell(math.inf, None, 2)
    assert mean_over([math.inf, 1.0, -math.inf]) == NOTHING
    assert math.isnan(mean_over([math.nan, 1.0]).mean)


def test_the_farthest_views_are_those_of_the_largest_distance():
    def pose(angle, radius=4.0):
        c, s = math.cos(angle), math.sin(angle)
        rotation = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
        return np.column_stack([rotation, np.array([s, 0.0, c]) * radius])

    trainings = np.stack([pose(0.0), pose(2.0)])
    tests = np.stack([pose(0.3), pose(1.0), pose(1.8), pose(0.0), pose(0.0, 8.0)])
    found = pose_space.distances(tests, trainings)
    # By an angle a on a circle: the chord 2 sin(a / 2), and a; a radius away, and not turned.
    expected = [math.hypot(2.0 * math.sin(a / 2.0), a) for a in (0.3, 1.0, 0.2, 0.0)]
    np.testing.assert_allclose(found, [*expected, 1.0], atol=1e-6)
    assert pose_space.farthest(found, 3) == [1, 4, 0]
    assert pose_space.farthest(found, 99) == [1, 4, 0, 2, 3]
    assert pose_space.farthest(np.zeros(3), 2) == [0, 1]
    # A turn about the optical axis counts.
    rolled = pose(0.0) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    found = pose_space.distances(rolled[None], trainings[:1])
    np.testing.assert_allclose(found, [math.pi], atol=1e-6)


def test_equal_numbers_share_a_mark_and_lower_may_be_better():
    columns = [Column("", "", "higher", 1), Column("", "", "lower", 1), Column("", "", None, 1)]
    cells = [(1.04, 2.0, 1.0), (1.01, 1.0, 2.0), (0.9, 3.0, 3.0), (0.8, 3.0, 4.0)]
    rows = [tables.row("", "ours", 1, [Cell(x, None, 1) for x in each]) for each in cells]
    marked = tables.mark(rows, columns, 1)
    assert [row.marks for row in marked] == [
        ("best", "second", ""),
        ("best", "best", ""),
        ("second", "", ""),
        ("", "", ""),
    ]
    assert tables.mark(rows[:1], columns, 1)[0].marks == ("", "", "")


def test_what_is_no_number_is_not_ranked():
    rows = [tables.row("", "ours", 1, [Cell(each, None, 1)]) for each in (math.nan, 1.0, 2.0)]
    assert [row.marks for row in tables.mark(rows, [_PSNR], 1)] == [("",), ("",), ("best",)]
    assert [row.marks for row in tables.mark(rows[:2], [_PSNR], 1)] == [("",), ("",)]


def test_distances_before_natural_backgrounds_are_those_in_the_mask():
    metrics = {"distance_mae": 500.0, "distance_mae_masked": 0.25}
    assert tables.value(tables.DMAE_MEDIAN, metrics, "env") == 0.25
    assert tables.value(tables.DMAE_MEDIAN, metrics, "cube") == 500.0
    assert tables.value(tables.DMAE, metrics, "cube") is None


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
_TREE, _ORACLE = METHODS["tree"].label, METHODS["oracle"].label


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
    rows = _rows(table.blocks[0])
    psnr, masked = _place(table, "PSNR"), _place(table, "masked PSNR")
    tree, oracle, straight = rows[_TREE], rows[_ORACLE], rows[METHODS["straight"].label]
    assert tree.cells[psnr] == Cell(33.5, 2.5, 2) and tree.cells[masked] == Cell(30.0, 0.0, 2)
    assert oracle.cells[psnr] == Cell(32.0, 2.0, 2) and oracle.cells[masked].mean == 26.0
    assert straight.cells[masked] == Cell(16.0, None, 1) and straight.scenes == 2
    # R3F has one scene, which by chance is the best: it does not compare.
    assert (tree.marks[psnr], oracle.marks[psnr]) == ("best", "second")
    assert straight.marks[psnr] == rows[METHODS["r3f"].label].marks[psnr] == ""
    # Two that have all scenes: there is a best, but no second best worth the name.
    assert (tree.marks[masked], oracle.marks[masked]) == ("best", "")
    every = _rows(table.blocks[-1])[_TREE]
    assert every.cells[psnr].mean == pytest.approx(92.0 / 3.0) and every.scenes == 3
    # The paper's rows are beside ours and never marked.
    theirs = _rows(table.blocks[0], "published", published.PAPER)
    assert list(theirs) == _THEIRS and all(row.scenes is None for row in theirs.values())
    assert theirs["Oracle"].cells[psnr] == Cell(31.64, digits=2)
    assert theirs["RoseNeRF"].cells[_place(table, "DMAE, substituted")] == NOTHING
    assert all(set(row.marks) == {""} for row in theirs.values())
    # The later table has no single background, so it is beside those of all backgrounds alone.
    versions = [{row.version for row in block.rows} for block in table.blocks]
    both = {"", published.PAPER, published.PAGE}
    assert [found == both for found in versions] == [
        "all backgrounds" in b.title for b in table.blocks
    ]
    later = _rows(table.blocks[-1], "published", published.PAGE)
    assert list(later) == _THEIRS_LATER and later["Zip-NeRF"].cells[psnr] == Cell(21.5, digits=2)
    earlier = _rows(table.blocks[-1], "published", published.PAPER)
    assert earlier["Zip-NeRF"].cells[psnr] == Cell(26.11, digits=2)
    # The paper's columns stay, though we know no LPIPS; FLIP, which nobody has, does not.
    labels = [column.label for column in table.columns]
    assert "LPIPS" in labels and "FLIP" not in labels and "DMAE, median" not in labels


def test_costs_are_beside_the_numbers_and_are_not_ranked():
    made = [
        (made_record(f"cube_smcvx_{name}", method, psnr=20.0), costs)
        for method, seconds in (("straight", 60.0), ("tree", 90.0))
        for name, costs in (
            ("ball", Costs(train_seconds=seconds, seconds_per_image=1.5, peak_host_mib=700.0)),
            ("cone", Costs(train_seconds=seconds + 20.0, peak_host_mib=800.0)),
        )
    ]
    table = paper_tables.main_table([record._replace(costs=costs) for record, costs in made])
    labels = [column.label for column in table.columns]
    assert labels[-3:] == ["training, s", "s per image", "memory, MiB"]  # no accelerator
    assert all(column.better is None for column in table.columns[-3:])
    tree = _rows(table.blocks[0])[_TREE]
    assert [cell.mean for cell in tree.cells[-3:]] == [100.0, 1.5, 750.0]
    assert tree.cells[-2].count == 1 and set(tree.marks[-3:]) == {""}
    theirs = _rows(table.blocks[0], "published", published.PAPER)["Zip-NeRF"]
    assert theirs.cells[-3:] == (NOTHING,) * 3 and "The paper states none" in " ".join(table.notes)


def test_the_rows_of_the_paper_that_are_missing_here_are_named():
    rows = {row.method for row in published.read() if row.table == published.MAIN}
    group = methods.parse(["paper"])
    assert {"straight", "msnerf", "neus", "raydef", "splats", "oracle", "r3f"} <= {
        each.name for each in group
    }
    assert {each.published for each in group} <= rows and all(each.published for each in group)
    (note,) = [n for n in paper_tables.main_table(_RESULTS).notes if n.startswith("Published rows")]
    told = note.partition(": ")[2].rstrip(".").split(", ")
    assert set(told) == rows - {each.published for each in group} and "NU-NeRF" in told


def test_methods_that_lack_different_scenes_are_not_compared():
    found = [
        made_record("cube_smcvx_ball", "oracle", psnr=20.0),
        made_record("cube_smcvx_cube", "oracle", psnr=20.0),
        made_record("cube_smcvx_cube", "tree", psnr=30.0),
        made_record("cube_smcvx_cone", "tree", psnr=30.0),
    ]
    both = [
        made_record("cube_smcvx_cone", "oracle", psnr=20.0),
        made_record("cube_smcvx_ball", "tree", psnr=30.0),
    ]
    for make in (paper_tables.main_table, paper_tables.top_views_table):
        for records, mark in ((found, ""), (found + both, "best")):
            rows = _rows(make(records).blocks[0])
            assert (rows[_TREE].marks[0], rows[_ORACLE].marks[0]) == (mark, "")


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
    (block,) = paper_tables.top_views_table([record]).blocks
    assert _rows(block)[_TREE].cells[0].mean == pytest.approx(4.0)
    few = made_record("cube_smcvx_cube", "tree", psnr=1.0)._replace(per_image=views[:2])
    for records, told in (([record], "5"), ([few], "2"), ([few, record], "2 to 5")):
        notes = paper_tables.top_views_table(records).notes
        assert f"The {told} rendered test views" in notes[0]
    assert paper_tables.top_views_table([]).blocks == ()


def test_the_drmse_beside_the_papers_is_that_in_the_mask():
    metrics = {"substituted_rmse": 0.75, "substituted_rmse_masked": 0.0}
    table = paper_tables.top_views_table([made_record("cube_smcvx_ball", "tree", **metrics)])
    masked = _place(table, "DRMSE, substituted, masked")
    image = _place(table, "DRMSE, substituted, of the image")
    ours = _rows(table.blocks[0])[_TREE].cells
    theirs = _rows(table.blocks[0], "published", published.PAPER)["R3F"].cells
    assert (ours[masked].mean, ours[image].mean) == (0.0, 0.75)
    assert (theirs[masked].mean, theirs[image]) == (0.88, NOTHING)
    assert "does not state the pixels" in " ".join(table.notes)


def test_ablations_are_differences_over_common_scenes_beside_the_papers():
    found = [
        *_RESULTS,
        made_record("cube_smcvx_ball", "oracle_no_tir", psnr=25.0, psnr_masked=20.0),
        made_record("cube_smcvx_cube", "oracle_no_tir", psnr=33.0, psnr_masked=None),
        made_record("env_smncvx_torus", "oracle_no_tir", psnr=10.0, psnr_masked=10.0),
        made_record("cube_smcvx_ball", "tree_cone", psnr=30.5, psnr_masked=29.0),
    ]
    table = paper_tables.ablation_table(found)
    assert [block.title for block in table.blocks] == [
        "ablation of the oracle; convex, single material; cube background",
        "ablation of the oracle; all categories; all backgrounds",
        "ablation of the tree; convex, single material; cube background",
        "ablation of the tree; all categories; all backgrounds",
    ]
    rows = _rows(table.blocks[0])
    difference, published_one = _place(table, "Δ PSNR"), _place(table, "Δ PSNR, published")
    tir, full = rows["w/o TIR"], rows[_ORACLE]
    assert tir.cells[difference] == Cell(-3.0, 2.0, 2)  # -5 and -1
    assert tir.cells[_place(table, "Δ masked PSNR")] == Cell(-4.0, None, 1)
    assert tir.cells[published_one].mean == -5.79
    assert tir.cells[_place(table, "SSIM, published")].mean == 0.9084
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
    every = _rows(table.blocks[1])["w/o TIR"]
    assert every.cells[difference] == Cell(-3.0, 2.0, 2) and every.scenes == 3
    assert every.cells[published_one] == NOTHING
    assert _rows(table.blocks[2])["footprint: cone"].cells[difference].mean == -0.5
    # They are in their own table alone.
    for other in (paper_tables.main_table(found), paper_tables.top_views_table(found)):
        labels = {row.label for block in other.blocks for row in block.rows}
        assert _ORACLE in labels and "w/o TIR" not in labels
    nothing = paper_tables.ablation_table(_RESULTS)
    assert nothing.blocks == () and "No results yet" in summary.markdown(nothing)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_differences_of_what_is_infinite_are_not_known(sign):
    inf = sign * math.inf
    for pairs, expected in [
        ([(inf, inf)], NOTHING),
        ([(inf, inf), (3.0, 1.0)], Cell(2.0, None, 1)),
        ([(inf, 1.0)], Cell(inf, None, 1)),
        ([(inf, 1.0), (1.0, inf)], NOTHING),
    ]:
        found = [
            made_record(f"cube_smcvx_{i}", name, psnr=psnr)
            for i, pair in enumerate(pairs)
            for name, psnr in zip(("oracle_no_tir", "oracle"), pair, strict=True)
        ]
        assert paper_tables.difference(found, "oracle_no_tir", "oracle", tables.PSNR) == expected


# --- how they are written ---


def test_markdown_and_latex_mark_and_label():
    table = paper_tables.main_table(_RESULTS)
    text, tex = summary.markdown(table), summary.latex(table)
    line = next(line for line in text.splitlines() if line.startswith("| Oracle (path tree) |"))
    assert "| 2 | **33.50** ± 2.50 | **30.00** ± 0.00 | - | - | - |" in line
    assert "| Oracle, *published 2025-05* | - | 31.64 | 25.37 | 0.96 |" in text
    assert "| Oracle, *published 2026-09-26* | - | 32.66 | 26.12 | 0.96 |" in text
    assert r"\textbf{33.50} {\tiny$\pm$2.50}" in tex and r"\underline{32.00}" in tex
    assert r"Oracle \emph{(published 2025-05)} & -- & 31.64" in tex
    body = [line for line in tex.splitlines() if line.startswith("Oracle (path")]
    assert body and {line.count("&") for line in body} == {len(table.columns) + 1}


def test_odd_names_break_no_row():
    shown = summary.in_markdown("a_b|<x> *c*\n_d_ `e`")
    assert shown == r"a_b\|\<x\> \*c\* \_d\_ \`e\`"
    assert summary.in_markdown("cube_smcvx_ball/tree: --a_b") == "cube_smcvx_ball/tree: --a_b"
    row = tables.row("a|b & 5%", "ours", 1, [Cell(1.5, 0.25, 2)])
    column = Column("Δ", "Δ", None, 2, True)
    table = tables.Table("t", "T", (), (column,), (tables.Block("b", (row,)),))
    assert r"| a\|b \& 5% | 1 | +1.50 ± 0.25 |" in summary.markdown(table)
    assert r"a|b \& 5\% & 1 & +1.50" in summary.latex(table)


def test_csv_and_json_have_every_number():
    table = paper_tables.main_table(_RESULTS)
    lines = list(csv.DictReader(io.StringIO(summary.table_as_csv(table))))
    assert len(lines) == sum(len(block.rows) for block in table.blocks) * len(table.columns)
    wanted = (table.blocks[0].title, _TREE, "PSNR")
    (line,) = [e for e in lines if (e["block"], e["method"], e["quantity"]) == wanted]
    assert (line["mean"], line["standard_error"]) == ("33.5", "2.5")
    assert (line["scenes"], line["mark"], line["origin"]) == ("2", "best", "ours")
    assert {line["mean"] for line in lines if line["quantity"] == "LPIPS"} >= {"", "0.11"}
    dates = {line["version"] for line in lines if line["origin"] == "published"}
    assert line["version"] == "" and dates == {published.PAPER, published.PAGE}
    assert summary.table_from_json(summary.table_as_json(table)) == table
    scenes = list(csv.DictReader(io.StringIO(summary.scenes_csv(_RESULTS))))
    assert len(scenes) == len(_RESULTS) and scenes[4]["psnr_masked"] == ""
    odd = [made_record("cube_smcvx_ball", "oracle", psnr=30.0, psnr_masked=math.inf)]
    for each in (table, paper_tables.main_table(odd), paper_tables.main_table([])):
        content = json.loads(json.dumps(summary.table_as_json(each), allow_nan=False))
        assert summary.table_from_json(content) == each
