"""What a report shows: results, the files of views, and which views are shown.

Results are read from a benchmark's results.json and from nothing else, files as far as they are
there. Views are shown where methods fail most, some spread evenly, and one that is typical.
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

# Of a scene's views, the share that is chosen because methods fail there.
_WORST = 0.6


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
            f"{path} is not that of a benchmark ({error!r}). Make it again with --tables_only."
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


class Image(NamedTuple):
    """A view, true or rendered; what is not there is `None`.

    Attributes:
      rgb: 8-bit sRGB.
      distance: along each pixel's ray, world units, `inf` where it meets nothing.
    """

    rgb: UInt8[np.ndarray, "h w 3"] | None
    distance: Float[np.ndarray, "h w"] | None


class View(NamedTuple):
    """A view of a scene.

    Attributes:
      name: of the view.
      truth: what should be seen.
      mask: of the object; `None` if it is not there.
      rendered: what each method sees, by its name.
    """

    name: str
    truth: Image
    mask: Bool[np.ndarray, "h w"] | None
    rendered: dict[str, Image]


def read_view(out: Path, scene: Scene, name: str) -> View:
    """Reads a view of a scene.

    A file that is missing or broken is `None`, and so is one of another size than the true image.

    Args:
      out: folder of the benchmark.
      scene: with its results.
      name: of the view.
    """
    files_of = {
        result.record.method: view
        for result in scene.results
        for view in result.record.views
        if view.name == name
    }
    roots = dict.fromkeys(root for result in scene.results for root in result.roots)
    told = next(iter(files_of.values())).truth
    truth, mask = _truth(list(roots), told)
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


def _truth(roots: Sequence[Path], told: Truth) -> tuple[Image, Bool[np.ndarray, "h w"] | None]:
    """Returns the true image and the mask, from the first folder that has the image."""
    root = next((root for root in roots if (root / told.rgb).is_file()), None)
    if root is None:
        return Image(None, None), None
    rgb = _or_unknown(image_files.read_rgb, root / told.rgb)
    mask = told.mask and _or_unknown(image_files.read_mask, root / told.mask)
    depth = told.distance and _or_unknown(image_files.read_depth, root / told.distance)
    return Image(rgb, None if depth is None else _distance(root, depth)), mask


def _distance(root: Path, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"] | None:
    """Returns planar depth as distance; `None` if the scene does not tell its field of view."""
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
    """One view, rendered by one method.

    Attributes:
      scene: name.
      method: name.
      view: name.
      psnr_masked: PSNR inside the mask, dB; `None` if it is not known.
      psnr: of the image, dB; `None` if it is not known.
    """

    scene: str
    method: str
    view: str
    psnr_masked: float | None
    psnr: float | None


def failures(scenes: Sequence[Scene], most: int) -> list[Case]:
    """Returns each method's worst views over all scenes, the worst of all first.

    Worse is a lower PSNR inside the mask. Views that have none come last, by the PSNR of the image.

    Args:
      scenes: with their results.
      most: views of a method.
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
    """Returns the names of a scene's views to show, in their own order.

    Three in five are where methods fail most: the worst view of each method in turn, the best
    method first. The others are spread evenly over what is left.

    Args:
      scene: with its results.
      count: views to choose.
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
    """Returns the name of the view in the middle, ordered by the mean of all methods.

    Views that a method has no PSNR of come last, so that they are in the middle only where most
    views are such; `None` if there are no views.
    """
    values: dict[str, list[float | None]] = {name: [] for name in view_names(scene)}
    for result in scene.results:
        for case in _cases(result.record):
            values[case.view].append(case.psnr_masked)
    ranked = sorted(values, key=lambda name: _mean(values[name]))
    return ranked[(len(ranked) - 1) // 2] if ranked else None


def psnr_masked(scene: Scene, method: str, view: str) -> float | None:
    """Returns the PSNR inside the mask of a method's view, dB; `None` if it is not known."""
    known = {
        (case.method, case.view): case.psnr_masked
        for result in scene.results
        for case in _cases(result.record)
    }
    return known.get((method, view))


def view_names(scene: Scene) -> list[str]:
    """Returns the names of all views of a scene, in their order."""
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
    """Sorts the worst first."""
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
    """Sorts the best method first."""
    value = record.metrics.get("psnr_masked")
    return math.inf if value is None or math.isnan(value) else -value
