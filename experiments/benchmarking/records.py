"""What a job of a benchmark leaves: a result, which says all there is to say of it."""

from typing import Any, NamedTuple

from experiments.benchmarking.methods import RECONSTRUCTION
from experiments.benchmarking.settings import Settings
from refref_jax.data import scene_names

OTHER = "other"
"""Category or background of a scene that has no name of the data set's form."""

Metrics = dict[str, float | None]
"""Measured numbers, by the names of docs/metrics.md; `None` for what is not known."""


class Image(NamedTuple):
    """What was measured of a test view.

    Attributes:
      name: of the view.
      pose_distance: from the nearest training view, see `pose_space`.
      seconds: that it was rendered in, if that was measured.
      metrics: of it.
    """

    name: str
    pose_distance: float
    seconds: float | None
    metrics: Metrics


class Costs(NamedTuple):
    """What a job took; `None` where it was not measured. See `trained_runs.Training`.

    Attributes:
      steps: of training.
      seconds_per_step: median.
      rays_per_second: of training.
      train_seconds: of all steps.
      startup_seconds: of training's process besides.
      peak_host_mib: most memory of training's process, or of a reconstruction's.
      peak_device_mib: most memory of its accelerator.
      seconds_per_image: of rendering.
      seconds: of a reconstruction's last process.
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
    """True files of a view, from `scene_path`; `None` for what the scene lacks."""

    rgb: str
    mask: str | None
    distance: str | None


class View(NamedTuple):
    """Files of a view: the true ones, and what was rendered, from the job's folder."""

    name: str
    truth: Truth
    rgb: str
    distance: str


class Record(NamedTuple):
    """What a job left, see docs/benchmark.md.

    Attributes:
      scene: name.
      category: `smcvx`, `smncvx`, `mmncvx`, or `OTHER`.
      background: `cube`, `sphere`, `env`, or `OTHER`.
      method: name, or `RECONSTRUCTION`.
      fingerprint: of the scene's files, see `fingerprints`.
      options: of its commands, by command.
      settings: of the benchmark.
      metrics: means over the images.
      per_image: of each image.
      costs: what it took.
      versions: of what it ran with.
      views: files of each image.
      scene_path: where the scene was.
      facts: what was found besides: learned colours, index of refraction.
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
    """Returns what a scene's name says it is."""
    if not scene_names.is_name(scene):
        return OTHER, OTHER
    name = scene_names.parse(scene)
    return name.category, name.background
