"""Stores the options of a reconstruction and the result of each stage: `reconstruction.json`.

    {out}/reconstruction.json        all records, readable; rewritten after every stage
    {out}/geometry/*.ply             the surface, with its shading normals
    {out}/index/                     files of the estimation of the index
    {out}/light/*.ply                the surface refined by light, if it was kept
    {out}/index.json                 the index of refraction that belongs to the surface
    {out}/pictures/*.png, report.md  the report

A stage that is `None` is not finished. The records contain no times, so that an interrupted and
resumed reconstruction yields the same files.
"""

import dataclasses
from pathlib import Path
from typing import Literal

from refref_jax import atomic_files, configuration
from refref_jax.choices import Exposure, Position, Space

FILE = "reconstruction.json"

Refinement = Literal["light", "none"]
"""What refines the surface from masks."""

UNEXPLAINED = 0.05
"""Error of the judges, sRGB, above which a shape leaves something unexplained."""

# Error of the judges above which no model has explained the object, sRGB.
_DOUBTFUL = 0.06

# Earlier versions had a number of steps here.
_FORMER_STEPS = dict.fromkeys(range(1, 10_001), "light") | {0: "none"}


@dataclasses.dataclass(frozen=True)
class ReconstructionConfig:
    """Options of a reconstruction.

    Attributes:
      geometry: name of the method from masks to a grid, see `geometry_stage.GEOMETRIES`.
      resolution: number of cells along the longest edge of the grid.
      outliers: number of views that may be wrong.
      index: index of refraction, or `None` to estimate it.
      space: type of the background, or `None` for the scene's own.
      radius: half-extent of the background cube, or radius of the sphere or of the uncontracted
        ball, world units; `None` for the scene's own.
      refinement: whether light refines the surface: `light`, or `none`.
      seed: random seed.
      centre: centre of the background, world units; `None` for the scene's own.
      exposure: exposure of the images: one, or a gain for each, learned around the object.
    """

    geometry: str
    resolution: int
    outliers: int
    index: float | None
    space: Space | None
    radius: float | None
    refinement: Refinement = dataclasses.field(
        metadata={configuration.FORMERLY: "light_steps", configuration.FORMER_VALUES: _FORMER_STEPS}
    )
    seed: int
    centre: Position | None = None
    exposure: Exposure = "fixed"


@dataclasses.dataclass(frozen=True)
class GeometryFacts:
    """Results of the geometry stage.

    Attributes:
      mesh: name of the file in the folder `geometry`.
      masks: number of masks.
      width: width of the masks, pixels.
      height: height of the masks, pixels.
      vertices: number of vertices of the mesh.
      faces: number of faces of the mesh.
      volume: enclosed volume, cubed world units.
      diameter: diagonal of the bounding box, world units.
      stages: names of the refinement stages that changed the mesh.
      refused: skipped stages, and the reasons.
      warnings: warnings about masks.
      families: whether families of shapes were fitted to the outlines; `None` in older records.
    """

    mesh: str
    masks: int
    width: int
    height: int
    vertices: int
    faces: int
    volume: float
    diameter: float
    stages: tuple[str, ...]
    refused: tuple[str, ...]
    warnings: tuple[str, ...] = dataclasses.field(metadata={configuration.FORMERLY: "doubts"})
    families: bool | None = None


@dataclasses.dataclass(frozen=True)
class IndexFacts:
    """The index of refraction and its origin.

    Attributes:
      source: origin of the index: given, estimated, or refined by light with the surface.
      index: index relative to air.
      error: standard deviation of an estimate.
      loss: photometric loss of an estimate.
    """

    source: Literal["given", "estimated", "refined"]
    index: float
    error: float | None
    loss: float | None


@dataclasses.dataclass(frozen=True)
class TrialFacts:
    """One shape that was fitted by light.

    Attributes:
      shape: kind of the shape.
      unknowns: number of its unknowns, the index included.
      error: mean error of the judges, sRGB.
      worse: error beyond that of the best shape.
      worse_error: standard error of that difference, over views.
      index: index of refraction.
      deviation: standard deviation of the index.
      steps: number of steps that were taken.
    """

    shape: str
    unknowns: int
    error: float
    worse: float
    worse_error: float
    index: float
    deviation: float
    steps: int


@dataclasses.dataclass(frozen=True)
class PartFacts:
    """One part of a refined object.

    Attributes:
      mesh: name of its file in the folder `light`.
      index: index of refraction inside.
      tint: factor of linear RGB light at every crossing of its surface; `None` if unknown.
      absorption: absorption inside, linear RGB, per world unit.
      radiance: linear RGB radiance of an opaque part, `None` for a clear one.
    """

    mesh: str
    index: float
    tint: tuple[float, float, float] | None = None
    absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radiance: tuple[float, float, float] | None = None


@dataclasses.dataclass(frozen=True)
class LightFacts:
    """Results of the refinement by light.

    Attributes:
      kept: whether the refined surface is used.
      index: index of refraction of the surface that is used.
      shape: kind of the chosen shape.
      before: mean error of the judges with the surface from masks, sRGB; `None` if no shape was
        fitted.
      after: the same with the chosen one.
      deviation: standard deviation of the index; `None` if it was not refined.
      undetermined: share of the normals that light has not determined.
      split: split of the views that judge.
      remark: reason why the surface from masks was kept.
      trials: all shapes that were fitted.
      parts: parts of the object, the outermost first, if light found several.
      steps: number of steps, of a refinement by an earlier version.
      furthest: largest displacement of the surface, world units, of the same.
    """

    kept: bool
    index: float
    shape: str = "masks"
    before: float | None = None
    after: float | None = None
    deviation: float | None = None
    undetermined: float = 1.0
    split: str = "val"
    remark: str = ""
    trials: tuple[TrialFacts, ...] = ()
    parts: tuple[PartFacts, ...] = ()
    steps: int | None = None
    furthest: float | None = None

    @property
    def leaves_error(self) -> bool:
        """Whether the shape leaves an error that a field reduces."""
        return self.after is not None and self.after > UNEXPLAINED

    @property
    def doubt(self) -> str:
        """Warning that no model explains the object; empty if one does."""
        if self.after is None or self.after <= _DOUBTFUL:
            return ""
        return (
            f"an error of {self.after:.4f} is left, so no model here explains the object. Compare "
            "with straight rays: train --paths=straight"
        )


@dataclasses.dataclass(frozen=True)
class DistanceFacts:
    """Distances between the surface and the true one, see `mesh_distance.Distance`."""

    chamfer: float
    furthest: float
    normal_error: float
    normal_error_99: float


@dataclasses.dataclass(frozen=True)
class ReportFacts:
    """Measurements of the report.

    Attributes:
      split: split of the views that were measured.
      names: names of the views.
      overlaps: intersection over union of mask and silhouette in each view.
      truth: distances to the true meshes, if these exist and may be read.
      remark: reason why the distances are missing.
    """

    split: str
    names: tuple[str, ...]
    overlaps: tuple[float, ...]
    truth: DistanceFacts | None
    remark: str

    @property
    def mean_overlap(self) -> float:
        """Mean overlap of all views."""
        return sum(self.overlaps) / len(self.overlaps)


@dataclasses.dataclass(frozen=True)
class Reconstruction:
    """A reconstruction, finished or not.

    Attributes:
      scene: name of the scene.
      inputs: fingerprint of the training images, masks and poses.
      config: options of the reconstruction.
      geometry: results of the first stage.
      index: results of the second stage.
      light: results of the third stage, which is optional.
      report: results of the last stage.
    """

    scene: str
    inputs: str
    config: ReconstructionConfig
    geometry: GeometryFacts | None = None
    index: IndexFacts | None = None
    light: LightFacts | None = None
    report: ReportFacts | None = None


def exists(out: Path) -> bool:
    """Returns whether a folder contains a reconstruction, finished or not."""
    return (out / FILE).is_file()


def read(out: Path) -> Reconstruction:
    """Reads the record of a reconstruction.

    Raises:
      ValueError: if the folder contains none.
    """
    if not exists(out):
        raise ValueError(f"{out} has no reconstruction. Use an --out of experiments.reconstruct.")
    return configuration.read(out / FILE, Reconstruction)


def write(out: Path, reconstruction: Reconstruction) -> None:
    """Writes the record atomically."""
    configuration.write(out / FILE, reconstruction)


def begin(out: Path, asked: Reconstruction) -> Reconstruction:
    """Creates the folder of a reconstruction, or reads the record that is there.

    Raises:
      ValueError: if the folder contains anything else, or a reconstruction from other images or
        with other options.
    """
    if not exists(out):
        if out.exists() and not out.is_dir():
            raise ValueError(f"{out} is a file, not a folder. Use another --out.")
        draft = atomic_files.beside(out / FILE)
        if out.is_dir() and any(each != draft for each in out.iterdir()):
            raise ValueError(
                f"{out} contains files, but no reconstruction. Use a new folder as --out."
            )
        out.mkdir(parents=True, exist_ok=True)
        write(out, asked)
        return asked
    begun = read(out)
    if begun.inputs != asked.inputs:
        raise ValueError(
            f"{out} was made from other images, masks or poses, of {begun.scene}. Use the scene "
            "that it was started with, or another --out."
        )
    if changed := _changed(begun, asked.config):
        raise ValueError(
            f"{out} was started with other options: {', '.join(changed)}. Repeat those options, "
            "or use another --out."
        )
    if begun.config != asked.config:
        begun = dataclasses.replace(begun, config=asked.config)
        write(out, begun)
    return begun


def _changed(begun: Reconstruction, asked: ReconstructionConfig) -> list[str]:
    """Returns descriptions of the changed options that affect finished stages."""
    before, now = dataclasses.asdict(begun.config), dataclasses.asdict(asked)
    return [
        f"{_OPTIONS.get(name, name)} {_told(name, value)}, not {_told(name, now[name])}"
        for name, value in before.items()
        if value != now[name] and getattr(begun, _STAGES.get(name, "geometry")) is not None
    ]


def _told(name: str, value: object) -> object:
    """Returns the value of an option, or a description of its default."""
    return ("estimated" if name == "index" else "as the scene says") if value is None else value


_OPTIONS = {"index": "ior", "space": "background"}
# First stage that an option affects, if it is not the geometry.
_STAGES = dict.fromkeys(("index", "space", "radius", "centre", "exposure"), "index") | {
    "refinement": "light"
}
