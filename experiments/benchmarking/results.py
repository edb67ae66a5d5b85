"""Stores the results of a benchmark's jobs: records, their JSON, and its files.

A record contains everything that is known of a job. Its JSON is validated when it is read;
docs/benchmark.md has the schema. Numbers that JSON does not support are written as strings, "inf",
"-inf" and "nan"; these are read as numbers only where a number is expected, because a scene may be
called nan.

Tables are built from these files only. To merge the results of several machines, the folder of a
job can be copied into another benchmark with the same settings. Each record is therefore compared
with the benchmark when it is read.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

from experiments.benchmarking import plan, settings
from experiments.benchmarking.methods import METHODS, RECONSTRUCTION
from experiments.benchmarking.settings import Benchmark, Settings
from refref_jax import configuration
from refref_jax.data import scene_names

OTHER = "other"
"""Category or background of a scene whose name does not follow the data set's pattern."""

Metrics = dict[str, float | None]
"""Measured numbers, by the names of docs/metrics.md; `None` for unknown values."""

_TAKE_OUT = "Remove its folder, and repeat the command."


class Image(NamedTuple):
    """Metrics of a test view.

    Attributes:
      name: name of the view.
      pose_distance: distance from the nearest training view, see `pose_space`.
      seconds: rendering time, if measured.
      metrics: metrics of the image.
    """

    name: str
    pose_distance: float
    seconds: float | None
    metrics: Metrics


class Costs(NamedTuple):
    """Cost of a job; `None` if not measured. See `measured_runs.Training`.

    Attributes:
      steps: number of training steps.
      seconds_per_step: median duration of a training step.
      rays_per_second: throughput of training.
      train_seconds: duration of all training steps.
      startup_seconds: remaining duration of the training's process.
      peak_host_mib: peak memory of the process of the training or reconstruction.
      peak_device_mib: peak memory of its accelerator.
      seconds_per_image: rendering time per image.
      seconds: duration of a reconstruction's last process.
    """

    steps: float | None = None
    seconds_per_step: float | None = None
    rays_per_second: float | None = None
    train_seconds: float | None = None
    startup_seconds: float | None = None
    peak_host_mib: float | None = None
    peak_device_mib: float | None = None
    seconds_per_image: float | None = None
    seconds: float | None = None


class Truth(NamedTuple):
    """Reference files of a view, relative to `scene_path`; `None` if the scene lacks them."""

    rgb: str
    mask: str | None
    distance: str | None


class View(NamedTuple):
    """Files of a view: the references, and the renders relative to the job's folder."""

    name: str
    truth: Truth
    rgb: str
    distance: str


class Record(NamedTuple):
    """Result of a job, see docs/benchmark.md.

    Attributes:
      scene: name of the scene.
      category: `smcvx`, `smncvx`, `mmncvx`, or `OTHER`.
      background: `cube`, `sphere`, `env`, or `OTHER`.
      method: name of the method, or `RECONSTRUCTION`.
      fingerprint: hash of the scene's files, see `plan.fingerprint`.
      options: options of its commands, by command, and the properties given with the scene by
        `plan.PROPERTIES`.
      settings: settings of the benchmark.
      metrics: means over the images.
      per_image: metrics of each image.
      costs: cost of the job.
      versions: versions of the software.
      views: files of each image.
      scene_path: folder of the scene at that time.
      facts: other results, such as learned colours and the index of refraction.
    """

    scene: str
    category: str
    background: str
    method: str
    fingerprint: str
    options: dict[str, list[str]]
    settings: Settings
    metrics: Metrics
    per_image: list[Image]
    costs: Costs
    versions: dict[str, str | None]
    views: list[View]
    scene_path: str
    facts: dict[str, Any]


def compared(found: list[Record]) -> list[Record]:
    """Returns the results of methods, without those of reconstructions."""
    return [record for record in found if record.method != RECONSTRUCTION]


def category_and_background(scene: str) -> tuple[str, str]:
    """Returns the category and the background in a scene's name."""
    if not scene_names.is_name(scene):
        return OTHER, OTHER
    name = scene_names.parse(scene)
    return name.category, name.background


def to_json(record: Record) -> dict[str, Any]:
    """Returns a record as a JSON object."""
    return configuration.string_safe(
        record._asdict()
        | {
            "settings": dataclasses.asdict(record.settings),
            "per_image": [
                {"name": image.name, "pose_distance": image.pose_distance}
                | ({} if image.seconds is None else {"seconds": image.seconds})
                | image.metrics
                for image in record.per_image
            ],
            "costs": {
                key: cost for key, cost in record.costs._asdict().items() if cost is not None
            },
            "views": [view._asdict() | {"truth": view.truth._asdict()} for view in record.views],
        }
    )


def from_json(content: Any) -> Record:
    """Inverts `to_json`; unknown keys of objects are ignored.

    Raises:
      ValueError: if something is missing or has the wrong type.
    """
    entry = _object(content, "the file")
    known = {key: _get(entry, key, "the file") for key in Record._fields}
    texts = ("scene", "category", "background", "method", "scene_path", "fingerprint")
    given = _object(known["settings"], "settings")
    try:
        common = Settings(**given)
    except TypeError as error:
        raise ValueError(f"its settings differ: {error}") from error
    return Record(
        **{key: _text(known[key], key) for key in texts},
        options={
            command: [_text(word, f"options of {command}") for word in _list(words, command)]
            for command, words in _object(known["options"], "options").items()
        },
        settings=common,
        metrics=_numbers(known["metrics"], "metrics"),
        per_image=[_image(each) for each in _list(known["per_image"], "per_image")],
        costs=_costs(known["costs"]),
        versions={
            name: _text_or_none(version, f"versions.{name}")
            for name, version in _object(known["versions"], "versions").items()
        },
        views=[_view(each) for each in _list(known["views"], "views")],
        facts=_object(known["facts"], "facts"),
    )


def number(value: Any, what: str) -> float | None:
    """Returns a number from JSON; `None` if it is unknown.

    Raises:
      ValueError: if it is anything else.
    """
    if isinstance(value, str) and value in configuration.NOT_FINITE:
        return float(value)
    if value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    raise ValueError(f"{what} is {value!r}, which is not a number")


def _image(content: Any) -> Image:
    entry = dict(_object(content, "an image of per_image"))
    name = _text(entry.pop("name", None), "the name of an image")
    apart = number(entry.pop("pose_distance", None), f"pose_distance of {name}")
    if apart is None or not math.isfinite(apart):
        raise ValueError(f"pose_distance of {name} is {apart}, which is not a distance")
    seconds = number(entry.pop("seconds", None), f"seconds of {name}")
    return Image(name, apart, seconds, _numbers(entry, name))


def _costs(content: Any) -> Costs:
    known = _numbers(content, "costs")
    if unknown := set(known) - set(Costs._fields):
        raise ValueError(f"costs has {sorted(unknown)[0]}, which is not a cost")
    return Costs(**known)


def _view(content: Any) -> View:
    entry = _object(content, "a view")
    name, rgb, distance = (
        _text(entry.get(key), f"{key} of a view") for key in ("name", "rgb", "distance")
    )
    truth = _object(entry.get("truth"), f"truth of {name}")
    files = (_text_or_none(truth.get(key), f"{key} of {name}") for key in ("mask", "distance"))
    return View(name, Truth(_text(truth.get("rgb"), f"rgb of {name}"), *files), rgb, distance)


def _numbers(content: Any, what: str) -> dict[str, float | None]:
    return {key: number(value, f"{what}.{key}") for key, value in _object(content, what).items()}


def _get(entry: dict[str, Any], key: str, what: str) -> Any:
    if key not in entry:
        raise ValueError(f"{what} lacks {key}")
    return entry[key]


def _object(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is {value!r}, which is not an object")
    return value


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{what} is {value!r}, which is not a list")
    return value


def _text(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{what} is {value!r}, which is not text")
    return value


def _text_or_none(value: Any, what: str) -> str | None:
    return None if value is None else _text(value, what)


def write(folder: Path, record: Record) -> None:
    """Writes the result of a job atomically."""
    settings.write_json(folder / plan.RESULT, to_json(record))


def read(path: Path) -> Record:
    """Reads the result of a job.

    Raises:
      ValueError: if the file is not a result.
    """
    try:
        return from_json(configuration.parse_json(path.read_text("utf-8")))
    except ValueError as error:
        raise ValueError(
            f"{path} is not the result of a job ({error}). Remove it, and repeat the command."
        ) from error


def read_all(out: Path, benchmark: Benchmark) -> list[Record]:
    """Reads all results of a benchmark, ordered by scene and method.

    Raises:
      ValueError: if a result is broken, is in the wrong folder, or was made with other settings,
        with another or unknown method, or of another scene of that name.
    """
    found: list[Record] = []
    fingerprints = {name: scene.fingerprint for name, scene in benchmark.scenes.items()}
    for path in sorted((out / plan.FOLDER).glob(f"*/*/{plan.RESULT}")):
        record = read(path)
        if (record.scene, record.method) != (path.parts[-3], path.parts[-2]):
            raise ValueError(
                f"{path} is the result of {record.scene}/{record.method}. Move its folder there."
            )
        _check_method(path, record, benchmark)
        _check_scene(path, record, fingerprints.setdefault(record.scene, record.fingerprint))
        found.append(record)
    return found


def _check_method(path: Path, record: Record, benchmark: Benchmark) -> None:
    """Rejects a result whose settings or options differ from those of the benchmark."""
    if record.settings != benchmark.settings:
        raise ValueError(
            f"{path} was made with other settings than those of {path.parents[3] / settings.FILE}, "
            f"so it is not comparable. {_TAKE_OUT}"
        )
    if record.method not in (*METHODS, RECONSTRUCTION):
        raise ValueError(
            f"{path} has the method {record.method}, which is unknown in this version. Use the "
            "version that made it, or remove its folder."
        )
    train = benchmark.methods.get(record.method)
    if train is None and record.method in METHODS:
        train = METHODS[record.method].train
    expected = plan.options(record.method, train or (), benchmark.settings)
    # The fingerprint covers the properties given with a scene.
    for command in sorted({*expected, *record.options} - {plan.PROPERTIES}):
        made, asked = record.options.get(command, []), expected.get(command, [])
        if made != asked:
            raise ValueError(
                f"{path} was made by {command} {' '.join(made)}, but here {record.method} is "
                f"{command} {' '.join(asked)}. {_TAKE_OUT}"
            )


def _check_scene(path: Path, record: Record, fingerprint: str) -> None:
    """Rejects a result of another scene of the same name."""
    if record.fingerprint != fingerprint:
        raise ValueError(
            f"{path} is of another scene named {record.scene} (fingerprint {record.fingerprint}) "
            f"than the benchmark's ({fingerprint}): cameras, meshes, scene.json, images or "
            f"properties differ. {_TAKE_OUT}"
        )
    kind = category_and_background(record.scene)
    if (record.category, record.background) != kind:
        raise ValueError(
            f"{path} has the category {record.category} and the background {record.background} for "
            f"{record.scene}, but its name has {' and '.join(kind)}. {_TAKE_OUT}"
        )
