"""The figures of docs/glass.md: what is drawn of bodies and paths, and the command once."""

import numpy as np
import pytest
import trimesh

from experiments.figures import cross_sections
from refref_jax.data import SceneError
from refref_jax.data.meshes import MeshPart
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"


def _part(mesh):
    return MeshPart("body", np.asarray(mesh.vertices), np.asarray(mesh.faces), 1.5, "auto")


def test_bodies_are_cut_into_outlines_that_go_round_in_order():
    (outline,) = cross_sections.outlines_of([_part(trimesh.creation.box([2.0, 3.0, 4.0]))])
    assert np.abs(outline).max(axis=0) == pytest.approx([1.0, 1.5])
    on_border = np.isclose(np.abs(outline), [1.0, 1.5]).any(axis=-1)
    assert on_border.all()
    assert cross_sections.width_of([outline]) == pytest.approx(1.5)
    outlines = cross_sections.outlines_of([_part(trimesh.creation.torus(1.0, 0.3))])
    # The area of a polygon is that of the disc, but for the facets; of points in any other order
    # it would be far smaller.
    rings = [(xy.T, np.roll(xy, -1, axis=0).T) for xy in outlines]
    areas = [abs(np.sum(x * next_y - y * next_x)) / 2.0 for (x, y), (next_x, next_y) in rings]
    assert sorted(areas) == pytest.approx([np.pi * 0.7**2, np.pi * 1.3**2], rel=0.02)
    above = trimesh.creation.box().apply_translation([0.0, 0.0, 2.0])
    with pytest.raises(SceneError, match="around the origin"):
        cross_sections.outlines_of([_part(above)])


def test_an_open_mesh_has_one_outline_from_end_to_end():
    # Three quarters of a tube's wall, whose gap is behind, so that its first point is no end.
    angles = np.linspace(-0.75 * np.pi, 0.75 * np.pi, 40) + np.pi
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    vertices = np.concatenate([np.insert(ring, 2, z, axis=-1) for z in (-1.0, 1.0)])
    first = np.arange(39)
    faces = np.concatenate([first[:, None] + [0, 1, 40], first[:, None] + [1, 41, 40]])
    tube = trimesh.Trimesh(vertices, faces, process=False)
    (outline,) = cross_sections.outlines_of([_part(tube)])
    found = np.unwrap(np.arctan2(-outline[:, 1], -outline[:, 0]))
    assert np.all(np.diff(found) > 0.0) or np.all(np.diff(found) < 0.0)
    assert sorted(found[[0, -1]]) == pytest.approx([-0.75 * np.pi, 0.75 * np.pi], abs=1e-4)


@pytest.mark.slow
def test_the_command_draws_all_figures(tmp_path):
    result = run_command("glass_figures", f"--scene={_SCENE}", f"--out={tmp_path}")
    made = sorted(tmp_path.glob("*.jpg"))
    assert [path.name for path in made] == [
        f"glass_{name}.jpg" for name in ("distances", "fan", "tree", "views")
    ]
    for path in made:
        assert path.stat().st_size < 300_000 and str(path) in result.stdout
