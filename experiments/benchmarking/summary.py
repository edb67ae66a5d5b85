"""Writes the tables and the index of a benchmark from its results; each file atomically.

{out}/summary.md                         all tables, and the failed, skipped and missing results
{out}/tables/{table}.{md,csv,json,tex}   each table
{out}/tables/scenes.csv                  all metrics of each scene and method
{out}/results.json                       input of the report, see docs/benchmark.md

Tables are written as CSV with a line for each number and as JSON, for programs, and as Markdown and
LaTeX (with booktabs), for people.
"""

import csv
import dataclasses
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.benchmarking import paper_tables, plan, results, settings, tables
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.plan import Skipped
from experiments.benchmarking.results import Record
from experiments.benchmarking.settings import Benchmark
from experiments.benchmarking.tables import Block, Cell, Column, Mark, Row, Table
from refref_jax import atomic_files, configuration
from refref_jax.training import run_folder

FILE, RESULTS, TABLES = "summary.md", "results.json", "tables"

# Largest number of points of a training curve in a figure.
_MOST_POINTS = 200

# Largest number of missing scenes in summary.md for each method; results.json lists all.
_MOST_NAMES = 10

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

_ARROWS = {"higher": " ↑", "lower": " ↓", None: ""}
_LATEX_ARROWS = {"higher": r"$\uparrow$", "lower": r"$\downarrow$", None: ""}
_MARKDOWN_MARKS: dict[Mark, tuple[str, str]] = {
    "": ("", ""),
    "best": ("**", "**"),
    "second": ("<u>", "</u>"),
}
_LATEX_MARKS: dict[Mark, tuple[str, str]] = {
    "": ("", ""),
    "best": (r"\textbf{", "}"),
    "second": (r"\underline{", "}"),
}
_LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "_": r"\_",
    "#": r"\#",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}

# Underscores between letters and digits are literal; elsewhere they may start emphasis.
_MARKDOWN_SPECIAL = re.compile(r"[\\|<>*`\[\]&]|(?<![^\W_])_|_(?![^\W_])")

# Markup in the notes of tables.
_MARKS = re.compile(r"\*+|</?u>|`")


def write(
    out: Path,
    benchmark: Benchmark,
    *,
    failed: Mapping[str, str],
    skipped: Sequence[Skipped],
) -> None:
    """Writes all tables and the results.

    Args:
      out: folder of the benchmark.
      benchmark: its settings, scenes and methods.
      failed: reasons of failed jobs, by name, as in `scene/method`.
      skipped: skipped methods.

    Raises:
      ValueError: if a result is broken, or not comparable with the others.
    """
    everything = results.read_all(out, benchmark)
    found = results.compared(everything)
    made = [
        paper_tables.main_table(found),
        paper_tables.top_views_table(found),
        paper_tables.ablation_table(found),
    ]
    missing = _missing(out, benchmark, failed, skipped)
    _write_tables(out / TABLES, made, found)
    lines = [*_heading(benchmark, found), *_not_done(failed, skipped, missing)]
    _write_text(out / FILE, "\n".join([*lines, *map(markdown, made)]))
    index = {
        "settings": dataclasses.asdict(benchmark.settings),
        "methods": {
            name: {"label": METHODS[name].label, "group": METHODS[name].group}
            for name in METHODS
            if name in benchmark.methods or any(name == record.method for record in found)
        },
        "jobs": [_indexed(out, record) for record in everything],
        "failed": dict(failed),
        "skipped": [each._asdict() for each in skipped],
        "missing": [f"{scene}/{method}" for scene, method in missing],
        "tables": {table.name: table_as_json(table) for table in made},
    }
    settings.write_json(out / RESULTS, configuration.string_safe(index))


def _write_tables(folder: Path, made: Sequence[Table], found: Sequence[Record]) -> None:
    folder.mkdir(exist_ok=True)
    for table in made:
        path = folder / table.name
        _write_text(path.with_suffix(".md"), markdown(table))
        _write_text(path.with_suffix(".tex"), latex(table))
        _write_text(path.with_suffix(".csv"), table_as_csv(table))
        settings.write_json(path.with_suffix(".json"), table_as_json(table))
    _write_text(folder / "scenes.csv", scenes_csv(found))


def not_done(out: Path) -> tuple[dict[str, str], list[Skipped]]:
    """Returns the failed and skipped jobs when the results were last written.

    Jobs that have obtained a result since then are not included. Both are empty if no results were
    written, or if they cannot be read.
    """
    try:
        index = configuration.parse_json((out / RESULTS).read_text("utf-8"))
        skipped = [Skipped(**each) for each in index["skipped"]]
        failed = dict(index["failed"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}, []

    return (
        {name: reason for name, reason in failed.items() if not _has_result(out, name)},
        [each for each in skipped if not _has_result(out, each.name)],
    )


def _has_result(out: Path, name: str) -> bool:
    return (out / plan.FOLDER / name / plan.RESULT).is_file()


def _missing(
    out: Path, benchmark: Benchmark, failed: Mapping[str, str], skipped: Sequence[Skipped]
) -> list[tuple[str, str]]:
    """Returns the scenes and methods of a benchmark that lack a result for no known reason."""
    reported = {*failed, *(each.name for each in skipped)}
    return [
        (scene, method)
        for method in METHODS
        if method in benchmark.methods
        for scene in sorted(benchmark.scenes)
        if (name := f"{scene}/{method}") not in reported and not _has_result(out, name)
    ]


def _heading(benchmark: Benchmark, found: Sequence[Record]) -> list[str]:
    common = benchmark.settings
    images = "all test images" if common.limit is None else f"at most {common.limit} test images"
    versions = sorted({tuple(sorted(record.versions.items())) for record in found})
    described = (", ".join(f"{name} {version}" for name, version in each) for each in versions)
    several = ["Measured by several versions, which may differ: " + "; ".join(described) + ".", ""]
    return [
        "# Benchmark",
        "",
        f"Results: {len(found)}, scenes: {len({record.scene for record in found})}. Preset "
        f"`{common.preset}`, steps: {common.steps}, seed: {common.seed}; {images} per scene, rays "
        f"per pixel: {common.rays_per_pixel}.",
        "",
        *(several if len(versions) > 1 else ()),
    ]


def _not_done(
    failed: Mapping[str, str], skipped: Sequence[Skipped], missing: Sequence[tuple[str, str]]
) -> list[str]:
    without: dict[str, list[str]] = {}
    for scene, method in missing:
        without.setdefault(method, []).append(scene)
    parts = {
        "Failed:": [f"{name}: {reason}" for name, reason in failed.items()],
        "Skipped:": [f"{each.name}: {each.reason}" for each in skipped],
        "Without result:": [
            f"{method}, scenes: {len(scenes)}: {', '.join(scenes[:_MOST_NAMES])}"
            + (", ..." if len(scenes) > _MOST_NAMES else "")
            for method, scenes in without.items()
        ],
    }
    lines = []
    for title, items in parts.items():
        if items:
            lines += [title, "", *(f"- {in_markdown(item)}" for item in items), ""]
    return lines


def _indexed(out: Path, record: Record) -> dict[str, Any]:
    """Returns a result with paths of its images relative to `out`, and its training curve."""
    folder = Path(plan.FOLDER) / record.scene / record.method
    views = [
        view._replace(rgb=str(folder / view.rgb), distance=str(folder / view.distance))
        for view in record.views
    ]
    return {
        **results.to_json(record._replace(views=views)),
        "folder": str(folder),
        "curve": _curve(out / folder / "run"),
    }


def _curve(run: Path) -> list[dict[str, Any]]:
    """Returns the metrics of a training, subsampled for a figure; the last line is kept."""
    lines = configuration.from_string_safe(run_folder.read_metrics(run))
    stride = max(1, -(-len(lines) // _MOST_POINTS))
    thinned = lines[::-1][::stride][::-1]
    keys = ("step", "loss", "psnr", "seconds")
    return [{key: line[key] for key in keys if key in line} for line in thinned]


def _write_text(path: Path, text: str) -> None:
    with atomic_files.written_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def table_as_csv(table: Table) -> str:
    """Returns a CSV line for each number of a table; unknown values are empty."""
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


def table_as_json(table: Table) -> dict[str, Any]:
    """Returns a table as a JSON object."""
    return configuration.string_safe(
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


def table_from_json(record: dict[str, Any]) -> Table:
    """Inverts `table_as_json`.

    Raises:
      KeyError, TypeError: if the object is not a table.
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
    """Returns a CSV line for each result, with all of its metrics."""
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
        Cell(**configuration.from_string_safe({key: cell[key] for key in Cell._fields}))
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


def markdown(table: Table) -> str:
    """Returns a Markdown section: title, a table for each block, and notes."""
    lines = [f"## {table.title}", ""]
    for block in table.blocks:
        heads = [heading(column) for column in table.columns]
        lines += [
            f"### {in_markdown(block.title[:1].upper() + block.title[1:])}",
            "",
            _line(["method", "scenes", *heads]),
            _line(["---", "---:", *["---:"] * len(heads)]),
            *(_line(_markdown_row(row, table.columns)) for row in block.rows),
            "",
        ]
    if not table.blocks:
        lines += ["No results yet.", ""]
    return "\n".join([*lines, *(f"{note}\n" for note in table.notes)])


def in_markdown(text: str) -> str:
    """Escapes a line of text for Markdown, including cells of tables."""
    return _MARKDOWN_SPECIAL.sub(lambda found: f"\\{found[0]}", " ".join(text.split()))


def heading(column: Column) -> str:
    """Returns the heading of a column: its label, and an arrow towards better values."""
    return f"{column.label}{_ARROWS[column.better]}"


def latex(table: Table) -> str:
    """Returns a LaTeX tabular with all blocks, and the notes as comments."""
    count = len(table.columns) + 2
    heads = [f"{column.latex}{_LATEX_ARROWS[column.better]}" for column in table.columns]
    lines = [
        f"% {table.title}. Published rows and columns: arXiv 2505.05848, on its data.",
        *(f"% {_MARKS.sub('', note)}" for note in table.notes),
        rf"\begin{{tabular}}{{@{{}}l{'r' * (count - 1)}@{{}}}}",
        r"\toprule",
        " & ".join(["Method", "Scenes", *heads]) + r" \\",
    ]
    for block in table.blocks:
        lines += [
            r"\midrule",
            rf"\multicolumn{{{count}}}{{@{{}}l}}{{{_escaped(block.title)}}} \\",
            *(" & ".join(_latex_row(row, table.columns)) + r" \\" for row in block.rows),
        ]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _markdown_row(row: Row, columns: Sequence[Column]) -> list[str]:
    label = in_markdown(row.label) + (", *published*" if row.origin == "published" else "")
    cells = [
        _marked(cell, column, _MARKDOWN_MARKS[mark], " ± {}")
        for cell, column, mark in zip(row.cells, columns, row.marks, strict=True)
    ]
    return [label, "-" if row.scenes is None else str(row.scenes), *cells]


def _latex_row(row: Row, columns: Sequence[Column]) -> list[str]:
    label = _escaped(row.label) + (r" \emph{(published)}" if row.origin == "published" else "")
    cells = [
        _marked(cell, column, _LATEX_MARKS[mark], r" {{\tiny$\pm${}}}")
        for cell, column, mark in zip(row.cells, columns, row.marks, strict=True)
    ]
    return [label, "--" if row.scenes is None else str(row.scenes), *cells]


def _marked(cell: Cell, column: Column, around: tuple[str, str], deviation: str) -> str:
    text = f"{around[0]}{tables.number(cell, column)}{around[1]}"
    return text if cell.error is None else text + deviation.format(tables.error(cell, column))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _escaped(text: str) -> str:
    return "".join(_LATEX_SPECIAL.get(letter, letter) for letter in text)
