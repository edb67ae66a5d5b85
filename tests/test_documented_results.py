"""Every number of a result table in README.md and docs stands in a file of benchmarks/results.

A result table is one that an HTML comment `<!-- results: FILE.csv -->` directly precedes. Of its
rows, but not of its heading, every number outside of code must be found in that file, rounded as it
is printed: within half a unit of its last digit. If the first cell of the table's row names rows of
the file by their first column, those rows alone are searched.
"""

import csv
import re
from decimal import Decimal
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[1]
_RESULTS = _ROOT / "benchmarks" / "results"
_PAGES = [_ROOT / "README.md", *sorted((_ROOT / "docs").rglob("*.md"))]

_MARK = re.compile(r"^<!-- results: (?P<file>\S+) -->$")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")
_HEADER = ["what", "command", "commit", "machine", "date"]

# These pages show measurements, so each has at least one table that names its file.
_MEASURED = {
    "README.md",
    "docs/presets.md",
    "docs/glass.md",
    "docs/r3f.md",
    "docs/benchmark.md",
    "docs/dataset.md",
    "docs/stability.md",
}


def _tables():
    """Yields the page, the file and the rows of each result table."""
    for page in _PAGES:
        lines = page.read_text().splitlines()
        for number, line in enumerate(lines):
            if mark := _MARK.match(line):
                rows = []
                for row in lines[number + 3 :]:
                    if not row.startswith("|"):
                        break
                    rows.append([cell.strip() for cell in row.strip("|").split("|")])
                heading = lines[number + 1 : number + 3]
                yield page.relative_to(_ROOT).as_posix(), mark["file"], heading, rows


_TABLES = list(_tables())


def _read(name):
    """Returns the comments of a file of results, and its rows; the first has the columns."""
    lines = (_RESULTS / name).read_text().splitlines()
    comments = [line for line in lines if line.startswith("# ")]
    return comments, list(csv.reader(lines[len(comments) :]))


def _numbers(text):
    text = re.sub(r"`[^`]*`", "", text).replace("\N{MINUS SIGN}", "-")
    text = re.sub(r"(?<=\d),(?=\d{3}\b)", "", text)
    return _NUMBER.findall(text)


def _stands_for(printed, exact):
    """Returns whether a number that is printed is another one, rounded."""
    shown, value = Decimal(printed), Decimal(exact)
    if printed[0] not in "+-":
        value = abs(value)
    return abs(shown - value) <= Decimal(5).scaleb(shown.as_tuple().exponent - 1)


def _named(label, rows):
    """Returns the rows of a file that the first cell of a table's row names; all, if none is."""
    label = label.replace("*", "").replace("`", "").lower()
    return [row for row in rows if row[0].lower() in label] if label else []


def test_numbers_are_compared_as_they_are_printed():
    assert _numbers("+7.2, `--cut=3`, 1,310,720 and 2.6e-07") == ["+7.2", "1310720", "2.6e-07"]
    assert _stands_for("+7.2", "7.24") and not _stands_for("+7.2", "-7.2")
    assert _stands_for("7.2", "-7.24") and not _stands_for("7.2", "7.26")
    assert _stands_for("1e-06", "1e-06") and not _stands_for("1e-06", "2e-06")


@pytest.mark.parametrize(
    ("page", "file", "heading", "rows"),
    _TABLES,
    ids=[f"{page}-{file}" for page, file, *_ in _TABLES],
)
def test_every_number_of_a_result_table_was_measured(page, file, heading, rows):
    assert heading[0].startswith("|") and set(heading[1]) <= set("|-: "), f"no table in {page}"
    found = _read(file)[1][1:]
    label, missing = "", []
    for row in rows:
        label = row[0] or label
        known = [n for values in _named(label, found) or found for n in _numbers(" ".join(values))]
        for number in _numbers(" ".join(row)):
            if not any(_stands_for(number, exact) for exact in known):
                missing.append((label, number))
    assert not missing, f"{page}: not in benchmarks/results/{file}: {missing}"


def test_pages_with_measurements_name_their_files():
    assert {page for page, *_ in _TABLES} >= _MEASURED


@pytest.mark.parametrize("file", sorted(path.name for path in _RESULTS.glob("*.csv")))
def test_a_file_of_results_says_where_it_comes_from(file):
    comments, rows = _read(file)
    names = [line[2:].split(":")[0] for line in comments]
    assert names[: len(_HEADER)] == _HEADER
    assert len(rows) > 1 and {len(row) for row in rows} == {len(rows[0])}
    assert f"[{file}]({file})" in (_RESULTS / "README.md").read_text()


def test_gains_of_options_follow_from_the_table_of_trainings():
    with (_ROOT / "experiments" / "data" / "trade_off.csv").open() as lines:
        masked = {row["name"]: float(row["psnr_masked"]) for row in csv.DictReader(lines)}
    columns, *rows = _read("options_one_at_a_time.csv")[1]
    for row in (dict(zip(columns, row, strict=True)) for row in rows):
        one, other = (
            masked.get(f"{row['option']}={row[key].replace(',', '+')}", masked["base"])
            for key in ("value", "compared_with")
        )
        assert float(row["gain_masked"]) == pytest.approx(one - other, abs=0.006), row
