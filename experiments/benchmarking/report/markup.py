"""Writes HTML, and the tables of the benchmark as HTML.

Text that is not markup is escaped when it is inserted, so that no name can break a page.
"""

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from experiments.benchmarking import paper_tables, published, summary, tables
from experiments.benchmarking.tables import Block, Cell, Column, Mark, Row, Table

# Void elements.
_ENDLESS = ("img", "input", "meta")

Value = str | int | float | bool | None

_MARKS: dict[Mark, str | None] = {"": None, "best": "strong", "second": "u"}

# Blocks that are open initially: all if there are few, otherwise each category over all
# backgrounds.
_FEW = 4
_OPEN = {
    paper_tables.describe(category, published.ALL)
    for category in (*paper_tables.CATEGORIES, published.ALL)
}

# Markup in the notes of tables.
_INLINE = (
    (re.compile(r"\*\*(.+?)\*\*"), r"<strong>\1</strong>"),
    (re.compile(r"\*(.+?)\*"), r"<em>\1</em>"),
    (re.compile(r"`(.+?)`"), r"<code>\1</code>"),
    (re.compile(r"&lt;u&gt;(.+?)&lt;/u&gt;"), r"<u>\1</u>"),
)


class Html(str):
    """Text that is markup; any other text is escaped when it is inserted."""

    __slots__ = ()


def tag(name: str, /, *children: str | None, **attributes: Value) -> Html:
    """Returns an element.

    Args:
      name: name of the element.
      children: content of the element, in order; `None` is skipped.
      attributes: attributes of the element. Underscores are written as hyphens, and a trailing one
        is removed, as in `class_`. `None` and `False` omit an attribute, `True` writes it without a
        value.
    """
    words = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in _ENDLESS:
        return Html(f"<{name}{words}>")
    return Html(f"<{name}{words}>{join(children)}</{name}>")


def join(parts: Iterable[str | None]) -> Html:
    """Concatenates parts."""
    return Html("".join(_escaped(part) for part in parts if part is not None))


def _escaped(part: str) -> str:
    return part if isinstance(part, Html) else html.escape(part)


def _attribute(key: str, value: Value) -> str:
    name = key.rstrip("_").replace("_", "-")
    if value is None or value is False:
        return ""
    return f" {name}" if value is True else f' {name}="{html.escape(str(value))}"'


def show(table: Table) -> Html:
    """Returns a table of the benchmark: a collapsible section for each block, and its notes."""
    few = len(table.blocks) <= _FEW
    blocks = [_block(table, block, few or block.title in _OPEN) for block in table.blocks]
    if not blocks:
        blocks = [tag("p", "No results yet.", class_="note")]
    notes = [tag("p", inline(note), class_="note") for note in table.notes]
    return tag("section", tag("h3", table.title), *blocks, *notes)


def grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Html:
    """Returns a table whose first column is its row headings; cells may be markup."""
    body = [
        tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:]))
        for row in rows
    ]
    return _scrolled(head, tag("tbody", *body))


def number(value: float | None, digits: int) -> str:
    """Returns a formatted number; `-` if it is unknown."""
    return "-" if value is None else format(value, f".{digits}f")


def inline(text: str) -> Html:
    """Converts the text of a note, with its Markdown, to HTML."""
    found = escape(text)
    for pattern, markup in _INLINE:
        found = pattern.sub(markup, found)
    return Html(found)


def options(given: Mapping[str, Sequence[str]]) -> Html:
    """Returns the options of commands, one line each."""
    return join(
        tag("div", tag("code", f"{command} {' '.join(words)}".rstrip()))
        for command, words in given.items()
    )


def _block(table: Table, block: Block, is_open: bool) -> Html:
    head = ["method", "scenes", *map(summary.heading, table.columns)]
    body = tag("tbody", *(_row(row, table.columns) for row in block.rows))
    title = tag("summary", f"{block.title[:1].upper()}{block.title[1:]}")
    return tag("details", title, _scrolled(head, body), open=is_open)


def _row(row: Row, columns: Sequence[Column]) -> Html:
    source = tables.source(row)
    badge = tag("span", source, class_="badge") if source else None
    cells = [
        _cell(cell, column, mark)
        for cell, column, mark in zip(row.cells, columns, row.marks, strict=True)
    ]
    scenes = tag("td", "-" if row.scenes is None else str(row.scenes))
    name = tag("th", row.label, badge, scope="row")
    theirs = row.origin if row.origin != "ours" else None
    return tag("tr", name, scenes, *cells, class_=theirs)


def _cell(cell: Cell, column: Column, mark: Mark) -> Html:
    shown: str = tables.number(cell, column)
    if _MARKS[mark] is not None:
        shown = tag(_MARKS[mark], shown)
    error = None
    if cell.error is not None:
        error = tag("span", f" ± {tables.error(cell, column)}", class_="error")
    return tag("td", shown, error)


def _scrolled(head: Sequence[str], body: Html) -> Html:
    heads = tag("thead", tag("tr", *(tag("th", each, scope="col") for each in head)))
    return tag("div", tag("table", heads, body), class_="scrolled", tabindex="0")
