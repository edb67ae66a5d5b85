"""Reads lists of scenes with properties for each scene, for `--scenes` (no JAX).

A list is a JSON file, or a CSV file with the same keys as columns:

    {"scenes": [{"scene": "ball", "rule": "facing", "ior": {"glass": 1.52}},
                {"scene": "hf:spherebg_single-convex/sphere_smcvx_ball",
                 "background": "spherical", "radius": 7.3, "properties": "ball.json"}]}

    scene,rule,background,radius,ior,properties
    ball,facing,,,glass=1.52 water=1.33,

Only `scene` is required: a folder, with or without wildcards, or `hf:CONFIG/SCENE`. The other keys
are options of `experiments.train`; `properties` is a file like `scene.json`. Paths are relative to
the list's folder. A key that does not exist or a wrong value is an error.
"""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

from experiments.runs import refraction_indices
from refref_jax import choices, configuration
from refref_jax.data import SceneError, scene_properties

_ENDINGS = (".json", ".csv")

# Options of trainings with the scene's own meshes.
_OF_MESHES = ("--rule=", "--ior=")

_KEYS = ("scene", "rule", "background", "radius", "ior", "properties")


class ListedScene(NamedTuple):
    """A scene, or all that match a wildcard, and the properties given with it.

    Attributes:
      source: folder, with or without wildcards, or `hf:CONFIG/SCENE`.
      options: options of `experiments.train`, except for `--properties`.
      properties: file of properties, or an empty string.
    """

    source: str
    options: tuple[str, ...] = ()
    properties: str = ""


def expand(words: Sequence[str]) -> list[ListedScene]:
    """Returns the scenes of `--scenes`, where lists are replaced by their scenes.

    Raises:
      ValueError: if a list is not valid; the message names the file and the key.
    """
    found = []
    for word in (each.strip() for each in words):
        if word.lower().endswith(_ENDINGS) and not Path(word).is_dir():
            found += _read(Path(word))
        elif word:
            found.append(ListedScene(word))
    return found


def sources(words: Sequence[str]) -> list[str]:
    """Returns the sources of all scenes of `--scenes`."""
    return [listed.source for listed in expand(words)]


def for_object(options: Sequence[str]) -> list[str]:
    """Returns the options that are valid for a reconstructed object too."""
    return [word for word in options if not word.startswith(_OF_MESHES)]


def for_background(options: Sequence[str]) -> list[str]:
    """Returns the options of a reconstruction: those of the background."""
    return [word for word in options if word.startswith(("--background=", "--radius="))]


def _read(path: Path) -> list[ListedScene]:
    if not path.is_file():
        raise SceneError(f"{path} does not exist. Give scenes, or a JSON or CSV file of scenes.")
    text = path.read_text(encoding="utf-8-sig")
    rows = _rows_of_json(path, text) if path.suffix.lower() == ".json" else _rows_of_csv(text)
    if not rows:
        raise SceneError(f"{path} lists no scene. Add one.")
    return [_listed(f"{path}: scene {number}", row, path) for number, row in enumerate(rows, 1)]


def _rows_of_json(path: Path, text: str) -> list[Any]:
    try:
        content = configuration.parse_json(text)
    except ValueError as error:
        raise SceneError(f"{path} is not valid JSON ({error}). Correct it.") from error
    rows = content.get("scenes") if isinstance(content, dict) else content
    if not isinstance(rows, list) or (isinstance(content, dict) and set(content) != {"scenes"}):
        raise SceneError(f"{path} is not an object with the only key 'scenes', a list. Correct it.")
    return rows


def _rows_of_csv(text: str) -> list[Any]:
    """Returns the rows as JSON would hold them; empty cells are not given."""
    rows = []
    for row in csv.DictReader(text.splitlines(), restkey="more cells than columns"):
        given = {str(key).strip(): each for key, each in row.items() if each not in (None, "")}
        if "radius" in given:
            given["radius"] = _number_in(given["radius"])
        if "ior" in given:
            pairs = (pair.partition("=") for pair in given["ior"].split())
            given["ior"] = {name: _number_in(number) for name, _, number in pairs}
        rows.append(given)
    return rows


def _number_in(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _listed(where: str, row: Any, path: Path) -> ListedScene:
    if not isinstance(row, dict) or not isinstance(row.get("scene"), str) or not row["scene"]:
        raise SceneError(f"{where} does not have the key 'scene' with a folder or hf:CONFIG/SCENE.")
    if unknown := [key for key in row if key not in _KEYS]:
        near = configuration.nearest(unknown[0], _KEYS)
        remedy = f"Write {near!r}, or remove it." if near else f"The keys are {', '.join(_KEYS)}."
        raise SceneError(f"{where}: {unknown[0]!r} is not a known key. {remedy}")
    options = []
    for key, names in (("rule", choices.RuleName), ("background", choices.Space)):
        if key in row:
            if row[key] not in get_args(names):
                wanted = f"one of {', '.join(get_args(names))}"
                raise SceneError(f"{where}: {key} is {row[key]!r}. Give {wanted}.")
            options.append(f"--{key}={row[key]}")
    if "radius" in row:
        if not _is_positive(row["radius"]):
            raise SceneError(f"{where}: radius is {row['radius']!r}. Give a positive number.")
        options.append(f"--radius={row['radius']!r}")
    options += _indices(where, row.get("ior", {}))
    source, properties = row["scene"], row.get("properties", "")
    if not isinstance(properties, str):
        raise SceneError(f"{where}: properties is {properties!r}. Give the name of a file.")
    if properties:
        properties = str((path.parent / properties).resolve())
        scene_properties.check_file(Path(properties))
    if not source.startswith("hf:"):
        source = str(path.parent / source)
    return ListedScene(source, tuple(options), properties)


def _indices(where: str, indices: Any) -> list[str]:
    if not isinstance(indices, Mapping) or not all(map(_is_positive, indices.values())):
        raise SceneError(
            f"{where}: ior is {json.dumps(indices)}. Give positive numbers by material or mesh, as "
            'in {"glass": 1.52}, or glass=1.52 in CSV.'
        )
    options = [f"--ior={name}={number!r}" for name, number in sorted(indices.items())]
    refraction_indices.parse_named([word.removeprefix("--ior=") for word in options])
    return options


def _is_positive(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and 0.0 < value < math.inf
