import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.rays import orthonormal_basis
from refref_jax.sampling import polylines
from tests.factories import made_paths
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# A few float32 roundings.
_ROUNDING = 2e-6

_RADIUS = 0.1

_INTERVALS = [
    (0.0, 1.0),
    (1.0, 2.0),
    (0.05, 15.0),
    (3.0, 3.001),
    (1e3, 1e3 + 1.0),
    (1e-10, 2e-10),
    (1e10, 3e10),
]


@functools.partial(jax.jit, static_argnames="count")
def _sample(line, start, end, rotation=0.0, radius=_RADIUS, *, count=6):
    line = line._replace(radius=jnp.float32(radius))
    return polylines.multisamples(
        line, *(jnp.float32(x) for x in (start, end, rotation)), count=count
    )


_basis = jax.jit(orthonormal_basis)


def _straight(direction=(0.0, 0.0, 1.0)):
    return polylines.whole_path(made_paths.path([], [direction], [0]))


def _elbow():
    """Returns a path that bends at 2, at 5 and never again; the middle segment lies inside."""
    return made_paths.path([2.0, 3.0], [[1, 0, 0], [0, 1, 1], [-1, 0, 1]], [0, 1, 0], segments=5)


def _wide(gaussians):
    return [np.asarray(x, np.float64) for x in gaussians]


# --- the frustum's moments ---


@pytest.mark.parametrize(("start", "end"), _INTERVALS)
def test_six_points_lie_where_the_paper_puts_them(start, end):
    positions, _ = _wide(_sample(_straight(), start, end))
    expected = reference_sampling.hexagon_distances(start, end)
    np.testing.assert_allclose(positions[:, 2], expected, rtol=_ROUNDING)


@pytest.mark.parametrize(("start", "end"), _INTERVALS)
def test_six_points_keep_the_frustums_covariance_across_the_ray(start, end):
    _, _, variance = reference_sampling.frustum_moments(_RADIUS, start, end)
    positions, _ = _wide(_sample(_straight(), start, end))
    spread = np.square(positions[:, :2]).mean(axis=0)
    np.testing.assert_allclose(spread.sum(), 2.0 * variance, rtol=_ROUNDING)

    # The pattern favours no axis once its rotation is averaged out.
    turns = np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)
    turned = np.concatenate([_wide(_sample(_straight(), start, end, x))[0] for x in turns])
    covariance = np.cov(turned[:, :2].T, bias=True) / variance
    np.testing.assert_allclose(covariance, np.eye(2), atol=_ROUNDING)
    np.testing.assert_allclose(
        turned[:, :2].mean(axis=0) / np.sqrt(variance), [0.0, 0.0], atol=_ROUNDING
    )


def test_six_points_against_a_frustum_full_of_random_points():
    rng = np.random.default_rng(0)
    start, end = 1.0, 3.0
    # Uniform in the frustum: t^3 is uniform, and the point is uniform on its disc.
    t = rng.uniform(start**3, end**3, size=400_000) ** (1.0 / 3.0)
    across = _RADIUS * t * np.sqrt(rng.uniform(size=t.size))
    positions, _ = _wide(_sample(_straight(), start, end))
    np.testing.assert_allclose(positions[:, 2].mean(), t.mean(), rtol=3e-3)
    np.testing.assert_allclose(positions[:, 2].std(), t.std(), rtol=3e-3)
    np.testing.assert_allclose(
        np.square(positions[:, :2]).sum(axis=-1).mean(), np.square(across).mean(), rtol=3e-3
    )


@pytest.mark.parametrize(("start", "end"), _INTERVALS)
def test_one_point_is_the_mean_and_takes_the_width_of_the_cone(start, end):
    (position,), (scale,) = _wide(_sample(_straight(), start, end, count=1))
    mean, _, _ = reference_sampling.frustum_moments(_RADIUS, start, end)
    np.testing.assert_allclose(position, [0.0, 0.0, mean], rtol=_ROUNDING)
    np.testing.assert_allclose(scale, 0.5 * _RADIUS * mean, rtol=_ROUNDING)


# --- the pattern ---


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 2.0, -2.0), (-0.3, 0.0, -0.9)])
def test_six_points_stand_at_the_corners_of_a_hexagon(direction):
    line = _straight(direction)
    unit = np.asarray(line.directions[0], np.float64)
    positions, scales = _wide(_sample(line, 1.0, 2.0))
    along = positions @ unit
    offsets = positions - along[:, None] * unit
    size = np.linalg.norm(offsets, axis=-1)
    np.testing.assert_allclose(size, _RADIUS * along / np.sqrt(2.0), rtol=_ROUNDING)
    np.testing.assert_allclose(scales, 0.5 * size, rtol=_ROUNDING)
    # Angles between one point and the next, counted round the ray.
    turned = np.diff(reference_sampling.HEXAGON_ANGLES)
    for (a, b), angle in zip(itertools.pairwise(offsets), turned, strict=True):
        cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        sine = np.cross(a, b) @ unit / np.linalg.norm(a) / np.linalg.norm(b)
        np.testing.assert_allclose([cosine, sine], [np.cos(angle), np.sin(angle)], atol=1e-5)


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.0])
def test_rotation_turns_the_pattern_about_the_ray(angle):
    before, scales = _wide(_sample(_straight(), 1.0, 2.0))
    after, scales_after = _wide(_sample(_straight(), 1.0, 2.0, angle))
    x, y, z = before.T
    turned = np.stack(
        [np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y]
    )
    np.testing.assert_allclose(after[:, :2].T, turned, atol=_ROUNDING)
    np.testing.assert_array_equal(after[:, 2], z)
    np.testing.assert_array_equal(scales_after, scales)


def test_a_ray_without_width_has_points_without_width():
    positions, scales = _wide(_sample(_straight(), 1.0, 2.0, radius=0.0))
    np.testing.assert_array_equal(positions[:, :2], np.zeros((6, 2)))
    np.testing.assert_array_equal(scales, np.zeros(6))


@pytest.mark.parametrize("count", [0, 2, 5, 7])
def test_other_numbers_of_points_are_refused(count):
    with pytest.raises(ValueError, match=f"count is {count}, but cone patterns"):
        _sample(_straight(), 1.0, 2.0, count=count)


@pytest.mark.parametrize("make", [polylines.whole_path, polylines.outside_path])
@pytest.mark.parametrize(("start", "end"), [(1.5, 2.5), (1.99, 2.01), (0.5, 3.5), (4.5, 5.5)])
def test_points_of_an_interval_across_an_interface_lie_on_both_of_its_sides(make, start, end):
    path = _elbow()
    line = make(path)
    positions, scales = _wide(_sample(line, start, end, 0.4))
    t = reference_sampling.hexagon_distances(start, end)
    used = set()
    for j in range(6):
        centre, direction, arc, _ = reference_sampling.walk_polyline(
            path.points,
            path.directions,
            path.tau,
            path.media,
            2,
            t[j],
            skip_inside=make is polylines.outside_path,
        )
        used.add(tuple(direction))
        across = _RADIUS * arc / np.sqrt(2.0)
        right, up = _wide(_basis(jnp.asarray(direction, jnp.float32)))
        angle = reference_sampling.HEXAGON_ANGLES[j] + 0.4
        expected = centre + across * (np.cos(angle) * right + np.sin(angle) * up)
        np.testing.assert_allclose(positions[j], expected, atol=5e-6)
        np.testing.assert_allclose(scales[j], 0.5 * across, rtol=_ROUNDING)
    # Past 4 in either coordinate the path that skips the inside has already bent for good.
    assert len(used) >= 2 or (make is polylines.outside_path and start > 2.0)


@jax.jit
def _gradients(line, start, end):
    def total(radius, start, end, rotation):
        wide = line._replace(radius=radius)
        positions, scales = polylines.multisamples(wide, start, end, rotation, count=6)
        return jnp.sum(positions) + jnp.sum(scales)

    arguments = jnp.float32(1e-3), start, end, jnp.float32(0.3)
    return jax.grad(total, argnums=(0, 1, 2, 3))(*arguments)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (0.0, 0.0),
        (0.0, 1e-10),
        (1.0, 1.0),
        (1.0, np.nextafter(np.float32(1.0), np.float32(2.0))),
        (1e10, 1e10),
        (0.05, 1e10),
        (1e10, 2e10),
        (0.05, 1e30),
    ],
)
def test_far_and_tiny_intervals_are_finite(start, end):
    line = polylines.whole_path(_elbow())
    for count in (1, 6):
        positions, scales = _wide(_sample(line, start, end, count=count))
        assert np.isfinite(positions).all() and np.isfinite(scales).all()
        assert (scales >= 0.0).all()
    assert gradients.all_finite(_gradients(line, jnp.float32(start), jnp.float32(end)))


_AXES = [np.roll([sign, 0.0, 0.0], axis) for axis in range(3) for sign in (1.0, -1.0)]
_OCTANTS = [np.array(signs) / np.sqrt(3.0) for signs in itertools.product((1.0, -1.0), repeat=3)]
_LEVEL = [np.array([0.6, sign * 0.8, zero]) for sign in (1.0, -1.0) for zero in (0.0, -0.0)]
_NEAR_POLES = [np.array([1e-4, -1e-4, sign * np.sqrt(1.0 - 2e-8)]) for sign in (1.0, -1.0)]


@pytest.mark.parametrize("direction", [*_AXES, *_OCTANTS, *_LEVEL, *_NEAR_POLES])
def test_orthonormal_basis_is_a_right_handed_frame(direction):
    frame = np.stack([*_wide(_basis(jnp.asarray(direction, jnp.float32))), direction])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=_ROUNDING)
    np.testing.assert_allclose(np.cross(frame[0], frame[1]), direction, atol=_ROUNDING)


def test_orthonormal_basis_by_hand():
    for sign in (1.0, -1.0):
        right, up = _basis(jnp.array([0.0, 0.0, sign]))
        np.testing.assert_array_equal(right, [1.0, 0.0, 0.0])
        np.testing.assert_array_equal(up, [0.0, sign, 0.0])


_basis_jacobian = jax.jit(jax.jacfwd(orthonormal_basis))


@pytest.mark.parametrize("direction", [*_AXES, *_LEVEL, *_NEAR_POLES])
def test_orthonormal_basis_has_a_finite_gradient(direction):
    assert gradients.all_finite(_basis_jacobian(jnp.asarray(direction, jnp.float32)))


# --- gradients and transformations ---


@pytest.mark.parametrize("count", [1, 6])
def test_multisamples_check_grads(count):
    line = _straight((1.0, 2.0, -2.0))

    def sample(radius, start, end, rotation):
        wide = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(jnp.float64), line)
        wide = wide._replace(radius=radius)
        return tuple(polylines.multisamples(wide, start, end, rotation, count=count))

    gradients.assert_numerical(sample, _RADIUS, 1.0, 2.5, 0.3)


def test_orthonormal_basis_check_grads():
    for direction in (_OCTANTS[0], _OCTANTS[-1]):
        gradients.assert_numerical(orthonormal_basis, direction)


_CASES = {
    "six": lambda path, start, end: polylines.multisamples(
        polylines.whole_path(path), start, end, 0.5 * start, count=6
    ),
    "one": lambda path, start, end: polylines.multisamples(
        polylines.outside_path(path), start, end, 0.5 * start, count=1
    ),
    "orthonormal_basis": lambda path, start, end: orthonormal_basis(path.directions[0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    paths = made_paths.stack(
        made_paths.random_path(seed, bends=seed, segments=4) for seed in range(3)
    )
    batches = (paths, jnp.array([0.05, 1.0, 2.0]), jnp.array([1.0, 4.0, 2.5]))
    transformation(_CASES[name], batches)
