"""The table of ablations: what taking or changing one thing does to the oracle and to the tree.

Differences are those of each scene, from the method that nothing is taken from, averaged over the
scenes that both have; the paper's stand beside them.
"""

import math
from collections.abc import Sequence

from experiments.benchmarking import comparisons, published, quantities, tables
from experiments.benchmarking.methods import FULL, METHODS, Group, Method
from experiments.benchmarking.quantities import Quantity
from experiments.benchmarking.records import Record
from experiments.benchmarking.statistics import NOTHING, Cell, mean_over
from experiments.benchmarking.tables import Block, Column, Row, Table

_PAPERS_SCENES = ("smcvx", "cube")

_DIFFERENCES = (quantities.PSNR, quantities.PSNR_MASKED)

_NOTES = (
    "Ablations change one thing of the method in the first row of their block. Means over images, "
    "then over scenes, ± the standard error over scenes; Δ is the mean over the scenes that both "
    "have of the difference to the first row, in dB. What is not known is -. All else, the "
    "footprint included, is the preset's for every row; Nerfacto's fields bring their own sizes, "
    "samples and footprint (a cone).",
    "*Published* columns are the paper's own (arXiv 2505.05848, ablation study: convex objects of "
    "a single material, cube backgrounds), measured on its data, which is not ours.",
    "Our DMAE is the substituted one, see the table of methods; which one the paper's is we do not "
    "know.",
)


def ablation_table(found: Sequence[Record]) -> Table:
    """Returns the ablations, over the paper's kind of scenes and over all."""
    blocks = []
    for group in FULL:
        for scenes in (_PAPERS_SCENES, (published.ALL, published.ALL)):
            own = comparisons.select(found, *scenes)
            rows = _rows(own, group, with_published=scenes == _PAPERS_SCENES)
            blocks.append(Block(f"{group}; {comparisons.describe(*scenes)}", rows))
    table = Table("ablations", "Ablations", _NOTES, _columns(), tuple(blocks))
    return tables.without_empty_columns(table, [column.label for column in _columns()])


def difference(found: Sequence[Record], method: str, full: str, quantity: Quantity) -> Cell:
    """Returns the mean difference of a quantity to that of a full method, over common scenes."""
    known = {
        (record.scene, record.method): quantities.value(quantity, record.metrics, record.background)
        for record in found
    }
    scenes = sorted({record.scene for record in found})
    pairs = [(known.get((scene, method)), known.get((scene, full))) for scene in scenes]
    return mean_over(_apart(*pair) for pair in pairs)


def _apart(ours: float | None, theirs: float | None) -> float | None:
    """Returns a difference; of what is infinite in both nothing is known."""
    if ours is None or theirs is None or (math.isinf(ours) and ours == theirs):
        return None
    return ours - theirs


def _rows(found: Sequence[Record], group: Group, *, with_published: bool) -> tuple[Row, ...]:
    """Returns a row for each method of a group that was measured, the full one first."""
    present = {record.method for record in found}
    members = [method for method in METHODS.values() if method.group == group]
    if not present & {method.name for method in members}:
        return ()
    full = METHODS[FULL[group]]
    rows = []
    for method in (full, *members):
        theirs = _published(method) if with_published else None
        if method.name in present or theirs is not None:
            rows.append(_row(found, method, full, theirs))
    return tuple(rows)


def _row(
    found: Sequence[Record], method: Method, full: Method, theirs: published.Published | None
) -> Row:
    own = [record for record in found if record.method == method.name]
    cells: list[Cell] = []
    for each in quantities.ABLATIONS:
        cells.append(
            mean_over(quantities.value(each, record.metrics, record.background) for record in own)
        )
        if each in _DIFFERENCES:
            cells.append(
                NOTHING if method == full else difference(found, method.name, full.name, each)
            )
        cells.append(NOTHING if theirs is None else theirs.cell(each))
        if each in _DIFFERENCES:
            cells.append(_published_difference(method, full, theirs, each))
    return tables.row(method.label, "ours", len(own), cells)


def _columns() -> tuple[Column, ...]:
    columns = []
    for each in quantities.ABLATIONS:
        plain = Column(each.label, each.latex, each.better, each.digits)
        # Not our kind of it: which kind of distance the paper's is, is not known.
        name, latex = (text.partition(",")[0] for text in (each.label, each.latex))
        theirs = plain._replace(
            label=f"{name}, published", latex=f"{latex}, published", better=None
        )
        columns.append(plain)
        if each in _DIFFERENCES:
            columns.append(Column(f"Δ {each.label}", rf"$\Delta$ {each.latex}", None, 2, True))
        columns.append(theirs)
        if each in _DIFFERENCES:
            columns.append(
                Column(
                    f"Δ {each.label}, published",
                    rf"$\Delta$ {each.latex}, published",
                    None,
                    2,
                    True,
                )
            )
    return tuple(columns)


def _published(method: Method) -> published.Published | None:
    rows = published.rows(published.ABLATION, *_PAPERS_SCENES)
    return next((row for row in rows if row.method == method.published), None)


def _published_difference(
    method: Method, full: Method, theirs: published.Published | None, quantity: Quantity
) -> Cell:
    reference = _published(full)
    if theirs is None or reference is None or method == full:
        return NOTHING
    mine, its = theirs.cell(quantity).mean, reference.cell(quantity).mean
    return NOTHING if mine is None or its is None else Cell(round(mine - its, quantity.digits))
