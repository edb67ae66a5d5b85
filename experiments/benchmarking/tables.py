"""Tables before they are written: blocks of rows, ours and the paper's, in columns.

`mean_over` makes a cell: a mean over scenes or views with its standard error; what is not known is
never counted. `mark` finds the best and the second best of a block's own rows. Rows that lack a
scene of the block are left out of that, and so are the paper's, which are of other data.

A `Quantity` is what a column shows of a result, and in which way it is better. Distances are of
three kinds, see docs/metrics.md. Those that are substituted, as the first release of the paper's
code had them, are exact inside the mask, by definition, for methods that know objects: they do not
rank. A distance's error is taken inside the mask before a natural background, which is infinitely
far, and over the image elsewhere, as the paper's DMAE is.

The paper does not say over which pixels its DRMSE is. Hardly over the image: the Oracle's is 0.00,
its DMAE there is 0.04 (cubes) and 0.15 (spheres), and no RMSE is below the MAE of the same pixels.
So the one over the mask is beside the paper's, and the one over the image is ours alone.
"""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

Mark = Literal["", "best", "second"]
Origin = Literal["ours", "published"]


class Cell(NamedTuple):
    """A number of a table.

    Attributes:
      mean: over scenes; `None` if no scene has the value.
      error: standard error of the mean over scenes; `None` for fewer than two.
      count: scenes that have the value.
      digits: after the point, where they are not its column's: those that the paper prints.
    """

    mean: float | None = None
    error: float | None = None
    count: int = 0
    digits: int | None = None


NOTHING = Cell()
"""What is not known."""


def mean_over(values: Iterable[float | None]) -> Cell:
    """Returns the mean of one value a scene, or a view.

    The standard error is the standard deviation (with n - 1) over the square root of n. A mean that
    is infinite, as the PSNR of equal images is, has none. Of `inf` and `-inf` together no mean is
    known; one `nan` makes a mean `nan`.
    """
    known = [value for value in values if value is not None]
    if not known or {math.inf, -math.inf} <= set(known):
        return NOTHING
    mean = math.fsum(known) / len(known) if all(map(math.isfinite, known)) else sum(known)
    if len(known) < 2 or not math.isfinite(mean):
        return Cell(mean, None, len(known))
    return Cell(mean, statistics.stdev(known) / math.sqrt(len(known)), len(known))


class Quantity(NamedTuple):
    """A column.

    Attributes:
      label: of tables.
      latex: the same in LaTeX.
      key: of the metrics, and of the published rows.
      better: `higher` or `lower`; `None` if it says nothing of how good a method is.
      digits: after the point.
      by_mask: whether it is taken inside the mask before a natural background.
      published: its name in published.csv, if the paper has it.
    """

    label: str
    latex: str
    key: str
    better: Literal["higher", "lower"] | None
    digits: int
    by_mask: bool = False
    published: str | None = None


PSNR = Quantity("PSNR", "PSNR", "psnr", "higher", 2, published="psnr")
PSNR_MASKED = Quantity(
    "masked PSNR", r"PSNR\textsubscript{M}", "psnr_masked", "higher", 2, published="psnr_masked"
)
SSIM = Quantity("SSIM", "SSIM", "ssim", "higher", 3, published="ssim")
LPIPS = Quantity("LPIPS", "LPIPS", "lpips", "lower", 3, published="lpips")
FLIP = Quantity("FLIP", "FLIP", "flip", "lower", 3)
DMAE = Quantity("DMAE, substituted", "DMAE, substituted", "substituted_mae", None, 3, True, "dmae")
DMAE_SURFACE = Quantity(
    "DMAE, first surface", "DMAE, first surface", "surface_mae", "lower", 3, by_mask=True
)
DMAE_MEDIAN = Quantity("DMAE, median", "DMAE, median", "distance_mae", "lower", 3, by_mask=True)
DRMSE_MASKED = Quantity(
    "DRMSE, substituted, in the mask",
    "DRMSE, substituted, in the mask",
    "substituted_rmse_masked",
    None,
    3,
    published="drmse",
)
DRMSE = Quantity(
    "DRMSE, substituted, of the image",
    "DRMSE, substituted, of the image",
    "substituted_rmse",
    None,
    3,
    by_mask=True,
)
DRMSE_SURFACE = Quantity(
    "DRMSE, first surface", "DRMSE, first surface", "surface_rmse", "lower", 3, by_mask=True
)
DRMSE_MEDIAN = Quantity("DRMSE, median", "DRMSE, median", "distance_rmse", "lower", 3, by_mask=True)


_OF_IMAGES = (PSNR, PSNR_MASKED, SSIM, LPIPS, FLIP)
MAIN = (*_OF_IMAGES, DMAE, DMAE_SURFACE, DMAE_MEDIAN)
TOP_VIEWS = (*_OF_IMAGES, DRMSE_MASKED, DRMSE, DRMSE_SURFACE, DRMSE_MEDIAN)
ABLATIONS = (PSNR, PSNR_MASKED, SSIM, LPIPS, DMAE)


def value(quantity: Quantity, metrics: Mapping[str, float | None], background: str) -> float | None:
    """Returns a quantity of a result's metrics; `None` if it is not known."""
    masked = quantity.by_mask and background == "env"
    return metrics.get(f"{quantity.key}_masked" if masked else quantity.key)


class Column(NamedTuple):
    """A column of numbers.

    Attributes:
      label: of it.
      latex: the same in LaTeX.
      better: `higher` or `lower`; `None` if its numbers are not to be ranked.
      digits: after the point.
      signed: whether positive numbers have their sign.
    """

    label: str
    latex: str
    better: Literal["higher", "lower"] | None
    digits: int
    signed: bool = False


class Row(NamedTuple):
    """A row: a method.

    Attributes:
      label: of the method.
      origin: whose numbers they are.
      scenes: that it was measured on; `None` of published rows.
      cells: a number for each column.
      marks: of each.
    """

    label: str
    origin: Origin
    scenes: int | None
    cells: tuple[Cell, ...]
    marks: tuple[Mark, ...]


class Block(NamedTuple):
    """Rows that compare."""

    title: str
    rows: tuple[Row, ...]


class Table(NamedTuple):
    """A table.

    Attributes:
      name: of its files.
      title: what it shows.
      notes: what one must know to read it.
      columns: of all blocks.
      blocks: in order; one without rows is left out.
    """

    name: str
    title: str
    notes: tuple[str, ...]
    columns: tuple[Column, ...]
    blocks: tuple[Block, ...]


def row(label: str, origin: Origin, scenes: int | None, cells: Sequence[Cell]) -> Row:
    """Returns a row that is not marked."""
    return Row(label, origin, scenes, tuple(cells), ("",) * len(cells))


def mark(rows: Sequence[Row], columns: Sequence[Column], scenes: int) -> tuple[Row, ...]:
    """Marks the best of our rows, and the second best of three or more, by the digits shown.

    Equal numbers share a mark. Numbers that lack a scene, and `nan`, are not compared.

    Args:
      rows: of one block.
      columns: of the table.
      scenes: of the block, whichever rows have them.
    """
    marks = [list(row.marks) for row in rows]
    for j, column in enumerate(columns):
        shown = {
            i: _shown(row.cells[j], column)
            for i, row in enumerate(rows)
            if row.origin == "ours" and _compares(row.cells[j], scenes)
        }
        ranked = sorted(set(shown.values()), reverse=column.better == "higher")
        if column.better is None or len(shown) < 2:
            continue
        for i, number in shown.items():
            if number == ranked[0]:
                marks[i][j] = "best"
            elif number == ranked[1] and len(shown) > 2:
                marks[i][j] = "second"
    return tuple(each._replace(marks=tuple(own)) for each, own in zip(rows, marks, strict=True))


def without_empty_columns(table: Table, kept: Sequence[str]) -> Table:
    """Returns a table without columns that no row of ours or the paper's fills.

    Args:
      table: the table.
      kept: labels of columns that stay nevertheless.
    """
    rows = [row for block in table.blocks for row in block.rows]
    places = [
        j
        for j, column in enumerate(table.columns)
        if column.label in kept or any(row.cells[j].mean is not None for row in rows)
    ]

    def choose(items: tuple) -> tuple:
        return tuple(items[j] for j in places)

    blocks = tuple(
        Block(
            block.title,
            tuple(
                row._replace(cells=choose(row.cells), marks=choose(row.marks)) for row in block.rows
            ),
        )
        for block in table.blocks
        if block.rows
    )
    return table._replace(columns=choose(table.columns), blocks=blocks)


def number(cell: Cell, column: Column) -> str:
    """Returns a mean as it is shown, without its error; `-` if it is not known."""
    if cell.mean is None:
        return "-"
    digits = column.digits if cell.digits is None else cell.digits
    return format(cell.mean, f"{'+' if column.signed else ''}.{digits}f")


def error(cell: Cell, column: Column) -> str:
    """Returns a standard error as it is shown; `-` if there is none."""
    return "-" if cell.error is None else format(cell.error, f".{column.digits}f")


def _compares(cell: Cell, scenes: int) -> bool:
    return cell.mean is not None and cell.count == scenes and not math.isnan(cell.mean)


def _shown(cell: Cell, column: Column) -> float:
    return round(cell.mean, column.digits) if math.isfinite(cell.mean) else cell.mean
