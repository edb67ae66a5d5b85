"""What a report shows, read from a benchmark's results.json and from nothing else."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.benchmarking import settings, summary
from experiments.benchmarking.jobs import Skipped
from experiments.benchmarking.results import Record, compared, from_json
from experiments.benchmarking.settings import Settings
from experiments.benchmarking.tables import Table
from experiments.cli import commands
from refref_jax.data import transforms


class Point(NamedTuple):
    """A point of a training's curve.

    Attributes:
      step: number of steps done.
      seconds: that they took.
      psnr: of the training rays, dB.
    """

    step: float
    seconds: float
    psnr: float


class Result(NamedTuple):
    """What a method came to on a scene.

    Attributes:
      record: the result; the rendered files of its views are relative to the benchmark's folder.
      curve: of its training.
      roots: folders where the scene may be, the likeliest first.
    """

    record: Record
    curve: tuple[Point, ...]
    roots: tuple[Path, ...]


class Scene(NamedTuple):
    """A scene with its results, in the order of the methods."""

    name: str
    category: str
    background: str
    results: tuple[Result, ...]


class Contents(NamedTuple):
    """All of a benchmark.

    Attributes:
      settings: common to all results.
      labels: of the methods, by name.
      scenes: in the order of their names.
      reconstructions: what methods of R3F share, a scene.
      failed: why jobs failed, by `scene/method`.
      skipped: what was left out.
      missing: jobs that were asked for and have no result, for no reason known.
      tables: all of them.
    """

    settings: Settings
    labels: dict[str, str]
    scenes: tuple[Scene, ...]
    reconstructions: tuple[Record, ...]
    failed: dict[str, str]
    skipped: tuple[Skipped, ...]
    missing: tuple[str, ...]
    tables: tuple[Table, ...]


def read(out: Path) -> Contents:
    """Reads the results of a benchmark.

    Args:
      out: its folder.

    Raises:
      ValueError: if there are none, or they are broken.
    """
    path = out / summary.RESULTS
    if not path.is_file():
        raise ValueError(f"{out} has no {path.name}. Make it with --tables_only.")
    content = transforms.read_json(path)
    moved = {name: Path(scene.path) for name, scene in settings.read(out).scenes.items()}
    try:
        results = [_result(job, moved) for job in content["jobs"]]
        labels = {name: method["label"] for name, method in content["methods"].items()}
        return Contents(
            settings=Settings(**content["settings"]),
            labels=labels,
            scenes=_by_scene(results, list(labels)),
            reconstructions=tuple(
                result.record for result in results if not compared([result.record])
            ),
            failed=dict(content["failed"]),
            skipped=tuple(Skipped(**each) for each in content["skipped"]),
            missing=tuple(content["missing"]),
            tables=tuple(map(summary.table_from_json, content["tables"].values())),
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} is not that of a benchmark ({error!r}). Make it again with --tables_only."
        ) from error


def _result(job: dict[str, Any], moved: dict[str, Path]) -> Result:
    record = from_json(job)
    was = Path(record.scene_path)
    curve = tuple(
        Point(point["step"], point["seconds"], point["psnr"])
        for point in commands.from_string_safe(job["curve"])
        if {"step", "seconds", "psnr"} <= set(point)
    )
    return Result(record, curve, (moved.get(record.scene, was), was))


def _by_scene(results: Sequence[Result], methods: Sequence[str]) -> tuple[Scene, ...]:
    """Returns the results of methods by scene; methods that are not known come last."""
    order = {name: i for i, name in enumerate(methods)}
    own: dict[str, list[Result]] = {}
    for result in results:
        if compared([result.record]):
            own.setdefault(result.record.scene, []).append(result)
    scenes = []
    for name in sorted(own):
        first = own[name][0].record
        ordered = sorted(
            own[name], key=lambda r: (order.get(r.record.method, len(order)), r.record.method)
        )
        scenes.append(Scene(name, first.category, first.background, tuple(ordered)))
    return tuple(scenes)
