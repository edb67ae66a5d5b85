import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths
from refref_jax.optics.light_paths import PathStatus
from refref_jax.sampling import polylines, scene_bounds
from tests.factories import made_paths
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# Sums of a few float32 lengths of about 10.
_DISTANCE = 5e-6

_SEGMENTS = 8

_whole = jax.jit(polylines.whole_path)
_outside = jax.jit(polylines.outside_path)
_points_at = jax.jit(jax.vmap(polylines.point_at, in_axes=(None, 0)))
_segments_at = jax.jit(jax.vmap(polylines.segment_at, in_axes=(None, 0)))


def _at(line, t):
    return _points_at(line, jnp.asarray(t, jnp.float32))


def _elbow():
    """Returns a path that goes 2 along x, 3 along y inside an object, and on along z."""
    return made_paths.path(
        [2.0, 3.0], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0, 1, 0], segments=_SEGMENTS
    )


def _walk(path, t, *, skip_inside=False):
    steps = [
        reference_sampling.walk_polyline(
            path.points,
            path.directions,
            path.tau,
            path.media,
            int(path.num_bends),
            x,
            skip_inside=skip_inside,
        )
        for x in t
    ]
    return [np.array(column) for column in zip(*steps, strict=True)]


# --- within a ball ---

_BALL = (2.0, 1.5, 0.0, 1.9)
_in_ball = jax.jit(polylines.path_in_ball, static_argnums=1)


def test_a_path_in_a_ball_by_hand():
    line = _in_ball(_elbow(), _BALL)
    half = np.sqrt(1.9**2 - 1.5**2)  # of the chords of the first and the last segment
    np.testing.assert_allclose(line.stop, 2.0 * half + 3.0, atol=_DISTANCE)
    seen = _at(line, [0.0, half + 1.0, line.stop])
    expected = [[2.0 - half, 0.0, 0.0], [2.0, 1.0, 0.0], [2.0, 3.0, half]]
    np.testing.assert_allclose(seen.position, expected, atol=_DISTANCE)
    np.testing.assert_allclose(seen.arc, [2.0 - half, 3.0, 5.0 + half], atol=_DISTANCE)
    np.testing.assert_array_equal(seen.outside, [True, False, True])


@pytest.mark.parametrize("bends", [0, 1, 2, 5])
def test_points_in_a_ball_are_those_of_the_whole_path(bends):
    path = made_paths.random_path(bends, bends=bends, segments=_SEGMENTS)
    corners = np.asarray(path.points[: bends + 1])
    centre = np.mean(corners, axis=0)
    reach = np.max(np.linalg.norm(corners - centre, axis=-1))
    ball = (*map(float, centre), float(reach) + 0.5)
    line = _in_ball(path, ball)
    seen = _at(line, np.linspace(0.0, line.stop, 60))
    whole = _at(_whole(path), seen.arc)
    np.testing.assert_allclose(seen.position, whole.position, atol=4.0 * _DISTANCE)
    away = np.linalg.norm(np.asarray(seen.position) - centre, axis=-1)
    assert np.all(away < ball[3] + 1e-4) and line.stop > 0.0
    np.testing.assert_allclose(away[-1], ball[3], atol=1e-4)


@pytest.mark.parametrize(
    ("path", "ball", "length"),
    [
        (made_paths.path([], [[1, 0, 0]], [0], segments=3), (2.0, 1.5, 0.0, 1.4), 0.0),
        (made_paths.path([], [[1, 0, 0]], [0], segments=3), (-5.0, 0.0, 0.0, 1.0), 0.0),
        (made_paths.path([], [[1, 0, 0]], [0], segments=3), (1.0, 0.0, 0.0, 3.0), 4.0),
        (made_paths.path([], [[1, 0, 0]], [0], segments=3), (2.0, 1.5, 0.0, 1.5), 0.0),
        (made_paths.path([1.0], [[1, 0, 0], [0, 1, 0]], [0, 1]), (9.0, 0.0, 0.0, 1.0), 0.0),
        (made_paths.path([10.0], [[1, 0, 0], [0, 1, 0]], [0, 1]), (2.0, 0.0, 0.0, 1.0), 2.0),
        (made_paths.path([10.0], [[1, 0, 0], [0, 1, 0]], [0, 1]), (2.0, 5.0, 0.0, 1.0), 0.0),
    ],
    ids=[
        *("beside", "behind", "around the camera", "tangent", "bends before it, and misses it"),
        *("bends behind it", "bends, and is beside it all along"),
    ],
)
def test_lengths_in_a_ball_at_the_extremes(path, ball, length):
    line = _in_ball(jax.tree.map(jnp.asarray, path), ball)
    np.testing.assert_allclose(line.stop, length, atol=1e-5)
    assert np.all(np.isfinite(_at(line, [0.0, length]).position))


@pytest.mark.parametrize(("away", "length"), [(1.0, 2.0), (6.5, 1.5), (7.5, 0.5), (12.0, 0.0)])
def test_a_path_in_a_ball_ends_on_the_background(away, length):
    path = jax.tree.map(jnp.asarray, made_paths.path([], [[1, 0, 0]], [0], segments=3))
    room, whole = scene_bounds.Domain(7.0, "bounded"), polylines.whole_path(path)
    end = scene_bounds.background_distance(room, whole)
    line = polylines.path_in_ball(path, (away, 0.0, 0.0, 1.0), end=end)
    np.testing.assert_allclose(line.stop, length, atol=1e-5)

    def stop(points, end):
        moved = path._replace(points=points)
        return polylines.path_in_ball(moved, (away, 0.0, 0.0, 1.0), end=end).stop

    slopes = jax.grad(stop, argnums=(0, 1))(path.points, end)
    assert gradients.all_finite(slopes)
    np.testing.assert_allclose(slopes[1], float(0.0 < length < 2.0), atol=1e-5)


@pytest.mark.parametrize("below", [-0.1, 0.0, 1e-6, 0.01])
@pytest.mark.parametrize("space", ["bounded", "spherical"])
def test_a_path_through_glass_that_reaches_below_the_floor_ends_there(space, below):
    down = [0, 0, -1]
    path = made_paths.path([1.0, 2.0 + below], [down, down, down], [0, 1, 0], origin=(0, 0, 1))
    path = jax.tree.map(jnp.asarray, path)
    room = scene_bounds.Domain(2.0, space)
    end = scene_bounds.background_distance(room, polylines.whole_path(path))
    line = polylines.path_in_ball(path, (0.0, 0.0, -1.5, 1.0), end=end)
    np.testing.assert_allclose(line.stop, 2.0 + max(below, 0.0), atol=1e-5)
    open_air = scene_bounds.background_distance(
        scene_bounds.Domain(2.0, "unbounded"), polylines.whole_path(path)
    )
    assert np.isinf(open_air)


def test_a_path_in_a_ball_ends_on_an_opaque_surface():
    path = _elbow()._replace(stop=light_paths.Stop(jnp.float32(5.5), None))
    line = _in_ball(path, _BALL)
    np.testing.assert_allclose(line.stop, np.sqrt(1.9**2 - 1.5**2) + 3.0 + 0.5, atol=_DISTANCE)


# --- the whole path ---


def test_point_at_by_hand():
    seen = _at(_whole(_elbow()), [0.0, 1.0, 3.5, 7.0])
    np.testing.assert_allclose(
        seen.position,
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 1.5, 0.0], [2.0, 3.0, 2.0]],
        atol=_DISTANCE,
    )
    np.testing.assert_array_equal(seen.direction, [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(seen.outside, [True, True, False, True])


@pytest.mark.parametrize("bends", [0, 1, 2, 5, _SEGMENTS - 1])
def test_point_at_against_a_slow_walk(bends):
    path = made_paths.random_path(bends, bends=bends, segments=_SEGMENTS)
    t = np.float32(np.random.default_rng(bends).uniform(0.0, 20.0, size=40))
    position, direction, arc, outside = _walk(path, t)
    seen = _at(_whole(path), t)
    np.testing.assert_allclose(seen.position, position, atol=_DISTANCE)
    np.testing.assert_allclose(seen.direction, direction, atol=_DISTANCE)
    np.testing.assert_allclose(seen.arc, arc, atol=_DISTANCE)
    np.testing.assert_array_equal(seen.outside, outside)


def test_at_a_knot_the_later_segment_is_taken():
    path = made_paths.random_path(0, bends=5, segments=_SEGMENTS)
    knots = path.tau[:6]
    line = _whole(path)
    seen = _at(line, knots)
    np.testing.assert_array_equal(_segments_at(line, knots), np.arange(6))
    np.testing.assert_array_equal(seen.position, path.points[:6])
    np.testing.assert_array_equal(seen.direction, path.directions[:6])
    before = jnp.nextafter(knots[1:], jnp.zeros(5))
    np.testing.assert_array_equal(_segments_at(line, before), np.arange(5))


@pytest.mark.parametrize("make", [_whole, _outside])
def test_unused_segments_are_never_reached(make):
    path = made_paths.random_path(1, bends=2, segments=_SEGMENTS)
    line = make(path)
    assert np.isinf(line.knots[3:]).all() and np.isfinite(line.knots[:3]).all()
    t = [100.0, 1e6, 1e30, 3e38]
    np.testing.assert_array_equal(_segments_at(line, jnp.array(t)), np.full(4, 2))
    assert gradients.all_finite(_at(line, t[:3]))


def test_unused_segments_may_hold_anything():
    path = made_paths.random_path(1, bends=2, segments=_SEGMENTS)
    unused = jnp.arange(_SEGMENTS) > 2
    other = path._replace(
        points=jnp.where(unused[:, None], 1e30, path.points),
        directions=jnp.where(unused[:, None], -7.0, path.directions),
        media=jnp.where(unused, 9, path.media),
    )
    for make in (_whole, _outside):
        for a, b in zip(
            _at(make(path), [0.0, 3.0, 50.0]), _at(make(other), [0.0, 3.0, 50.0]), strict=True
        ):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("bends", [0, 1, 2, 4, 6])
def test_outside_path_against_a_slow_walk(bends):
    path = made_paths.random_path(bends, bends=bends, segments=_SEGMENTS)
    t = np.float32(np.random.default_rng(bends).uniform(0.0, 20.0, size=40))
    position, direction, arc, _ = _walk(path, t, skip_inside=True)
    seen = _at(_outside(path), t)
    np.testing.assert_allclose(seen.position, position, atol=_DISTANCE)
    np.testing.assert_allclose(seen.direction, direction, atol=_DISTANCE)
    np.testing.assert_allclose(seen.arc, arc, atol=_DISTANCE)


_MANY = 200


@jax.jit
def _many_outside_paths(paths):
    """Returns the polylines of many paths, and whether points at and next to knots lie outside."""
    lines = jax.vmap(polylines.outside_path)(paths)

    def near_knots(line):
        finite = jnp.where(jnp.isfinite(line.knots), line.knots, 0.0)
        around = [
            finite,
            jnp.nextafter(finite, jnp.full_like(finite, jnp.inf)),
            jnp.maximum(jnp.nextafter(finite, jnp.full_like(finite, -jnp.inf)), 0.0),
        ]
        t = jnp.concatenate(around)
        return jax.vmap(polylines.point_at, in_axes=(None, 0))(line, t).outside

    return lines, jax.vmap(near_knots)(lines)


@pytest.mark.slow
def test_no_sample_of_an_outside_path_lies_inside():
    paths = made_paths.stack(
        made_paths.random_path(seed, bends=6, segments=_SEGMENTS) for seed in range(_MANY)
    )
    lines, outside = _many_outside_paths(paths)
    knots = np.asarray(lines.knots)[:, :7]
    assert (np.diff(knots, axis=-1) >= 0.0).all()
    np.testing.assert_array_equal(knots[:, [1, 3, 5]], knots[:, [2, 4, 6]])
    assert outside.all()


def test_the_coordinate_advances_in_the_media_of_chosen_parts_too():
    path = made_paths.random_path(4, bends=4, segments=_SEGMENTS, media=np.array([0, 1, 2, 1, 0]))
    line = jax.jit(functools.partial(polylines.outside_path, also=(1,)))(path)
    lengths = np.asarray(path.ends - path.tau)[:4]
    steps = np.diff(np.asarray(line.knots)[:5])
    np.testing.assert_allclose(steps, lengths * np.array([1, 0, 1, 0]), atol=_DISTANCE)


@pytest.mark.parametrize("make", [_whole, _outside])
@pytest.mark.parametrize("bends", [1, 3])
def test_the_last_segment_always_counts_as_outside(make, bends):
    path = made_paths.random_path(bends, bends=bends, segments=_SEGMENTS)
    path = path._replace(statuses=jnp.int32(PathStatus.OUT_OF_BENDS))
    assert path.media[bends] != 0
    line = make(path)
    assert line.outside[bends]
    np.testing.assert_array_equal(line.outside[:bends], np.arange(bends) % 2 == 0)
    assert _at(line, [50.0]).outside.all()


@pytest.mark.parametrize("make", [_whole, _outside])
def test_a_first_segment_of_no_length_is_skipped(make):
    path = made_paths.path(
        [0.0, 1.0], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0, 1, 0], segments=_SEGMENTS
    )
    seen = _at(make(path), [0.0, 0.5, 3.0])
    assert gradients.all_finite(seen)
    walked = _walk(path, [0.0, 0.5, 3.0], skip_inside=make is _outside)
    np.testing.assert_allclose(seen.position, walked[0], atol=_DISTANCE)
    np.testing.assert_allclose(seen.direction, walked[1], atol=_DISTANCE)


def test_outside_path_of_a_camera_inside_an_object_starts_at_the_exit():
    path = made_paths.path([1.5], [[1, 0, 0], [0, 1, 0]], [1, 0], segments=_SEGMENTS)
    seen = _at(_outside(path), [0.0, 2.0])
    np.testing.assert_allclose(seen.position, [[1.5, 0, 0], [1.5, 2, 0]], atol=_DISTANCE)
    np.testing.assert_allclose(seen.arc, [1.5, 3.5], atol=_DISTANCE)
    assert seen.outside.all()


# --- gradients and transformations ---


def test_point_at_check_grads():
    line = _whole(made_paths.random_path(9, bends=2, segments=3))

    def position(points, directions, t):
        wide = line._replace(
            points=points,
            directions=directions,
            knots=line.knots.astype(jnp.float64),
            arcs=line.arcs.astype(jnp.float64),
            radius=line.radius.astype(jnp.float64),
        )
        return polylines.point_at(wide, t).position

    for t in (0.05, float(line.knots[1]) + 0.05, 20.0):
        gradients.assert_numerical(position, line.points, line.directions, t)


_CASES = {
    "whole_path": lambda paths, t: polylines.whole_path(paths),
    "outside_path": lambda paths, t: polylines.outside_path(paths),
    "path_in_ball": lambda paths, t: polylines.path_in_ball(paths, (0.5, 0.0, 0.0, 3.0), end=2.0),
    "point_at": lambda paths, t: polylines.point_at(polylines.outside_path(paths), t),
    "segment_at": lambda paths, t: polylines.segment_at(polylines.whole_path(paths), t),
}


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    paths = made_paths.stack(
        made_paths.random_path(seed, bends=seed, segments=4) for seed in range(4)
    )
    transformation(_CASES[name], (paths, jnp.array([0.0, 1.0, 5.0, 20.0])))


# --- a straight ray, bent ---


def _straight(footprint="cone"):
    path = made_paths.path([], [[0, 0, 1]], [0], origin=(1.0, 2.0, 3.0), radius=0.1)
    if footprint == "differential":
        ray = Rays(path.points[0], path.directions[0], path.radii)
        begun = light_paths.begin_differential(ray, "differential")
        path = path._replace(differentials=jax.tree.map(lambda x: x[None], begun))
    return _whole(path)


_through = jax.jit(polylines.through)


def test_a_bent_ray_by_hand():
    """Two units along z, three along x, and on along y: 1 unit behind the last vertex."""
    vertices = [[1.0, 2.0, 5.0], [4.0, 2.0, 5.0], [4.0, 6.0, 5.0]]
    bent = _through(_straight(), jnp.asarray(vertices, jnp.float32))
    np.testing.assert_allclose(bent.knots, [0.0, 2.0, 5.0], atol=_DISTANCE)
    np.testing.assert_allclose(bent.directions, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-6)
    seen = _at(bent, [0.0, 1.0, 4.0, 9.0, 10.0])
    expected = [[1, 2, 3], [1, 2, 4], [3, 2, 5], [4, 6, 5], [4, 7, 5]]
    np.testing.assert_allclose(seen.position, expected, atol=_DISTANCE)
    np.testing.assert_allclose(seen.arc, [0.0, 1.0, 4.0, 9.0, 10.0], atol=_DISTANCE)
    assert np.all(bent.outside)


@pytest.mark.parametrize("footprint", ["cone", "differential"])
def test_a_ray_through_points_of_its_own_stays_as_it_is(footprint):
    line = _straight(footprint)
    t = jnp.array([0.5, 2.0, 2.0, 7.0], jnp.float32)
    bent = _through(line, line.points + t[:, None] * line.directions)
    # Where two vertices are equal, the segment between them has the direction of the ray.
    np.testing.assert_allclose(bent.directions, np.tile(line.directions, (4, 1)), atol=1e-6)
    there = [0.0, 0.7, 2.0, 5.0, 20.0]
    ours, theirs = _at(bent, there), _at(line, there)
    np.testing.assert_allclose(ours.position, theirs.position, atol=_DISTANCE)
    np.testing.assert_allclose(ours.footprint, theirs.footprint, atol=_DISTANCE)


def test_gradients_by_vertices_are_numerical():
    line = jax.tree.map(lambda x: np.asarray(x, np.float64), _straight()._replace(outside=None))
    vertices = np.array([[1.0, 2.5, 4.0], [1.5, 2.0, 6.0], [1.0, 1.0, 9.0]])

    def position(vertices):
        whole = jax.tree.map(jnp.asarray, line)._replace(outside=jnp.ones(1, bool))
        bent = polylines.through(whole, vertices)
        return jax.vmap(polylines.point_at, in_axes=(None, 0))(bent, jnp.arange(4.0) + 0.3).position

    gradients.assert_numerical(position, vertices)
