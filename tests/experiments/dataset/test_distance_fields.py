import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from experiments.dataset.objects import distance_fields as fields
from experiments.dataset.objects import field_operations as operations
from experiments.dataset.objects import space_curves

# A turn, half a turn, and a unit interval, sampled finely.
_TURN = np.linspace(0.0, 2.0 * np.pi, 401)
_HALF = np.linspace(0.0, np.pi, 201)


def _points(count=400, *, seed=0, extent=2.0):
    return np.random.default_rng(seed).uniform(-extent, extent, (count, 3))


def _sphere_points():
    profile = np.stack([np.sin(_HALF), np.cos(_HALF)], axis=-1)
    return _turned(profile)


def _turned(line):
    """Points of the surface that a densely sampled line leaves when it is turned around z."""
    r, z = line[:, None, 0], np.broadcast_to(line[:, None, 1], (len(line), len(_TURN)))
    return np.stack([r * np.cos(_TURN), r * np.sin(_TURN), z], axis=-1).reshape(-1, 3)


def _turned_points(profile):
    """Points of the surface that a closed polygon leaves when it is turned around z."""
    ends = np.roll(profile, -1, axis=0)
    along = np.linspace(0.0, 1.0, max(2, 800 // len(profile)))[:, None]
    line = np.concatenate([a + along * (b - a) for a, b in zip(profile, ends, strict=True)])
    return _turned(line[line[:, 0] > 0.0])


_PROFILE = np.array([(0.0, -1.0), (0.8, -1.0), (1.1, 0.2), (0.5, 0.4), (0.7, 1.0), (0.0, 0.8)])

_RING = np.stack([1.2 + 0.4 * np.cos(_TURN), 0.4 * np.sin(_TURN)], axis=-1)[:-1]

_CAPSULE = np.array([(0.0, 0.0, -0.5), (0.0, 0.0, 1.0)])
_CAPSULE_POINTS = np.concatenate(
    [
        0.4 * _sphere_points()
        + np.clip(np.sign(_sphere_points()[:, 2:]), 0, 1) * [0, 0, 1.5]
        + _CAPSULE[0],
        _turned(np.stack([np.full(200, 0.4), np.linspace(-0.5, 1.0, 200)], axis=-1)),
    ]
)

_SOLIDS = {
    "sphere": (fields.sphere((0.2, -0.1, 0.3), 0.7), 0.7 * _sphere_points() + [0.2, -0.1, 0.3]),
    "flat ellipsoid": (
        fields.ellipsoid((0.1, 0.0, 0.2), (1.5, 1.0, 0.2)),
        _sphere_points() * [1.5, 1.0, 0.2] + [0.1, 0.0, 0.2],
    ),
    "long ellipsoid": (
        fields.ellipsoid((0.0, 0.0, 0.0), (0.2, 0.3, 1.6)),
        _sphere_points() * [0.2, 0.3, 1.6],
    ),
    "capsule": (fields.tube(_CAPSULE, 0.4), _CAPSULE_POINTS),
    "torus": (fields.torus(1.2, 0.4), _turned_points(_RING)),
    "revolution": (fields.revolution(_PROFILE), _turned_points(_PROFILE)),
}


@pytest.mark.parametrize("name", _SOLIDS)
def test_a_field_is_the_distance_to_the_nearest_of_many_points(name):
    field, surface = _SOLIDS[name]
    points = _points()
    expected = KDTree(surface).query(points)[0]
    # Of the farthest that a point of the surface is from the samples.
    np.testing.assert_allclose(np.abs(field(points)), expected, atol=0.02)
    assert np.max(np.abs(field(surface))) < 2e-3
    assert np.any(field(points) < 0.0) and np.any(field(points) > 0.0)
    assert np.all(np.linalg.norm(surface - field.centre, axis=-1) <= field.radius + 1e-9)
    norm = np.linalg.norm(fields.gradient(field, _points(seed=1)), axis=-1)
    # All but those that sit where two points of the surface are equally near.
    assert np.mean(np.abs(norm - 1.0) < 1e-6) > 0.98


def test_distances_known_by_hand():
    points = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    np.testing.assert_allclose(fields.torus(1.0, 0.25)(points), [0.75, 0.75, np.sqrt(10) - 0.25])
    np.testing.assert_allclose(fields.box((1, 1, 1))(points), [-1.0, 1.0, 2.0])
    np.testing.assert_allclose(fields.box((1, 1, 1), 0.5)([[2, 2, 2]]), np.sqrt(6.75) - 0.5)
    ellipsoid = fields.ellipsoid((0, 0, 0), (2.0, 1.0, 0.5))
    np.testing.assert_allclose(ellipsoid(points), [-0.5, 0.0, 2.5], atol=1e-4)
    cone = fields.tube(np.array([[0.0, 0, 0], [4.0, 0, 0]]), np.array([1.0, 0.5]))
    np.testing.assert_allclose(cone(np.array([[-2.0, 0, 0], [6.0, 0, 0]])), [1.0, 1.5])
    limb = space_curves.limb((0, 0, 0, 0.2), (0, 0, 1, 0.4), (0, 0, 2, 0.3))
    joints = np.array([[0.0, 0, 0], [0, 0, 1.0], [0, 0, 2.0], [0, 0, -0.2], [0, 0, 2.3]])
    np.testing.assert_allclose(limb(joints), [-0.2, -0.4, -0.3, 0.0, 0.0], atol=1e-12)


def test_a_wall_of_revolution_has_its_thickness_and_a_round_edge():
    wall = fields.revolution_wall(np.array([(1.0, -1.0), (1.0, 1.0)]), 0.2)
    points = np.array(
        [[1.0, 0, 0], [1.1, 0, 0], [0, 0.9, 0], [0, 0, 0], [1.0, 0, 1.1], [1.3, 0, 1.4]]
    )
    np.testing.assert_allclose(wall(points), [-0.1, 0.0, 0.0, 0.9, 0.0, 0.4], atol=1e-12)


def test_blocks_change_nothing():
    field, _ = _SOLIDS["torus"]
    points = _points(40000)
    np.testing.assert_array_equal(fields.evaluate(field, points), field(points))
    assert fields.evaluate(field, np.zeros((0, 3))).shape == (0,)


def test_a_blend_adds_a_sixth_of_its_length_where_distances_are_equal():
    left, right = (fields.sphere((x, 0, 0), 0.5) for x in (-1.0, 1.0))
    middle = np.zeros((1, 3))
    np.testing.assert_allclose(operations.union(left, right, blend=0.6)(middle), 0.5 - 0.1)
    np.testing.assert_allclose(operations.intersection(left, right, blend=0.6)(middle), 0.5 + 0.1)
    np.testing.assert_allclose(operations.union(left, right)(middle), 0.5)
    cut = operations.subtraction(left, right, blend=0.6)
    np.testing.assert_allclose(cut(middle), 0.5)  # one is farther out than the blend reaches
    np.testing.assert_allclose(cut(np.array([[-0.5, 0.0, 0.0]])), 0.0)


def test_skipping_what_is_far_changes_no_union_and_it_lies_in_its_ball():
    solids = [_SOLIDS[name][0] for name in ("sphere", "capsule", "torus", "long ellipsoid")]
    union = operations.union(*solids, blend=0.2)
    points = _points(4000, extent=3.0)
    expected = solids[0](points)
    for solid in solids[1:]:
        expected = operations.smooth_minimum(expected, solid(points), 0.2)
    np.testing.assert_array_equal(union(points), expected)
    inside = points[expected < 0.0]
    assert np.all(np.linalg.norm(inside - union.centre, axis=-1) <= union.radius)


def test_motions():
    solid = operations.union(fields.sphere((1, 0, 0), 0.4), fields.box((0.2, 0.6, 0.1)))
    points = _points()
    shift = np.array([0.3, -0.2, 0.5])
    np.testing.assert_allclose(operations.moved(solid, shift)(points + shift), solid(points))
    rotation = Rotation.from_euler("xyz", [20.0, 50.0, -70.0], degrees=True)
    turned = operations.turned(solid, rotation)
    np.testing.assert_allclose(turned(rotation.apply(points)), solid(points), atol=1e-12)
    np.testing.assert_allclose(turned.centre, rotation.apply(solid.centre))
    other = operations.both_sides(solid)[1]
    np.testing.assert_allclose(other(points * [-1, 1, 1]), solid(points))


def test_offsets_and_warps():
    ball, points = fields.sphere((0, 0, 0), 1.0), _points()
    np.testing.assert_allclose(
        operations.offset(ball, -0.3)(points), fields.sphere((0, 0, 0), 0.7)(points)
    )
    warped = operations.warped(ball, lambda p: p * [1.0, 1.0, 0.5], 1.0)
    np.testing.assert_allclose(warped(np.array([[0.0, 0.0, 2.0]])), 0.0)


def test_a_grid_gives_back_smooth_values():
    ticks = np.linspace(-1.0, 1.0, 21)
    x, y, z = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    smooth = lambda x, y, z: np.sin(x) + x * y - 0.5 * z**2
    field = operations.gridded(smooth(x, y, z), np.full(3, -1.0), 0.1)
    points = _points(extent=0.4)  # the spline has no slope at the ends of the grid
    np.testing.assert_allclose(field(points), smooth(*points.T), atol=2e-5)
