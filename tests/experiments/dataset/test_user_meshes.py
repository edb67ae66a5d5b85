"""Objects of the user's own meshes."""

import numpy as np
import pytest
import trimesh

from experiments.dataset import user_meshes
from experiments.dataset.parts import RADIUS
from refref_jax.geometry.triangle_meshes import volume
from tests.processes.command import run_command


@pytest.fixture
def ring(tmp_path):
    path = tmp_path / "My Ring-1.stl"
    mesh = trimesh.creation.annulus(0.5, 1.0, 0.4)
    mesh.apply_scale(37.0)
    mesh.apply_translation([100.0, 5.0, 3.0])
    mesh.invert()
    mesh.export(path)
    return path


def test_read_object_centres_scales_and_orients(ring):
    made = user_meshes.read_object([ring], ["glass"])
    (part,) = made.make(1.0)
    assert (made.name, made.category) == ("my_ring_1", "smncvx")
    assert (part.material, part.smooth) == ("glass", False)
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    np.testing.assert_allclose(low, -high, atol=1e-6)
    assert np.linalg.norm(part.vertices, axis=-1).max() == pytest.approx(0.9 * RADIUS)
    assert volume(part.vertices, part.faces) > 0.0


def test_read_object_keeps_parts_in_place(tmp_path):
    for name, radius in (("shell", 2.0), ("core", 1.0)):
        ball = trimesh.creation.icosphere(4, radius=radius)
        ball.apply_translation([0.0, 0.0, 2.0 - radius])
        ball.export(tmp_path / f"{name}.ply")
    paths = [tmp_path / "shell.ply", tmp_path / "core.ply"]
    made = user_meshes.read_object(paths, ["glass", "water"])
    shell, core = made.make(1.0)
    assert (made.category, shell.material, core.material) == ("mmncvx", "glass", "water")
    assert shell.smooth and core.smooth
    assert np.ptp(core.vertices[:, 2]) == pytest.approx(0.5 * np.ptp(shell.vertices[:, 2]))
    assert core.vertices[:, 2].max() == pytest.approx(shell.vertices[:, 2].max())


def test_read_object_recognises_convex_meshes(tmp_path):
    trimesh.creation.icosphere(3).export(tmp_path / "orb.ply")
    assert user_meshes.read_object([tmp_path / "orb.ply"], ["glass"]).category == "smcvx"


def test_read_object_keeps_a_cavity(tmp_path):
    outer, inner = (trimesh.creation.icosphere(3, radius=radius) for radius in (1.0, 0.5))
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "hollow.ply")
    made = user_meshes.read_object([tmp_path / "hollow.ply"], ["glass"])
    (part,) = made.make(1.0)
    assert made.category == "smncvx"
    whole = (0.9 * RADIUS) ** 3 * outer.volume
    assert volume(part.vertices, part.faces) == pytest.approx(whole * (1.0 - 0.5**3), rel=1e-6)


def test_pieces_within_one_another_are_not_convex(tmp_path):
    balls = [trimesh.creation.icosphere(3, radius=radius) for radius in (1.0, 0.5)]
    trimesh.util.concatenate(balls).export(tmp_path / "twice.ply")
    assert user_meshes.read_object([tmp_path / "twice.ply"], ["glass"]).category == "smncvx"


def test_digest_tells_meshes_and_materials_apart(ring, tmp_path):
    trimesh.creation.icosphere(1).export(tmp_path / "orb.ply")
    found = {
        user_meshes.digest([path], [material])
        for path in (ring, tmp_path / "orb.ply")
        for material in ("glass", "water")
    }
    assert len(found) == 4


def test_mistakes_end_before_anything_is_made(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "orb.ply")
    ball.update_faces(np.arange(len(ball.faces)) > 3)
    ball.export(tmp_path / "open.ply")
    (tmp_path / "text.ply").write_text("not a mesh")
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 1]], process=False).export(tmp_path / "flat.ply")
    out = tmp_path / "out"
    for options, said in [
        (("--mesh=open.ply",), "open.ply is not closed"),
        (("--mesh=flat.ply",), "flat.ply encloses no volume"),
        (("--mesh=none.ply",), "none.ply does not exist"),
        (("--mesh=text.ply",), "text.ply is not a mesh"),
        (("--mesh=orb.ply", "--material=wine"), "no material 'wine'"),
        (("--mesh=orb.ply", "--material=glass", "--material=air"), "2 materials for 1 meshes"),
        (("--mesh=orb.ply", "--scenes=cube_smcvx_ball"), "cube_smcvx_orb"),
    ]:
        given = [each.replace("--mesh=", f"--mesh={tmp_path}/") for each in options]
        answer = run_command(
            "dataset.make", f"--out={out}", "--blender=/bin/true", *given, fails=True
        )
        assert said in answer.stderr and "Traceback" not in answer.stderr
    assert not out.exists()
