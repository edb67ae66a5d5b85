"""Reads the object of a run from a reconstruction, and records where it came from.

A run that was trained with a reconstructed object records it in `{run}/body.json`, with `write` and
`read`. The other functions read the newest surface of a reconstruction and its index of refraction.
"""

import dataclasses
from pathlib import Path

from etils import epy

from experiments.r3f import records
from experiments.r3f.records import IndexFacts, PartFacts, Reconstruction
from refref_jax import configuration
from refref_jax.choices import Material
from refref_jax.data import file_inside, meshes
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh, join

with epy.lazy_imports():  # of a second each, and most runs have no reconstruction
    from experiments.r3f import geometry_stage, light_stage

_FILE = "body.json"


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Origin of an object.

    Attributes:
      reconstruction: folder of the reconstruction.
      index: index of refraction used in training.
    """

    reconstruction: str
    index: float


def write(run: Path, provenance: Provenance | None) -> None:
    """Writes the origin into a run's folder, which is created; `None` removes it."""
    if provenance is None:
        (run / _FILE).unlink(missing_ok=True)
        return
    run.mkdir(parents=True, exist_ok=True)
    configuration.write(run / _FILE, provenance)


def read(run: Path) -> Provenance | None:
    """Returns the origin, or `None` if the run uses the scene's own meshes."""
    return configuration.read(run / _FILE, Provenance) if (run / _FILE).is_file() else None


def surface_file(out: Path, found: Reconstruction) -> Path:
    """Returns the path of the outer surface: the refined one if the refinement was kept."""
    if not _is_refined(found):
        return _file(out / geometry_stage.FOLDER, found.geometry.mesh)
    parts = found.light.parts
    return _file(out / light_stage.FOLDER, parts[0].mesh if parts else found.geometry.mesh)


def _file(folder: Path, mesh: str) -> Path:
    return file_inside([folder], mesh, where="mesh", path=folder.parent / records.FILE)


def _is_refined(found: Reconstruction) -> bool:
    return found.light is not None and found.light.kept


def are_there(out: Path, found: Reconstruction) -> bool:
    """Returns whether the files of all parts exist."""
    parts = found.light.parts if _is_refined(found) else ()
    files = [_file(out / light_stage.FOLDER, part.mesh) for part in parts]
    return all(file.is_file() for file in (*files, surface_file(out, found)))


def index_facts(found: Reconstruction) -> IndexFacts:
    """Returns the index of refraction that belongs to the surface."""
    moved = found.light is not None and found.light.kept and found.index.source == "estimated"
    if not moved:
        return found.index
    return IndexFacts("refined", found.light.index, found.light.deviation, None)


def read_parts(out: Path, found: Reconstruction) -> list[MeshPart]:
    """Reads the object as mesh parts with their indices of refraction, the outermost first."""
    if not _is_refined(found) or not found.light.parts:
        return [meshes.read_part(surface_file(out, found), index=index_facts(found).index)]
    return [_read(out / light_stage.FOLDER, part) for part in found.light.parts]


def _read(folder: Path, facts: PartFacts) -> MeshPart:
    mesh = _file(folder, facts.mesh)
    part = meshes.read_part(mesh, index=facts.index)
    if facts.radiance is not None:
        material = Material("opaque", radiance=facts.radiance)
        radiance = meshes.read_radiance(material, part.faces, path=mesh)
        return part._replace(material=material, radiance=radiance)
    if facts.tint is None:
        return part
    return part._replace(tint=facts.tint, absorption=facts.absorption, colour_known=True)


def read_mesh(out: Path, found: Reconstruction) -> Mesh:
    """Reads the outer surface and opaque parts; vertices are in the order of the file's reader."""
    surface = shaded_mesh(meshes.read_part(surface_file(out, found), index=1.0))
    parts = found.light.parts if _is_refined(found) else ()
    opaque = [part for part in parts if part.radiance is not None]
    others = [shaded_mesh(_read(out / light_stage.FOLDER, part)) for part in opaque]
    return join([surface, *others]) if others else surface
