import numpy as np
import pytest

from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.geometry.triangle_meshes import corner_normals, face_normals
from refref_jax.optics.media import AMBIENT
from tests.factories.solids import ball, box

# Positions and normals are stored in single precision.
_SINGLE = 1e-6


def _nested():
    return [
        ball("bubble_air", radius=0.3, index=1.0),
        box("cup_glass", size=(4.0, 4.0, 4.0), index=1.5),
        ball("drink_water", index=1.333),
    ]


def _build(parts, rule="nested"):
    return assemble_scene(parts, find_containment(parts).parents, rule=rule)


def _own_slots(scene, part):
    """Returns the slots of the triangles of a part; every triangle has at least one."""
    return np.flatnonzero(np.asarray(scene.surfaces.parts) == part)


def test_media_of_nested_parts():
    interfaces = _build(_nested()).interfaces
    np.testing.assert_allclose(interfaces.index_inside, [1.0, 1.5, 1.333], rtol=_SINGLE)
    np.testing.assert_allclose(interfaces.index_outside, [1.333, 1.0, 1.5], rtol=_SINGLE)
    np.testing.assert_array_equal(interfaces.medium_outside, [3, AMBIENT, 2])


def test_media_of_the_facing_rule_have_air_outside():
    interfaces = _build(_nested(), rule="facing").interfaces
    np.testing.assert_allclose(interfaces.index_inside, [1.0, 1.5, 1.333], rtol=_SINGLE)
    np.testing.assert_array_equal(interfaces.index_outside, 1.0)
    np.testing.assert_array_equal(interfaces.medium_outside, [3, AMBIENT, 2])


def test_every_triangle_keeps_its_part():
    parts = _nested()
    scene = _build(parts)
    for number, part in enumerate(parts):
        stored = np.asarray(scene.surfaces.bvh.triangles)[_own_slots(scene, number)]
        expected = part.vertices[part.faces].astype(np.float32)
        assert {t.tobytes() for t in stored} == {t.tobytes() for t in expected}


def test_arrays_are_single_precision():
    scene = _build(_nested())
    assert scene.surfaces.normals.dtype == np.float32
    assert scene.surfaces.bvh.triangles.dtype == np.float32
    assert scene.surfaces.parts.dtype == np.int32
    assert scene.interfaces.index_inside.dtype == np.float32


def _smooth(part):
    return corner_normals(part.vertices, part.faces, crease_angle=np.pi)


def _flat(part):
    return np.repeat(face_normals(part.vertices[part.faces])[:, None], 3, axis=1)


@pytest.mark.parametrize(
    ("part", "shading", "normals"),
    [
        (ball(), "auto", _smooth),
        (ball(), "smooth", _smooth),
        (ball(), "flat", _flat),
        (box(), "auto", _flat),
        (box(), "smooth", _smooth),
        (box(), "flat", _flat),
    ],
)
def test_shading_decides_the_normals(part, shading, normals):
    scene = _build([part._replace(shading=shading)])
    by_corners = {
        corners.tobytes(): normal
        for corners, normal in zip(
            part.vertices[part.faces].astype(np.float32), normals(part), strict=True
        )
    }
    surfaces = scene.surfaces
    for corners, normal in zip(surfaces.bvh.triangles, surfaces.normals, strict=True):
        np.testing.assert_allclose(normal, by_corners[np.asarray(corners).tobytes()], atol=_SINGLE)


def test_a_scene_without_parts_has_one_interface_that_does_nothing():
    scene = assemble_scene([], [], rule="nested")
    np.testing.assert_array_equal(scene.interfaces.index_inside, [1.0])
    np.testing.assert_array_equal(scene.interfaces.index_outside, [1.0])
    np.testing.assert_array_equal(scene.interfaces.medium_outside, [AMBIENT])
    assert scene.surfaces.normals.shape == scene.surfaces.bvh.triangles.shape
    assert scene.surfaces.parts.shape == scene.surfaces.normals.shape[:1]


def test_a_scene_without_parts_can_be_ranked():
    scene = assemble_scene([], [], rule="priority")
    np.testing.assert_array_equal(scene.interfaces.priority, [0])


def test_media_of_the_priority_rule():
    bubble, cup, drink = _nested()
    parts = [bubble._replace(priority=3), cup._replace(priority=1), drink._replace(priority=2)]
    interfaces = _build(parts, rule="priority").interfaces
    np.testing.assert_array_equal(interfaces.priority, [2, 0, 1])
    np.testing.assert_allclose(interfaces.index_inside, [1.0, 1.5, 1.333], rtol=_SINGLE)


@pytest.mark.parametrize("rule", ["nested", "facing", "priority"])
def test_colours_reach_the_interfaces(rule):
    bubble, cup, drink = _nested()
    drink = drink._replace(tint=(0.5, 0.8, 0.95), absorption=(0.0, 1.0, 2.0))
    interfaces = _build([bubble, cup, drink], rule=rule).interfaces
    np.testing.assert_allclose(interfaces.tint[2], [0.5, 0.8, 0.95], rtol=_SINGLE)
    np.testing.assert_array_equal(interfaces.tint[:2], 1.0)
    np.testing.assert_array_equal(interfaces.absorption, [[0.0] * 3, [0.0] * 3, [0.0, 1.0, 2.0]])
