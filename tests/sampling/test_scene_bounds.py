import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.sampling import scene_bounds
from refref_jax.sampling.polylines import Gaussians
from refref_jax.sampling.scene_bounds import DistanceWarp, Domain
from tests.factories import arrays, scenes
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# A few float32 roundings.
_ROUNDING = 1e-6

_MAGNITUDES = 10.0 ** np.arange(-6, 7)

_contract = jax.jit(scene_bounds.contract)
_shrinkage = jax.jit(scene_bounds.shrinkage)
_to_unit_cube = jax.jit(scene_bounds.to_unit_cube, static_argnums=0)

_FUNCTIONS = (scene_bounds.contract, scene_bounds.shrinkage)
_JACOBIANS = {function: jax.jit(jax.vmap(jax.jacrev(function))) for function in _FUNCTIONS}


def _points(magnitude, count=20):
    """Returns points in all directions at a distance from the origin."""
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions[:3] = np.eye(3)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return jnp.asarray(magnitude * unit, jnp.float32)


def _cube(domain, positions, scales=None):
    positions = jnp.asarray(positions, jnp.float32)
    scales = np.zeros(positions.shape[0]) if scales is None else scales
    return _to_unit_cube(domain, Gaussians(positions, jnp.asarray(scales, jnp.float32)))


# --- where a ray leaves ---

_BOUNDED = Domain(radius=2.0, space="bounded")
_SPHERICAL = Domain(radius=2.0, space="spherical")

_exit_distance = jax.jit(scene_bounds.exit_distance, static_argnums=0)


def _assert_exit(domain, origin, direction, expected):
    ray = (jnp.asarray(x, jnp.float32) for x in (origin, arrays.unit(direction)))
    np.testing.assert_allclose(_exit_distance(domain, *ray), expected, rtol=_ROUNDING)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, 0), (1, 0, 0), 2.0),
        ((0, 0, 0), (0, 0, -1), 2.0),
        ((1, -1, 0.5), (0.6, 0, -0.8), 1.0 / 0.6),
        ((-5, 0, 0), (1, 0, 0), 7.0),  # enters and leaves
        ((2, 0, 0), (-1, 0, 0), 4.0),  # starts on a face
        ((1, 1, 1), (1, 1, 1), np.sqrt(3.0)),  # through a corner
        ((0, 0, 2), (1, 0, 0), 0.0),  # along a face, which is out already
        ((5, 0, 0), (1, 0, 0), np.inf),  # behind
        ((5, 5, 0), (1, -0.1, 0), np.inf),  # past
        ((0, 3, 0), (1, 0, 0), np.inf),  # beside, parallel
    ],
)
def test_exit_distance_by_hand(origin, direction, expected):
    _assert_exit(_BOUNDED, origin, direction, expected)


@pytest.mark.parametrize("radius", [1e-3, 7.3, 1e6])
@pytest.mark.parametrize(("space", "order"), [("bounded", np.inf), ("spherical", 2)])
def test_exit_lies_on_the_bounds(space, order, radius):
    rng = np.random.default_rng(3)
    domain = Domain(radius=radius, space=space)
    for _ in range(20):
        origin = rng.uniform(0.0, radius) * arrays.unit(rng.normal(size=3))
        direction = arrays.unit(rng.normal(size=3))
        given = (jnp.asarray(x, jnp.float32) for x in (origin, direction))
        end = origin + float(_exit_distance(domain, *given)) * direction
        np.testing.assert_allclose(np.linalg.norm(end, order), radius, rtol=1e-5)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, 0), (1, 1, 1), 2.0),
        ((1, 0, 0), (1, 0, 0), 1.0),
        ((0, 1, 0), (1, 0, 0), np.sqrt(3.0)),
        ((-5, 0, 0), (1, 0, 0), 7.0),  # enters and leaves
        ((2, 0, 0), (-1, 0, 0), 4.0),  # starts on the sphere
        ((2, 0, 0), (1, 0, 0), 0.0),  # and leaves at once
        ((0, 0, 2), (1, 0, 0), np.inf),  # only touches
        ((5, 0, 0), (1, 0, 0), np.inf),  # behind
        ((5, 5, 0), (1, -0.1, 0), np.inf),  # past
    ],
)
def test_exit_distance_of_a_ball_by_hand(origin, direction, expected):
    _assert_exit(_SPHERICAL, origin, direction, expected)


def test_rays_leave_a_sphere_at_once_where_they_start_on_it():
    domain, rng = Domain(7.3, "spherical"), np.random.default_rng(0)
    normals, others = rng.normal(size=(2, 1000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tilted = normals + 5.0 * np.cross(normals, others)  # at grazing angles
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    leave = jax.vmap(scene_bounds.exit_distance, in_axes=(None, 0, 0))
    for directions in (normals, tilted):
        found = leave(domain, jnp.asarray(7.3 * normals), jnp.asarray(directions))
        np.testing.assert_allclose(found, 0.0, atol=5e-5)


def test_gradients_of_an_exit_are_finite_everywhere():
    for origin in ([0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 1.9999999, 0.0]):
        for space in ("bounded", "spherical"):
            domain = Domain(radius=2.0, space=space)
            gradient = jax.grad(lambda x, d=domain: scene_bounds.exit_distance(d, x, jnp.eye(3)[0]))
            assert np.isfinite(gradient(jnp.array(origin))).all()


@pytest.mark.parametrize(
    ("space", "point", "expected"),
    [
        ("bounded", (3.0, -1.0, -5.0), (2.0, -1.0, -2.0)),
        ("spherical", (0.0, 3.0, 4.0), (0.0, 1.2, 1.6)),
        ("spherical", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
        ("spherical", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ("unbounded", (0.0, 3.0, 4.0), (0.0, 3.0, 4.0)),
    ],
)
def test_the_nearest_point_within_by_hand(space, point, expected):
    domain = Domain(radius=2.0, space=space)
    got = scene_bounds.nearest_within(domain, jnp.array(point))
    np.testing.assert_allclose(got, expected, rtol=_ROUNDING)
    jacobian = jax.jacrev(lambda x: scene_bounds.nearest_within(domain, x))(jnp.array(point))
    assert np.isfinite(jacobian).all()


def test_an_unbounded_scene_is_never_left():
    domain = Domain(radius=2.0, space="unbounded")
    assert np.isinf(_exit_distance(domain, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])))


def test_contract_by_hand():
    got = _contract(jnp.array([[0.5, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 3.0, 4.0]]))
    np.testing.assert_allclose(
        got, [[0.5, 0.0, 0.0], [0.0, -1.5, 0.0], [0.0, 1.08, 1.44]], atol=_ROUNDING
    )


@pytest.mark.parametrize("magnitude", _MAGNITUDES)
def test_contract_against_its_definition(magnitude):
    points = _points(magnitude)
    expected = [reference_sampling.contracted(point) for point in points]
    np.testing.assert_allclose(_contract(points), expected, rtol=_ROUNDING, atol=_ROUNDING)


@pytest.mark.parametrize("magnitude", [0.0, 1e-30, 1e-6, 0.3, 0.999])
def test_the_unit_ball_stays_as_it_is(magnitude):
    points = _points(magnitude)
    np.testing.assert_array_equal(_contract(points), points)
    np.testing.assert_array_equal(_shrinkage(points), np.ones(20))


@pytest.mark.parametrize("magnitude", [1e-3, 0.5, 1.5, 10.0, 1e3, 1e6])
def test_shrinkage_is_the_cube_root_of_the_jacobians_determinant(magnitude):
    points = np.asarray(_points(magnitude), np.float64)
    with jax.enable_x64(True):
        jacobians = np.asarray(_JACOBIANS[scene_bounds.contract](jnp.asarray(points)))
    expected = abs(np.linalg.det(jacobians)) ** (1.0 / 3.0)
    np.testing.assert_allclose(_shrinkage(_points(magnitude)), expected, rtol=1e-5)


_BOUNDED, _UNBOUNDED = Domain(2.0, "bounded"), Domain(2.0, "unbounded")


def test_a_bounded_scene_fills_the_cube():
    got = _cube(_BOUNDED, [[0.0, 1.0, -2.0], [2.0, -1.0, 0.5]], [0.4, 1.0])
    np.testing.assert_allclose(
        got.positions, [[0.5, 0.75, 0.0], [1.0, 0.25, 0.625]], atol=_ROUNDING
    )
    np.testing.assert_allclose(got.scales, [0.1, 0.25], rtol=_ROUNDING)


def test_an_unbounded_scene_keeps_its_ball_in_the_middle():
    got = _cube(_UNBOUNDED, [[0.0, 1.0, -2.0 / 3.0], [4.0, 0.0, 0.0]], [0.4, 0.4])
    np.testing.assert_allclose(
        got.positions, [[0.5, 0.625, 5.0 / 12.0], [0.875, 0.5, 0.5]], atol=_ROUNDING
    )
    shrunk = 0.05 * (9.0 / 64.0) ** (1.0 / 3.0)
    np.testing.assert_allclose(got.scales, [0.05, shrunk], rtol=_ROUNDING)


@pytest.mark.parametrize(
    ("outside", "expected"),
    [
        ([2.5, 0.0, 0.0], [1.0, 0.5, 0.5]),
        ([-3.0, 1.0, 100.0], [0.0, 0.75, 1.0]),
        ([1e30, -1e30, 0.0], [1.0, 0.0, 0.5]),
    ],
)
def test_points_outside_a_bounded_scene_go_to_the_nearest_face(outside, expected):
    np.testing.assert_allclose(_cube(_BOUNDED, [outside]).positions[0], expected, atol=_ROUNDING)


@pytest.mark.parametrize("domain", [_BOUNDED, _UNBOUNDED])
@pytest.mark.parametrize("magnitude", [0.0, 1e-30, 1e-3, 1.0, 2.0, 1e3, 1e10, 1e30])
def test_everything_lands_in_the_unit_cube(domain, magnitude):
    got = _cube(domain, _points(magnitude), np.full(20, 1e-3 * magnitude))
    # Rounding may leave the cube by a unit in the last place; the hash grid holds its cells.
    positions, scales = (np.asarray(x) for x in got)
    assert (positions >= -_ROUNDING).all() and (positions <= 1.0 + _ROUNDING).all()
    assert (scales >= 0.0).all() and np.isfinite(scales).all()


@pytest.mark.parametrize("space", ["bounded", "unbounded"])
def test_scenes_of_another_size_look_the_same(space):
    points, scales = 3.0 * _points(1.0), np.full(20, 0.1)
    small = _cube(Domain(2.0, space), points, scales)
    large = _cube(Domain(14.0, space), 7.0 * points, 7.0 * scales)
    for a, b in zip(small, large, strict=True):
        np.testing.assert_allclose(a, b, atol=_ROUNDING)


@pytest.mark.parametrize("function", [scene_bounds.contract, scene_bounds.shrinkage])
@pytest.mark.parametrize("magnitude", [0.0, 1e-30, 1e-6, 1.0, 1e6, 1e30])
def test_gradients_are_finite_at_any_distance(function, magnitude):
    assert gradients.all_finite(_JACOBIANS[function](_points(magnitude)))


@pytest.mark.parametrize("magnitude", [3.0, 1e3, 1e6])
def test_contract_has_the_right_gradient_far_away(magnitude):
    points = _points(magnitude)
    got = np.asarray(_JACOBIANS[scene_bounds.contract](points), np.float64)
    for jacobian, point in zip(got, np.asarray(points, np.float64), strict=True):
        unit = point / np.linalg.norm(point)
        across = (2.0 - 1.0 / magnitude) / magnitude * (np.eye(3) - np.outer(unit, unit))
        expected = across + np.outer(unit, unit) / magnitude**2
        np.testing.assert_allclose(jacobian, expected, atol=3.0 * _ROUNDING / magnitude)


@pytest.mark.parametrize("domain", [_BOUNDED, _UNBOUNDED])
def test_gradients_of_the_unit_cube_are_finite(domain):
    def total(positions, scales):
        return sum(
            jnp.sum(x) for x in scene_bounds.to_unit_cube(domain, Gaussians(positions, scales))
        )

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))
    for magnitude in (0.0, 1.0, 1e30):
        assert gradients.all_finite(gradient(_points(magnitude), jnp.ones(20)))


@pytest.mark.parametrize("function", _FUNCTIONS)
def test_check_grads(function):
    gradients.assert_numerical(function, [[0.1, -0.4, 0.2], [0.5, -0.9, 0.8], [1.0, 1.2, -0.9]])


def _box(positions, scales, *, domain):
    return tuple(scene_bounds.to_unit_cube(domain, Gaussians(positions, scales)))


_SOME = (jnp.stack([_points(x) for x in (0.5, 1.0, 20.0)]), jnp.ones((3, 20)))

_CASES = {
    "contract": lambda x, scales: scene_bounds.contract(x),
    "shrinkage": lambda x, scales: scene_bounds.shrinkage(x),
    "bounded": lambda x, scales: _box(x, scales, domain=_BOUNDED),
    "unbounded": lambda x, scales: _box(x, scales, domain=_UNBOUNDED),
}


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    transformation(_CASES[name], _SOME)


_EPSILON = float(np.finfo(np.float32).eps)

_WARPS = [
    DistanceWarp(near=0.05, far=15.0, unit=3.0),
    DistanceWarp(near=0.05, far=1000.0, unit=2.0),
    DistanceWarp(near=0.05, far=1e6, unit=1.0),
    DistanceWarp(near=0.0, far=1000.0, unit=2.0),
]

# The transformed distance is a float32 of about 1; where the warp flattens, one unit in its last
# place is a long way. Every operation of the warp may cost about one.
_OPERATIONS = 4.0


_to_distance = jax.jit(scene_bounds.to_distance, static_argnums=0)
_to_unit = jax.jit(scene_bounds.to_unit, static_argnums=0)


def _distances(warp, count=200):
    first = warp.near or 1e-6 * warp.unit
    return np.concatenate([[warp.near], np.geomspace(first, warp.far, count)[1:]])


@pytest.mark.parametrize("warp", _WARPS)
def test_to_unit_against_the_power_transformation(warp):
    t = _distances(warp)
    expected = reference_sampling.warped_distance(*warp, t)
    got = _to_unit(warp, jnp.asarray(t, jnp.float32))
    np.testing.assert_allclose(got, expected, atol=_OPERATIONS * _EPSILON)


@pytest.mark.parametrize("warp", _WARPS)
def test_to_distance_against_the_power_transformation(warp):
    s = np.linspace(0.0, 1.0, 101, dtype=np.float32)
    t = np.asarray(_to_distance(warp, jnp.asarray(s)), np.float64)
    back = reference_sampling.warped_distance(*warp, t)
    np.testing.assert_allclose(back, s, atol=_OPERATIONS * _EPSILON)


def test_to_unit_by_hand():
    # In units of 1.25 the distances are 0, 3 and 8, whose ladders are 1, 1/8 and 1/27.
    warp = DistanceWarp(near=0.0, far=10.0, unit=1.0)
    s = _to_unit(warp, jnp.float32(3.75))
    np.testing.assert_allclose(s, (1.0 - 1.0 / 8.0) / (1.0 - 1.0 / 27.0), rtol=1e-6)


@pytest.mark.parametrize("warp", _WARPS)
def test_to_distance_meets_both_ends(warp):
    near, far = _to_distance(warp, jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(near, warp.near, atol=_OPERATIONS * _EPSILON * warp.unit)
    np.testing.assert_allclose(far, warp.far, rtol=_OPERATIONS * _EPSILON)


@pytest.mark.parametrize("warp", _WARPS)
def test_to_distance_increases(warp):
    t = np.asarray(_to_distance(warp, jnp.linspace(0.0, 1.0, 10001)))
    assert (np.diff(t) > 0.0).all()


@pytest.mark.parametrize("warp", _WARPS)
def test_to_unit_holds_distances_outside_the_interval(warp):
    got = _to_unit(warp, jnp.array([0.0, 0.5 * warp.near, 2.0 * warp.far, 1e30]))
    np.testing.assert_array_equal(got, [0.0, 0.0, 1.0, 1.0])


@pytest.mark.parametrize("warp", _WARPS)
def test_gradients_are_finite_and_positive(warp):
    s = jnp.linspace(0.0, 1.0, 101)
    slope = jax.jit(jax.vmap(jax.grad(functools.partial(scene_bounds.to_distance, warp))))(s)
    assert np.isfinite(slope).all() and (slope > 0.0).all()
    t = jnp.asarray(_distances(warp), jnp.float32)
    slope = jax.jit(jax.vmap(jax.grad(functools.partial(scene_bounds.to_unit, warp))))(t)
    assert np.isfinite(slope).all() and (slope[1:-1] > 0.0).all()


def test_check_grads_of_warps():
    warp = _WARPS[0]
    gradients.assert_numerical(functools.partial(scene_bounds.to_distance, warp), [0.1, 0.5, 0.9])
    gradients.assert_numerical(functools.partial(scene_bounds.to_unit, warp), [0.1, 1.0, 10.0])


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("function", [scene_bounds.to_distance, scene_bounds.to_unit])
def test_transformations_change_nothing_of_warps(function, transformation):
    transformation(functools.partial(function, _WARPS[0]), (jnp.array([0.1, 0.5, 0.9]),))


# --- around another centre ---


_CENTRE = (16.0, -8.0, 4.0)
_SPACES = ("bounded", "spherical", "unbounded")


def test_the_unit_cube_is_around_the_centre():
    domain = Domain(2.0, "bounded", _CENTRE)
    points = jnp.array([[16.0, -8.0, 4.0], [18.0, -10.0, 5.0], [99.0, -8.0, -99.0]])
    found = scene_bounds.to_unit_cube(domain, Gaussians(points, jnp.full(3, 0.4)))
    np.testing.assert_array_equal(found.positions, [[0.5] * 3, [1.0, 0.0, 0.75], [1.0, 0.5, 0.0]])
    np.testing.assert_allclose(found.scales, 0.1, rtol=1e-6)


@pytest.mark.parametrize(
    "space",
    [
        pytest.param(space, marks=() if space == "unbounded" else pytest.mark.slow)
        for space in _SPACES
    ],
)
def test_what_is_moved_as_a_whole_is_the_same(space):
    usual, moved = Domain(2.0, space), Domain(2.0, space, _CENTRE)
    rng = np.random.default_rng(0)
    # Multiples of 1/64, which are moved without rounding.
    points = jnp.asarray(np.round(64 * rng.uniform(-4.0, 4.0, (50, 3))) / 64, jnp.float32)
    directions = rng.normal(size=(50, 3))
    directions = jnp.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    centre = jnp.broadcast_to(jnp.array(_CENTRE), points.shape)
    for old, new in zip(
        scene_bounds.to_unit_cube(usual, Gaussians(points, jnp.ones(50))),
        scene_bounds.to_unit_cube(moved, Gaussians(points + centre, jnp.ones(50))),
        strict=True,
    ):
        np.testing.assert_array_equal(old, new)
    leave = jax.vmap(scene_bounds.exit_distance, in_axes=(None, 0, 0))
    np.testing.assert_array_equal(
        leave(usual, points, directions), leave(moved, points + centre, directions)
    )
    nearest = jax.vmap(scene_bounds.nearest_within, in_axes=(None, 0))
    np.testing.assert_allclose(
        nearest(moved, points + centre), nearest(usual, points) + centre, rtol=1e-6
    )


@pytest.mark.parametrize("space", _SPACES)
def test_the_origin_as_centre_costs_no_operation(space):
    def count(domain):
        def all_of(point, direction):
            cell = scene_bounds.to_unit_cube(domain, Gaussians(point[None], jnp.ones(1)))
            held = scene_bounds.nearest_within(domain, point)
            return cell, held, scene_bounds.exit_distance(domain, point, direction)

        return len(jax.make_jaxpr(all_of)(jnp.ones(3), jnp.ones(3)).eqns)

    assert count(Domain(2.0, space, (0.0, -0.0, 0.0))) == count(Domain(2.0, space))
    assert count(Domain(2.0, space, (0.0, 0.0, 1e-3))) > count(Domain(2.0, space))


def test_an_occupancy_grid_by_hand():
    occupancy = jnp.ones((2, 2, 2)).at[0, 0, 0].set(0.0)
    points = [[1.5, 2.5, 3.5], [0.5, 1.5, 2.5], [0.5, 2.5, 2.5], [3.5, 2.0, 3.0], [-9.0, 2.0, 3.0]]
    grid = scene_bounds.OccupancyGrid(occupancy, (1.0, 2.0, 3.0, 1.0))
    found = scene_bounds.is_occupied(grid, jnp.asarray(points))
    np.testing.assert_array_equal(found, [True, False, True, False, False])


def test_no_point_is_in_a_cell_that_is_infinite_or_nan():
    grid = scene_bounds.OccupancyGrid(np.ones((2, 2, 2), np.float32), (0.0, 0.0, 0.0, 1.0))
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e30, 0, 0], [0, 0, 0]])
    found = jax.jit(scene_bounds.is_occupied)(grid, jnp.asarray(points, jnp.float32))
    np.testing.assert_array_equal(found, [False, False, False, False, True])


def test_rays_meet_the_cells_of_a_numpy_grid_under_transformations():
    grid = scene_bounds.OccupancyGrid(np.zeros((4, 4, 4), np.float32), (0.0, 0.0, 0.0, 1.0))
    grid.occupancy[2, 2, 2] = 1.0
    ray = scenes.rays([[-5.0, 0.2, 0.2], [-5.0, -0.2, 0.2], [0.2, 0.2, 0.2]], 3 * [[1.0, 0.0, 0.0]])
    found = jax.jit(jax.vmap(lambda one: scene_bounds.meets_occupied(grid, one)))(ray)
    np.testing.assert_array_equal(found, [True, False, True])


@pytest.mark.parametrize("space", ["bounded", "spherical"])
def test_a_ball_is_no_larger_than_the_background(space):
    scene_bounds.check_ball_size(Domain(2.0, space), (0.0, 0.0, -1.5, 3.4))
    scene_bounds.check_ball_size(Domain(2.0, "unbounded"), (0.0, 0.0, 0.0, 200.0))
    with pytest.raises(ValueError, match="is larger than a ball of radius"):
        scene_bounds.check_ball_size(Domain(2.0, space), (0.0, 0.0, 0.0, 3.5))
