"""The figures of docs/glass.md: what is drawn of bodies and paths, and the command once."""

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh

from experiments.figures import cross_sections, glass
from experiments.figures.cross_sections import Panel
from experiments.figures.glass import Shown
from refref_jax.data import SceneError
from refref_jax.data.meshes import MeshPart
from refref_jax.optics.light_paths import PathStatus
from refref_jax.render.pixel_paths import PixelPaths
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"


def _part(mesh):
    return MeshPart("body", np.asarray(mesh.vertices), np.asarray(mesh.faces), 1.5, "auto")


def _paths(*polylines, shares):
    return PixelPaths(
        polylines=tuple(np.array(line, np.float32) for line in polylines),
        throughput=np.repeat(np.array(shares, np.float32)[:, None], 3, axis=-1),
        statuses=(PathStatus.ESCAPED,) * len(polylines),
        num_bends=np.array([len(line) - 2 for line in polylines]),
        dropped=np.zeros(3, np.float32),
    )


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


def test_rays_start_in_one_point_and_cross_where_they_are_told():
    rays = cross_sections.rays_towards(4.0, [-1.0, 0.0, 2.0])
    for ray, height in zip(rays, (-1.0, 0.0, 2.0), strict=True):
        assert np.linalg.norm(ray.directions) == pytest.approx(1.0)
        at = ray.origins + 4.0 / ray.directions[0] * ray.directions
        assert at == pytest.approx([0.0, height, 0.0], abs=1e-6)


@pytest.mark.parametrize(
    ("towards", "end"),
    [
        ([9.0, 3.0, 0.0], [2.0, 2.0 / 3.0]),
        ([-50.0, 0.0, 7.0], [-2.0, 0.0]),
        ([0.0, 1e-3, 0.0], [0.0, 2.0]),
        ([-4.0, -4.0, 0.0], [-2.0, -2.0]),
    ],
)
def test_a_path_ends_at_the_border_of_the_picture(towards, end):
    paths = _paths([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], towards], shares=[0.7])
    (line,) = cross_sections.lines_within(paths, 2.0)
    assert line.points[:2].tolist() == [[-1.0, 0.0], [0.0, 0.0]]
    assert line.points[-1] == pytest.approx(end)
    assert line.share == pytest.approx(0.7)


def test_every_drawing_is_a_picture_with_something_in_it(tmp_path):
    outline = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    start = [-2.0, 0.0, 0.0]
    paths = _paths(
        [start, [-1.0, 0.0, 0.0], [9.0, 1.0, 0.0]],
        [start, [-1.0, 0.0, 0.0], [-9.0, 4.0, 0.0]],
        shares=[0.96, 0.04],
    )
    panels = [Panel("one", [paths]), Panel("other", [paths])]
    image = np.full((8, 8, 3), 0.5, np.float32)
    far = np.where(np.eye(8, dtype=bool), np.inf, 3.0)
    far[0, 1] = 2.0
    names = ("views", "fan", "tree", "distances")
    views, fan, tree, distances = (tmp_path / f"{name}.jpg" for name in names)
    glass.write_views(views, [Shown("true", image), Shown("ours", 0.9 * image, 26.0)])
    glass.write_fan(fan, panels, [outline], 3.0)
    glass.write_tree(tree, panels, [outline])
    glass.write_distances(distances, Shown("true", image), [("far", far)])
    for path in (views, fan, tree, distances):
        picture = iio.imread(path)
        assert picture.shape[0] > 300 and picture.shape[1] > 600
        assert picture.min() < 64 and picture.max() > 240 and picture.std() > 5.0


@pytest.mark.slow
def test_the_command_draws_all_figures(tmp_path):
    result = run_command("glass_figures", f"--scene={_SCENE}", f"--out={tmp_path}")
    made = sorted(tmp_path.glob("*.jpg"))
    assert [path.name for path in made] == [
        f"glass_{name}.jpg" for name in ("distances", "fan", "tree", "views")
    ]
    for path in made:
        assert path.stat().st_size < 300_000 and str(path) in result.stdout
