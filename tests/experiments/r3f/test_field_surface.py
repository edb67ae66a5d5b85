"""The geometry of a NeuS field, with its initial ball, which is known exactly, as the field."""

import dataclasses
import shutil

import numpy as np
import pytest

from experiments.r3f import chain, field_surface, geometry_stage, index_stage, records, report
from experiments.r3f.records import ReconstructionConfig
from refref_jax.data import scene_folder
from refref_jax.geometry.triangle_meshes import volume
from refref_jax.reconstruct.grids import Grid, find_isosurface
from refref_jax.reconstruct.masks import overlaps
from refref_jax.render import Model
from refref_jax.render.model import ball_of
from tests.factories import bodies
from tests.factories.silhouettes import without_masks, write_scene
from tests.factories.small_model import initial

_CONFIG = ReconstructionConfig("neus", 32, 0, 1.5, "bounded", 4.0, "none", 0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball", views=6, meshes=False)


@pytest.fixture(scope="module")
def bare(scene, tmp_path_factory):
    copy = tmp_path_factory.mktemp("bare") / "cube_smcvx_ball"
    return without_masks(shutil.copytree(scene, copy))


@pytest.fixture
def untrained(monkeypatch):
    """Replaces training by the initial model; returns the models that were asked for."""
    asked = []

    def learned(scene, run, wanted):
        saved = wanted.model
        params = initial(saved.config)
        asked.append((run, Model(saved.config, saved.settings, None, params)))
        return asked[-1][1]

    monkeypatch.setattr(index_stage, "learned", learned)
    monkeypatch.setattr(field_surface, "_COARSE", 24)
    return asked


def _radius(asked):
    config = asked[-1][1].config
    return ball_of(config).radius * config.field.start


@pytest.mark.slow
def test_the_surface_is_the_zero_set_of_the_field(bare, untrained, tmp_path):
    grid = field_surface.find(bare, tmp_path, _CONFIG)
    mesh, radius = find_isosurface(grid), _radius(untrained)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), radius, rtol=2e-3)
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)
    run, model = untrained[-1]
    assert run == tmp_path / "field" and model.config.field.kind == "neus"
    assert model.settings.max_bends == 0 and model.config.backdrop is None


@pytest.mark.parametrize("geometry", field_surface.NAMES)
def test_a_geometry_is_the_field_of_its_name_along_straight_rays(bare, geometry):
    wanted = field_surface._resolved(bare, dataclasses.replace(_CONFIG, geometry=geometry))
    assert wanted.model.config.field.kind == geometry
    assert wanted.model.settings.max_bends == 0 and wanted.config.seed == _CONFIG.seed


def test_the_largest_piece_is_the_object():
    x, y, z = np.meshgrid(*[np.linspace(-2.0, 2.0, 33)] * 3, indexing="ij")
    large = np.sqrt((x + 0.8) ** 2 + y**2 + z**2) - 0.9
    small = np.sqrt((x - 1.4) ** 2 + y**2 + z**2) - 0.4
    both = Grid(np.minimum(large, small), np.full(3, -2.0), 0.125)
    alone = field_surface._largest(both)
    assert (np.sign(alone.values[large < 0.0]) == -1.0).all()
    assert (alone.values[small < 0.0] >= 0.0).all()
    untouched = small >= 0.0
    np.testing.assert_array_equal(alone.values[untouched], both.values[untouched])


def test_a_field_without_a_surface_is_told():
    nothing = Grid(np.ones((4, 4, 4)), np.zeros(3), 1.0)
    with pytest.raises(ValueError, match=r"no surface.*--geometry=hull"):
        field_surface._largest(nothing)


@pytest.mark.slow
def test_a_scene_without_masks_gets_silhouettes_of_the_surface(bare, untrained, tmp_path):
    masked = field_surface.masked_scene(bare, tmp_path, _CONFIG)
    assert masked.name == bare.name and masked != bare
    radius = _radius(untrained)
    for split in ("train", "test"):
        frames = scene_folder.read_frames(masked, split)
        expected = bodies.masks_of(
            lambda points: bodies.ball(points, radius=radius), frames.cameras
        )
        assert min(overlaps(scene_folder.read_masks(frames), expected)) > 0.97
    assert scene_folder.read_frames(bare, "train").masks is None
    trained = len(untrained)
    assert field_surface.masked_scene(bare, tmp_path, _CONFIG) == masked
    assert len(untrained) == trained  # the copy is not made again


@pytest.mark.parametrize("geometry", ["neus", "nunerf", "hull"])
def test_masks_that_are_there_are_kept(scene, untrained, tmp_path, geometry):
    config = dataclasses.replace(_CONFIG, geometry=geometry)
    assert field_surface.masked_scene(scene, tmp_path, config) == scene and not untrained
    assert field_surface.warnings(scene, tmp_path) == ()


@pytest.mark.slow
def test_a_reconstruction_without_masks_says_so(bare, untrained, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_HEIGHT", 40)
    out = tmp_path / "out"
    said = []
    found = chain.reconstruct(bare, out, _CONFIG, compare=False, say=said.append)
    assert any("has no masks" in warning for warning in found.geometry.warnings)
    assert any("warning: the scene has no masks" in line for line in said)
    assert found.scene == "cube_smcvx_ball" and found.geometry.mesh == "ball_glass.ply"
    assert found.report.mean_overlap > 0.97
    before = records.read(out)
    monkeypatch.setattr(geometry_stage, "run", None)  # would raise
    chain.reconstruct(bare, out, _CONFIG, compare=False, say=said.append)
    assert records.read(out) == before
