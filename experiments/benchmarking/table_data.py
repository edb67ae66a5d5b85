"""Writes tables as programs read them: CSV with a line for each number, and JSON."""

import csv
import io
from collections.abc import Sequence
from typing import Any

from experiments.benchmarking.results import Record
from experiments.benchmarking.tables import Block, Cell, Column, Row, Table
from experiments.cli import commands

_HEAD = (
    "table",
    "block",
    "origin",
    "method",
    "quantity",
    "mean",
    "standard_error",
    "scenes",
    "mark",
)


def as_csv(table: Table) -> str:
    """Returns a line for each number of a table; what is not known is empty."""
    rows = [
        (
            table.name,
            block.title,
            row.origin,
            row.label,
            column.label,
            _text(cell.mean),
            _text(cell.error),
            cell.count or "",
            mark,
        )
        for block in table.blocks
        for row in block.rows
        for column, cell, mark in zip(table.columns, row.cells, row.marks, strict=True)
    ]
    return _csv([_HEAD, *rows])


def as_json(table: Table) -> dict[str, Any]:
    """Returns a table as JSON has it."""
    return commands.string_safe(
        {
            "name": table.name,
            "title": table.title,
            "notes": list(table.notes),
            "columns": [column._asdict() for column in table.columns],
            "blocks": [
                {
                    "title": block.title,
                    "rows": [
                        {
                            "method": row.label,
                            "origin": row.origin,
                            "scenes": row.scenes,
                            "cells": [
                                {**cell._asdict(), "mark": mark}
                                for cell, mark in zip(row.cells, row.marks, strict=True)
                            ],
                        }
                        for row in block.rows
                    ],
                }
                for block in table.blocks
            ],
        }
    )


def from_json(record: dict[str, Any]) -> Table:
    """Undoes `as_json`.

    Raises:
      KeyError, TypeError: if it is no table.
    """
    return Table(
        name=record["name"],
        title=record["title"],
        notes=tuple(record["notes"]),
        columns=tuple(Column(**column) for column in record["columns"]),
        blocks=tuple(
            Block(block["title"], tuple(map(_row, block["rows"]))) for block in record["blocks"]
        ),
    )


def scenes_csv(found: Sequence[Record]) -> str:
    """Returns a line for each result, with all of its metrics."""
    keys = sorted({key for record in found for key in record.metrics})
    head = ("scene", "category", "background", "method", *keys)
    rows = [
        (
            record.scene,
            record.category,
            record.background,
            record.method,
            *(_text(record.metrics.get(key)) for key in keys),
        )
        for record in found
    ]
    return _csv([head, *rows])


def _row(record: dict[str, Any]) -> Row:
    cells = [
        Cell(**commands.from_string_safe({key: cell[key] for key in Cell._fields}))
        for cell in record["cells"]
    ]
    marks = tuple(cell["mark"] for cell in record["cells"])
    return Row(record["method"], record["origin"], record["scenes"], tuple(cells), marks)


def _csv(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _text(value: float | None) -> str:
    return "" if value is None else repr(float(value))
