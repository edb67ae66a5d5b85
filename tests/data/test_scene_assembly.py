"""Bodies of files, trimeshes and arrays, and the scenes that they make."""

import warnings

import jax
import numpy as np
import pytest
import trimesh

from refref_jax.data import SceneError
from refref_jax.data.scene_assembly import assemble, assemble_scene, make_part, single_object
from refref_jax.optics.interface_rules import NO_PARENT
from tests.factories.solids import ball, box, inverted


def _same_scene(one, other):
    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_file_a_mesh_and_its_arrays_are_one_body(tmp_path):
    mesh = trimesh.creation.box([1.0, 2.0, 3.0])
    path = tmp_path / "crate.ply"
    mesh.export(path)
    made = [
        make_part(each, index=1.4, name="crate") for each in (mesh, (mesh.vertices, mesh.faces))
    ]
    made += [make_part(path, index=1.4), make_part(str(path), index=1.4)]
    for part in made:
        assert (part.name, part.index, part.shading, part.normals) == ("crate", 1.4, "auto", None)
        _same_scene(assemble([part]), single_object(mesh, index=1.4))


def test_equal_corners_are_merged():
    soup = trimesh.creation.box().triangles.reshape(-1, 3)
    part = make_part((soup, np.arange(36).reshape(-1, 3)), index=1.5)
    assert part.vertices.shape == (8, 3) and part.name == "body"


def test_what_is_known_of_a_body_is_kept():
    tint, absorption = (0.5, 0.8, 0.9), (1.0, 0.2, 0.0)
    part = make_part(
        trimesh.creation.box(),
        index=1.5,
        shading="flat",
        tint=tint,
        absorption=absorption,
        priority=3,
    )
    assert (part.shading, part.priority, part.colour_known) == ("flat", 3, True)
    interfaces = assemble([part]).interfaces
    np.testing.assert_allclose(interfaces.tint, [tint], rtol=1e-6)
    np.testing.assert_allclose(interfaces.absorption, [absorption], rtol=1e-6)
    assert not make_part(trimesh.creation.box(), index=1.5).colour_known


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"index": 0.0}, "index of refraction of 'body' is 0.0"),
        ({"index": np.nan}, "positive number"),
        ({"index": 1.5, "tint": (1.1, 0.0, 0.0)}, "tint of 'body'.*from 0 to 1"),
        ({"index": 1.5, "absorption": (-1.0, 0.0, 0.0)}, "absorption of 'body'.*0 or positive"),
        ({"index": 1.5, "absorption": (np.inf, 0.0, 0.0)}, "absorption of 'body'"),
    ],
)
def test_numbers_without_meaning_are_refused(options, message):
    with pytest.raises(SceneError, match=message):
        make_part(trimesh.creation.box(), **options)


_CUBE = trimesh.creation.box()


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (_CUBE.vertices, np.zeros((0, 3), int), "has no triangles"),
        (_CUBE.vertices[:4], _CUBE.faces, "faces without vertices"),
        (_CUBE.vertices, -_CUBE.faces, "faces without vertices"),
        (_CUBE.vertices * np.nan, _CUBE.faces, "not finite"),
        (_CUBE.vertices[:, :2], _CUBE.faces, r"shape \(8, 2\)"),
        (_CUBE.vertices, _CUBE.faces.astype(float), "type float64"),
        (_CUBE.vertices, _CUBE.faces.ravel(), r"shape \(36,\)"),
    ],
)
def test_broken_arrays_are_refused(vertices, faces, message):
    with pytest.raises(SceneError, match=message):
        make_part((np.asarray(vertices), np.asarray(faces)), index=1.5, name="odd")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"ball\.ply cannot be read"):
        single_object(tmp_path / "ball.ply", index=1.5)


def test_a_scene_finds_what_lies_in_what():
    cup, drink = box("cup", size=(4.0, 4.0, 4.0)), ball("drink", index=1.333)
    for rule in ("nested", "facing"):
        _same_scene(
            assemble([cup, drink], rule=rule),
            assemble_scene([cup, drink], [NO_PARENT, 0], rule=rule),
        )
    np.testing.assert_allclose(assemble([cup, drink]).interfaces.index_outside, [1.0, 1.5])


def test_no_part_is_an_empty_scene():
    _same_scene(assemble([]), assemble_scene([], [], rule="nested"))


def test_faces_that_point_inwards_are_refused():
    with pytest.raises(SceneError, match=r"Fix them first:\n  ball_glass: .*point inwards"):
        assemble([inverted(ball())])


def test_a_hole_is_warned_of():
    open_box = box()._replace(faces=box().faces[1:])
    with pytest.warns(UserWarning, match="box_glass is not watertight"):
        assemble([open_box])


def test_equal_priorities_of_an_overlap_are_warned_of():
    parts = [ball("first"), ball("second", centre=(0.5, 0.0, 0.0))]
    with pytest.warns(UserWarning, match="first has the same priority as second"):
        assemble(parts, rule="priority")


def test_overlaps_that_the_rule_is_for_are_not_warned_of():
    parts = [ball("ice")._replace(priority=2), ball("drink", centre=(0.5, 0.0, 0.0))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assemble(parts, rule="priority")
        assemble(parts, rule="facing")
    with pytest.warns(UserWarning, match="ice intersects or touches drink"):
        assemble(parts)
