"""Reports a sweep: a Markdown file with tables of all points, and a figure of PSNR over time."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.figures.style import COLOURS, LABEL_HEIGHT, label_plainly, pyplot, style
from experiments.sweeps import table
from experiments.sweeps.options import OF_EVALUATION
from experiments.sweeps.table import NOISE, Row, Turn

_HEAD = (
    "| | point | ms a step | rays/s | training, s | host MiB | device MiB | PSNR in mask | PSNR "
    "| SSIM | distance error | s an image |"
)

_FRONT = "#999999"
_MARKERS = "osD^vP"

# Points this many decibels below the best are drawn at the bottom, labelled with their PSNR: they
# would compress the scale of all others.
_DEPTH = 10.0

# Width of a letter of a label, in pixels of the figure.
_LETTER_WIDTH = 6.5


class _Panel(NamedTuple):
    """One plot of a figure: the label and value of the cost, then those of the quality."""

    cost_label: str
    cost: Callable[[Row], float]
    label: str
    quality: Callable[[Row], float]


def markdown(rows: Sequence[Row]) -> str:
    """Returns the text of a report on a sweep; its figure must be in the same folder."""
    base = table.base_of(rows)
    found = table.turns(rows)
    training = "Training is the time of all steps, compiling excluded"
    if base.has_backdrop:
        training = (
            "Its backdrop is fitted to one traced ray per pixel, and a step is an iteration of its "
            "solver. Training is the time of tracing, compiling and all iterations; of a field, "
            "that of all steps, compiling excluded"
        )
    parts = [
        f"# Trade-off between speed and accuracy on {base.scene}",
        f"Base: `{base.training}`{base.evaluation and f', evaluated with `{base.evaluation}`'}. "
        "Every other point changes one option of it, and is trained from the same seed. Errors are "
        f"means over {base.images} test images. {training}; device memory is empty where there is "
        "no accelerator.",
        "![PSNR against time](trade_off.png)",
        f"## Options to change first\n\n{_first_table(table.worth_turning(found))}",
        f"## Options that save time\n\n{_saving_table(table.worth_saving(found))}",
        "## All points\n\nCheapest first; ● marks those that no other point beats in both training "
        f"time and PSNR. Differences below {NOISE:g} dB are noise.\n\n{_all_points(rows)}",
    ]
    return "\n\n".join(parts) + "\n"


def _all_points(rows: Sequence[Row]) -> str:
    front = {row.name for row in table.pareto(rows, lambda row: row.stepping)}
    lines = [_HEAD, "|---" * 12 + "|"]
    for row in sorted(rows, key=lambda row: (row.stepping, row.name)):
        cells = [
            "●" if row.name in front else "",
            row.name,
            f"{1e3 * row.seconds_per_step:.1f}",
            _or_dash(row.rays_per_second, ".0f"),
            f"{row.stepping:.0f}",
            _or_dash(row.peak_host_mib, ".0f"),
            _or_dash(row.peak_device_mib, ".0f"),
            _or_dash(row.psnr_masked, ".2f"),
            f"{row.psnr:.2f}",
            f"{row.ssim:.3f}",
            _or_dash(row.distance_mae, ".3f"),
            f"{row.seconds_per_image:.2f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _first_table(found: Sequence[Turn]) -> str:
    if not found:
        return f"No option gains more than {NOISE:g} dB."
    lines = ["| option | gain, dB | more time | dB for each percent |", "|---|---|---|---|"]
    for turn in found:
        rate = "free" if table.is_free(turn) else f"{turn.gain / turn.percent:.3f}"
        lines.append(f"| `--{_option(turn)}` | {turn.gain:+.2f} | {_time(turn)} | {rate} |")
    return "\n".join(lines)


def _saving_table(found: Sequence[Turn]) -> str:
    if not found:
        return "No option saves time."
    lines = ["| option | time | gain, dB |", "|---|---|---|"]
    lines += [f"| `--{_option(turn)}` | {_time(turn)} | {turn.gain:+.2f} |" for turn in found]
    return "\n".join(lines)


def _option(turn: Turn) -> str:
    return f"{turn.row.option}={turn.row.value}"


def _time(turn: Turn) -> str:
    of_evaluation = " of evaluation" if turn.row.option in OF_EVALUATION else ""
    return f"{turn.percent:+.0f} %{of_evaluation}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def write_figure(path: Path, rows: Sequence[Row]) -> None:
    """Draws the points of a sweep: masked PSNR over the time of a step and of all steps.

    If the base has a backdrop, curves show masked PSNR and PSNR over the time of training, and
    masked PSNR over that of rendering an image.

    Args:
      path: output file.
      rows: rows of one scene, with the base.
    """
    options = list(dict.fromkeys(row.option for row in rows))
    styles = {
        option: (COLOURS[i % len(COLOURS)], _MARKERS[i // len(COLOURS) % len(_MARKERS)])
        for i, option in enumerate(options)
    }
    panels = _panels(rows)
    figure, axes = pyplot.subplots(
        1, len(panels), figsize=(7.0 * len(panels), 6.4), layout="constrained", squeeze=False
    )
    for i, (axis, panel) in enumerate(zip(axes[0], panels, strict=True)):
        _draw(axis, rows, panel, styles)
        if i and panel.label == panels[0].label:
            axis.sharey(axes[0, 0])
            axis.tick_params(labelleft=False)
        else:
            axis.set_ylabel(panel.label)
    figure.suptitle(f"{rows[0].scene}: one option changed at a time")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False)
    figure.canvas.draw()  # places the axes, so that labels know where they are
    for axis, panel in zip(axes[0], panels, strict=True):
        _label_points(axis, rows, panel, styles)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def _panels(rows: Sequence[Row]) -> list[_Panel]:
    masked = all(row.psnr_masked is not None for row in rows)
    label = "masked PSNR, dB" if masked else "PSNR, dB"

    def quality(row: Row) -> float:
        return row.quality

    if not table.base_of(rows).has_backdrop:
        return [
            _Panel("time of a step, ms", lambda row: 1e3 * row.seconds_per_step, label, quality),
            _Panel("time of all steps, s", lambda row: row.stepping, label, quality),
        ]
    training, rendering = "time of training, s", "time of rendering an image, s"
    whole = _Panel(training, lambda row: row.stepping, "PSNR, dB", lambda row: row.psnr)
    return [
        _Panel(training, lambda row: row.stepping, label, quality),
        *([whole] if masked else []),
        _Panel(rendering, lambda row: row.seconds_per_image, label, quality),
    ]


def _draw(
    axis: pyplot.Axes, rows: Sequence[Row], panel: _Panel, styles: dict[str, tuple[str, str]]
) -> None:
    foot, base = _foot(rows, panel), table.base_of(rows)
    front = table.pareto(rows, panel.cost, panel.quality)
    axis.step(
        [panel.cost(row) for row in front],
        [max(panel.quality(row), foot) for row in front],
        color=_FRONT,
        linewidth=1.5,
        where="post",
        label="none better",
    )
    for option, (colour, marker) in styles.items():
        own = [row for row in rows if row.option == option]
        if base.has_backdrop and option:
            curve = sorted([base, *own], key=lambda row: (panel.cost(row), panel.quality(row)))
            axis.plot(
                [panel.cost(row) for row in curve],
                [max(panel.quality(row), foot) for row in curve],
                color=colour,
                linewidth=0.8,
            )
        axis.plot(
            [panel.cost(row) for row in own],
            [max(panel.quality(row), foot) for row in own],
            marker,
            color=colour,
            markersize=9 if not option else 6,
            label=option or "base",
        )
    axis.set_xscale("log")
    axis.set_xlabel(panel.cost_label)
    style(axis)
    label_plainly(axis.xaxis)


def _foot(rows: Sequence[Row], panel: _Panel) -> float:
    return max(panel.quality(row) for row in rows) - _DEPTH


def _label_points(
    axis: pyplot.Axes, rows: Sequence[Row], panel: _Panel, styles: dict[str, tuple[str, str]]
) -> None:
    """Labels the points with their values, the Pareto front first; omits overlapping labels."""
    foot = _foot(rows, panel)
    front = table.pareto(rows, panel.cost, panel.quality)
    taken: list[tuple[float, float, float]] = []
    named_first = [table.base_of(rows), *front]
    for row in [*named_first, *(row for row in rows if row not in named_first)]:
        quality = panel.quality(row)
        name = (row.value or row.name) + f" ({quality:.1f} dB)" * (quality < foot)
        point = (panel.cost(row), max(quality, foot))
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
            color=styles[row.option][0],
        )
