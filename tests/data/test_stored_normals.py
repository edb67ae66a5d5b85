"""Meshes that keep their shading normals in their file."""

import numpy as np
import pytest
import trimesh

from refref_jax.data import meshes
from refref_jax.data.scene_assembly import assemble_scene, shaded_mesh
from refref_jax.data.scene_properties import PartDescription
from refref_jax.geometry.triangle_meshes import corner_normals


@pytest.fixture
def mesh():
    """A box whose top alone is smooth, with normals that no rule would give it."""
    box = trimesh.creation.box((1.0, 2.0, 3.0)).subdivide()
    vertices, faces = np.asarray(box.vertices) / 3.0, np.asarray(box.faces)
    normals = corner_normals(vertices, faces)
    top = normals[..., 2] > 0.9
    leaning = normals + 0.1 * np.sin(7.0 * vertices[faces])
    leaning /= np.linalg.norm(leaning, axis=-1, keepdims=True)
    return vertices, faces, np.where(top[..., None], leaning, normals)


def test_a_mesh_comes_back_to_the_bit(tmp_path, mesh):
    vertices, faces, normals = mesh
    path = tmp_path / "box_glass.ply"
    meshes.write_mesh(path, *mesh)
    part = meshes.read_part(path, index=1.37)
    assert part.name == "box_glass" and part.index == 1.37
    np.testing.assert_array_equal(part.vertices[part.faces], vertices[faces])
    np.testing.assert_array_equal(part.normals, normals)
    np.testing.assert_array_equal(shaded_mesh(part).normals, normals)
    assert len(part.vertices) == len(vertices)  # positions are merged again
    assert np.abs(normals - corner_normals(vertices, faces)).max() > 0.05  # no rule gives them


def test_light_is_bent_by_the_stored_normals(tmp_path, mesh):
    meshes.write_mesh(tmp_path / "box_glass.ply", *mesh)
    part = meshes.read_part(tmp_path / "box_glass.ply", index=1.5)
    surfaces = assemble_scene([part], [-1], rule="nested").surfaces
    ours = np.concatenate([surfaces.bvh.triangles, surfaces.normals], axis=-1).reshape(-1, 18)
    theirs = np.concatenate([mesh[0][mesh[1]], mesh[2]], axis=-1).reshape(-1, 18)
    # The tree sorts the faces, and pads its leaves.
    wanted = np.unique(theirs.astype(np.float32), axis=0)
    assert {row.tobytes() for row in wanted} <= {row.tobytes() for row in ours}


def test_a_scene_reads_them_unless_it_says_how_it_is_shaded(tmp_path, mesh):
    (tmp_path / "meshes").mkdir()
    meshes.write_mesh(tmp_path / "meshes" / "box_glass.ply", *mesh)
    (part,) = meshes.read_meshes(tmp_path)
    np.testing.assert_array_equal(part.normals, mesh[2])
    description = '{"parts": [{"mesh": "box_glass.ply", "smooth_normals": false}]}'
    (tmp_path / "scene.json").write_text(description)
    (flat,) = meshes.read_meshes(tmp_path)
    assert flat.normals is None and flat.shading == "flat"
    assert PartDescription().shading == "auto"


def test_other_programs_read_the_file(tmp_path, mesh):
    path = tmp_path / "box_glass.ply"
    meshes.write_mesh(path, *mesh)
    seen = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(seen.vertices[seen.faces], mesh[0][mesh[1]])
    assert len(seen.vertices) > len(mesh[0])  # one for each normal


def test_normals_of_other_files_are_not_trusted(tmp_path, mesh):
    path = tmp_path / "box_glass.ply"
    meshes.write_mesh(path, *mesh)
    trimesh.load_mesh(path, process=False).export(path, vertex_normal=True)
    assert b"property float nx" in path.read_bytes()[:400]
    assert meshes.read_normals(path) is None
    assert meshes.read_part(path, index=1.5).normals is None


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_a_truncated_file_is_refused(tmp_path, mesh, kept):
    path = tmp_path / "box_glass.ply"
    meshes.write_mesh(path, *mesh)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    assert meshes.read_normals(path) is None
    with pytest.raises(ValueError, match="export it again"):
        meshes.read_part(path, index=1.5)
