"""Runs sweeps: measures points one by one, and writes a table, a figure and a report."""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.cli.progress import ProgressBar
from experiments.runs import measured_runs
from experiments.runs.subprocesses import RunFailedError
from experiments.sweeps import report, table
from experiments.sweeps.options import OF_EVALUATION
from experiments.sweeps.points import BASE, Point
from experiments.sweeps.table import Row
from refref_jax.data import scene_names

Measure = Callable[[Point], Row]
"""Trains and evaluates a point, or raises `RunFailedError`."""

# An evaluation has more columns than the table.
_COLUMNS = {field.name for field in dataclasses.fields(Row)}


def sweep(
    points: Sequence[Point], out: Path, measure_: Measure, earlier: Sequence[Row] = ()
) -> dict[str, str]:
    """Measures points, and writes table, figure and report after each.

    Args:
      points: points to measure, the base first.
      out: output folder.
      measure_: function that measures one point.
      earlier: existing rows of the table; see `earlier_rows`.

    Returns:
      Error messages of failed points, by name; the sweep continues without them.

    Raises:
      ValueError: if the base point failed: all others are compared with it.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = {row.name: row for row in earlier}
    failed: dict[str, str] = {}
    with ProgressBar("trade-off", len(points)) as bar:
        for done, point in enumerate(points, 1):
            try:
                row = measure_(point)
            except RunFailedError as error:
                if point.name == BASE:
                    raise ValueError(
                        f"The base point failed: {error}. Fix this error, or give another --base."
                    ) from error
                failed[point.name] = str(error)
                bar.show(done, f"{point.name} failed")
                continue
            rows[row.name] = row
            _write(out, list(rows.values()))
            bar.show(done, f"{point.name}: {row.quality:.2f} dB")
    return failed


def earlier_rows(out: Path, base: Point, scene: Path, *, images: int) -> list[Row]:
    """Returns the rows that earlier sweeps around the same base have written to a folder.

    Args:
      out: folder of the sweeps.
      base: the base point.
      scene: folder of the scene.
      images: number of images that an evaluation renders.

    Raises:
      ValueError: if they had another base, scene or number of images.
    """
    path = out / "trade_off.csv"
    if not path.exists():
        return []
    rows = table.read(path)
    found, new = table.base_of(rows), (" ".join(base.training), " ".join(base.evaluation))
    if (found.scene, found.training, found.evaluation) != (scene_names.of_folder(scene), *new):
        raise ValueError(
            f"{path} has another base: {found.scene}, {found.training}. Give another --out."
        )
    if not (out / "runs" / run_name(base, scene)).is_dir():
        raise ValueError(f"{path} is of another folder named {found.scene}. Give another --out.")
    if found.images != images:
        raise ValueError(
            f"{path} was measured on {found.images} images, and this sweep would be on {images}. "
            f"Give --limit={found.images}, or another --out."
        )
    return rows


def measure(point: Point, scene: Path, runs: Path, limit: Sequence[str] = ()) -> Row:
    """Trains and evaluates a point, or reads its earlier measurement.

    Points that differ only in evaluation share a training.

    Args:
      point: point to measure.
      scene: folder of the scene.
      runs: folder of the trainings.
      limit: options that select the images of the evaluation.
    """
    run = runs / run_name(point, scene)
    cost = measured_runs.train(run, scene=scene, options=point.training)
    gain = measured_runs.evaluate(run, scene=scene, options=(*point.evaluation, *limit))
    return Row(
        scene=scene_names.of_folder(scene),
        name=point.name,
        option=point.option,
        value=point.value,
        training=" ".join(point.training),
        evaluation=" ".join(point.evaluation),
        **vars(cost),
        **{name: value for name, value in vars(gain).items() if name in _COLUMNS},
    )


def run_name(point: Point, scene: Path) -> str:
    """Returns the name of a training's folder, unique for each scene and set of options."""
    text = " ".join((str(scene.resolve()), *point.training))
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    shared = not point.option or point.option in OF_EVALUATION
    return f"{BASE if shared else point.name}-{digest}"


def _write(out: Path, rows: Sequence[Row]) -> None:
    table.write(out / "trade_off.csv", rows)
    report.write_figure(out / "trade_off.png", rows)
    text = report.markdown(rows)
    (out / "trade_off.md").write_text(text, encoding="utf-8")
