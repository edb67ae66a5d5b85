"""What of a table compares with what, and how odd numbers and odd names are shown."""

import math

import pytest

from experiments.benchmarking import paper_tables, summary, tables
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.tables import NOTHING, Cell, Column, mean_over
from tests.experiments.benchmarking.made_records import made_record

_PSNR = Column("PSNR", "PSNR", "higher", 2)


def _marks(table):
    """Returns the marks of our methods in the first block, by label and column."""
    return {
        (row.label, column.label): mark
        for row in table.blocks[0].rows
        if row.origin == "ours"
        for column, mark in zip(table.columns, row.marks, strict=True)
    }


def test_methods_that_lack_different_scenes_are_not_compared():
    results = [
        made_record("cube_smcvx_ball", "oracle", psnr=20.0),
        made_record("cube_smcvx_cube", "oracle", psnr=20.0),
        made_record("cube_smcvx_cube", "tree", psnr=30.0),
        made_record("cube_smcvx_cone", "tree", psnr=30.0),
    ]
    for table in (paper_tables.main_table(results), paper_tables.top_views_table(results)):
        assert set(_marks(table).values()) == {""}
    results += [
        made_record("cube_smcvx_cone", "oracle", psnr=20.0),
        made_record("cube_smcvx_ball", "tree", psnr=30.0),
    ]
    for table in (paper_tables.main_table(results), paper_tables.top_views_table(results)):
        marks = _marks(table)
        assert marks[METHODS["tree"].label, "PSNR"] == "best"
        assert marks[METHODS["oracle"].label, "PSNR"] == ""


def test_what_is_no_number_is_not_ranked():
    rows = [
        tables.row(str(value), "ours", 1, [Cell(value, None, 1)]) for value in (math.nan, 1.0, 2.0)
    ]
    assert [row.marks for row in tables.mark(rows, [_PSNR], 1)] == [("",), ("",), ("best",)]
    alone = tables.mark(rows[:2], [_PSNR], 1)
    assert [row.marks for row in alone] == [("",), ("",)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_differences_of_what_is_infinite_are_not_known(sign):
    def results(*pairs):
        for i, (ours, theirs) in enumerate(pairs):
            yield made_record(f"cube_smcvx_{i}", "oracle_no_tir", psnr=ours)
            yield made_record(f"cube_smcvx_{i}", "oracle", psnr=theirs)

    inf = sign * math.inf

    def difference(*pairs):
        found = list(results(*pairs))
        return paper_tables.difference(found, "oracle_no_tir", "oracle", tables.PSNR)

    assert difference((inf, inf)) == NOTHING
    assert difference((inf, inf), (3.0, 1.0)) == Cell(2.0, None, 1)
    assert difference((inf, 1.0)) == Cell(inf, None, 1)
    assert difference((inf, 1.0), (1.0, inf)) == NOTHING


def test_a_mean_of_opposite_infinities_is_not_known_and_of_nan_is_nan():
    assert mean_over([math.inf, 1.0, -math.inf]) == NOTHING
    assert math.isnan(mean_over([math.nan, 1.0]).mean)


def test_the_drmse_beside_the_papers_is_that_in_the_mask():
    metrics = {"substituted_rmse": 0.75, "substituted_rmse_masked": 0.0}
    table = paper_tables.top_views_table([made_record("cube_smcvx_ball", "tree", **metrics)])
    labels = [column.label for column in table.columns]
    masked = labels.index("DRMSE, substituted, in the mask")
    image = labels.index("DRMSE, substituted, of the image")
    rows = {(row.label, row.origin): row.cells for row in table.blocks[0].rows}
    ours, theirs = rows[METHODS["tree"].label, "ours"], rows["R3F", "published"]
    assert (ours[masked].mean, ours[image].mean) == (0.0, 0.75)
    assert (theirs[masked].mean, theirs[image]) == (0.88, NOTHING)
    assert "does not say over which pixels" in " ".join(table.notes)


def test_latex_says_what_kind_of_distance_it_shows_and_has_the_notes():
    metrics = {"substituted_mae": 0.1, "substituted_rmse": 0.1, "substituted_rmse_masked": 0.0}
    found = [made_record("cube_smcvx_ball", "tree", psnr=1.0, **metrics)]
    for table in (paper_tables.main_table(found), paper_tables.top_views_table(found)):
        comments = [line for line in summary.latex(table).splitlines() if line[:1] == "%"]
        assert len(comments) == 1 + len(table.notes)
        assert not any("**" in line or "<u>" in line or "`" in line for line in comments)
        assert any("Substituted distances have the true ones" in line for line in comments)
        heads = summary.latex(table).splitlines()[len(comments) + 2]
        assert "DMAE, substituted" in heads or "DRMSE, substituted" in heads
        assert "& DMAE &" not in heads and "& DRMSE &" not in heads


def test_odd_names_break_no_row_of_markdown():
    shown = summary.in_markdown("a_b|<x> *c*\n_d_ `e`")
    assert shown == r"a_b\|\<x\> \*c\* \_d\_ \`e\`"
    assert summary.in_markdown("cube_smcvx_ball/tree: --a_b") == "cube_smcvx_ball/tree: --a_b"
    row = tables.row("a|b", "ours", 1, [Cell(1.0, None, 1)])
    table = tables.Table("t", "T", (), (_PSNR,), (tables.Block("b", (row,)),))
    assert r"| a\|b | 1 | 1.00 |" in summary.markdown(table)
