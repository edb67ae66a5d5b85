"""What a reconstruction is asked for, and what each of its stages found: `reconstruction.json`.

    {out}/reconstruction.json        all of it, readable; written anew after every stage
    {out}/geometry/*.ply             the surface, with its shading normals
    {out}/index/                     what the estimation of the index keeps
    {out}/light/*.ply                the surface refined by light, if that bettered it
    {out}/index.json                 the index of refraction that goes with the surface
    {out}/pictures/*.png, report.md  the report

A stage that is `None` is not finished. What is written holds no times, so that a reconstruction
that was interrupted comes to the same files.
"""

import dataclasses
from pathlib import Path
from typing import Literal

from refref_jax import atomic_files, configuration
from refref_jax.choices import Space

FILE = "reconstruction.json"


@dataclasses.dataclass(frozen=True)
class ReconstructionConfig:
    """What is asked for.

    Attributes:
      geometry: name of the way from masks to a grid, see `geometry_stage.GEOMETRIES`.
      resolution: cells along the longest edge of the grid.
      outliers: views that may be wrong.
      index: the index of refraction, or `None` to estimate it.
      space: whether there are walls, or `None` for what the scene says.
      radius: of the walls' cube or sphere or the uncontracted ball, world units; `None` likewise.
      light_steps: of the refinement by light; 0 leaves it out.
      seed: of everything random.
    """

    geometry: str
    resolution: int
    outliers: int
    index: float | None
    space: Space | None
    radius: float | None
    light_steps: int
    seed: int


@dataclasses.dataclass(frozen=True)
class GeometryFacts:
    """What came of the geometry.

    Attributes:
      mesh: the file in the folder `geometry`.
      masks: how many there were.
      width: of the masks, pixels.
      height: of the masks, pixels.
      vertices: of the mesh.
      faces: of the mesh.
      volume: inside of it, cubed world units.
      diameter: diagonal of its box, world units.
      stages: of the refinement that changed something.
      refused: those that were left out, and why.
      doubts: what is wrong with masks, if anything seems so.
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
    doubts: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class IndexFacts:
    """The index of refraction.

    Attributes:
      source: whether it was given or estimated, or found together with the surface by light.
      index: relative to air.
      error: one standard deviation, of an estimate.
      loss: photometric loss of an estimate.
    """

    source: Literal["given", "estimated", "refined"]
    index: float
    error: float | None
    loss: float | None


@dataclasses.dataclass(frozen=True)
class LightFacts:
    """What came of the refinement by light.

    Attributes:
      steps: of the descent.
      kept: whether the validation views are explained better.
      before: mean error of their pixels before, sRGB.
      after: and after.
      index: of refraction, after.
      furthest: that a part of the surface moved, world units.
    """

    steps: int
    kept: bool
    before: float
    after: float
    index: float
    furthest: float


@dataclasses.dataclass(frozen=True)
class DistanceFacts:
    """How far the surface is from the true one, see `reconstruct.comparison.Distance`."""

    chamfer: float
    furthest: float
    normal_error: float
    normal_error_99: float


@dataclasses.dataclass(frozen=True)
class ReportFacts:
    """What the report measured.

    Attributes:
      split: of the views that it looked at.
      names: of the views.
      overlaps: of mask and silhouette in each view: intersection over union.
      truth: the distance to the true meshes, if there are any that may be looked at.
      remark: why there is no such distance.
    """

    split: str
    names: tuple[str, ...]
    overlaps: tuple[float, ...]
    truth: DistanceFacts | None
    remark: str

    @property
    def mean_overlap(self) -> float:
        """Of all views."""
        return sum(self.overlaps) / len(self.overlaps)


@dataclasses.dataclass(frozen=True)
class Reconstruction:
    """A reconstruction as far as it has got.

    Attributes:
      scene: how the scene is called.
      inputs: fingerprint of the training images, masks and poses that it is made from.
      config: what was asked for.
      geometry: the first stage.
      index: the second.
      light: the third, if it is asked for.
      report: the last.
    """

    scene: str
    inputs: str
    config: ReconstructionConfig
    geometry: GeometryFacts | None = None
    index: IndexFacts | None = None
    light: LightFacts | None = None
    report: ReportFacts | None = None


def exists(out: Path) -> bool:
    """Returns whether a folder holds a reconstruction, finished or not."""
    return (out / FILE).is_file()


def read(out: Path) -> Reconstruction:
    """Reads how far a reconstruction has got.

    Raises:
      ValueError: if the folder holds none.
    """
    if not exists(out):
        raise ValueError(f"{out} holds no reconstruction. Give one of experiments.reconstruct.")
    return configuration.read(out / FILE, Reconstruction)


def write(out: Path, reconstruction: Reconstruction) -> None:
    """Writes how far it has got, at once."""
    configuration.write(out / FILE, reconstruction)


def begin(out: Path, asked: Reconstruction) -> Reconstruction:
    """Opens a folder for a reconstruction, or finds how far it has got there.

    Raises:
      ValueError: if the folder holds anything else, or a reconstruction from other images or with
        other options.
    """
    if not exists(out):
        if out.exists() and not out.is_dir():
            raise ValueError(f"{out} is a file, but a folder is needed. Give another --out.")
        draft = atomic_files.beside(out / FILE)
        if out.is_dir() and any(each != draft for each in out.iterdir()):
            raise ValueError(
                f"{out} holds something else than a reconstruction. Give a new folder as --out."
            )
        out.mkdir(parents=True, exist_ok=True)
        write(out, asked)
        return asked
    begun = read(out)
    if begun.inputs != asked.inputs:
        raise ValueError(
            f"{out} was made from other images, masks or poses, of {begun.scene}. Give the scene "
            "that it was begun with, or another --out."
        )
    if changed := _changed(begun, asked.config):
        raise ValueError(
            f"{out} was begun with other options: {', '.join(changed)}. Give those again, or "
            "another --out."
        )
    if begun.config != asked.config:
        begun = dataclasses.replace(begun, config=asked.config)
        write(out, begun)
    return begun


def _changed(begun: Reconstruction, asked: ReconstructionConfig) -> list[str]:
    """Says which options of finished stages differ, as they were."""
    before, now = dataclasses.asdict(begun.config), dataclasses.asdict(asked)
    return [
        f"{_OPTIONS.get(name, name)} {_told(name, value)}, not {_told(name, now[name])}"
        for name, value in before.items()
        if value != now[name] and getattr(begun, _STAGES.get(name, "geometry")) is not None
    ]


def _told(name: str, value: object) -> object:
    """Says what an option is, or what stands for it where it is left out."""
    return ("estimated" if name == "index" else "as the scene says") if value is None else value


_OPTIONS = {"index": "ior", "space": "background"}
# The first stage that an option matters to, where that is not the geometry.
_STAGES = {"index": "index", "space": "index", "radius": "index", "light_steps": "light"}
