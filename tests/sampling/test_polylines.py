import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics.light_paths import PathStatus
from refref_jax.sampling import polylines
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


def test_whole_path_counts_in_arc_length():
    path = made_paths.random_path(2, bends=4, segments=_SEGMENTS)
    line, t = _whole(path), np.linspace(0.0, 20.0, 40, dtype=np.float32)
    np.testing.assert_array_equal(line.knots, path.tau)
    np.testing.assert_allclose(_at(line, t).arc, t, atol=_DISTANCE)


def test_a_path_is_as_long_as_the_way_along_it():
    line = _whole(made_paths.random_path(3, bends=5, segments=_SEGMENTS))
    t = np.linspace(0.0, 20.0, 4001, dtype=np.float32)
    steps = np.diff(np.asarray(_at(line, t).position, np.float64), axis=0)
    # Corners that are cut short make the chain a little shorter.
    np.testing.assert_allclose(np.linalg.norm(steps, axis=-1).sum(), 20.0, rtol=2e-3)


# --- only the way outside ---


def test_outside_path_by_hand():
    line = _outside(_elbow())
    np.testing.assert_array_equal(line.knots[:3], [0.0, 2.0, 2.0])
    seen = _at(line, [1.0, 2.0, 3.5])
    np.testing.assert_allclose(
        seen.position, [[1.0, 0.0, 0.0], [2.0, 3.0, 0.0], [2.0, 3.0, 1.5]], atol=_DISTANCE
    )
    np.testing.assert_allclose(seen.arc, [1.0, 5.0, 6.5], atol=_DISTANCE)
    assert seen.outside.all()


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


def _paths_in_and_out():
    return made_paths.stack(
        made_paths.random_path(seed, bends=6, segments=_SEGMENTS) for seed in range(_MANY)
    )


def test_outside_path_has_knots_that_never_decrease():
    lines, _ = _many_outside_paths(_paths_in_and_out())
    used = np.asarray(lines.knots)[:, :7]
    assert (np.diff(used, axis=-1) >= 0.0).all()


def test_outside_path_gives_inner_segments_no_length_at_all():
    lines, _ = _many_outside_paths(_paths_in_and_out())
    knots = np.asarray(lines.knots)
    np.testing.assert_array_equal(knots[:, [1, 3, 5]], knots[:, [2, 4, 6]])


def test_no_sample_of_an_outside_path_lies_inside():
    _, outside = _many_outside_paths(_paths_in_and_out())
    assert outside.all()


def test_outside_path_finds_the_same_points_as_the_whole_path():
    path = made_paths.random_path(7, bends=6, segments=_SEGMENTS)
    t = np.linspace(0.0, 12.0, 50, dtype=np.float32)
    skipping = _at(_outside(path), t)
    walking = _at(_whole(path), skipping.arc)
    np.testing.assert_allclose(skipping.position, walking.position, atol=_DISTANCE)
    np.testing.assert_allclose(skipping.arc, walking.arc, atol=_DISTANCE)
    # The arc is the coordinate plus the way inside that lies behind.
    tau = np.asarray(path.tau, np.float64)
    inside = sum((tau[i + 1] - tau[i]) * (np.asarray(skipping.arc) > tau[i]) for i in (1, 3, 5))
    np.testing.assert_allclose(skipping.arc, t + inside, atol=_DISTANCE)


def test_outside_path_of_a_path_that_stays_outside_is_the_whole_path():
    path = made_paths.random_path(8, bends=4, segments=_SEGMENTS, media=np.zeros(5, int))
    for a, b in zip(*map(jax.tree.leaves, (_outside(path), _whole(path))), strict=True):
        np.testing.assert_allclose(a, b, atol=_DISTANCE)


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


def test_position_moves_along_the_direction():
    line = _whole(made_paths.random_path(9, bends=4, segments=_SEGMENTS))
    velocity = jax.jit(jax.vmap(jax.jacfwd(lambda t: polylines.point_at(line, t).position)))
    t = jnp.linspace(0.0, 15.0, 20)
    np.testing.assert_allclose(velocity(t), _at(line, t).direction, atol=_DISTANCE)


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
    "point_at": lambda paths, t: polylines.point_at(polylines.outside_path(paths), t),
    "segment_at": lambda paths, t: polylines.segment_at(polylines.whole_path(paths), t),
}


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    paths = made_paths.stack(
        made_paths.random_path(seed, bends=seed, segments=4) for seed in range(4)
    )
    transformation(_CASES[name], (paths, jnp.array([0.0, 1.0, 5.0, 20.0])))
