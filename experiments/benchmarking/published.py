"""Reads the numbers printed in the paper, measured on its own data, from `published.csv`.

They are transcribed from the LaTeX source of arXiv 2505.05848; `line` is the line there. `--` marks
a missing value, as in the paper. In the ablation table SSIM, LPIPS and DMAE are divided by 100,
because the paper multiplies them by 100. DMAE is taken inside the mask with natural backgrounds
(`env`).
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

ALL = "all"
"""Category or background of a row that covers all of them."""


class Published(NamedTuple):
    """A row of a table of the paper.

    Attributes:
      table: label of the paper's table.
      category: category as in `scene_names.CATEGORIES`, or `ALL`.
      background: background as in `scene_names.BACKGROUNDS`, or `ALL`.
      method: name of the method in the paper.
      numbers: printed numbers by name, see `NUMBERS`; `None` if missing.
      line: line of the LaTeX source.
    """

    table: str
    category: str
    background: str
    method: str
    numbers: dict[str, str | None]
    line: int

    def cell(self, quantity: Quantity) -> Cell:
        """Returns a number of the row as a cell of a table."""
        text = None if quantity.published is None else self.numbers[quantity.published]
        return NOTHING if text is None else Cell(float(text), digits=len(text.partition(".")[2]))


@functools.cache
def read() -> tuple[Published, ...]:
    """Reads all rows, in the paper's order."""
    with FILE.open(newline="", encoding="utf-8") as file:
        return tuple(
            Published(
                record["table"],
                record["category"],
                record["background"],
                record["method"],
                {name: None if record[name] == "--" else record[name] for name in NUMBERS},
                int(record["line"]),
            )
            for record in csv.DictReader(file)
        )


def rows(table: str, category: str, background: str) -> list[Published]:
    """Returns the rows of a table for a category and background."""
    wanted = (table, category, background)
    return [each for each in read() if (each.table, each.category, each.background) == wanted]
