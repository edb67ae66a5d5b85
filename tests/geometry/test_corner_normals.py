import itertools
import math

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from refref_jax.geometry.triangle_meshes import (
    CREASE_ANGLE,
    average_normals,
    corner_angles,
    corner_normals,
    corner_weights,
    face_normals,
    smooth_groups,
)

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


def _random_ball():
    """Triangles of all shapes whose corners lie on a sphere."""
    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    faces = ConvexHull(points).simplices.astype(np.int64)
    inward = np.linalg.det(points[faces]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


def _bevelled(width, bevels=3, sections=8):
    """A cylinder with a rim of bevels, each of the same width, that meet at equal angles."""
    angles = np.linspace(0.0, 0.5 * math.pi, bevels + 2)[1:-1]
    steps = width * np.stack([np.cos(angles), -np.sin(angles)], axis=-1)
    rim = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
    rim += [0.9 - rim[-1, 0], 0.6]
    profile = np.concatenate([[[0.0, -0.6]], rim * [1.0, -1.0], rim[::-1], [[0.0, 0.6]]])
    return _arrays(trimesh.creation.revolve(profile, sections=sections))


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


def _slow_weight(vertices, face, vertex):
    place = list(face).index(vertex)
    to_next = vertices[face[(place + 1) % 3]] - vertices[vertex]
    to_last = vertices[face[(place + 2) % 3]] - vertices[vertex]
    sine = np.linalg.norm(np.cross(to_next, to_last))
    return sine / np.dot(to_next, to_next) / np.dot(to_last, to_last)


def _slow_area(vertices, face):
    a, b, c = vertices[face]
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a))


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


def _slow_angle(vertices, face, vertex):
    place = list(face).index(vertex)
    to_next = vertices[face[(place + 1) % 3]] - vertices[vertex]
    to_last = vertices[face[(place + 2) % 3]] - vertices[vertex]
    return math.atan2(np.linalg.norm(np.cross(to_next, to_last)), np.dot(to_next, to_last))


def _slow_mean(vertices, faces, vertex, around, weigh=_slow_weight):
    weighted = [
        weigh(vertices, faces[j], vertex) * _slow_normal(vertices, faces[j]) for j in around
    ]
    return np.sum(weighted, axis=0) / np.linalg.norm(np.sum(weighted, axis=0))


def _slow_corner_normals(vertices, faces, crease_angle):
    """Max's weights, but large flat pieces alone at their rims, and by angle where it is steep."""
    patch = _slow_patches(vertices, faces, crease_angle)
    piece = _slow_patches(vertices, faces, 1e-4)
    size = [
        sum(_slow_area(vertices, faces[j]) for j in range(len(faces)) if piece[j] == piece[i])
        for i in range(len(faces))
    ]
    corners = [(patch[i], vertex) for i, face in enumerate(faces) for vertex in face]
    around = {
        (p, vertex): [j for j in range(len(faces)) if patch[j] == p and vertex in faces[j]]
        for p, vertex in set(corners)
    }
    peers = {
        at: [j for j in near if size[j] >= 0.3 * max(size[k] for k in near)]
        for at, near in around.items()
    }
    ratio = {}
    for at, near in around.items():
        others = [size[j] for j in near if j not in peers[at] or piece.count(piece[j]) == 1]
        for j in peers[at]:
            ratio[piece[j]] = max(ratio.get(piece[j], 0.0), max(others, default=0.0) / size[j])
    found = {}
    for at, near in around.items():
        curved = _slow_mean(vertices, faces, at[1], near)
        pinned = _slow_mean(vertices, faces, at[1], peers[at])
        worst = max(ratio[piece[j]] for j in peers[at])
        share = np.interp(math.log(max(worst, 1e-9)), np.log([0.1, 0.2]), [1.0, 0.0])
        mixed = (1.0 - share) * curved + share * pinned
        mixed /= np.linalg.norm(mixed)
        by_angle = _slow_mean(vertices, faces, at[1], near, _slow_angle)
        turns = [math.acos(min(1.0, by_angle @ _slow_normal(vertices, faces[j]))) for j in near]
        steep = np.interp(math.degrees(max(turns)), [30.0, 45.0], [0.0, 1.0])
        mixed = (1.0 - steep) * mixed + steep * by_angle
        found[at] = mixed / np.linalg.norm(mixed)
    return np.reshape([found[at] for at in corners], (len(faces), 3, 3))


def test_face_normal_by_hand():
    corners = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]]])
    np.testing.assert_array_equal(face_normals(corners), [[0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(face_normals(corners[:, ::-1]), [[0.0, 0.0, -1.0]])


@pytest.mark.parametrize("crease_angle", [0.1, 0.5, math.pi])
@pytest.mark.parametrize(
    "mesh",
    [_rough_ball(), _cylinder(6), _bevelled(0.03), _bevelled(0.17), _bevelled(0.1, bevels=1)],
    ids=["rough-ball", "cylinder", "narrow-bevels", "wide-bevels", "steep-bevel"],
)
def test_corner_normals_agree_with_a_slow_reference(mesh, crease_angle):
    normals = corner_normals(*mesh, crease_angle=crease_angle)
    np.testing.assert_allclose(normals, _slow_corner_normals(*mesh, crease_angle), atol=1e-9)


def test_the_reference_mesh_has_creases_and_smooth_edges():
    vertices, faces = _rough_ball()
    patches = len(set(_slow_patches(vertices, faces, 0.5)))
    assert 1 < patches < len(faces)


@pytest.mark.parametrize("mesh", [_random_ball(), _ball(), _arrays(trimesh.creation.uv_sphere())])
def test_vertices_on_a_sphere_have_its_normals(mesh):
    """Weighted by angle, they are off by up to 6.1, 0.3 and 0.09 degrees."""
    vertices, faces = mesh
    centre = np.array([0.3, -0.2, 0.1])
    normals = corner_normals(2.0 * vertices + centre, faces, crease_angle=math.pi)
    np.testing.assert_allclose(normals, vertices[faces], atol=1e-9)


def test_weights_of_corners_by_hand():
    corners = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 4.0, 0.0]]])
    expected = np.array([[1 / (2 * 4), 4 / 20**0.5 / (2 * 20**0.5), 2 / 20**0.5 / (4 * 20**0.5)]])
    np.testing.assert_allclose(corner_weights(corners), 4.0**2 * expected, rtol=_EXACT)
    np.testing.assert_allclose(
        corner_angles(corners), [[0.5 * math.pi, math.atan(2.0), math.atan(0.5)]], rtol=_EXACT
    )


def test_normals_are_averaged_by_any_weights():
    vertices, faces = _hinge(0.2)
    weights = np.array([[1.0, 0.0, 3.0], [1.0, 0.0, 0.0]])
    flat = face_normals(vertices[faces])
    normals = average_normals(flat, smooth_groups(vertices, faces), weights)
    sums = np.stack([flat[0] + flat[1], flat[0], 3.0 * flat[0]])
    np.testing.assert_allclose(
        normals[0], sums / np.linalg.norm(sums, axis=-1, keepdims=True), atol=_EXACT
    )


@pytest.mark.parametrize("width", [1e-4, 0.01, 0.05])
def test_large_lids_and_sides_stay_flat_up_to_a_narrow_bevel(width):
    """The bevels, which meet at 22.5 degrees, would turn them by up to as much."""
    vertices, faces = _bevelled(width, sections=64)
    normals, corners = corner_normals(vertices, faces), vertices[faces]
    lid = np.all(corners[..., 2] == 0.6, axis=1)
    np.testing.assert_allclose(normals[lid], np.tile([0.0, 0.0, 1.0], (64, 3, 1)), atol=_EXACT)
    side = np.ptp(corners[..., 2], axis=1) > 0.5
    radial = corners[side] * [1.0, 1.0, 0.0] / 0.9
    assert np.count_nonzero(side) == 2 * 64
    # Both strips at a vertex have other diagonals, so their weights differ by rounding alone.
    np.testing.assert_allclose(normals[side], radial, atol=1e-9)


@pytest.mark.parametrize("height", [0.1, 1.0, 30.0])
def test_no_normal_lies_in_the_plane_of_its_face(height):
    """Smoothed across right angles, long sides do not decide the normals of their small ends."""
    vertices, faces = _box((1.0, 1.0, height))
    normals = corner_normals(vertices, faces, crease_angle=math.pi)
    assert np.min(np.sum(normals * _flat(vertices, faces), axis=-1)) > 0.5


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


@pytest.mark.parametrize("length", [1e-7, 1e-6, 3e-6])
def test_rounding_of_a_tiny_edge_does_not_decide_a_normal(length):
    """Two faces with an edge of a few roundings of single precision are turned by 20 degrees."""
    vertices, faces = _ball()
    first, second = faces[0][:2]
    start, end = vertices[first], vertices[second]
    middle = len(vertices)
    vertices = np.vstack([vertices, start + length * ((end - start) / 0.15 + 0.4 * start)])
    split = []
    for face in faces:
        if {first, second} <= set(face):
            split += [np.where(face == first, middle, face), np.where(face == second, middle, face)]
        else:
            split.append(face)
    normals = corner_normals(vertices, np.array(split), crease_angle=math.pi)
    radial = vertices[split] / np.linalg.norm(vertices[split], axis=-1, keepdims=True)
    solid = np.any(normals != 0.0, axis=-1)
    assert np.max(_angles(normals, radial)[solid]) < _FLAT_BALL


@pytest.mark.parametrize("mesh", [_bevelled(0.17), _random_ball()])
def test_normals_know_no_place(mesh):
    vertices, faces = mesh
    moved = corner_normals(vertices + 2.0**14, faces)
    np.testing.assert_allclose(moved, corner_normals(vertices, faces), atol=1e-9)


def test_normals_that_cancel_fall_back_to_the_face_s_own():
    """Two opposite faces are one patch by way of a third; they cancel at the corner they share."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [2, 1, 3], [0, 2, 1]])
    normals = corner_normals(vertices, faces, crease_angle=math.pi)
    np.testing.assert_array_equal(normals[0, 0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(normals[2, 0], [0.0, 0.0, -1.0])


@pytest.mark.parametrize("scale", [1e-60, 1e-9, 1e9, 1e60])
@pytest.mark.parametrize("mesh", [_cylinder(), _bevelled(0.17), _random_ball()])
def test_normals_know_no_size(mesh, scale):
    vertices, faces = mesh
    np.testing.assert_allclose(
        corner_normals(scale * vertices, faces), corner_normals(vertices, faces), atol=1e-9
    )
