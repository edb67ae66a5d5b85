"""The figure of a sweep: PSNR against time, the points named, and the front that none beats."""

from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.figures.style import COLOURS, LABEL_HEIGHT, label_plainly, pyplot, style
from experiments.sweeps import table as trade_table
from experiments.sweeps.table import Row

_COSTS: dict[str, Callable[[Row], float]] = {
    "time of a step, ms": lambda row: 1e3 * row.seconds_per_step,
    "time of all steps, s": lambda row: row.stepping,
}

_FRONT = "#999999"
_MARKERS = "osD^vP"

# Decibels below the best beyond which a point stands at the figure's foot, with its number: it
# would press all others together.
_DEPTH = 10.0

# Of a letter of a label, in pixels of the figure.
_LETTER_WIDTH = 6.5


def write(path: Path, rows: Sequence[Row]) -> None:
    """Draws the points of a sweep against both costs.

    Args:
      path: of the picture.
      rows: of one scene, with the base.
    """
    knobs = list(dict.fromkeys(row.knob for row in rows))
    styles = {
        knob: (COLOURS[i % len(COLOURS)], _MARKERS[i // len(COLOURS) % len(_MARKERS)])
        for i, knob in enumerate(knobs)
    }
    foot = max(row.quality for row in rows) - _DEPTH
    figure, axes = pyplot.subplots(1, 2, figsize=(14.0, 6.4), sharey=True, layout="constrained")
    for axis, (label, cost) in zip(axes, _COSTS.items(), strict=True):
        _draw(axis, rows, label, cost, styles, foot)
    masked = all(row.psnr_masked is not None for row in rows)
    axes[0].set_ylabel("PSNR inside the mask, dB" if masked else "PSNR, dB")
    figure.suptitle(f"{rows[0].scene}: one option changed at a time")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False)
    figure.canvas.draw()  # places the axes, so that labels know where they are
    for axis, cost in zip(axes, _COSTS.values(), strict=True):
        _label_points(axis, rows, cost, styles, foot)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def _draw(
    axis: pyplot.Axes,
    rows: Sequence[Row],
    label: str,
    cost: Callable[[Row], float],
    styles: dict[str, tuple[str, str]],
    foot: float,
) -> None:
    front = trade_table.pareto(rows, cost)
    axis.step(
        [cost(row) for row in front],
        [max(row.quality, foot) for row in front],
        color=_FRONT,
        linewidth=1.5,
        where="post",
        label="none better",
    )
    for knob, (colour, marker) in styles.items():
        own = [row for row in rows if row.knob == knob]
        axis.plot(
            [cost(row) for row in own],
            [max(row.quality, foot) for row in own],
            marker,
            color=colour,
            markersize=9 if not knob else 6,
            label=knob or "base",
        )
    axis.set_xscale("log")
    axis.set_xlabel(label)
    style(axis)
    label_plainly(axis.xaxis)


def _label_points(
    axis: pyplot.Axes,
    rows: Sequence[Row],
    cost: Callable[[Row], float],
    styles: dict[str, tuple[str, str]],
    foot: float,
) -> None:
    """Names the points by their values, those of the front first; none where another name is."""
    front = trade_table.pareto(rows, cost)
    taken: list[tuple[float, float, float]] = []
    named_first = [trade_table.base_of(rows), *front]
    for row in [*named_first, *(row for row in rows if row not in named_first)]:
        name = (row.value or row.name) + f" ({row.quality:.1f} dB)" * (row.quality < foot)
        point = (cost(row), max(row.quality, foot))
        x, y = axis.transData.transform(point)
        width = _LETTER_WIDTH * len(name)
        if any(
            abs(y - b) < LABEL_HEIGHT and x < a + other and a < x + width for a, b, other in taken
        ):
            continue
        taken.append((x, y, width))
        axis.annotate(
            name,
            point,
            xytext=(6, -9),
            textcoords="offset points",
            fontsize=8,
            color=styles[row.knob][0],
        )
