"""Objects that lie wrong: placed by outlines, placed by light, and read as reconstructions."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from experiments.r3f import alignment, chain, index_stage, records, training_body
from experiments.r3f.alignment import Background, PlacedObject, fit_placement
from refref_jax.data import SceneError, meshes
from refref_jax.geometry.triangle_meshes import make_mesh
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.outlines import Outlines
from refref_jax.training.config import TrainConfig
from tests.factories import bodies, scenes
from tests.factories.silhouettes import RADIUS, write_scene

_BUNDLED = Path(__file__).parents[3] / "experiments" / "data" / "cube_smcvx_ball"
_OWN = Background(None, None, None)


def _perturbed(part, *, size=1.03, shift=(0.02, -0.01, 0.03)):
    mesh = make_mesh(size * part.vertices + np.array(shift), part.faces)
    return part._replace(vertices=mesh.vertices, normals=None)


def _errors(parts):
    """Returns the place and the size of a ball, in shares of the true radius."""
    radii = np.linalg.norm(parts[0].vertices - parts[0].vertices.mean(axis=0), axis=1)
    return np.linalg.norm(parts[0].vertices.mean(axis=0)), radii.mean()


@pytest.mark.slow
def test_outlines_place_an_object_before_a_field(tmp_path, monkeypatch):
    scene = write_scene(tmp_path / "cube_smcvx_ball", size=64)
    monkeypatch.setattr(index_stage, "learn_backdrop", lambda *_, **options: None)
    parts = [_perturbed(meshes.read_meshes(scene)[0]._replace(colour_known=True))]
    out = tmp_path / "out"
    out.mkdir()
    facts = alignment.align(scene, parts, out, _OWN, seed=0)
    place, radius = _errors(chain.read_parts(out))
    assert place < 0.005 and radius == pytest.approx(RADIUS, rel=0.005)
    assert facts.size == pytest.approx(1.0 / 1.03, rel=0.005) and facts.error is None
    assert "outlines alone" in alignment.describe(facts)
    found = records.read(out)
    assert found.light.kept and found.light.parts[0].index == parts[0].index
    assert found.inputs == chain.fingerprint(scene)
    config = TrainConfig().override(reconstruction=str(out))
    read = chain.read_parts(out)
    config = training_body.with_parts(
        config, read, out, run=out / "run", ior=(), say=lambda line: None
    )
    assert config.model.interior is None  # nothing says that the shape is wrong


@pytest.mark.slow
def test_light_places_an_object_within_a_thousandth(tmp_path):
    parts = [_perturbed(part) for part in meshes.read_meshes(_BUNDLED)]
    true = meshes.read_meshes(_BUNDLED)[0].vertices
    facts = alignment.align(_BUNDLED, parts, tmp_path, _OWN, seed=0)
    assert facts.light < facts.outlines < 0.3 * facts.given
    found = chain.read_parts(tmp_path)[0].vertices
    extent = np.ptp(true, axis=0)
    np.testing.assert_allclose(np.ptp(found, axis=0), extent, rtol=1e-3)
    middle = 0.5 * (found.max(axis=0) + found.min(axis=0))
    expected = 0.5 * (true.max(axis=0) + true.min(axis=0))
    np.testing.assert_allclose(middle, expected, atol=1e-3 * extent.max())
    assert (tmp_path / alignment.FIGURE).is_file()
    assert "by light" in alignment.describe(facts)


def test_a_placement_is_applied_as_its_file_says(tmp_path):
    ball = scenes.ball(1.0, subdivisions=1)
    facts = alignment.PlacementFacts(
        *((0.0, 0.0, 90.0), (1.0, 0.0, 0.0), 2.0, (0.0, 1.0, 0.0)),
        *((0.1,) * 3, (0.1,) * 3, 0.1, 0.2, 0.1, 0.07, "val"),
    )
    (placed,) = alignment.placed_parts([ball], facts)
    x, y, z = (ball.vertices - [0.0, 1.0, 0.0]).T
    expected = np.array([1.0, 1.0, 0.0]) + 2.0 * np.stack([-y, x, z], axis=-1)
    np.testing.assert_allclose(placed.vertices, expected, atol=1e-9)
    assert "an error of 0.0700 is left" in alignment.describe(facts)


def test_rough_objects_and_none_are_refused():
    ball = scenes.ball(1.0, subdivisions=1)
    rough = ball._replace(material=ball.material._replace(roughness=0.2))
    with pytest.raises(SceneError, match="is rough or dispersive, or not a dielectric"):
        alignment.placed_object([rough])
    with pytest.raises(SceneError, match="no meshes to align"):
        alignment.placed_object([])


def test_other_meshes_than_the_scenes_are_read_by_their_names(tmp_path):
    scene = write_scene(tmp_path / "scene", meshes=False)
    other = tmp_path / "scan"
    other.mkdir()
    meshes.write_mesh(other / "scan_diamond.ply", *bodies.icosphere(2))
    (part,) = meshes.read_meshes(scene, folder=other)
    assert (part.name, part.index) == ("scan_diamond", meshes.INDEX_OF_REFRACTION["diamond"])


_PLACED = np.array([0.02, -0.03, 0.015, 0.02, 0.01, -0.03, np.log(1.03)])


_RADII = np.array([0.6, 0.8, 1.1])


def _ellipsoid(points):
    """A distance that is never too long."""
    return _RADII.min() * (np.linalg.norm(points / _RADII, axis=-1) - 1.0)


def _ellipsoid_mesh():
    ball = bodies.icosphere(4)
    return make_mesh(_RADII * ball.vertices, ball.faces)


def _placed(mesh):
    return PlacedObject([mesh], nested([1.5], [NO_PARENT]))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1.0, 30.0], ids=str)
def test_derivatives_of_a_placement_are_central_differences(size):
    model, direction = _placed(bodies.icosphere(1)), np.linspace(-1.0, 1.5, 7)
    x, step = size * _PLACED, 1e-6
    part, *beside = (model.pose(x + t * direction).parts[0] for t in (0.0, step, -step))
    for name in ("vertices", "normals"):
        change = (getattr(beside[0], name) - getattr(beside[1], name)) / (2.0 * step)
        slopes = getattr(part, f"by_{name}") @ direction
        np.testing.assert_allclose(slopes.reshape(-1, 3), change, atol=1e-7 * max(1.0, size))
    np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, rtol=1e-9)
    (placed,) = model.placed(x)
    np.testing.assert_array_equal(placed.vertices, part.vertices)


@pytest.mark.slow
def test_outlines_place_an_object_that_lies_wrong():
    cameras = bodies.cameras_around(12, size=160, distance=4.0)
    views = Views(bodies.masks_of(_ellipsoid, cameras, steps=120), cameras)
    (wrong,) = _placed(_ellipsoid_mesh()).placed(3.0 * _PLACED)
    model, x = _placed(wrong), None
    for reach in (20.0, 3.0):
        x = fit_placement(model, Outlines(views, reach=reach), x=x)
    (found,) = model.placed(x)
    true = _ellipsoid_mesh().vertices
    # 0.4 % of the length is a fifth of a pixel.
    assert np.max(np.linalg.norm(found.vertices - true, axis=1)) < 0.004 * 2.2
    assert np.max(np.linalg.norm(wrong.vertices - true, axis=1)) > 0.2


def test_an_object_without_parts_is_refused():
    with pytest.raises(ReconstructionError, match="no parts"):
        PlacedObject([], nested([], []))


@pytest.mark.slow
def test_creases_have_outlines_of_their_own():
    """A box of twelve triangles has no other points where it turns away from a camera."""
    cameras = bodies.cameras_around(12, size=160, distance=4.0)
    half = np.array([0.5, 0.7, 0.9])
    masks = bodies.masks_of(lambda points: bodies.box(points, half=half), cameras)
    box = trimesh.creation.box(2.0 * half)
    mesh = make_mesh(np.asarray(box.vertices), np.asarray(box.faces, np.int64))
    (wrong,) = _placed(mesh).placed(_PLACED)
    model, x = _placed(wrong), None
    for reach in (20.0, 3.0):
        x = fit_placement(model, Outlines(Views(masks, cameras), reach=reach, creased=True), x=x)
    (found,) = model.placed(x)
    assert np.max(np.linalg.norm(found.vertices - mesh.vertices, axis=1)) < 0.004 * 2.5


def test_creases_of_an_open_mesh_are_refused():
    box = trimesh.creation.box()
    mesh = make_mesh(np.asarray(box.vertices), np.asarray(box.faces[:-1], np.int64))
    cameras = bodies.cameras_around(2)
    views = Views(bodies.masks_of(bodies.ball, cameras), cameras)
    with pytest.raises(ReconstructionError, match="not closed"):
        fit_placement(_placed(mesh), Outlines(views, creased=True))


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [{"shift": (30.0, 0.0, 0.0)}, {"size": 0.02}])
def test_an_object_that_is_elsewhere_is_refused(tmp_path, monkeypatch, wrong):
    scene = write_scene(tmp_path / "cube_smcvx_ball", size=64)
    monkeypatch.setattr(index_stage, "learn_backdrop", None)  # would raise
    parts = [_perturbed(part, **wrong) for part in meshes.read_meshes(scene)]
    with pytest.raises(ValueError, match="The object cannot be aligned"):
        alignment.align(scene, parts, tmp_path, _OWN, seed=0)
