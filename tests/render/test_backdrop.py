"""Surfaces of the far field: lookups against numpy, transposes, seams, footprints."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.rays import Rays
from refref_jax.optics.light_paths import straight_ends
from refref_jax.render import backdrop
from refref_jax.sampling.scene_bounds import Domain

_SPACES = ("bounded", "spherical", "unbounded")
_DOMAINS = {space: Domain(2.0, space, (0.1, -0.2, 0.3)) for space in _SPACES}
_SIDE = 16


def _rays(count, *, radius=1e-2, seed=0):
    drawn = np.random.default_rng(seed).normal(size=(2, count, 3))
    directions = drawn[1] / np.linalg.norm(drawn[1], axis=-1, keepdims=True)
    radii = np.full(count, radius, np.float32)
    return Rays(*(jnp.asarray(x, jnp.float32) for x in (0.3 * drawn[0], directions, radii)))


_straight = jax.jit(functools.partial(straight_ends, footprint="differential"))


@functools.partial(jax.jit, static_argnames=("domain", "most_taps", "axes"))
def _lookups(domain, rays, *, most_taps=3, axes=0):
    ends = straight_ends(rays, footprint="differential")
    pixels = jnp.arange(rays.radii.size, dtype=jnp.int32) // 2
    shape = {"resolution": _SIDE, "most_taps": most_taps, "axes": axes}
    return backdrop.locate(domain, ends, pixels, **shape)


_colours = jax.jit(backdrop.colours, static_argnames="pixels")
_mipmap = jax.jit(backdrop.mipmap, static_argnums=1)
_transposed = jax.jit(backdrop.transposed, static_argnames="resolution")


@functools.partial(jax.jit, static_argnums=(0, 1))
def _run(function, count, *arguments):
    """Returns what a function of `backdrop` does, in one program."""
    return function(count, *arguments)


def _random_pyramid(seed=1):
    random = np.random.default_rng(seed)
    return tuple(
        jnp.asarray(random.uniform(size=(6, side + 1, side + 1, 3)), jnp.float32)
        for side in backdrop.sides(_SIDE)
    )


@pytest.mark.slow
def test_faint_paths_have_one_tap():
    ends = _straight(_rays(200, radius=0.1))
    dimmed = ends._replace(throughput=jnp.full((200, 3), 0.05))

    @jax.jit
    def taps(ends, faint):
        domain, pixels = _DOMAINS["spherical"], jnp.arange(200, dtype=jnp.int32)
        found = backdrop.locate(domain, ends, pixels, resolution=64, most_taps=3, faint=faint)
        return jnp.prod(found.taps, axis=-1)

    assert np.all(taps(dimmed, jnp.float32(0.1)) == 1)
    np.testing.assert_array_equal(
        taps(dimmed, jnp.float32(0.01)), taps(ends, jnp.float32(backdrop.FAINT))
    )
    assert np.all(taps(ends, jnp.float32(0.0)) > 1)


@pytest.mark.slow
@pytest.mark.parametrize("count", [40, 400])
def test_the_radiance_may_be_linear_in_the_direction(count):
    domain, rays = _DOMAINS["spherical"], _rays(count)
    lookups, plain = _lookups(domain, rays, axes=3), _lookups(domain, rays)
    each = [_mipmap(_random_pyramid(seed), "spherical") for seed in range(4)]
    mips = tuple(jnp.concatenate(level, axis=-1) for level in zip(*each, strict=True))
    seen = _colours(mips, lookups, pixels=count // 2)
    shares = [np.ones((count, 1), np.float32), *np.split(np.asarray(rays.directions), 3, axis=1)]
    expected = sum(
        np.asarray(
            _colours(mip, plain._replace(throughput=share * plain.throughput), pixels=count // 2)
        )
        for mip, share in zip(each, shares, strict=True)
    )
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    # The transpose is that of the same function.
    slopes = jnp.asarray(np.random.default_rng(7).normal(size=(count // 2, 3)), jnp.float32)
    spread = _transposed(slopes, lookups, resolution=_SIDE)
    assert spread[0].shape[-1] == 12
    pairs = zip(spread, mips, strict=True)
    np.testing.assert_allclose(
        sum(float(jnp.vdot(a, b)) for a, b in pairs), float(jnp.vdot(seen, slopes)), rtol=1e-4
    )


def _faces(lookups):
    """Returns the faces of lookups at the finest resolution."""
    return np.asarray(lookups.entries) // (np.asarray(lookups.sides) + 1) ** 2


def _middles(lookups):
    """Returns the middle of all taps of each path."""
    half = 0.5 * (np.asarray(lookups.taps) - 1.0)[..., None]
    return np.asarray(lookups.starts) + np.sum(half * np.asarray(lookups.steps), axis=1)


def test_levels_are_halved_while_their_number_of_cells_is_even():
    assert backdrop.sides(16) == (4, 8, 16)
    assert backdrop.sides(12) == (6, 12)
    assert backdrop.sides(7) == (7,)


@pytest.mark.parametrize("space", _SPACES)
def test_a_uniform_surface_is_the_throughput_of_each_pixel(space):
    rays = _rays(200, radius=0.3)
    mips = _mipmap(backdrop.init(_SIDE, radiance=jnp.array([0.2, 0.5, 4.0])), space)
    for copy in mips:
        np.testing.assert_allclose(copy, np.broadcast_to([0.2, 0.5, 4.0], copy.shape), rtol=1e-6)
    lookups = _lookups(_DOMAINS[space], rays)
    assert np.any(lookups.sides < _SIDE) and np.all(lookups.taps >= 1)
    seen = _colours(mips, lookups, pixels=100)
    np.testing.assert_allclose(seen, np.broadcast_to([0.4, 1.0, 8.0], (100, 3)), rtol=1e-5)


@pytest.mark.parametrize("space", _SPACES)
def test_native_loops_are_the_formulas_of_other_devices(space):
    lookups = _lookups(_DOMAINS[space], _rays(200, radius=0.1))
    mips = _mipmap(_random_pyramid(), space)
    table = backdrop._table(mips)
    np.testing.assert_allclose(
        _run(backdrop._read_native, 100, table, lookups),
        _run(backdrop._read, 100, table, lookups),
        rtol=1e-5,
    )
    slopes = jnp.asarray(np.random.default_rng(2).normal(size=(100, 3)), jnp.float32)
    np.testing.assert_allclose(
        _run(backdrop._add_native, len(table), slopes, lookups),
        _run(backdrop._add, len(table), slopes, lookups),
        atol=1e-5,
    )


@pytest.mark.parametrize("space", _SPACES)
def test_the_transpose_of_the_colours(space):
    lookups = _lookups(_DOMAINS[space], _rays(200, radius=0.1))
    mips = tuple(_random_pyramid()[::-1])
    slopes = jnp.asarray(np.random.default_rng(2).normal(size=(100, 3)), jnp.float32)
    forward = np.vdot(_colours(mips, lookups, pixels=100), slopes)
    back = _transposed(slopes, lookups, resolution=_SIDE)
    backward = sum(np.vdot(a, b) for a, b in zip(mips, back, strict=True))
    np.testing.assert_allclose(forward, backward, rtol=1e-4)


def test_a_wall_is_interpolated_bilinearly_at_the_point_where_the_ray_leaves():
    domain = _DOMAINS["bounded"]
    target = np.array([0.1 + 0.3, -0.2 + 2.0, 0.3 - 0.7])  # on the wall +y
    origin = np.array([0.5, 0.1, 0.2])
    direction = (target - origin) / np.linalg.norm(target - origin)
    ray = Rays(*(jnp.asarray(x, jnp.float32)[None] for x in (origin, direction, 1e-4)))
    lookups = _lookups(domain, ray)
    assert _faces(lookups)[0] == 3
    # Columns of a wall are along the next axis, rows along the one after: z, then x.
    expected = 0.5 * _SIDE * (np.array([-0.7, 0.3]) / 2.0 + 1.0)
    np.testing.assert_allclose(_middles(lookups)[0], expected, atol=1e-4)
    grid = np.asarray(_mipmap(_random_pyramid(), "bounded")[0])[3]
    column, row = np.floor(expected).astype(int)
    right, up = expected - (column, row)
    across = grid[row : row + 2, column] * (1 - right) + grid[row : row + 2, column + 1] * right
    seen = _colours(_mipmap(_random_pyramid(), "bounded"), lookups, pixels=1)
    np.testing.assert_allclose(seen[0], across[0] * (1 - up) + across[1] * up, rtol=1e-3)


@pytest.mark.parametrize("space", ["spherical", "unbounded"])
def test_there_are_no_seams(space):
    mips = _mipmap(_random_pyramid(), space)
    domain = Domain(2.0, space)
    random = np.random.default_rng(3)
    for axis, other in ((0, 1), (1, 2), (2, 0)):
        edge = random.uniform(-1.0, 1.0, size=(40, 3))
        edge[:, axis], edge[:, other] = 1.0, random.choice([-1.0, 1.0], size=40)
        either = np.stack([edge, edge])
        either[0, :, axis] += 1e-5
        either[1, :, axis] -= 1e-5
        directions = either / np.linalg.norm(either, axis=-1, keepdims=True)
        rays = Rays(
            jnp.zeros((80, 3)),
            jnp.asarray(directions.reshape(-1, 3), jnp.float32),
            jnp.full(80, 1e-6),
        )
        lookups = _lookups(domain, rays)._replace(pixels=jnp.arange(80, dtype=jnp.int32))
        faces = _faces(lookups)
        assert np.all(faces[:40] != faces[40:])
        first = 0
        for side in backdrop.sides(_SIDE)[::-1]:
            coarser = lookups._replace(
                entries=jnp.asarray(first + faces * (side + 1) ** 2),
                sides=jnp.full(80, side, jnp.int32),
                starts=lookups.starts * (side / _SIDE),
            )
            first += 6 * (side + 1) ** 2
            seen = _colours(mips, coarser, pixels=80)
            np.testing.assert_allclose(seen[:40], seen[40:], atol=2e-3)


@pytest.mark.parametrize("space", _SPACES)
def test_axes_are_the_change_of_the_place_across_a_pixel(space):
    domain, rays = _DOMAINS[space], _rays(200, radius=1e-3)
    lookups = _lookups(domain, rays)
    ends = _straight(rays)
    for axis in range(2):
        moved = rays._replace(directions=rays.directions + ends.differentials.directions[:, axis])
        there = _lookups(domain, moved)
        same = _faces(there) == _faces(lookups)
        assert same.sum() > 180 and np.all(lookups.sides == _SIDE)
        change = np.sqrt(3.0) * (_middles(there) - _middles(lookups))
        across = np.asarray(lookups.steps) * np.asarray(lookups.taps)[..., None]
        np.testing.assert_allclose(change[same], across[same][:, axis], rtol=0.03, atol=2e-3)


def test_a_wide_footprint_reads_the_mean_of_its_surroundings():
    grid = np.zeros((6, _SIDE + 1, _SIDE + 1, 3), np.float32)
    grid[:, ::2] = 1.0  # stripes of one cell
    pyramid = (*backdrop.init(_SIDE)[:-1], jnp.asarray(grid))
    mips = _mipmap(pyramid, "bounded")
    narrow, wide = (_lookups(_DOMAINS["bounded"], _rays(200, radius=r)) for r in (1e-5, 0.5))
    seen = [np.std(_colours(mips, lookups, pixels=100)) for lookups in (narrow, wide)]
    assert seen[0] > 0.3 and seen[1] < 0.2 * seen[0]


def test_places_and_axes_are_finite_at_the_extremes():
    directions = jnp.asarray([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]], jnp.float32)
    origins = jnp.asarray([[5.0, 0.0, 0.0], [0.1, -0.2, 0.3], [2.1, 1.8, 2.3]], jnp.float32)
    for space in _SPACES:
        lookups = _lookups(_DOMAINS[space], Rays(origins, directions, jnp.full(3, 1e6)))
        for values in lookups:
            assert np.all(np.isfinite(values))


def test_a_coarse_level_is_interpolated_exactly_on_finer_grids():
    first, *others = backdrop.init(_SIDE)
    ramp = jnp.broadcast_to(jnp.arange(5.0)[None, None, :, None], first.shape)
    finest = _mipmap((ramp, *others), "bounded")[0]
    expected = np.broadcast_to(np.linspace(0.0, 4.0, _SIDE + 1)[None, None, :, None], finest.shape)
    np.testing.assert_allclose(finest, expected, atol=1e-6)


@pytest.mark.parametrize(
    "space",
    ["bounded", *(pytest.param(each, marks=pytest.mark.slow) for each in _SPACES[1:])],
)
def test_gradients_by_radiance_and_throughput_are_finite_differences(space):
    lookups, pyramid = _lookups(_DOMAINS[space], _rays(40, radius=0.1)), _random_pyramid()
    target = jnp.asarray(np.random.default_rng(5).uniform(size=(20, 3)), jnp.float32)

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def loss(pyramid, throughput):
        seen = backdrop.colours(
            backdrop.mipmap(pyramid, space), lookups._replace(throughput=throughput), pixels=20
        )
        return jnp.sum(jnp.square(seen - target))

    given = pyramid, lookups.throughput
    _, slopes = loss(*given)
    random = np.random.default_rng(6)
    for number in range(2):
        towards = jax.tree.map(lambda x: np.float32(random.normal(size=x.shape)), given[number])
        values = []
        for step in (1e-2, -1e-2):
            moved = jax.tree.map(
                lambda x, y, step=step: np.asarray(x) + np.float32(step) * y, given[number], towards
            )
            values.append(float(loss(*(moved if n == number else given[n] for n in range(2)))[0]))
        pairs = zip(jax.tree.leaves(slopes[number]), jax.tree.leaves(towards), strict=True)
        expected = sum(np.sum(a * b) for a, b in pairs)
        np.testing.assert_allclose((values[0] - values[1]) / 2e-2, expected, rtol=5e-3)
