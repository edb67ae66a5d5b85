"""Reads the object of a run from a reconstruction, and records where it came from.

A run that was trained with a reconstructed object records it in `{run}/body.json`, with `write` and
`read`. The other functions read the newest surface of a reconstruction and its index of refraction.
"""

import dataclasses
from pathlib import Path

from experiments.r3f import geometry_stage, light_stage
from experiments.r3f.records import IndexFacts, Reconstruction
from refref_jax import configuration
from refref_jax.data import meshes
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh

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
    """Returns the path of the surface: the refined one if the refinement was kept."""
    refined = found.light is not None and found.light.kept
    folder = light_stage.FOLDER if refined else geometry_stage.FOLDER
    return out / folder / found.geometry.mesh


def index_facts(found: Reconstruction) -> IndexFacts:
    """Returns the index of refraction that belongs to the surface."""
    moved = found.light is not None and found.light.kept and found.index.source == "estimated"
    if not moved:
        return found.index
    return IndexFacts("refined", found.light.index, found.light.deviation, None)


def read_part(out: Path, found: Reconstruction) -> MeshPart:
    """Reads the object as a mesh part with an index of refraction."""
    return meshes.read_part(surface_file(out, found), index=index_facts(found).index)


def read_mesh(out: Path, found: Reconstruction) -> Mesh:
    """Reads the surface; its vertices are in the order of the file's reader."""
    return shaded_mesh(meshes.read_part(surface_file(out, found), index=1.0))
