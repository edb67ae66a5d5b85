import itertools
import math

import numpy as np
import pytest
import trimesh

from refref_jax.geometry.triangle_meshes import CREASE_ANGLE, corner_normals, face_normals

# Double precision, after a few sums.
_EXACT = 1e-12

# Normals of a ball of 1280 triangles, in radians: averaged ones, and those of the faces.
_SMOOTH_BALL, _FLAT_BALL = math.radians(1.0), math.radians(5.0)


def _arrays(mesh):
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def _ball(subdivisions=3):
    return _arrays(trimesh.creation.icosphere(subdivisions=subdivisions))


def _box(size=(1.0, 2.0, 3.0)):
    return _arrays(trimesh.creation.box(size))


def _cylinder(sections=32):
    return _arrays(trimesh.creation.cylinder(1.0, 2.0, sections=sections))


def _rough_ball():
    """A ball whose vertices are shaken, so that some of its edges are creases."""
    vertices, faces = _ball(1)
    return vertices + np.random.default_rng(0).normal(scale=0.08, size=vertices.shape), faces


def _hinge(angle):
    """Two triangles that share the edge from 0 to 1, their normals at an angle to each other."""
    far = [-math.cos(angle), 0.5, -math.sin(angle)]
    vertices = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.5, 0.0], far])
    return vertices, np.array([[0, 2, 1], [0, 1, 3]])


def _flat(vertices, faces):
    return np.repeat(face_normals(vertices[faces])[:, None], 3, axis=1)


def _angles(normals, expected):
    """Returns the angles between unit vectors, in radians, accurate also for small ones."""
    return 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(normals - expected, axis=-1), 0.0, 1.0))


def _slow_normal(vertices, face):
    a, b, c = vertices[face]
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal)


def _slow_angle(vertices, face, vertex):
    place = list(face).index(vertex)
    to_next = vertices[face[(place + 1) % 3]] - vertices[vertex]
    to_last = vertices[face[(place + 2) % 3]] - vertices[vertex]
    return math.atan2(np.linalg.norm(np.cross(to_next, to_last)), np.dot(to_next, to_last))


def _slow_patches(vertices, faces, crease_angle):
    """Numbers the patches by painting: faces that meet smoothly take the lower number."""
    normals = [_slow_normal(vertices, face) for face in faces]
    smooth = [
        (i, j)
        for i, j in itertools.combinations(range(len(faces)), 2)
        if len(set(faces[i]) & set(faces[j])) == 2
        and math.acos(min(1.0, np.dot(normals[i], normals[j]))) < crease_angle
    ]
    patch = list(range(len(faces)))
    while any(patch[i] != patch[j] for i, j in smooth):
        for i, j in smooth:
            patch[i] = patch[j] = min(patch[i], patch[j])
    return patch


def _slow_corner_normals(vertices, faces, crease_angle):
    patch = _slow_patches(vertices, faces, crease_angle)
    sums = np.zeros((len(faces), 3, 3))
    for i, corner, j in itertools.product(range(len(faces)), range(3), range(len(faces))):
        vertex = faces[i][corner]
        if patch[j] == patch[i] and vertex in faces[j]:
            weight = _slow_angle(vertices, faces[j], vertex)
            sums[i, corner] += weight * _slow_normal(vertices, faces[j])
    return sums / np.linalg.norm(sums, axis=-1, keepdims=True)


def test_face_normal_by_hand():
    corners = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]]])
    np.testing.assert_array_equal(face_normals(corners), [[0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(face_normals(corners[:, ::-1]), [[0.0, 0.0, -1.0]])


@pytest.mark.parametrize("crease_angle", [0.1, 0.5, math.pi])
@pytest.mark.parametrize("mesh", [_rough_ball(), _cylinder(6)], ids=["rough-ball", "cylinder"])
def test_corner_normals_agree_with_a_slow_reference(mesh, crease_angle):
    normals = corner_normals(*mesh, crease_angle=crease_angle)
    np.testing.assert_allclose(normals, _slow_corner_normals(*mesh, crease_angle), atol=1e-9)


def test_the_reference_mesh_has_creases_and_smooth_edges():
    vertices, faces = _rough_ball()
    patches = len(set(_slow_patches(vertices, faces, 0.5)))
    assert 1 < patches < len(faces)


def test_a_smoothed_box_points_to_its_corners():
    """Each side has a right angle at a corner, however it is cut into triangles."""
    vertices, faces = _box((2.0, 2.0, 2.0))
    normals = corner_normals(vertices, faces, crease_angle=math.pi)
    np.testing.assert_allclose(normals, vertices[faces] / math.sqrt(3.0), atol=_EXACT)


@pytest.mark.parametrize("degrees", [-29.0, -5.0, 0.0, 1.0, 29.0])
def test_the_two_sides_of_a_smooth_hinge_share_the_middle_normal(degrees):
    angle = math.radians(degrees)
    normals = corner_normals(*_hinge(angle))
    middle = [-math.sin(0.5 * angle), 0.0, math.cos(0.5 * angle)]
    np.testing.assert_allclose(normals[0, [0, 2]], [middle] * 2, atol=_EXACT)
    np.testing.assert_allclose(normals[1, [0, 1]], [middle] * 2, atol=_EXACT)
    np.testing.assert_allclose(normals[0, 1], [0.0, 0.0, 1.0], atol=_EXACT)
    np.testing.assert_allclose(normals[1, 2], [-math.sin(angle), 0.0, math.cos(angle)], atol=_EXACT)


@pytest.mark.parametrize("degrees", [-120.0, -31.0, 31.0, 90.0, 179.0])
def test_a_sharp_hinge_is_flat(degrees):
    mesh = _hinge(math.radians(degrees))
    np.testing.assert_allclose(corner_normals(*mesh), _flat(*mesh), atol=_EXACT)


def test_the_crease_angle_is_thirty_degrees():
    assert pytest.approx(math.pi / 6.0) == CREASE_ANGLE


@pytest.mark.parametrize("mesh", [_ball(1), _cylinder(), _hinge(0.1)])
def test_no_crease_angle_gives_face_normals(mesh):
    np.testing.assert_array_equal(corner_normals(*mesh, crease_angle=0.0), _flat(*mesh))


def test_the_order_of_faces_and_corners_does_not_matter():
    vertices, faces = _rough_ball()
    order = np.random.default_rng(0).permutation(len(faces))
    normals = corner_normals(vertices, np.roll(faces[order], 1, axis=1))
    expected = np.roll(corner_normals(vertices, faces)[order], 1, axis=1)
    np.testing.assert_allclose(normals, expected, atol=_EXACT)


def test_separate_pieces_do_not_see_each_other():
    one, other = _ball(1), _cylinder()
    together = np.concatenate([one[0], other[0]]), np.concatenate([one[1], other[1] + len(one[0])])
    expected = np.concatenate([corner_normals(*one), corner_normals(*other)])
    np.testing.assert_allclose(corner_normals(*together), expected, atol=_EXACT)


def test_pieces_that_share_only_a_vertex_stay_apart():
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0.2], [0, -1, 0.2]], dtype=np.float64
    )
    mesh = vertices, np.array([[0, 1, 2], [0, 3, 4]])
    np.testing.assert_allclose(
        corner_normals(*mesh, crease_angle=math.pi), _flat(*mesh), atol=_EXACT
    )


@pytest.mark.parametrize("crease_angle", [0.0, CREASE_ANGLE, math.pi])
@pytest.mark.parametrize("corners", [(0, 0, 1), (0, 0, 0)])
def test_a_face_with_a_repeated_corner_has_zero_normals_and_no_weight(corners, crease_angle):
    vertices, faces = _ball(1)
    shuffled = faces[0][list(corners)]
    normals = corner_normals(
        vertices, np.concatenate([faces, shuffled[None]]), crease_angle=crease_angle
    )
    expected = corner_normals(vertices, faces, crease_angle=crease_angle)
    np.testing.assert_allclose(normals[:-1], expected, atol=_EXACT)
    np.testing.assert_array_equal(normals[-1], 0.0)


@pytest.mark.parametrize("share", [0.3, 1.0 / 3.0, 0.5])
@pytest.mark.parametrize("crease_angle", [CREASE_ANGLE, math.pi])
def test_a_face_without_area_has_no_weight(share, crease_angle):
    """Rounding gives a collinear face some normal, and its middle corner an angle of pi."""
    vertices, faces = _ball()
    first, second, opposite = faces[0]
    middle = len(vertices)
    vertices = np.vstack([vertices, vertices[first] * (1.0 - share) + vertices[second] * share])
    split = [[first, middle, opposite], [middle, second, opposite], [first, second, middle]]
    normals = corner_normals(vertices, np.vstack([faces[1:], split]), crease_angle=crease_angle)
    radial = vertices[np.vstack([faces[1:], split])]
    radial /= np.linalg.norm(radial, axis=-1, keepdims=True)
    assert np.max(_angles(normals, radial)[:-1]) < _FLAT_BALL


def test_normals_that_cancel_fall_back_to_the_face_s_own():
    """Two opposite faces are one patch by way of a third; they cancel at the corner they share."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [2, 1, 3], [0, 2, 1]])
    normals = corner_normals(vertices, faces, crease_angle=math.pi)
    np.testing.assert_array_equal(normals[0, 0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(normals[2, 0], [0.0, 0.0, -1.0])


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_normals_know_no_size(scale):
    vertices, faces = _cylinder()
    np.testing.assert_allclose(
        corner_normals(scale * vertices, faces), corner_normals(vertices, faces), atol=1e-9
    )
