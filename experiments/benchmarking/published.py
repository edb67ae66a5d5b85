"""Reads the numbers that the paper's authors published for their own data, from `published.csv`.

There are two versions, told apart by their dates:

- `PAPER`: transcribed from the LaTeX source of arXiv 2505.05848; `line` is the line there. In the
  ablation table SSIM, LPIPS and DMAE are divided by 100, because the paper multiplies them by 100.
  DMAE is taken inside the mask with natural backgrounds (`env`).
- `PAGE`: the interactive table of the project page (repository `YueYin27/refref-page`, file
  `static/js/script.js`), as stored on that day. It has the categories over all backgrounds. Several
  of its numbers differ a lot from the paper's, without a stated reason. Its table of 60 real scenes
  is left out: there are no such scenes here.

`--` marks a missing value.
"""

import csv
import functools
from pathlib import Path
from typing import NamedTuple

from experiments.benchmarking.tables import NOTHING, Cell, Quantity

FILE = Path(__file__).with_name("published.csv")
NUMBERS = ("psnr", "psnr_masked", "ssim", "lpips", "dmae", "drmse")

MAIN, ABLATION, TOP_VIEWS = "result_quantitative", "ablation", "top5"
"""Labels of the paper's tables."""

PAPER, PAGE = "2025-05", "2026-09-26"
"""Versions: the month of arXiv 2505.05848, and the day on which the project page was stored."""

ALL = "all"
"""Category or background of a row that covers all of them."""


class Published(NamedTuple):
    """A row of a published table.

    Attributes:
      version: version of the table, `PAPER` or `PAGE`.
      table: label of the paper's table; the page's is a version of `MAIN`.
      category: category as in `scene_names.CATEGORIES`, or `ALL`.
      background: background as in `scene_names.BACKGROUNDS`, or `ALL`.
      method: name of the method in the paper.
      numbers: printed numbers by name, see `NUMBERS`; `None` if missing.
      line: line of the LaTeX source; `None` for the page.
    """

    version: str
    table: str
    category: str
    background: str
    method: str
    numbers: dict[str, str | None]
    line: int | None

    def cell(self, quantity: Quantity) -> Cell:
        """Returns a number of the row as a cell of a table."""
        text = None if quantity.published is None else self.numbers[quantity.published]
        return NOTHING if text is None else Cell(float(text), digits=len(text.partition(".")[2]))


@functools.cache
def read() -> tuple[Published, ...]:
    """Reads all rows, the paper's first, in their order."""
    with FILE.open(newline="", encoding="utf-8") as file:
        return tuple(
            Published(
                record["version"],
                record["table"],
                record["category"],
                record["background"],
                record["method"],
                {name: None if record[name] == "--" else record[name] for name in NUMBERS},
                None if record["line"] == "--" else int(record["line"]),
            )
            for record in csv.DictReader(file)
        )


def rows(table: str, category: str, background: str) -> list[Published]:
    """Returns the rows of a table for a category and background, in all versions."""
    wanted = (table, category, background)
    return [each for each in read() if (each.table, each.category, each.background) == wanted]
