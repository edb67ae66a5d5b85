"""Reads the data of a report: results, files of views, and the selection of views.

Results are only read from a benchmark's results.json, and files as far as they exist. The views are
those where methods fail most, some that are spread evenly, and a typical one.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from experiments.benchmarking import settings, summary
from experiments.benchmarking.plan import SPLIT, Skipped
from experiments.benchmarking.results import Metrics, Record, Truth, compared, from_json
from experiments.benchmarking.settings import Settings
from experiments.benchmarking.tables import Table
from refref_jax import configuration
from refref_jax.data import SceneError, image_files, scene_folder
from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras

T = TypeVar("T")

# Share of a scene's shown views that are selected because methods fail there.
_WORST = 0.6


class Point(NamedTuple):
    """A point of a training curve.

    Attributes:
      step: number of finished steps.
      seconds: duration of these steps.
      psnr: PSNR of the training rays, dB.
    """

    step: float
    seconds: float
    psnr: float


class Result(NamedTuple):
    """Result of a method on a scene.

    Attributes:
      record: record of the result; the rendered files of its views are relative to the benchmark's
        folder.
      curve: training curve.
      roots: possible folders of the scene, the most likely first.
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
    """All data of a benchmark.

    Attributes:
      settings: settings of all results.
      labels: labels of the methods, by name.
      scenes: scenes in the order of their names.
      reconstructions: reconstruction that the R3F methods share, for each scene.
      failed: reasons of failed jobs, by `scene/method`.
      skipped: skipped methods.
      missing: requested jobs that have no result for no known reason.
      tables: all tables.
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
      out: folder of the benchmark.

    Raises:
      ValueError: if there are no results, or they are broken.
    """
    path = out / summary.RESULTS
    if not path.is_file():
        raise ValueError(f"{out} has no {path.name}. Create it with --tables_only.")
    content = scene_folder.read_json(path)
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
            f"{path} is not a valid index ({error!r}). Create it again with --tables_only."
        ) from error


def _result(job: dict[str, Any], moved: dict[str, Path]) -> Result:
    record = from_json(job)
    was = Path(record.scene_path)
    curve = tuple(
        Point(point["step"], point["seconds"], point["psnr"])
        for point in configuration.from_string_safe(job["curve"])
        if {"step", "seconds", "psnr"} <= set(point)
    )
    return Result(record, curve, (moved.get(record.scene, was), was))


def _by_scene(results: Sequence[Result], methods: Sequence[str]) -> tuple[Scene, ...]:
    """Groups the results of methods by scene; unknown methods come last."""
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


class Image(NamedTuple):
    """A reference or rendered view; missing parts are `None`.

    Attributes:
      rgb: 8-bit sRGB.
      distance: distance along each pixel's ray, world units, `inf` where it hits nothing.
    """

    rgb: UInt8[np.ndarray, "h w 3"] | None
    distance: Float[np.ndarray, "h w"] | None


class View(NamedTuple):
    """A view of a scene.

    Attributes:
      name: name of the view.
      truth: reference image and distance.
      mask: mask of the object; `None` if it is missing.
      rendered: render of each method, by its name.
    """

    name: str
    truth: Image
    mask: Bool[np.ndarray, "h w"] | None
    rendered: dict[str, Image]


def read_view(out: Path, scene: Scene, name: str) -> View:
    """Reads a view of a scene.

    A file that is missing, broken, or of another size than the reference image is `None`.

    Args:
      out: folder of the benchmark.
      scene: scene with its results.
      name: name of the view.
    """
    files_of = {
        result.record.method: view
        for result in scene.results
        for view in result.record.views
        if view.name == name
    }
    roots = dict.fromkeys(root for result in scene.results for root in result.roots)
    entry = next(iter(files_of.values())).truth
    truth, mask = _truth(list(roots), entry)
    rendered = {
        method: Image(
            _or_unknown(image_files.read_rgb, out / view.rgb),
            _or_unknown(image_files.read_exr, out / view.distance),
        )
        for method, view in files_of.items()
    }
    if truth.rgb is not None:
        size = truth.rgb.shape[:2]
        truth = Image(truth.rgb, _of_size(truth.distance, size))
        mask = _of_size(mask, size)
        rendered = {
            method: Image(_of_size(image.rgb, size), _of_size(image.distance, size))
            for method, image in rendered.items()
        }
    return View(name, truth, mask, rendered)


def _truth(roots: Sequence[Path], entry: Truth) -> tuple[Image, Bool[np.ndarray, "h w"] | None]:
    """Returns the reference image and the mask, from the first folder that contains the image."""
    root = next((root for root in roots if (root / entry.rgb).is_file()), None)
    if root is None:
        return Image(None, None), None
    rgb = _or_unknown(image_files.read_rgb, root / entry.rgb)
    mask = entry.mask and _or_unknown(image_files.read_mask, root / entry.mask)
    depth = entry.distance and _or_unknown(image_files.read_depth, root / entry.distance)
    return Image(rgb, None if depth is None else _distance(root, depth)), mask


def _distance(root: Path, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"] | None:
    """Converts planar depth to distance; `None` if the scene does not define its field of view."""
    path = root / f"transforms_{SPLIT}.json"
    try:
        angle = scene_folder.get(scene_folder.read_json(path), "camera_angle_x", path)
        height, width = depth.shape
        pose = np.eye(4)[None, :3]
        seen = Cameras(pose, width, height, cameras.focal_length(width, float(angle)))
        return cameras.planar_depth_to_distance(seen, depth)
    except (SceneError, TypeError, ValueError, ZeroDivisionError):
        return None


def _or_unknown(read: Callable[[Path], T], path: Path) -> T | None:
    try:
        return read(path)
    except SceneError:
        return None


def _of_size(pixels: T | None, size: tuple[int, int]) -> T | None:
    return pixels if pixels is not None and pixels.shape[:2] == size else None


class Case(NamedTuple):
    """A view rendered by a method.

    Attributes:
      scene: name of the scene.
      method: name of the method.
      view: name of the view.
      psnr_masked: PSNR inside the mask, dB; `None` if it is unknown.
      psnr: PSNR of the image, dB; `None` if it is unknown.
    """

    scene: str
    method: str
    view: str
    psnr_masked: float | None
    psnr: float | None


def failures(scenes: Sequence[Scene], most: int) -> list[Case]:
    """Returns each method's worst views over all scenes, the worst first.

    They are sorted by masked PSNR. Views without one come last, sorted by the PSNR of the image.

    Args:
      scenes: scenes with their results.
      most: number of views per method.
    """
    cases = sorted(
        (case for scene in scenes for result in scene.results for case in _cases(result.record)),
        key=_badness,
    )
    taken: dict[str, int] = {}
    kept = []
    for case in cases:
        taken[case.method] = taken.get(case.method, 0) + 1
        if taken[case.method] <= most:
            kept.append(case)
    return kept


def choose_views(scene: Scene, count: int) -> list[str]:
    """Selects the views of a scene to show; returns their names in the original order.

    Three in five are those where methods fail most: the worst view of each method in turn, the best
      method first. The others are spread evenly over the rest.

    Args:
      scene: scene with its results.
      count: number of views to select.
    """
    names = view_names(scene)
    ranked = [
        sorted(_cases(result.record), key=_badness)
        for result in sorted(scene.results, key=lambda r: _mean_badness(r.record))
    ]
    turns = [cases[i] for i in range(len(names)) for cases in ranked if i < len(cases)]
    worst = list(dict.fromkeys(case.view for case in turns))[: math.ceil(_WORST * count)]
    others = [name for name in names if name not in worst]
    wanted = min(count - len(worst), len(others))
    spread = {others[i] for i in np.linspace(0, len(others) - 1, wanted).round().astype(int)}
    return [name for name in names if name in spread or name in worst]


def typical_view(scene: Scene) -> str | None:
    """Returns the name of the median view, ordered by the mean of all methods.

    Views that lack the PSNR of a method come last, so that one is only selected if most views lack
    it. Returns `None` if there are no views.
    """
    values: dict[str, list[float | None]] = {name: [] for name in view_names(scene)}
    for result in scene.results:
        for case in _cases(result.record):
            values[case.view].append(case.psnr_masked)
    ranked = sorted(values, key=lambda name: _mean(values[name]))
    return ranked[(len(ranked) - 1) // 2] if ranked else None


def psnr_masked(scene: Scene, method: str, view: str) -> float | None:
    """Returns the masked PSNR of a method's view, dB; `None` if it is unknown."""
    known = {
        (case.method, case.view): case.psnr_masked
        for result in scene.results
        for case in _cases(result.record)
    }
    return known.get((method, view))


def view_names(scene: Scene) -> list[str]:
    """Returns the names of all views of a scene, in order."""
    return list(
        dict.fromkeys(view.name for result in scene.results for view in result.record.views)
    )


def _cases(record: Record) -> list[Case]:
    return [
        Case(
            record.scene,
            record.method,
            image.name,
            _known(image.metrics, "psnr_masked"),
            _known(image.metrics, "psnr"),
        )
        for image in record.per_image
    ]


def _known(metrics: Metrics, key: str) -> float | None:
    value = metrics.get(key)
    return None if value is None or math.isnan(value) else value


def _badness(case: Case) -> tuple[bool, float, bool, float]:
    """Sort key of views, the worst first."""
    return (
        case.psnr_masked is None,
        case.psnr_masked or 0.0,
        case.psnr is None,
        case.psnr or 0.0,
    )


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else math.inf


def _mean_badness(record: Record) -> float:
    """Sort key of methods, the best first."""
    value = record.metrics.get("psnr_masked")
    return math.inf if value is None or math.isnan(value) else -value
