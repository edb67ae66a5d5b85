"""The tables that compare methods with each other and with the paper's rows.

- `main_table`: by category and background, as the paper's table 2.
- `top_views_table`: the same means over the test views farthest from all training views (its table
  of the supplement).
- `ablation_table`: what taking or changing one thing does to the oracle and to the tree.

A number is the mean over a scene's images, then over scenes; its error is over scenes. Differences
are those of each scene, from the method that nothing is taken from, averaged over the scenes that
both have; the paper's stand beside them.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from experiments.benchmarking import pose_space, published, tables
from experiments.benchmarking.methods import FULL, METHODS, Group, Method
from experiments.benchmarking.results import OTHER, Metrics, Record
from experiments.benchmarking.tables import (
    NOTHING,
    Block,
    Cell,
    Column,
    Quantity,
    Row,
    Table,
    mean_over,
)

TOP = 5
"""Test views of a scene that are farthest from its training views, as in the paper."""

CATEGORIES = {
    "smcvx": "convex, single material",
    "smncvx": "non-convex, single material",
    "mmncvx": "non-convex, several materials",
    OTHER: "other objects",
}
BACKGROUNDS = {
    "cube": "cube background",
    "sphere": "sphere background",
    "env": "natural background",
    OTHER: "other backgrounds",
}

_THEIRS = (
    "Rows marked *published* are the paper's own (arXiv 2505.05848), measured on its data, which "
    "is not ours: they are beside ours for orientation and take no part in best and second best."
)
_MEANS = (
    "Mean over the images of a scene, then over scenes; ± is the standard error over scenes. What "
    "is not known is - and is not counted. Best **bold**, and of three or more second best "
    "<u>underlined</u>, among our methods that have all scenes of a block."
)
_SUBSTITUTED = (
    "Substituted distances have the true ones inside the mask, as the first release of the paper's "
    "code had: they are 0 there by definition for methods that know objects, and do not rank. The "
    "paper's stand in their column, for they come nearest; which kind they are is not known. "
    "Before natural backgrounds all distances are those inside the mask."
)
_FARTHEST = (
    "Of each scene the {views} rendered test views that are farthest from any training view. The "
    "paper defines no distance of poses; here it is sqrt(|c - c'|²/s² + a²) of positions c, the "
    "angle a between the cameras' axes, and the mean distance s of the training cameras from the "
    "origin."
)
_DRMSE = (
    "The paper does not say over which pixels its DRMSE is. It is beside ours *in the mask*, for "
    "it is hardly over the image: its Oracle has 0.00 here, its DMAE over the image is 0.04 before "
    "cubes and 0.15 in spheres, and no root mean square is below the mean of the same pixels. That "
    "*of the image* is ours alone."
)

_PAPERS_SCENES = ("smcvx", "cube")

_DIFFERENCES = (tables.PSNR, tables.PSNR_MASKED)

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


def main_table(found: Sequence[Record]) -> Table:
    """Returns the means of all methods that are no ablations, by category and background."""
    found, blocks = _without_ablations(found), []
    for category in (*CATEGORIES, published.ALL):
        for background in (*BACKGROUNDS, published.ALL):
            own = select(found, category, background)
            if own:
                rows = _ours(own, tables.MAIN, lambda record: record.metrics)
                rows += _theirs(published.MAIN, category, background, tables.MAIN)
                title = describe(category, background)
                blocks.append(_marked(title, rows, tables.MAIN, own))
    return _table("main", "Methods by category and background", (), tables.MAIN, blocks)


def top_views_table(found: Sequence[Record]) -> Table:
    """Returns the same means over the test views farthest from any training view."""
    found = _without_ablations(found)
    rows = _ours(found, tables.TOP_VIEWS, top_metrics)
    rows += _theirs(published.TOP_VIEWS, published.ALL, published.ALL, tables.TOP_VIEWS)
    blocks = [_marked("all scenes", rows, tables.TOP_VIEWS, found)] if found else []
    notes = (_FARTHEST.format(views=_views(found)), _DRMSE)
    return _table("top_views", "Farthest test views", notes, tables.TOP_VIEWS, blocks)


def _views(found: Sequence[Record]) -> str:
    """Returns how many of the farthest views there were, up to `TOP` of each scene."""
    counts = {min(TOP, len(record.per_image)) for record in found} or {TOP}
    least, most = min(counts), max(counts)
    return str(most) if least == most else f"{least} to {most}"


def top_metrics(record: Record) -> Metrics:
    """Returns the means over the views of a result that are farthest from any training view."""
    apart = np.array([image.pose_distance for image in record.per_image])
    views = [record.per_image[i].metrics for i in pose_space.farthest(apart, TOP)]
    keys = [key for key in record.metrics if all(key in view for view in views)]
    return {key: mean_over([view[key] for view in views]).mean for key in keys}


def select(found: Sequence[Record], category: str, background: str) -> list[Record]:
    """Returns the results of a category and background; `published.ALL` is any."""
    return [
        record
        for record in found
        if category in (published.ALL, record.category)
        and background in (published.ALL, record.background)
    ]


def describe(category: str, background: str) -> str:
    """Returns what a block of rows is of."""
    kind = CATEGORIES.get(category, "all categories")
    return f"{kind}; {BACKGROUNDS.get(background, 'all backgrounds')}"


def columns(wanted: Sequence[Quantity]) -> tuple[Column, ...]:
    """Returns a column for each quantity."""
    return tuple(Column(each.label, each.latex, each.better, each.digits) for each in wanted)


def _marked(
    title: str, rows: Sequence[Row], wanted: Sequence[Quantity], found: Sequence[Record]
) -> Block:
    """Returns a block of rows whose best are marked, among those that have all of its scenes."""
    scenes = len({record.scene for record in found})
    return Block(title, tables.mark(rows, columns(wanted), scenes))


def _ours(
    found: Sequence[Record], wanted: Sequence[Quantity], metrics: Callable[[Record], Metrics]
) -> list[Row]:
    """Returns a row for each method with results, in the order of the methods."""
    rows = []
    for name, method in METHODS.items():
        own = [record for record in found if record.method == name]
        if not own:
            continue
        known = [(metrics(record), record.background) for record in own]
        cells = [mean_over(tables.value(each, *pair) for pair in known) for each in wanted]
        rows.append(tables.row(method.label, "ours", len(own), cells))
    return rows


def _without_ablations(found: Sequence[Record]) -> list[Record]:
    return [record for record in found if METHODS[record.method].group == "main"]


def _theirs(table: str, category: str, background: str, wanted: Sequence[Quantity]) -> list[Row]:
    return [
        tables.row(row.method, "published", None, [row.cell(each) for each in wanted])
        for row in published.rows(table, category, background)
    ]


def _table(
    name: str,
    title: str,
    notes: Sequence[str],
    wanted: Sequence[Quantity],
    blocks: Sequence[Block],
) -> Table:
    notes = (*notes, _MEANS, _SUBSTITUTED, _THEIRS)
    whole = Table(name, title, notes, columns(wanted), tuple(blocks))
    kept = [each.label for each in wanted if each.published is not None]
    return tables.without_empty_columns(whole, kept)


def ablation_table(found: Sequence[Record]) -> Table:
    """Returns the ablations, over the paper's kind of scenes and over all."""
    blocks = []
    for group in FULL:
        for scenes in (_PAPERS_SCENES, (published.ALL, published.ALL)):
            own = select(found, *scenes)
            rows = _rows(own, group, with_published=scenes == _PAPERS_SCENES)
            blocks.append(Block(f"{group}; {describe(*scenes)}", rows))
    table = Table("ablations", "Ablations", _NOTES, _columns(), tuple(blocks))
    return tables.without_empty_columns(table, [column.label for column in _columns()])


def difference(found: Sequence[Record], method: str, full: str, quantity: Quantity) -> Cell:
    """Returns the mean difference of a quantity to that of a full method, over common scenes."""
    known = {
        (record.scene, record.method): tables.value(quantity, record.metrics, record.background)
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
    for each in tables.ABLATIONS:
        cells.append(
            mean_over(tables.value(each, record.metrics, record.background) for record in own)
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
    for each in tables.ABLATIONS:
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
