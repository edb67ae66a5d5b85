"""Meshes and points of planted fields, and bodies of planted geometry."""

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from experiments.exporting import field_mesh, object_meshes
from refref_jax.data import meshes
from refref_jax.fields import registry
from refref_jax.fields.base import Radiance, RadianceConfig
from refref_jax.optics.path_settings import PAPER
from refref_jax.reconstruct.grids import Grid
from refref_jax.render.model import Model, Params
from tests.factories import scenes, small_model, solids
from tests.processes.command import run_command

_RADIUS = 2.0  # of the scene
_SOFT = 0.15

# Half-way down, the planted density is this, per world unit.
_LEVEL = 8.0


@dataclasses.dataclass(frozen=True)
class _BallConfig(RadianceConfig):
    kind: Literal["ball"] = dataclasses.field(default="ball", kw_only=True)


def _ball(params, config, gaussians, direction):
    """A ball of radius 1 about (0.2, 0, 0): red on the side of larger x, blue on the other."""
    del params, config
    point = (2.0 * gaussians.positions[0] - 1.0) * _RADIUS - jnp.array([0.2, 0.0, 0.0])
    density = _LEVEL * jnp.exp((1.0 - jnp.linalg.norm(point)) / _SOFT)
    side = jnp.where(point[0] > 0.0, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    looks_inwards = jnp.where(jnp.vdot(direction, point) < 0.0, 1.0, 0.2)
    return Radiance(_RADIUS * density, side * looks_inwards)


@pytest.fixture
def model(monkeypatch):
    plain = registry.KINDS["zipnerf"]._replace(radiance_config=_BallConfig, radiance=_ball)
    monkeypatch.setitem(registry.KINDS, "ball", plain)
    config = dataclasses.replace(
        small_model.MODEL, field=_BallConfig(), radius=_RADIUS, interior="field"
    )
    return Model(config, PAPER, scenes.build(), Params((), {}))


def _sampled(model, resolution=40, half=1.6):
    steps = []
    grid = field_mesh.sample_density(
        model,
        np.full(3, -half),
        np.full(3, half),
        resolution=resolution,
        step=lambda done, total: steps.append((done, total)),
    )
    assert steps[-1] == (resolution + 1, resolution + 1)
    return grid


def test_a_planted_ball_is_found_with_radius_volume_and_colours(model, tmp_path):
    grid = _sampled(model)
    assert grid.spacing == pytest.approx(0.08) and grid.values.shape == (41, 41, 41)
    found = field_mesh.find_surface(grid, level=_LEVEL)
    distances = np.linalg.norm(found.vertices - [0.2, 0.0, 0.0], axis=-1)
    np.testing.assert_allclose(distances, 1.0, atol=0.005)
    outwards = (found.vertices - [0.2, 0.0, 0.0]) / distances[:, None]
    assert np.sum(found.normals * outwards, axis=-1).min() > 0.98
    _, colours = field_mesh.look_up_points(model, found.vertices, -found.normals, width=0.08)
    field_mesh.write_surface(tmp_path / "ball.ply", found, np.rint(255 * colours).astype(np.uint8))
    read = trimesh.load(tmp_path / "ball.ply", process=False)
    assert read.is_watertight
    assert read.volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.01)
    right, left = read.vertices[:, 0] > 0.25, read.vertices[:, 0] < 0.15
    assert (read.visual.vertex_colors[right, :3] == [255, 0, 0]).all()
    assert (read.visual.vertex_colors[left, :3] == [0, 0, 255]).all()
    np.testing.assert_allclose(read.vertex_normals, found.normals, atol=1e-5)
    # Points are the shell of the ball.
    shell = field_mesh.find_points(grid, level=_LEVEL)
    distances = np.linalg.norm(shell.points - [0.2, 0.0, 0.0], axis=-1)
    assert distances.max() <= 1.0 + 1e-6 and distances.min() > 1.0 - np.sqrt(3.0) * grid.spacing
    outwards = (shell.points - [0.2, 0.0, 0.0]) / distances[:, None]
    assert np.sum(shell.normals * outwards, axis=-1).min() > 0.9
    eight = np.full(shell.points.shape, (255, 0, 128), np.uint8)
    field_mesh.write_points(tmp_path / "points.ply", shell, eight)
    read = trimesh.load(tmp_path / "points.ply")
    assert isinstance(read, trimesh.PointCloud)
    np.testing.assert_allclose(read.vertices, shell.points, atol=1e-6)
    np.testing.assert_array_equal(read.colors[:, :3], eight)


def test_density_is_per_world_unit_and_colours_go_by_the_side_that_is_looked_at(model):
    point, along = np.array([[1.2, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    density, front = field_mesh.look_up_points(model, point, -along, width=0.1)
    _, back = field_mesh.look_up_points(model, point, along, width=0.1)
    assert density[0] == pytest.approx(_LEVEL, rel=1e-4)
    np.testing.assert_allclose(front, [[1.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(back, [[1.055 * 0.2 ** (1 / 2.4) - 0.055, 0, 0]], atol=1e-5)
    none, rgb = field_mesh.look_up_points(model, np.zeros((0, 3)), None, width=0.1)
    assert none.shape == (0,) and rgb.shape == (0, 3)


def test_where_no_samples_are_taken_there_is_no_density(model):
    glass = scenes.build(scenes.ball(0.8, subdivisions=3))
    clear = model._replace(config=dataclasses.replace(model.config, interior="clear"), scene=glass)
    everywhere, outside = _sampled(model, 20), _sampled(clear, 20)
    ticks = np.linspace(-1.6, 1.6, 21)
    distance = np.sqrt(ticks[:, None, None] ** 2 + ticks[:, None] ** 2 + ticks**2)
    assert (outside.values[distance < 0.78] == 0.0).all()
    far = distance > 0.8
    np.testing.assert_array_equal(outside.values[far], everywhere.values[far])
    assert (everywhere.values > 0.0).all()


@pytest.mark.slow
def test_a_cavity_is_inside_and_what_is_between_bodies_is_not():
    scene = scenes.build(
        solids.ball("ball_glass", radius=1.0),
        solids.ball("hole_air", radius=0.5, index=1.0),
        solids.ball("far_glass", radius=0.5, centre=(3.0, 0.0, 0.0)),
    )
    axes = [np.array([-1.2, -0.75, 0.0, 0.75, 1.75, 3.0, 3.9]), np.zeros(1), np.zeros(1)]
    inside = field_mesh.inside_objects(scene, axes)[:, 0, 0]
    assert inside.tolist() == [False, True, True, True, False, True, False]


def test_walls_are_where_a_bounded_model_ends():
    empty = Grid(np.zeros((9, 9, 9)), np.full(3, -2.0), 0.5)
    with pytest.raises(ValueError, match="below 5 per world unit in the whole box"):
        field_mesh.find_surface(empty, level=5.0)
    room = field_mesh.with_background(empty, level=5.0)
    found = field_mesh.find_surface(room, level=5.0)
    largest = np.abs(found.vertices).max(axis=-1)
    assert largest.min() > 2.0 - 0.2 * 0.5 and largest.max() <= 2.0
    middles = found.vertices[np.abs(found.vertices[:, 0]) > 1.9]
    flat = np.abs(middles[:, 1:]).max(axis=-1) < 1.4
    index = np.flatnonzero(np.abs(found.vertices[:, 0]) > 1.9)[flat]
    inwards = -np.sign(found.vertices[index, 0])
    np.testing.assert_allclose(found.normals[index, 0], inwards, atol=1e-6)
    points = field_mesh.find_points(room, level=5.0).points
    assert (np.abs(points).max(axis=-1) == 2.0).all()
    dense = Grid(np.full((4, 4, 4), 9.0), np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="at least 5 per world unit in the whole box"):
        field_mesh.find_points(dense, level=5.0)


def test_a_spherical_model_ends_on_its_sphere():
    empty = Grid(np.zeros((33, 33, 33)), np.full(3, -2.0), 0.125)
    room = field_mesh.with_sphere(empty, level=5.0, radius=1.7)
    found = field_mesh.find_surface(room, level=5.0)
    distances = np.linalg.norm(found.vertices, axis=-1)
    # A tenth of a cell is what marching cubes may move a vertex by.
    np.testing.assert_allclose(distances, 1.7, atol=0.0125)
    inwards = -found.vertices / distances[:, None]
    assert np.sum(found.normals * inwards, axis=-1).min() > 0.98
    solid = Grid(np.full((33, 33, 33), 9.0, np.float32), empty.low, 0.125)
    kept = field_mesh.with_sphere(solid, level=5.0, radius=1.7).values
    # What the field has within is not touched, and walls are nowhere thinner than the level.
    assert kept.dtype == np.float32 and kept.min() == 9.0
    assert room.values[0, 0, 0] > 5.0 and room.values[16, 16, 16] < 5.0 * np.exp(-5.9)


def test_bodies_keep_their_normals_and_corners():
    sharp, round_ = solids.box("box_glass", centre=(3.0, 0.0, 0.0)), solids.ball("ball_glass")
    scene = scenes.build(sharp, round_)
    box, ball = object_meshes.read_meshes(scene)
    assert (len(box.vertices), len(box.faces)) == (8, 12)
    assert len(ball.vertices) == len(round_.vertices)
    assert trimesh.Trimesh(*box[:2]).volume == pytest.approx(1.0)
    np.testing.assert_allclose(
        ball.normals, ball.vertices[ball.faces], atol=0.03
    )  # a ball's, not its facets'
    assert np.all(np.sort(np.abs(box.normals), axis=-1)[..., :2] < 1e-6)


def test_a_run_s_bodies_are_files_that_are_read_again(tmp_path, monkeypatch):
    scene = scenes.build(solids.box(centre=(3.0, 0.0, 0.0)), solids.ball())
    monkeypatch.setattr(object_meshes, "load_scene", lambda run: scene)
    written = object_meshes.write(tmp_path, tmp_path / "new" / "body.ply", overwrite=False)
    assert [path.name for path in written] == ["body_0.ply", "body_1.ply"]
    part = meshes.read_part(written[1], index=1.5)
    np.testing.assert_array_equal(part.normals, meshes.read_normals(written[1]))
    assert len(part.faces) == 320
    with pytest.raises(ValueError, match=r"body_0\.ply exists.* --overwrite"):
        object_meshes.write(tmp_path, tmp_path / "new" / "body.ply", overwrite=False)
    monkeypatch.setattr(object_meshes, "load_scene", lambda run: scenes.build())
    with pytest.raises(ValueError, match="has no object"):
        object_meshes.write(tmp_path, tmp_path / "none.ply", overwrite=False)


@pytest.mark.slow
def test_the_command_writes_the_bodies_of_a_run(trained, tmp_path):
    options = (f"--run={trained}", "--what=object", f"--out={tmp_path / 'body.ply'}")
    assert "body.ply" in run_command("export", *options).stdout
    read = trimesh.load(tmp_path / "body.ply")
    assert read.volume == pytest.approx(4.0 / 3.0 * np.pi * 1.4**3, rel=0.01)  # the bundled ball
    again = run_command("export", *options, fails=True)
    assert "--overwrite to replace it" in again.stderr and "Traceback" not in again.stderr
    run_command("export", *options, "--overwrite")
    assert {path.name for path in tmp_path.iterdir()} == {"body.ply"}


@pytest.mark.slow
def test_the_command_writes_the_walls_of_a_run(trained, tmp_path):
    for what in ("mesh", "points"):
        out = tmp_path / f"{what}.ply"
        options = (f"--run={trained}", f"--what={what}", f"--out={out}", "--resolution=8")
        assert "from -7.3 to 7.3" in run_command("export", *options).stdout
        read = trimesh.load(out, process=False)
        # Where a field is denser than the level at its walls, the surface is a little within them.
        outermost = np.abs(read.vertices).max(axis=-1)
        assert outermost.min() > 7.2 and outermost.max() < 7.3 + 1e-4
        colours = read.visual.vertex_colors if what == "mesh" else read.colors
        assert len(np.unique(colours, axis=0)) > 10


def test_a_spherical_model_around_another_centre_ends_on_its_sphere():
    centre = np.array([3.0, -1.0, 0.5])
    empty = Grid(np.zeros((17, 17, 17)), centre - 2.0, 0.25)
    room = field_mesh.with_sphere(empty, level=5.0, radius=1.7, centre=(3.0, -1.0, 0.5))
    found = field_mesh.find_surface(room, level=5.0)
    distances = np.linalg.norm(found.vertices - centre, axis=-1)
    np.testing.assert_allclose(distances, 1.7, atol=0.025)
