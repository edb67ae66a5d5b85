"""Writes what a benchmark has come to so far, from its results alone; each file all or nothing.

{out}/summary.md                         all tables, what failed and what was left out
{out}/tables/{table}.{md,csv,json,tex}   each table
{out}/tables/scenes.csv                  all metrics of each scene and method
{out}/results.json                       what a report needs, see docs/benchmark.md
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments import commands
from experiments.benchmarking import (
    ablations,
    comparisons,
    jobs,
    records,
    settings,
    table_data,
    table_text,
)
from experiments.benchmarking.jobs import Skipped
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.records import Record
from experiments.benchmarking.settings import Benchmark
from experiments.benchmarking.tables import Table
from experiments.r3f import stages
from refref_jax.training import run_folder

FILE, RESULTS, TABLES = "summary.md", "results.json", "tables"

# Points of a curve of training: as many as a figure shows.
_MOST_POINTS = 200


def write(
    out: Path,
    benchmark: Benchmark,
    *,
    failed: Mapping[str, str],
    skipped: Sequence[Skipped],
) -> None:
    """Writes all tables and the results.

    Args:
      out: folder of the benchmark.
      benchmark: what it was begun with.
      failed: why jobs failed, by name, as `scene/method`.
      skipped: what was left out.

    Raises:
      ValueError: if a result is broken, or of other settings.
    """
    everything = records.read_all(out, benchmark.settings)
    found = records.compared(everything)
    made = all_tables(found)
    (out / TABLES).mkdir(exist_ok=True)
    for table in made:
        path = out / TABLES / table.name
        _write_text(path.with_suffix(".md"), table_text.markdown(table))
        _write_text(path.with_suffix(".tex"), table_text.latex(table))
        _write_text(path.with_suffix(".csv"), table_data.as_csv(table))
        settings.write_json(path.with_suffix(".json"), table_data.as_json(table))
    _write_text(out / TABLES / "scenes.csv", table_data.scenes_csv(found))
    _write_text(out / FILE, _summary(benchmark, found, made, failed, skipped))
    index = {
        "settings": dataclasses.asdict(benchmark.settings),
        "methods": {
            name: {"label": METHODS[name].label, "group": METHODS[name].group}
            for name in METHODS
            if name in benchmark.methods or any(name == record.method for record in found)
        },
        "jobs": [_indexed(out, record) for record in everything],
        "failed": dict(failed),
        "skipped": [each._asdict() for each in skipped],
        "tables": {table.name: table_data.as_json(table) for table in made},
    }
    settings.write_json(out / RESULTS, commands.string_safe(index))


def not_done(out: Path) -> tuple[dict[str, str], list[Skipped]]:
    """Returns what failed and what was left out when the results were last written.

    What has a result since is in neither. Nothing is told where no results were written, or where
    they can not be read.
    """
    try:
        index = json.loads((out / RESULTS).read_text("utf-8"))
        skipped = [Skipped(**each) for each in index["skipped"]]
        failed = dict(index["failed"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}, []

    def is_done(name: str) -> bool:
        return (out / jobs.FOLDER / name / jobs.RESULT).is_file()

    return (
        {name: reason for name, reason in failed.items() if not is_done(name)},
        [each for each in skipped if not is_done(f"{each.scene}/{each.method}")],
    )


def all_tables(found: Sequence[Record]) -> list[Table]:
    """Returns all tables of some results."""
    return [
        comparisons.main_table(found),
        comparisons.top_views_table(found),
        ablations.ablation_table(found),
    ]


def _summary(
    benchmark: Benchmark,
    found: Sequence[Record],
    made: Sequence[Table],
    failed: Mapping[str, str],
    skipped: Sequence[Skipped],
) -> str:
    common = benchmark.settings
    images = "all test images" if common.limit is None else f"at most {common.limit} test images"
    lines = [
        "# Benchmark",
        "",
        f"Results: {len(found)}, scenes: {len({record.scene for record in found})}. Preset "
        f"`{common.preset}`, steps: {common.steps}, seed: {common.seed}; {images} a scene, rays in "
        f"a pixel: {common.rays_per_pixel}.",
        "",
    ]
    if failed:
        lines += ["Failed:", "", *(f"- {name}: {why}" for name, why in failed.items()), ""]
    if skipped:
        lines += ["Left out:", ""]
        lines += [f"- {each.scene}/{each.method}: {each.reason}" for each in skipped] + [""]
    return "\n".join([*lines, *map(table_text.markdown, made)])


def _indexed(out: Path, record: Record) -> dict[str, Any]:
    """Returns a result with the paths of its pictures from `out`, and its curve of training."""
    folder = Path(jobs.FOLDER) / record.scene / record.method
    views = [
        {**view, "rgb": str(folder / view["rgb"]), "distance": str(folder / view["distance"])}
        for view in record.views
    ]
    return {
        **record._asdict(),
        "folder": str(folder),
        "views": views,
        "curve": _curve(out / folder / "run"),
    }


def _curve(run: Path) -> list[dict[str, Any]]:
    """Returns the metrics of a training, thinned to what a figure shows; the last stays."""
    lines = commands.from_string_safe(run_folder.read_metrics(run))
    stride = max(1, -(-len(lines) // _MOST_POINTS))
    thinned = lines[::-1][::stride][::-1]
    keys = ("step", "loss", "psnr", "seconds")
    return [{key: line[key] for key in keys if key in line} for line in thinned]


def _write_text(path: Path, text: str) -> None:
    with stages.unfinished_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
