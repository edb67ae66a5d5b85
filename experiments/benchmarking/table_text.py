"""Writes tables as people read them: Markdown, and LaTeX for a paper (with booktabs)."""

import re
from collections.abc import Sequence

from experiments.benchmarking import tables
from experiments.benchmarking.tables import Cell, Column, Mark, Row, Table

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

# Underscores between letters and digits are letters; elsewhere they may begin emphasis.
_MARKDOWN_SPECIAL = re.compile(r"[\\|<>*`\[\]&]|(?<![^\W_])_|_(?![^\W_])")

# What the notes of tables are written with.
_MARKS = re.compile(r"\*+|</?u>|`")


def markdown(table: Table) -> str:
    """Returns a section: title, a table for each block, and notes."""
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
        lines += ["Nothing is measured yet.", ""]
    return "\n".join([*lines, *(f"{note}\n" for note in table.notes)])


def in_markdown(text: str) -> str:
    """Returns text of one line that Markdown shows as it is, in a table's cell too."""
    return _MARKDOWN_SPECIAL.sub(lambda found: f"\\{found[0]}", " ".join(text.split()))


def heading(column: Column) -> str:
    """Returns what stands above a column: its label, and an arrow to what is better."""
    return f"{column.label}{_ARROWS[column.better]}"


def latex(table: Table) -> str:
    """Returns a tabular, with the blocks below one another, and the notes in comments."""
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
