"""The results of a benchmark's jobs, each one JSON file that says all there is to say of it.

Tables are made of these files alone. A job's folder can be copied to another machine's benchmark
of the same settings, to merge what both have measured.

docs/benchmark.md has the schema.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

from experiments import commands
from experiments.benchmarking import jobs, settings
from experiments.benchmarking.methods import RECONSTRUCTION
from experiments.benchmarking.settings import Settings
from refref_jax.data import scene_names

OTHER = "other"
"""Category or background of a scene that has no name of the data set's form."""


class Record(NamedTuple):
    """What a job left, see docs/benchmark.md.

    Attributes:
      scene: name.
      category: `smcvx`, `smncvx`, `mmncvx`, or `OTHER`.
      background: `cube`, `sphere`, `env`, or `OTHER`.
      method: name, or `RECONSTRUCTION`.
      options: of its commands, by command.
      settings: of the benchmark.
      metrics: means over the images, by name; `None` for what is not known.
      per_image: the same of each image, with its `name` and `pose_distance`.
      costs: what it took.
      versions: of what it ran with.
      views: files of each image, relative to `scene_path` (truth) and the job's folder (rendered).
      scene_path: where the scene was.
      facts: what was found besides: learned colours, index of refraction.
    """

    scene: str
    category: str
    background: str
    method: str
    options: dict[str, list[str]]
    settings: dict[str, Any]
    metrics: dict[str, float | None]
    per_image: list[dict[str, Any]]
    costs: dict[str, Any]
    versions: dict[str, str | None]
    views: list[dict[str, Any]]
    scene_path: str
    facts: dict[str, Any]


def write(folder: Path, record: Record) -> None:
    """Writes the result of a job, all or nothing."""
    settings.write_json(folder / jobs.RESULT, commands.string_safe(record._asdict()))


def read(path: Path) -> Record:
    """Reads the result of a job.

    Raises:
      ValueError: if it is none.
    """
    try:
        return Record(**commands.from_string_safe(json.loads(path.read_text("utf-8"))))
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{path} is not the result of a job ({error}). Remove it, and repeat the command."
        ) from error


def read_all(out: Path, common: Settings) -> list[Record]:
    """Reads all results of a benchmark, ordered by scene and method.

    Raises:
      ValueError: if one is broken, lies in another's folder, or was made with other settings.
    """
    found = []
    for path in sorted((out / jobs.FOLDER).glob(f"*/*/{jobs.RESULT}")):
        record = read(path)
        if (record.scene, record.method) != (path.parts[-3], path.parts[-2]):
            raise ValueError(
                f"{path} is the result of {record.scene}/{record.method}. Move its folder there."
            )
        if record.settings != dataclasses.asdict(common):
            raise ValueError(
                f"{path} was made with other settings than those of {out / settings.FILE}, so that "
                "it does not compare. Take its folder out."
            )
        found.append(record)
    return found


def compared(found: list[Record]) -> list[Record]:
    """Returns the results of methods, without those of reconstructions."""
    return [record for record in found if record.method != RECONSTRUCTION]


def category_and_background(scene: str) -> tuple[str, str]:
    """Returns what a scene's name says it is."""
    if not scene_names.is_name(scene):
        return OTHER, OTHER
    name = scene_names.parse(scene)
    return name.category, name.background
