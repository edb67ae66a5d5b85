"""The measured trade in words: a Markdown file, with tables of all points and of what to turn."""

from collections.abc import Sequence

from experiments.sweeps import table as trade_table
from experiments.sweeps.points import OF_EVALUATION
from experiments.sweeps.table import NOISE, Row, Turn

_HEAD = (
    "| | point | ms a step | rays/s | training, s | host MiB | device MiB | PSNR in mask | PSNR "
    "| SSIM | distance error | s an image |"
)


def markdown(rows: Sequence[Row]) -> str:
    """Returns the text of a report on a sweep; its figure is expected beside it."""
    base = trade_table.base_of(rows)
    found = trade_table.turns(rows)
    parts = [
        f"# The trade of speed for accuracy on {base.scene}",
        f"Base: `{base.training}`{base.evaluation and f', evaluated with `{base.evaluation}`'}. "
        "Every other point changes one option of it, and is trained from the same seed. Errors are "
        f"means over {base.images} test images. Training is the time of all steps, compiling "
        "excluded; device memory is empty where there is no accelerator.",
        "![PSNR against time](trade_off.png)",
        f"## What to turn first\n\n{_first_table(trade_table.worth_turning(found))}",
        f"## What saves time\n\n{_saving_table(trade_table.worth_saving(found))}",
        "## All points\n\nCheapest first; ● marks those that no other point beats in both training "
        f"time and PSNR. Differences below {NOISE:g} dB are noise.\n\n{_all_points(rows)}",
    ]
    return "\n\n".join(parts) + "\n"


def _all_points(rows: Sequence[Row]) -> str:
    front = {row.name for row in trade_table.pareto(rows, lambda row: row.stepping)}
    lines = [_HEAD, "|---" * 12 + "|"]
    for row in sorted(rows, key=lambda row: (row.stepping, row.name)):
        cells = [
            "●" if row.name in front else "",
            row.name,
            f"{1e3 * row.seconds_per_step:.1f}",
            f"{row.rays_per_second:.0f}",
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
        rate = "free" if trade_table.is_free(turn) else f"{turn.gain / turn.percent:.3f}"
        lines.append(f"| `--{_option(turn)}` | {turn.gain:+.2f} | {_time(turn)} | {rate} |")
    return "\n".join(lines)


def _saving_table(found: Sequence[Turn]) -> str:
    if not found:
        return "No option saves time."
    lines = ["| option | time | gain, dB |", "|---|---|---|"]
    lines += [f"| `--{_option(turn)}` | {_time(turn)} | {turn.gain:+.2f} |" for turn in found]
    return "\n".join(lines)


def _option(turn: Turn) -> str:
    return f"{turn.row.knob}={turn.row.value}"


def _time(turn: Turn) -> str:
    of_evaluation = " of evaluation" if turn.row.knob in OF_EVALUATION else ""
    return f"{turn.percent:+.0f} %{of_evaluation}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
