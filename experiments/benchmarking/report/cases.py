"""Which views are shown: where methods fail most, some spread evenly, and one that is typical."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from experiments.benchmarking.report.contents import Scene
from experiments.benchmarking.results import Metrics, Record

# Of a scene's views, the share that is chosen because methods fail there.
_WORST = 0.6


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
