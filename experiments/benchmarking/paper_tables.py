"""Builds the tables that compare methods with each other and with the published rows.

- `main_table`: by category and background, like the paper's table 2.
- `top_views_table`: the same means over the test views farthest from all training views (the
corresponding table of the supplement).
- `ablation_table`: the effect of single changes to the oracle and to the tree.

A number is the mean over a scene's images, then over scenes; its error is over scenes. Differences
are computed per scene, relative to the reference method, and averaged over the scenes that both
methods have; those of the paper are next to them.
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
"""Number of test views of a scene, the farthest from its training views, as in the paper."""

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

EXTERNAL = "external"
"""Group of methods whose renderings were given."""

_THEIRS = (
    f"Rows marked *published* are the authors' own, measured on their data, which differs from "
    f"ours: they are shown for orientation and excluded from best and second best. "
    f"*{published.PAPER}* is the paper, arXiv 2505.05848; *{published.PAGE}* is the project page "
    "on that day, which has categories over all backgrounds. The two differ without a stated "
    "reason."
)
_GIVEN = (
    "Rows marked *external* are renderings by other programs, measured here like ours, from 8-bit "
    "images. Their distances, if given, are in all three columns of distances, as for methods that "
    "know no objects."
)
_MEANS = (
    "Mean over the images of a scene, then over scenes; ± is the standard error over scenes. "
    "Unknown values are shown as - and not counted. Best **bold**, and of three or more second "
    "best <u>underlined</u>, among the methods measured here that have all scenes of a block."
)
_SUBSTITUTED = (
    "Substituted distances equal the true ones inside the mask, as in the first release of the "
    "paper's code: their error is 0 there by definition for methods that know the objects, so they "
    "are not ranked. The paper's are in their column as the most similar; their definition is not "
    "known. With natural backgrounds all distances are those inside the mask."
)
_COSTS = (
    "Costs are means over scenes, of the machine that ran the jobs: seconds of all training steps, "
    "compilation included, seconds to render an image, and the largest memory of the training's "
    "process. The reconstruction that methods of R3F share is not included. The paper states none."
)
_ABSENT = "Published rows of methods that there are none of here: {names}."
_FARTHEST = (
    "The {views} rendered test views of each scene that are farthest from any training view. The "
    "paper does not define a distance of poses; here it is sqrt(|c - c'|²/s² + a²) of positions c, "
    "the angle a between the cameras' axes, and the mean distance s of the training cameras from "
    "the origin."
)
_DRMSE = (
    "The paper does not state the pixels of its DRMSE. It is next to our *masked* one, because "
    "it is unlikely to be over the image: its Oracle has 0.00 here, but a DMAE over the image of "
    "0.04 with cubes and 0.15 with spheres, and a root mean square is never below the mean of the "
    "same pixels. Our DRMSE *of the image* has no counterpart."
)

_PAPERS_SCENES = ("smcvx", "cube")

_DIFFERENCES = (tables.PSNR, tables.PSNR_MASKED)

_NOTES = (
    "Ablations change one thing of the method in the first row of their block. Means over images, "
    "then over scenes, ± the standard error over scenes; Δ is the mean difference to the first row "
    "over the scenes that both have, in dB. Unknown values are shown as -. All other options, "
    "including the footprint, are the preset's for every row; Nerfacto's fields define their own "
    "sizes, samples and footprint (a cone).",
    "*Published* columns are the paper's own (arXiv 2505.05848, ablation study: convex objects of "
    "a single material, cube backgrounds), measured on its data, which differs from ours.",
    "Our DMAE is the substituted one, see the table of methods; the paper's definition is not "
    "known.",
)


def main_table(found: Sequence[Record]) -> Table:
    """Returns the means of all methods except ablations, by category and background."""
    found, blocks = _without_ablations(found), []
    for category in (*CATEGORIES, published.ALL):
        for background in (*BACKGROUNDS, published.ALL):
            own = select(found, category, background)
            if own:
                rows = _ours(own, tables.MAIN, lambda each: each.metrics | each.costs._asdict())
                rows += _theirs(published.MAIN, category, background, tables.MAIN)
                title = describe(category, background)
                blocks.append(_marked(title, rows, tables.MAIN, own))
    notes = (*_of_externals(found), _COSTS, *_of_absent())
    return _table("main", "Methods by category and background", notes, tables.MAIN, blocks)


def top_views_table(found: Sequence[Record]) -> Table:
    """Returns the same means over the test views farthest from any training view."""
    found = _without_ablations(found)
    rows = _ours(found, tables.TOP_VIEWS, top_metrics)
    rows += _theirs(published.TOP_VIEWS, published.ALL, published.ALL, tables.TOP_VIEWS)
    blocks = [_marked("all scenes", rows, tables.TOP_VIEWS, found)] if found else []
    notes = (_FARTHEST.format(views=_views(found)), _DRMSE, *_of_externals(found))
    return _table("top_views", "Farthest test views", notes, tables.TOP_VIEWS, blocks)


def _views(found: Sequence[Record]) -> str:
    """Returns the number of farthest views per scene, up to `TOP`, as text."""
    counts = {min(TOP, len(record.per_image)) for record in found} or {TOP}
    least, most = min(counts), max(counts)
    return str(most) if least == most else f"{least} to {most}"


def top_metrics(record: Record) -> Metrics:
    """Returns the means over those views of a result that are farthest from any training view."""
    apart = np.array([image.pose_distance for image in record.per_image])
    views = [record.per_image[i].metrics for i in pose_space.farthest(apart, TOP)]
    keys = [key for key in record.metrics if all(key in view for view in views)]
    return {key: mean_over([view[key] for view in views]).mean for key in keys}


def select(found: Sequence[Record], category: str, background: str) -> list[Record]:
    """Returns the results of a category and background; `published.ALL` matches all."""
    return [
        record
        for record in found
        if category in (published.ALL, record.category)
        and background in (published.ALL, record.background)
    ]


def describe(category: str, background: str) -> str:
    """Returns the title of a block of rows."""
    kind = CATEGORIES.get(category, "all categories")
    return f"{kind}; {BACKGROUNDS.get(background, 'all backgrounds')}"


def columns(wanted: Sequence[Quantity]) -> tuple[Column, ...]:
    """Returns a column for each quantity."""
    return tuple(Column(each.label, each.latex, each.better, each.digits) for each in wanted)


def _marked(
    title: str, rows: Sequence[Row], wanted: Sequence[Quantity], found: Sequence[Record]
) -> Block:
    """Returns a block of rows; the best among those that have all of its scenes are marked."""
    scenes = len({record.scene for record in found})
    return Block(title, tables.mark(rows, columns(wanted), scenes))


def _ours(
    found: Sequence[Record], wanted: Sequence[Quantity], metrics: Callable[[Record], Metrics]
) -> list[Row]:
    """Returns a row for each method with results, in the order of the methods, ours first."""
    rows = []
    given = sorted({record.method for record in found} - set(METHODS))
    for name in (*METHODS, *given):
        own = [record for record in found if record.method == name]
        if not own:
            continue
        known = [(metrics(record), record.background) for record in own]
        cells = [mean_over(tables.value(each, *pair) for pair in known) for each in wanted]
        if name in METHODS:
            rows.append(tables.row(METHODS[name].label, "ours", len(own), cells))
        else:
            rows.append(tables.row(name, "external", len(own), cells))
    return rows


def _without_ablations(found: Sequence[Record]) -> list[Record]:
    return [
        record
        for record in found
        if record.method not in METHODS or METHODS[record.method].group not in FULL
    ]


def _of_externals(found: Sequence[Record]) -> tuple[str, ...]:
    return (_GIVEN,) if any(record.method not in METHODS for record in found) else ()


def _of_absent() -> tuple[str, ...]:
    """Returns a note on the published rows of the main table that no method here stands for."""
    ours = {method.published for method in METHODS.values()}
    theirs = [row.method for row in published.read() if row.table == published.MAIN]
    absent = [name for name in dict.fromkeys(theirs) if name not in ours]
    return (_ABSENT.format(names=", ".join(absent)),) if absent else ()


def _theirs(table: str, category: str, background: str, wanted: Sequence[Quantity]) -> list[Row]:
    return [
        tables.row(row.method, "published", None, [row.cell(each) for each in wanted], row.version)
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
    """Returns the ablations, over the scenes of the paper's ablations and over all scenes."""
    blocks = []
    for group in FULL:
        for scenes in (_PAPERS_SCENES, (published.ALL, published.ALL)):
            own = select(found, *scenes)
            rows = _rows(own, group, with_published=scenes == _PAPERS_SCENES)
            blocks.append(Block(f"{group}; {describe(*scenes)}", rows))
    table = Table("ablations", "Ablations", _NOTES, _columns(), tuple(blocks))
    return tables.without_empty_columns(table, [column.label for column in _columns()])


def difference(found: Sequence[Record], method: str, full: str, quantity: Quantity) -> Cell:
    """Returns the mean difference of a quantity to that of the reference, over common scenes."""
    known = {
        (record.scene, record.method): tables.value(quantity, record.metrics, record.background)
        for record in found
    }
    scenes = sorted({record.scene for record in found})
    pairs = [(known.get((scene, method)), known.get((scene, full))) for scene in scenes]
    return mean_over(_apart(*pair) for pair in pairs)


def _apart(ours: float | None, theirs: float | None) -> float | None:
    """Returns a difference, or `None` if both values are infinite."""
    if ours is None or theirs is None or (math.isinf(ours) and ours == theirs):
        return None
    return ours - theirs


def _rows(found: Sequence[Record], group: Group, *, with_published: bool) -> tuple[Row, ...]:
    """Returns a row for each measured method of a group, the reference first."""
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
        # Not ranked with ours, because the paper's kind of distance is not known.
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
