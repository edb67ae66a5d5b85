"""What a table is, before it is written: blocks of rows, ours and the paper's, in columns.

`mark` finds the best and the second best of a block's own rows. Rows that lack a scene of the block
are left out of that, and so are the paper's, which are of other data.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from experiments.benchmarking.quantities import Better
from experiments.benchmarking.statistics import Cell

Mark = Literal["", "best", "second"]
Origin = Literal["ours", "published"]


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
    better: Better | None
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
