"""Writes what a benchmark has come to so far, from its results alone; each file all or nothing.

{out}/summary.md                         all tables, what failed, what was left out, what has no
                                         result yet
{out}/tables/{table}.{md,csv,json,tex}   each table
{out}/tables/scenes.csv                  all metrics of each scene and method
{out}/results.json                       what a report needs, see docs/benchmark.md
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.benchmarking import jobs, paper_tables, results, settings, table_data, table_text
from experiments.benchmarking.jobs import Skipped
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.results import Record
from experiments.benchmarking.settings import Benchmark
from experiments.benchmarking.tables import Table
from experiments.cli import commands
from refref_jax import drafts
from refref_jax.training import run_folder

FILE, RESULTS, TABLES = "summary.md", "results.json", "tables"

# Points of a curve of training: as many as a figure shows.
_MOST_POINTS = 200

# Scenes without a result that summary.md names for each method; results.json has all.
_MOST_NAMES = 10


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
      ValueError: if a result is broken, or does not compare with the others.
    """
    everything = results.read_all(out, benchmark)
    found = results.compared(everything)
    made = all_tables(found)
    missing = _missing(out, benchmark, failed, skipped)
    _write_tables(out / TABLES, made, found)
    lines = [*_heading(benchmark, found), *_not_done(failed, skipped, missing)]
    _write_text(out / FILE, "\n".join([*lines, *map(table_text.markdown, made)]))
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
        "missing": [f"{scene}/{method}" for scene, method in missing],
        "tables": {table.name: table_data.as_json(table) for table in made},
    }
    settings.write_json(out / RESULTS, commands.string_safe(index))


def _write_tables(folder: Path, made: Sequence[Table], found: Sequence[Record]) -> None:
    folder.mkdir(exist_ok=True)
    for table in made:
        path = folder / table.name
        _write_text(path.with_suffix(".md"), table_text.markdown(table))
        _write_text(path.with_suffix(".tex"), table_text.latex(table))
        _write_text(path.with_suffix(".csv"), table_data.as_csv(table))
        settings.write_json(path.with_suffix(".json"), table_data.as_json(table))
    _write_text(folder / "scenes.csv", table_data.scenes_csv(found))


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

    return (
        {name: reason for name, reason in failed.items() if not _has_result(out, name)},
        [each for each in skipped if not _has_result(out, each.name)],
    )


def all_tables(found: Sequence[Record]) -> list[Table]:
    """Returns all tables of some results."""
    return [
        paper_tables.main_table(found),
        paper_tables.top_views_table(found),
        paper_tables.ablation_table(found),
    ]


def _has_result(out: Path, name: str) -> bool:
    return (out / jobs.FOLDER / name / jobs.RESULT).is_file()


def _missing(
    out: Path, benchmark: Benchmark, failed: Mapping[str, str], skipped: Sequence[Skipped]
) -> list[tuple[str, str]]:
    """Returns the scenes and methods of a benchmark that have no result, for no reason known."""
    told = {*failed, *(each.name for each in skipped)}
    return [
        (scene, method)
        for method in METHODS
        if method in benchmark.methods
        for scene in sorted(benchmark.scenes)
        if (name := f"{scene}/{method}") not in told and not _has_result(out, name)
    ]


def _heading(benchmark: Benchmark, found: Sequence[Record]) -> list[str]:
    common = benchmark.settings
    images = "all test images" if common.limit is None else f"at most {common.limit} test images"
    versions = sorted({tuple(sorted(record.versions.items())) for record in found})
    told = (", ".join(f"{name} {version}" for name, version in each) for each in versions)
    several = ["Measured by several versions, which may differ: " + "; ".join(told) + ".", ""]
    return [
        "# Benchmark",
        "",
        f"Results: {len(found)}, scenes: {len({record.scene for record in found})}. Preset "
        f"`{common.preset}`, steps: {common.steps}, seed: {common.seed}; {images} a scene, rays in "
        f"a pixel: {common.rays_per_pixel}.",
        "",
        *(several if len(versions) > 1 else ()),
    ]


def _not_done(
    failed: Mapping[str, str], skipped: Sequence[Skipped], missing: Sequence[tuple[str, str]]
) -> list[str]:
    without: dict[str, list[str]] = {}
    for scene, method in missing:
        without.setdefault(method, []).append(scene)
    parts = {
        "Failed:": [f"{name}: {reason}" for name, reason in failed.items()],
        "Left out:": [f"{each.name}: {each.reason}" for each in skipped],
        "No result yet, of the scenes and methods asked for:": [
            f"{method}, scenes: {len(scenes)}: {', '.join(scenes[:_MOST_NAMES])}"
            + (", ..." if len(scenes) > _MOST_NAMES else "")
            for method, scenes in without.items()
        ],
    }
    lines = []
    for title, items in parts.items():
        if items:
            lines += [title, "", *(f"- {table_text.in_markdown(item)}" for item in items), ""]
    return lines


def _indexed(out: Path, record: Record) -> dict[str, Any]:
    """Returns a result with the paths of its pictures from `out`, and its curve of training."""
    folder = Path(jobs.FOLDER) / record.scene / record.method
    views = [
        view._replace(rgb=str(folder / view.rgb), distance=str(folder / view.distance))
        for view in record.views
    ]
    return {
        **results.to_json(record._replace(views=views)),
        "folder": str(folder),
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
    with drafts.unfinished_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
