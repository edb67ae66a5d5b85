"""Draws the training curves as inline SVG: PSNR over steps, and over seconds.

A method has the same line style in every chart, whatever else is measured.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from experiments.benchmarking.methods import FULL, METHODS
from experiments.benchmarking.report.data import Result
from experiments.benchmarking.report.markup import Html, join, tag
from experiments.figures.style import COLOURS

_DASHES = (None, "7 3", "2 3")

_MAIN = [method.name for method in METHODS.values() if method.group == "main"]

_WIDTH, _HEIGHT = 380.0, 230.0
_LEFT, _TOP, _BOTTOM = 34.0, 26.0, 36.0
_LETTER, _LINE = 6.6, 14.0
_LONGEST_NAME = 14
_TICKS = 5

Points = Sequence[tuple[float, float]]


class Line(NamedTuple):
    """Style of a line.

    Attributes:
      colour: index into `figures.style.COLOURS`.
      dash: SVG dash pattern; `None` for a solid line.
    """

    colour: int
    dash: str | None


def look(method: str) -> Line:
    """Returns the line style of a method.

    An ablation never has the colour of its reference method, and is dashed once the colours of its
    group are used up. Baselines are dashed, since the main methods, in the same charts, are not.
    External methods, which have no curves, share one style.
    """
    if method not in METHODS:
        return Line(len(COLOURS) - 1, _DASHES[-1])
    if method in _MAIN:
        return Line(_MAIN.index(method), None)
    group = METHODS[method].group
    place = [name for name in METHODS if METHODS[name].group == group].index(method)
    if group not in FULL:
        return Line(place % len(COLOURS), _DASHES[1 + place // len(COLOURS)])
    full = look(FULL[group])
    free = [i for i in range(len(COLOURS)) if i != full.colour]
    return Line(free[place % len(free)], _DASHES[place // len(free)])


def families(methods: Sequence[str]) -> list[list[str]]:
    """Groups methods by chart: those that are no ablations, and each kind of ablation.

    Args:
      methods: names of all methods, in order.
    """
    groups = {name: METHODS[name].group if name in METHODS else "main" for name in methods}
    found = [[name for name in methods if groups[name] not in FULL]]
    for kind, full in FULL.items():
        if kind in groups.values():
            found.append([name for name in methods if name == full or groups[name] == kind])
    return [names for names in found if names]


class Span(NamedTuple):
    """An axis: the mapping from a range of values to a range of the image, with its ticks."""

    low: float
    high: float
    start: float
    end: float
    ticks: tuple[float, ...]

    def place(self, value: float) -> float:
        """Returns the position of a value."""
        share = (value - self.low) / (self.high - self.low)
        return round(self.start + share * (self.end - self.start), 1)


def training_charts(results: Sequence[Result]) -> Html:
    """Returns charts of all trainings of a scene, a pair for each group of methods."""
    by_name = {result.record.method: result for result in results}
    pairs = []
    for names in families(list(by_name)):
        curves = {name: by_name[name].curve for name in names if len(by_name[name].curve) > 1}
        if curves:
            steps = {name: [(p.step, p.psnr) for p in curve] for name, curve in curves.items()}
            seconds = {name: [(p.seconds, p.psnr) for p in curve] for name, curve in curves.items()}
            charts = _chart(steps, "steps"), _chart(seconds, "seconds, compilation included; noisy")
            pairs.append(tag("div", legend(list(curves)), *charts, class_="charts"))
    if not pairs:
        return tag("p", "There are no training curves.", class_="note")
    return join(pairs)


def legend(methods: Sequence[str]) -> Html:
    """Returns a legend of the line styles of methods."""
    return tag("p", *(tag("span", swatch(name), " ", name) for name in methods), class_="legend")


def swatch(method: str) -> Html:
    """Returns a short sample of a method's line."""
    line = tag("line", x1="0", y1="5", x2="22", y2="5", **_look(method))
    return tag("svg", line, viewBox="0 0 22 10", width="22", height="10", aria_hidden="true")


def ticks(low: float, high: float) -> tuple[float, ...]:
    """Returns about five round numbers whose range contains the given one."""
    rough = max(high - low, 1e-6) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
    first, last = math.floor(low / step), math.ceil(high / step)
    return tuple(round(i * step, 10) for i in range(first, max(last, first + 1) + 1))


def _chart(curves: dict[str, Points], unit: str) -> Html:
    """Returns a chart of the finite values."""
    known = {
        name: [point for point in points if all(map(math.isfinite, point))]
        for name, points in curves.items()
    }
    known = {name: points for name, points in known.items() if points}
    longest = max((len(_short(name)) for name in known), default=0)
    right = _WIDTH - 10.0 - longest * _LETTER
    across = _span([x for points in known.values() for x, _ in points] + [0.0], _LEFT, right)
    up = _span([y for points in known.values() for _, y in points], _HEIGHT - _BOTTOM, _TOP)
    title = f"PSNR of the training rays in dB over {unit}, of {', '.join(known)}"
    drawn = [
        tag(
            "polyline",
            points=" ".join(f"{across.place(x):g},{up.place(y):g}" for x, y in points),
            **_look(name),
        )
        for name, points in known.items()
    ]
    last = {name: points[-1] for name, points in known.items()}
    ends = {name: (across.place(x), up.place(y)) for name, (x, y) in last.items()}
    return tag(
        "svg",
        _grid(across, up),
        *drawn,
        *_labels(ends),
        tag("text", "PSNR, dB", x=4.0, y=11.0),
        tag("text", unit, x=(across.start + across.end) / 2, y=_HEIGHT - 4.0, text_anchor="middle"),
        viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}",
        role="img",
        aria_label=title,
        class_="chart",
    )


def _span(values: Sequence[float], start: float, end: float) -> Span:
    marks = ticks(min(values, default=0.0), max(values, default=1.0))
    return Span(marks[0], marks[-1], start, end, marks)


def _grid(across: Span, up: Span) -> Html:
    """Returns grid lines at the ticks of both axes, with their numbers."""
    parts = []
    for value in up.ticks:
        y = up.place(value)
        parts.append(tag("line", x1=across.start, x2=across.end, y1=y, y2=y, class_="grid"))
        parts.append(tag("text", f"{value:g}", x=across.start - 5.0, y=y + 4.0, text_anchor="end"))
    for value in across.ticks:
        x = across.place(value)
        parts.append(tag("text", f"{value:g}", x=x, y=up.start + 16.0, text_anchor="middle"))
    return join(parts)


def _labels(ends: dict[str, tuple[float, float]]) -> list[Html]:
    """Returns the names of lines at their ends, moved apart where they would overlap."""
    heights, last = {}, -math.inf
    for name, (_, y) in sorted(ends.items(), key=lambda item: item[1][1]):
        heights[name] = last = max(y + 4.0, last + _LINE)
    above = max(0.0, last - (_HEIGHT - _BOTTOM))
    return [
        tag("text", _short(name), x=ends[name][0] + 5.0, y=round(y - above, 1), class_="name")
        for name, y in heights.items()
    ]


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"


def _look(method: str) -> dict[str, str | None]:
    line = look(method)
    colour = f"stroke:var(--c{line.colour})"
    return {"style": colour, "stroke_dasharray": line.dash, "class_": "curve"}
