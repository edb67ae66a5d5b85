"""The speed-accuracy curve of light paths: measured on scenes, as a table and as figures."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.lines import Line2D

from experiments.figures.style import COLOURS, LABEL_HEIGHT, label_plainly, pyplot, style
from experiments.runs import known_scene
from experiments.runs.known_scene import KnownScene
from refref_jax.optics.path_settings import PathSettings
from refref_jax.training import evaluation

_MARKERS = {"straight": "s", "paper": "D"}
_GREY = "#777777"

_LABEL_WIDTH = 34.0

_SWEEPS = {
    "min_throughput": "throughput threshold",
    "max_bends": "maximum bends of a path",
}
_COSTS = {
    "casts_per_pixel": ("ray casts per pixel", 1.0),
    "seconds_per_pixel": ("time per pixel, µs", 1e6),
}


class Setting(NamedTuple):
    """One setting of a sweep over path settings.

    Attributes:
      sweep: varied option, `min_throughput` or `max_bends`; `settings` for a single preset.
      name: label in figures.
      settings: path settings.
    """

    sweep: str
    name: str
    settings: PathSettings


class Trial(NamedTuple):
    """Cost and quality of one setting on one scene: means over its views, one ray per pixel.

    Attributes:
      scene: name of the scene.
      sweep: varied option: `min_throughput`, `max_bends`, or `settings` for a single preset.
      name: value of that option, or name of the preset.
      min_throughput: throughput threshold.
      max_bends: max bends.
      psnr: PSNR over the image, dB.
      psnr_masked: masked PSNR, dB.
      psnr_outside: PSNR outside the mask, dB.
      casts_per_pixel: closest-hit queries per pixel.
      paths_per_pixel: light paths per pixel.
      seconds_per_pixel: rendering time per pixel, seconds.
      dropped: share of the throughput that was dropped because the path buffer was full.
    """

    scene: str
    sweep: str
    name: str
    min_throughput: float
    max_bends: int
    psnr: float | None
    psnr_masked: float
    psnr_outside: float | None
    casts_per_pixel: float
    paths_per_pixel: float
    seconds_per_pixel: float
    dropped: float


def measure_all(chosen: list[KnownScene], plan: list[Setting], side: int) -> Iterator[Trial]:
    """Renders every scene with every setting; equal path settings are rendered once."""
    for scene in chosen:
        known: dict[PathSettings, Trial] = {}
        for setting in plan:
            if setting.settings not in known:
                known[setting.settings] = measure_one(scene, setting, side)
            yield known[setting.settings]._replace(sweep=setting.sweep, name=setting.name)


def measure_one(scene: KnownScene, setting: Setting, side: int) -> Trial:
    """Renders all views of a scene with one setting."""
    known_scene.warm_up(scene, setting.settings)
    views, measured = [], []
    for i in range(len(scene.indices)):
        view = known_scene.render_view(scene, i, settings=setting.settings, side=side)
        views.append(view)
        measured.append(known_scene.measure(scene, i, view.rgb))
    pixels = scene.frames.cameras.height * scene.frames.cameras.width * side**2
    return Trial(
        scene=scene.name,
        sweep=setting.sweep,
        name=setting.name,
        min_throughput=setting.settings.min_throughput,
        max_bends=setting.settings.max_bends,
        psnr=evaluation.mean_of(measured, "psnr"),
        psnr_masked=evaluation.mean_of(measured, "psnr_masked"),
        psnr_outside=evaluation.mean_of(measured, "psnr_outside"),
        casts_per_pixel=float(np.mean([view.casts for view in views])),
        paths_per_pixel=float(np.mean([view.paths for view in views])),
        seconds_per_pixel=sum(view.seconds for view in views) / (pixels * len(views)),
        dropped=float(np.mean([view.dropped for view in views])),
    )


def write_table(path: Path, trials: Sequence[Trial]) -> None:
    """Writes a CSV, one row per trial."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Trial._fields)
        writer.writerows(trials)


def write_figures(folder: Path, trials: Sequence[Trial]) -> list[Path]:
    """Draws each sweep against casts and against time, one line per scene.

    Args:
      folder: output folder.
      trials: trials of all scenes.

    Returns:
      The files; none for a sweep without trials.
    """
    made = {trial.sweep for trial in trials}
    return [_write_sweep(folder, trials, sweep) for sweep in _SWEEPS if sweep in made]


def _write_sweep(folder: Path, trials: Sequence[Trial], sweep: str) -> Path:
    scenes = list(dict.fromkeys(trial.scene for trial in trials))
    colours = {scene: COLOURS[i % len(COLOURS)] for i, scene in enumerate(scenes)}
    figure, axes = pyplot.subplots(1, 2, figsize=(12.0, 5.4), sharey=True, layout="constrained")
    for axis, (cost, (label, scale)) in zip(axes, _COSTS.items(), strict=True):
        for scene in scenes:
            own = [trial for trial in trials if trial.scene == scene]
            _draw_scene(axis, own, sweep, cost, scale, colours[scene])
        axis.set_xlabel(f"{label} (one camera ray)")
        axis.set_xscale("log" if cost == "seconds_per_pixel" else "linear")
        if cost == "seconds_per_pixel":
            label_plainly(axis.xaxis)
        style(axis)
    axes[0].set_ylabel("masked PSNR, dB")
    fixed = _fixed(trials, sweep)
    figure.suptitle(f"{_SWEEPS[sweep]}, as labelled{fixed}", fontsize=12)
    figure.legend(
        handles=_legend(colours), loc="outside lower center", ncols=len(scenes) + 2, frameon=False
    )
    path = folder / f"path_trade_off_{sweep}.png"
    figure.canvas.draw()  # places the axes, so that labels know where they are
    for axis, (cost, (_, scale)) in zip(axes, _COSTS.items(), strict=True):
        swept = [trial for trial in trials if trial.sweep == sweep]
        _label_points(axis, swept, cost, scale, colours)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
    return path


def _draw_scene(
    axis: pyplot.Axes, trials: Sequence[Trial], sweep: str, cost: str, scale: float, colour: str
) -> None:
    line = [trial for trial in trials if trial.sweep == sweep]
    x = [scale * getattr(trial, cost) for trial in line]
    y = [trial.psnr_masked for trial in line]
    axis.plot(x, y, "-o", color=colour, markersize=4.5, linewidth=1.8, zorder=3)
    for trial in trials:
        if trial.sweep == "settings":
            axis.plot(
                scale * getattr(trial, cost),
                trial.psnr_masked,
                _MARKERS[trial.name],
                color=colour,
                markerfacecolor="white",
                markeredgewidth=1.8,
                markersize=7,
                zorder=4,
            )


def _label_points(
    axis: pyplot.Axes, trials: Sequence[Trial], cost: str, scale: float, colours: dict[str, str]
) -> None:
    """Labels points with the option's value, except where labels would overlap."""
    taken: list[tuple[float, float]] = []
    # Ends of lines come first: intermediate values can be guessed.
    lines = [[trial for trial in trials if trial.scene == scene] for scene in colours]
    ends = [trial for line in lines for trial in (line[0], line[-1])]
    for trial in ends + [trial for line in lines for trial in line[1:-1]]:
        point = (scale * getattr(trial, cost), trial.psnr_masked)
        x, y = axis.transData.transform(point)
        if any(abs(x - a) < _LABEL_WIDTH and abs(y - b) < LABEL_HEIGHT for a, b in taken):
            continue
        taken.append((x, y))
        axis.annotate(
            trial.name,
            point,
            xytext=(6, -9),
            textcoords="offset points",
            fontsize=8,
            color=colours[trial.scene],
            path_effects=[patheffects.withStroke(linewidth=1.5, foreground="white")],
            zorder=5,
        )


def _fixed(trials: Sequence[Trial], sweep: str) -> str:
    """Returns the value that is constant over all trials of a sweep, as text."""
    other = "max_bends" if sweep == "min_throughput" else "min_throughput"
    values = {getattr(trial, other) for trial in trials if trial.sweep == sweep}
    return f"; {other} {values.pop():g}" if len(values) == 1 else ""


def _legend(colours: dict[str, str]) -> list[Line2D]:
    scenes = [Line2D([], [], color=c, marker="o", label=scene) for scene, c in colours.items()]
    points = [
        Line2D([], [], color=_GREY, marker=m, markerfacecolor="white", linestyle="", label=name)
        for name, m in _MARKERS.items()
    ]
    return scenes + points
