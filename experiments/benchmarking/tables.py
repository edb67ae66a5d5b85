"""Builds tables before they are formatted: blocks of rows, ours and the paper's, in columns.

`mean_over` makes a cell: a mean over scenes or views with its standard error; unknown values are
not counted. `mark` finds the best and the second best of our rows of a block. Rows that lack a
scene of the block are excluded, and so are the paper's, which use other data.

A `Quantity` defines a column: a value of a result, and whether higher or lower is better. There are
three kinds of distances, see docs/metrics.md. Substituted distances, as in the first release of the
paper's code, are not ranked: for methods that know the objects, they are exact inside the mask by
definition. The error of a distance is taken inside the mask with a natural background, which is at
infinity, and over the image otherwise, like the paper's DMAE. Costs are those of `results.Costs`;
they depend on the machine, and are not ranked either.

The paper does not state over which pixels its DRMSE is computed. It is unlikely to be the image:
the oracle's DRMSE is 0.00, but its DMAE over the image is 0.04 (cubes) and 0.15 (spheres), and an
RMSE is never below the MAE of the same pixels. The tables therefore show our masked DRMSE next to
the paper's; our DRMSE over the image has no counterpart.
"""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

Better = Literal["higher", "lower"]
Mark = Literal["", "best", "second"]
Origin = Literal["ours", "external", "published"]


class Cell(NamedTuple):
    """A number of a table.

    Attributes:
      mean: mean over scenes; `None` if no scene has the value.
      error: standard error of the mean over scenes; `None` for fewer than two.
      count: number of scenes that have the value.
      digits: decimal places, if they differ from those of the column, as for the paper's numbers.
    """

    mean: float | None = None
    error: float | None = None
    count: int = 0
    digits: int | None = None


NOTHING = Cell()
"""Cell of an unknown value."""


def mean_over(values: Iterable[float | None]) -> Cell:
    """Returns the mean of one value per scene or view.

    The standard error is the standard deviation (with n - 1) over the square root of n. An infinite
    mean, such as the PSNR of equal images, has no error. The mean of `inf` and `-inf` is unknown;
    one `nan` makes the mean `nan`.
    """
    known = [value for value in values if value is not None]
    if not known or {math.inf, -math.inf} <= set(known):
        return NOTHING
    mean = math.fsum(known) / len(known) if all(map(math.isfinite, known)) else sum(known)
    if len(known) < 2 or not math.isfinite(mean):
        return Cell(mean, None, len(known))
    return Cell(mean, statistics.stdev(known) / math.sqrt(len(known)), len(known))


class Quantity(NamedTuple):
    """A value of a result that is shown in a column.

    Attributes:
      label: label in tables.
      latex: label in LaTeX.
      key: key in the metrics, and in the published rows.
      better: `higher` or `lower`; `None` if it does not measure the quality of a method.
      digits: number of decimal places.
      by_mask: whether it is taken inside the mask with a natural background.
      published: name in published.csv, if the paper has it.
    """

    label: str
    latex: str
    key: str
    better: Better | None
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
    "DRMSE, substituted, masked",
    "DRMSE, substituted, masked",
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


TRAINING = Quantity("training, s", "training, s", "train_seconds", None, 0)
RENDERING = Quantity("s per image", "s per image", "seconds_per_image", None, 2)
MEMORY = Quantity("memory, MiB", "memory, MiB", "peak_host_mib", None, 0)
DEVICE_MEMORY = Quantity("device memory, MiB", "device memory, MiB", "peak_device_mib", None, 0)


_OF_IMAGES = (PSNR, PSNR_MASKED, SSIM, LPIPS, FLIP)
_OF_COSTS = (TRAINING, RENDERING, MEMORY, DEVICE_MEMORY)
MAIN = (*_OF_IMAGES, DMAE, DMAE_SURFACE, DMAE_MEDIAN, *_OF_COSTS)
TOP_VIEWS = (*_OF_IMAGES, DRMSE_MASKED, DRMSE, DRMSE_SURFACE, DRMSE_MEDIAN)
ABLATIONS = (PSNR, PSNR_MASKED, SSIM, LPIPS, DMAE)


def value(quantity: Quantity, metrics: Mapping[str, float | None], background: str) -> float | None:
    """Returns a quantity of a result's metrics; `None` if it is unknown."""
    masked = quantity.by_mask and background == "env"
    return metrics.get(f"{quantity.key}_masked" if masked else quantity.key)


class Column(NamedTuple):
    """A column of numbers.

    Attributes:
      label: label of the column.
      latex: label in LaTeX.
      better: `higher` or `lower`; `None` if its numbers are not ranked.
      digits: number of decimal places.
      signed: whether positive numbers are written with their sign.
    """

    label: str
    latex: str
    better: Better | None
    digits: int
    signed: bool = False


class Row(NamedTuple):
    """A row of a table: the numbers of a method.

    Attributes:
      label: label of the method.
      origin: origin of the numbers: a method of ours, given renderings, or published.
      scenes: number of scenes of the method; `None` for published rows.
      cells: number for each column.
      marks: mark for each cell.
      version: date of a published row.
    """

    label: str
    origin: Origin
    scenes: int | None
    cells: tuple[Cell, ...]
    marks: tuple[Mark, ...]
    version: str = ""


class Block(NamedTuple):
    """Comparable rows."""

    title: str
    rows: tuple[Row, ...]


class Table(NamedTuple):
    """A table with all of its blocks.

    Attributes:
      name: name of its files.
      title: title of the table.
      notes: notes that explain it.
      columns: columns of all blocks.
      blocks: blocks in order; empty ones are omitted.
    """

    name: str
    title: str
    notes: tuple[str, ...]
    columns: tuple[Column, ...]
    blocks: tuple[Block, ...]


def row(
    label: str, origin: Origin, scenes: int | None, cells: Sequence[Cell], version: str = ""
) -> Row:
    """Returns a row without marks."""
    return Row(label, origin, scenes, tuple(cells), ("",) * len(cells), version)


def source(row: Row) -> str:
    """Returns the source of a row's numbers, with its date; empty for ours."""
    return "" if row.origin == "ours" else f"{row.origin} {row.version}".rstrip()


def mark(rows: Sequence[Row], columns: Sequence[Column], scenes: int) -> tuple[Row, ...]:
    """Marks the best of the rows measured here, and the second best of three or more.

    They are compared by the digits shown, so equal ones share a mark. Rows that lack a scene, and
    `nan`, are not compared.

    Args:
      rows: rows of a block.
      columns: columns of the table.
      scenes: number of scenes of the block, over all rows.
    """
    marks = [list(row.marks) for row in rows]
    for j, column in enumerate(columns):
        shown = {
            i: _shown(row.cells[j], column)
            for i, row in enumerate(rows)
            if row.origin != "published" and _compares(row.cells[j], scenes)
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
    """Removes the columns that neither our rows nor the paper's fill.

    Args:
      table: table to reduce.
      kept: labels of columns to keep even if empty.
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
    """Returns a formatted mean without its error; `-` if it is unknown."""
    if cell.mean is None:
        return "-"
    digits = column.digits if cell.digits is None else cell.digits
    return format(cell.mean, f"{'+' if column.signed else ''}.{digits}f")


def error(cell: Cell, column: Column) -> str:
    """Returns a formatted standard error; `-` if there is none."""
    return "-" if cell.error is None else format(cell.error, f".{column.digits}f")


def _compares(cell: Cell, scenes: int) -> bool:
    return cell.mean is not None and cell.count == scenes and not math.isnan(cell.mean)


def _shown(cell: Cell, column: Column) -> float:
    return round(cell.mean, column.digits) if math.isfinite(cell.mean) else cell.mean
