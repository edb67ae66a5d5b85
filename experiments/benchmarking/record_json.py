"""Results of jobs as JSON has them, checked when they are read: docs/benchmark.md has the schema.

Numbers that JSON does not know are written by name, "inf", "-inf" and "nan"; these are read as
numbers where a number belongs, and nowhere else: a scene may be called nan.
"""

import dataclasses
import math
from typing import Any

from experiments.benchmarking.records import Costs, Image, Record, Truth, View
from experiments.benchmarking.settings import Settings
from experiments.cli import app


def to_json(record: Record) -> dict[str, Any]:
    """Returns a result as JSON has it."""
    return app.string_safe(
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
    """Undoes `to_json`. What else an object holds is passed over.

    Raises:
      ValueError: if something is missing or of another kind.
    """
    told = _object(content, "the file")
    known = {key: _get(told, key, "the file") for key in Record._fields}
    texts = ("scene", "category", "background", "method", "scene_path", "fingerprint")
    given = _object(known["settings"], "settings")
    try:
        common = Settings(**given)
    except TypeError as error:
        raise ValueError(f"its settings are others: {error}") from error
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
    """Returns a number that JSON holds; what is not known is `None`.

    Raises:
      ValueError: if it is anything else.
    """
    if isinstance(value, str) and value in app.NOT_FINITE:
        return float(value)
    if value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    raise ValueError(f"{what} is {value!r}, which is no number")


def _image(content: Any) -> Image:
    told = dict(_object(content, "an image of per_image"))
    name = _text(told.pop("name", None), "the name of an image")
    apart = number(told.pop("pose_distance", None), f"pose_distance of {name}")
    if apart is None or not math.isfinite(apart):
        raise ValueError(f"pose_distance of {name} is {apart}, which is no distance")
    seconds = number(told.pop("seconds", None), f"seconds of {name}")
    return Image(name, apart, seconds, _numbers(told, name))


def _costs(content: Any) -> Costs:
    known = _numbers(content, "costs")
    if unknown := set(known) - set(Costs._fields):
        raise ValueError(f"costs has {sorted(unknown)[0]}, which is no cost")
    return Costs(**known)


def _view(content: Any) -> View:
    told = _object(content, "a view")
    name, rgb, distance = (
        _text(told.get(key), f"{key} of a view") for key in ("name", "rgb", "distance")
    )
    truth = _object(told.get("truth"), f"truth of {name}")
    files = (_text_or_none(truth.get(key), f"{key} of {name}") for key in ("mask", "distance"))
    return View(name, Truth(_text(truth.get("rgb"), f"rgb of {name}"), *files), rgb, distance)


def _numbers(content: Any, what: str) -> dict[str, float | None]:
    return {key: number(value, f"{what}.{key}") for key, value in _object(content, what).items()}


def _get(told: dict[str, Any], key: str, what: str) -> Any:
    if key not in told:
        raise ValueError(f"{what} lacks {key}")
    return told[key]


def _object(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is {value!r}, which is no object")
    return value


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{what} is {value!r}, which is no list")
    return value


def _text(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{what} is {value!r}, which is no text")
    return value


def _text_or_none(value: Any, what: str) -> str | None:
    return None if value is None else _text(value, what)
