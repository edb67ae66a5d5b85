"""Runs the parts of `accelerator_check`, and writes what they found."""

import functools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.accelerator import comparisons, speeds
from experiments.accelerator.measuring import Context, Row
from refref_jax import configuration

VERSION = 1
"""Version of `report.json`."""

_LONGEST_ERROR = 500

_HEADER = "| quantity | value | unit | verdict | limit or remark |\n|---|---|---|---|---|"

_LEGEND = """\
Verdicts: `ok` and `problem` compare a value with its limit; `failed` is an error, and the other
parts were run all the same; `-` is a value for which nothing is expected. Times are those of the
fastest of several calls; compiling is timed apart. Bytes are those that the compiler counts for
the program of this device: training steps count as one; on a CPU, the loops over
hash tables are left out.
"""


class Part(NamedTuple):
    """One part of the check.

    Attributes:
      name: heading of the part.
      rows: function that measures, and yields the lines of the report.
    """

    name: str
    rows: Callable[[Context], Iterator[Row]]


class Result(NamedTuple):
    """What a part found.

    Attributes:
      name: heading of the part.
      seconds: duration.
      rows: its lines.
    """

    name: str
    seconds: float
    rows: tuple[Row, ...]


_ONCE = (
    Part("Environment", speeds.environment),
    Part("Memory: bandwidth, gathers and scatter-adds", speeds.memory),
    Part("Single operations", comparisons.single_operations),
    Part("Closest hits", comparisons.hits),
    Part("Light paths", comparisons.paths),
    Part("Repeated training", comparisons.repeated_runs),
    Part("Gradients of one step", comparisons.gradients),
)
_OF_A_PRESET = {
    "set-up": speeds.setting_up,
    "tracing": speeds.tracing,
    "training steps": speeds.steps,
    "rendering": speeds.rendering,
}
_LAST = (Part("Backdrop", speeds.backdrop),)


def parts_of(presets: Sequence[str]) -> tuple[Part, ...]:
    """Returns all parts, those of programs for each preset."""
    by_preset = (
        Part(f"Preset {preset}: {name}", functools.partial(rows, preset=preset))
        for preset in presets
        for name, rows in _OF_A_PRESET.items()
    )
    return (*_ONCE, *by_preset, *_LAST)


def chosen(parts: Sequence[Part], headings: Sequence[str]) -> tuple[Part, ...]:
    """Returns the parts whose names begin with one of some headings; all parts if there are none.

    Raises:
      ValueError: if a heading begins no name.
    """
    for heading in headings:
        if not heading or not any(part.name.lower().startswith(heading.lower()) for part in parts):
            names = ", ".join(part.name for part in parts)
            raise ValueError(f"--parts: no part begins with {heading!r}. There are: {names}.")
    begins = tuple(heading.lower() for heading in headings)
    return tuple(part for part in parts if not begins or part.name.lower().startswith(begins))


def run_part(part: Part, context: Context) -> Result:
    """Runs a part; an error becomes its last line."""
    begun, rows = time.perf_counter(), []
    try:
        rows.extend(part.rows(context))
    except Exception as error:  # out of memory, or not compiled: the other parts are still of use
        text = " ".join(f"{type(error).__name__}: {error}".split())
        rows.append(Row("error", text[:_LONGEST_ERROR], "", "failed"))
    return Result(part.name, time.perf_counter() - begun, tuple(rows))


def describe(context: Context) -> str:
    """Returns what was compared with what."""
    if context.compares:
        name = f"{context.device.device_kind} ({context.device.platform})"
        return f"{name}, compared with the CPU of the same machine"
    return "no accelerator found: compared the CPU with itself"


def in_words(result: Result) -> str:
    """Returns the lines of a part as text, with verdicts where there are any, and its duration."""
    lines = [f"  {row.name}: {_value(row)}" + _verdict(row) for row in result.rows]
    return "\n".join([*lines, f"  in {result.seconds:.0f} s"])


def _verdict(row: Row) -> str:
    if row.verdict == "-":
        return ""
    return f"  {row.verdict}" + f" ({row.note})" * bool(row.note)


def with_verdict(results: Sequence[Result], *verdicts: str) -> list[str]:
    """Returns the lines with one of some verdicts, in words."""
    return [
        f"{each.verdict}: {result.name}: {each.name}: {_value(each)}"
        for result in results
        for each in result.rows
        if each.verdict in verdicts
    ]


def summary(results: Sequence[Result]) -> str:
    """Returns the numbers of lines by verdict."""
    ok, problems, failed = (len(with_verdict(results, x)) for x in ("ok", "problem", "failed"))
    return f"{ok} ok, {problems} {'problem' if problems == 1 else 'problems'}, {failed} failed"


def write(folder: Path, context: Context, results: Sequence[Result], *, parts: int) -> None:
    """Writes `report.md` and `report.json` into a folder.

    Args:
      folder: folder to write to.
      context: what was checked.
      results: results of the parts that ran.
      parts: number of parts that there are.
    """
    bad = with_verdict(results, "problem", "failed")
    told, taken = describe(context), sum(result.seconds for result in results)
    lines = ["# Accelerator check", "", f"{told[:1].upper()}{told[1:]}.", ""]
    ran = "all parts" if len(results) == parts else f"{len(results)} of {parts} parts"
    lines += [f"In {taken:.0f} s, {ran}: {summary(results)}.", ""]
    lines += [f"- {line}" for line in bad] + [""] * bool(bad) + [_LEGEND]
    for result in results:
        lines += [f"## {result.name}", "", _HEADER]
        lines += [_line(row) for row in result.rows]
        lines.append("")
    (folder / "report.md").write_text("\n".join(lines), encoding="utf-8")
    content = {
        "version": VERSION,
        "compared": describe(context),
        "complete": len(results) == parts,
        "parts": [
            result._asdict() | {"rows": [row._asdict() for row in result.rows]}
            for result in results
        ],
    }
    text = json.dumps(configuration.string_safe(content), indent=2, allow_nan=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")


def _line(row: Row) -> str:
    cells = (row.name, _value(row, unit=False), row.unit, row.verdict, row.note)
    return f"| {' | '.join(each.replace('|', '/') for each in cells)} |"


def _value(row: Row, *, unit: bool = True) -> str:
    """Returns a value in words: numbers with four digits, whole ones as they are."""
    if isinstance(row.value, str):
        return row.value
    text = f"{row.value:,}" if isinstance(row.value, int) else f"{row.value:.4g}"
    return f"{text} {row.unit}".rstrip() if unit else text
