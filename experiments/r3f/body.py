"""The reconstructed body as far as it has got: its newest surface, and its index of refraction."""

from pathlib import Path

from experiments.r3f import geometry_stage, light_stage
from experiments.r3f.records import IndexFacts, Reconstruction
from refref_jax.data import meshes
from refref_jax.data.geometry import shading_normals
from refref_jax.data.meshes import MeshPart
from refref_jax.reconstruct.triangles import Mesh


def surface_file(out: Path, found: Reconstruction) -> Path:
    """Returns where the surface is: refined by light, if that bettered it."""
    refined = found.light is not None and found.light.kept
    folder = light_stage.FOLDER if refined else geometry_stage.FOLDER
    return out / folder / found.geometry.mesh


def index_facts(found: Reconstruction) -> IndexFacts:
    """Returns the index of refraction that goes with the surface."""
    moved = found.light is not None and found.light.kept and found.index.source == "estimated"
    return IndexFacts("refined", found.light.index, None, None) if moved else found.index


def read_part(out: Path, found: Reconstruction) -> MeshPart:
    """Reads the body as what light is traced through."""
    return meshes.read_part(surface_file(out, found), index=index_facts(found).index)


def read_mesh(out: Path, found: Reconstruction) -> Mesh:
    """Reads the surface; its vertices are in the order of the file's reader."""
    return mesh_of(meshes.read_part(surface_file(out, found), index=1.0))


def mesh_of(part: MeshPart) -> Mesh:
    """Returns the surface of a part, with the normals that bend light."""
    return Mesh(part.vertices, part.faces, shading_normals(part))
