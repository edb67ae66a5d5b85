"""NeuS's and UNISURF's surface, opacity and slope; `render/test_surfaces.py` has whole paths."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special

from refref_jax.fields import hash_grid, neus, registry, zipnerf
from refref_jax.fields.base import Surface
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.sampling.polylines import Gaussians
from tests.laws import gradients

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_NEUS = neus.NeusConfig(
    _GRID,
    density_width=8,
    bottleneck=4,
    colour_width=8,
    colour_depth=1,
    around=_GRID,
    ball_centre=(0.45, 0.5, 0.55),
)
_UNISURF = neus.UnisurfConfig(
    _GRID, density_width=8, bottleneck=4, colour_width=8, colour_depth=1, around=_GRID
)

_TOWARDS = jnp.array([0.36, 0.48, 0.8], jnp.float32)

# Rounding of a logarithm in float32.
_ROUNDING = 1e-6


def _trained(config, size=0.6):
    """Returns parameters as after training: large entries, and biases that are not 0."""
    initial, rng = _initial(config), np.random.default_rng(1)
    return jax.tree.map(lambda x: jnp.float32(size * rng.normal(size=x.shape)), initial)


@functools.cache
def _initial(config):
    return jax.jit(lambda: neus.init_radiance(jax.random.key(0), config))()


def _at(point):
    return Gaussians(jnp.asarray(point, jnp.float32)[None], jnp.zeros(1, jnp.float32))


# --- signed values of solids, in float64: value, gradient ---


def _ball(points):
    length = np.linalg.norm(points, axis=-1, keepdims=True)
    return length[..., 0] - 0.5, points / length


def _torus(points):
    around = np.linalg.norm(points[..., :2], axis=-1, keepdims=True)
    ring = np.concatenate([points[..., :2] * (1.0 - 0.5 / around), points[..., 2:]], axis=-1)
    length = np.linalg.norm(ring, axis=-1, keepdims=True)
    return length[..., 0] - 0.2, ring / length


_SOLIDS = pytest.mark.parametrize("solid", [_ball, _torus], ids=["ball", "torus"])


def _rays(count, seed=0):
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= 1.5 / np.linalg.norm(origins, axis=-1, keepdims=True)
    aims = rng.uniform(-0.4, 0.4, size=(count, 3))
    towards = aims - origins
    return origins, towards / np.linalg.norm(towards, axis=-1, keepdims=True)


# --- opacity ---


def _depths(before, after, sharpness):
    """Returns the depths between pairs of values, in the precision that is enabled."""
    before, after = jnp.asarray(before), jnp.asarray(after)
    depth = jax.vmap(neus.logistic_depth, in_axes=(0, 0, None))
    return np.asarray(depth(before, after, jnp.asarray(sharpness, before.dtype)))


@_SOLIDS
@pytest.mark.parametrize("sharpness", [5.0, 60.0])
def test_depths_are_integrals_of_the_published_density(solid, sharpness):
    """The sum over many intervals against quadrature of `s sigma(-s f) max(0, -df/dt)`."""
    for origin, towards in zip(*_rays(6), strict=True):

        def density(t, origin=origin, towards=towards):
            value, slope = solid(origin + t * towards)
            return sharpness * scipy.special.expit(-sharpness * value) * max(0.0, -slope @ towards)

        with jax.enable_x64(True):
            # Middles and slopes of 4000 intervals, as the field returns them.
            edges = np.linspace(0.0, 3.0, 4001)
            middles = 0.5 * (edges[1:] + edges[:-1])
            value, slope = solid(origin + middles[:, None] * towards)
            half = 0.5 * np.diff(edges) * np.maximum(0.0, -slope @ towards)
            found = np.sum(_depths(value + half, value - half, sharpness))
        wanted, _ = scipy.integrate.quad(density, 0.0, 3.0, limit=2000, epsabs=1e-10)
        np.testing.assert_allclose(found, wanted, rtol=2e-4, atol=1e-9)


def test_depths_of_a_linear_value_add_up_over_any_partition():
    rng = np.random.default_rng(2)
    for sharpness in (0.5, 20.0, 900.0):
        values = np.sort(rng.uniform(-1.0, 1.0, size=30))[::-1].copy()
        with jax.enable_x64(True):
            parts = np.sum(_depths(values[:-1], values[1:], sharpness))
            (whole,) = _depths(values[:1], values[-1:], sharpness)
        np.testing.assert_allclose(parts, whole, rtol=1e-12)


def test_opacity_is_the_published_alpha_without_its_padding():
    """Numerator and denominator are padded by 1e-5 there: a haze of `1e-5 / sigma(s f_prev)`."""
    rng = np.random.default_rng(3)
    for sharpness in (3.0, 20.0, 400.0):
        before = rng.uniform(-10.0 / sharpness, 30.0 / sharpness, size=2000)
        after = before - rng.exponential(2.0 / sharpness, size=2000)
        first, second = (scipy.special.expit(sharpness * f) for f in (before, after))
        published = np.clip((first - second + 1e-5) / (first + 1e-5), 0.0, 1.0)
        alpha = -np.expm1(-_depths(np.float32(before), np.float32(after), sharpness))
        haze = 1e-5 / (first + 1e-5)
        np.testing.assert_allclose(alpha + haze * (1.0 - alpha), published, atol=3e-6)
        ahead = before >= 0.0
        np.testing.assert_allclose(alpha[ahead], published[ahead], atol=2e-5)


def test_the_weight_is_largest_at_the_surface():
    """Along a ray on which the value falls linearly, whatever the sharpness."""
    for sharpness in (5.0, 50.0, 500.0):
        for cosine in (1.0, 0.3):
            edges = np.linspace(0.0, 4.0, 4001)
            values = cosine * (2.0 - edges)
            with jax.enable_x64(True):
                depth = _depths(values[:-1], values[1:], sharpness)
            passed = np.exp(-np.concatenate([[0.0], np.cumsum(depth)[:-1]]))
            weights = passed * -np.expm1(-depth)
            assert abs(edges[np.argmax(weights)] - 2.0) <= edges[1]


@pytest.mark.parametrize("sharpness", [1e-3, 1.0, 1e3, 1e6])
def test_depths_are_finite_with_their_gradients(sharpness):
    values = [-1e30, -1e3, -1.0, -1e-12, 0.0, 1e-12, 1.0, 1e3, 1e30]
    slopes = jax.jit(jax.value_and_grad(neus.logistic_depth, argnums=(0, 1, 2)))
    for before in values:
        for after in values:
            found = slopes(*(jnp.float32(x) for x in (before, after, sharpness)))
            assert gradients.all_finite(found), (before, after)
            assert found[0] >= 0.0
            if after >= before:
                assert found[0] == 0.0


def test_gradients_of_depths_are_numerical():
    before, after = np.array([0.3, 0.1, 0.02]), np.array([0.1, -0.2, -0.5])
    gradients.assert_numerical(jax.vmap(neus.logistic_depth), before, after, np.full(3, 4.0))


@pytest.mark.parametrize("head_on", [0.0, 0.4, 1.0])
def test_the_annealed_cosine_is_the_published_one(head_on):
    cosines = np.linspace(-1.0, 1.0, 21)
    relu = lambda x: np.maximum(x, 0.0)
    published = relu(-cosines * 0.5 + 0.5) * (1.0 - head_on) + relu(-cosines) * head_on
    falling = jax.vmap(neus.falling, in_axes=(0, None))(jnp.asarray(cosines), jnp.float32(head_on))
    np.testing.assert_allclose(falling, published, atol=_ROUNDING)
    if head_on == 1.0:
        np.testing.assert_array_equal(falling[cosines >= 0.0], 0.0)


def _seen(signed, slope, *, within=True, density=0.7):
    return Surface(
        jnp.float32(signed),
        jnp.asarray(slope, jnp.float32),
        jnp.float32(0.0),
        jnp.asarray(within),
        jnp.float32(density),
        jnp.full(3, 0.5, jnp.float32),
    )


def _depth(config, seen, direction, length, *, progress=1.0, params=None):
    return registry.depth(
        _initial(config) if params is None else params,
        config,
        seen,
        jnp.asarray(direction, jnp.float32),
        jnp.float32(length),
        jnp.float32(progress),
    )


@pytest.mark.slow
def test_depth_of_an_interval_of_neus_by_hand():
    """The ball's radius is a quarter of an edge, which is half of the scene's radius."""
    towards, length = [0.0, 0.0, -1.0], 0.1
    log = lambda x: -np.logaddexp(0.0, -20.0 * x)
    for signed, steepness in [(0.05, 1.0), (0.0, 0.5), (-0.3, 2.0), (0.6, 1.0)]:
        half = 0.5 * steepness * length / 0.5
        found = _depth(_NEUS, _seen(signed, [0.0, 0.0, steepness]), towards, length)
        np.testing.assert_allclose(found, log(signed + half) - log(signed - half), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.0, 0.1, 1e30])
def test_a_ray_that_leaves_is_not_stopped(length):
    found = _depth(_NEUS, _seen(-0.2, [0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], length)
    assert found == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("config", [_NEUS, _UNISURF], ids=["neus", "unisurf"])
def test_beyond_the_ball_there_is_a_density(config):
    seen = _seen(-0.2, [0.0, 0.0, 1.0], within=False)
    np.testing.assert_allclose(_depth(config, seen, _TOWARDS, 2.0), 1.4, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("config", [_NEUS, _UNISURF], ids=["neus", "unisurf"])
def test_nothing_is_stopped_without_length(config):
    assert _depth(config, _seen(-0.2, [0.0, 0.0, 1.0]), [0.0, 0.0, -1.0], 0.0) == 0.0


def test_depth_of_an_occupancy_ignores_length_and_slope():
    for signed in (-6.0, -0.3, 0.0, 0.2, 6.0):
        occupied = scipy.special.expit(-10.0 * signed)
        for length, slope in [(0.1, [0.0, 0.0, 1.0]), (7.0, [3.0, 0.0, 0.0])]:
            depth = _depth(_UNISURF, _seen(signed, slope), _TOWARDS, length)
            wanted = np.logaddexp(0.0, -10.0 * signed)
            np.testing.assert_allclose(depth, wanted, rtol=_ROUNDING)
            np.testing.assert_allclose(-np.expm1(-depth), occupied, rtol=2e-6)


def test_annealing_depends_on_the_progress():
    config = dataclasses.replace(_NEUS, head_on=(0.0, 0.4))
    leaving = _seen(0.0, [0.0, 0.0, 0.5])
    depths = [_depth(config, leaving, [0.0, 0.0, 1.0], 0.1, progress=p) for p in (0.0, 0.5, 1.0)]
    assert depths[0] > depths[1] > depths[2] > 0.0


@functools.cache
def _slopes_of_intervals(config):
    """Returns the slopes of what an interval stops and shows, and its depth: one program."""

    def stopped(params, point, length):
        seen = neus.radiance(params, config, _at(point), _TOWARDS)
        depth = registry.depth(params, config, seen, -_TOWARDS, length, jnp.float32(1.0))
        return -jnp.expm1(-depth) + jnp.sum(seen.rgb), depth

    return jax.jit(jax.grad(stopped, has_aux=True))


@pytest.mark.slow
@pytest.mark.parametrize("config", [_NEUS, _UNISURF], ids=["neus", "unisurf"])
@pytest.mark.parametrize("log_sharpness", [-20.0, 0.0, 20.0])
@pytest.mark.parametrize("length", [0.0, 1e-20, 1.0, 1e30])
def test_intervals_are_finite_with_their_gradients(config, log_sharpness, length):
    params = _trained(config)
    if params.log_sharpness is not None:
        params = params._replace(log_sharpness=jnp.float32(log_sharpness))
    slopes = _slopes_of_intervals(config)
    for point in ([0.5, 0.5, 0.5], [0.45, 0.5, 0.55], [0.55, 0.6, 0.5], [0.0, 1.0, 0.3]):
        assert gradients.all_finite(slopes(params, point, jnp.float32(length))), point


# --- signed value, slope and curvature ---


@pytest.mark.parametrize("solid", [_ball, _torus], ids=["ball", "torus"])
def test_the_slope_is_the_gradient_up_to_the_step_times_second_derivatives(solid):
    """A tetrahedron is not symmetric: mixed second derivatives remain."""
    points = np.random.default_rng(4).uniform(0.4, 0.7, size=(40, 3))
    _, wanted = solid(points)
    corners = np.asarray(hash_grid.TETRAHEDRON)
    errors = []
    with jax.enable_x64(True):
        for step in (2e-3, 1e-3):
            values, _ = solid(points[:, None] + step * corners)
            found = jax.vmap(functools.partial(hash_grid.slope, step=step))(jnp.asarray(values))
            errors.append(np.abs(found - wanted).max())
    assert errors[0] < 5e-3 and 1.9 < errors[0] / errors[1] < 2.1


def test_the_laplacian_of_a_ball_is_two_over_the_radius():
    points, step = np.random.default_rng(5).normal(size=(40, 3)), 1e-3
    corners = points[:, None] + step * np.asarray(hash_grid.TETRAHEDRON)
    with jax.enable_x64(True):
        middle, around = (jnp.asarray(_ball(x)[0]) for x in (points, corners))
        found = jax.vmap(functools.partial(hash_grid.laplacian, step=step))(middle, around)
    np.testing.assert_allclose(found, 2.0 / np.linalg.norm(points, axis=-1), rtol=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("config", [_NEUS, _UNISURF], ids=["neus", "unisurf"])
def test_an_untrained_field_is_a_ball(config):
    params, centre = _initial(config), np.asarray(config.ball_centre)
    see = jax.jit(lambda point: neus.radiance(params, config, _at(point), _TOWARDS))
    for offset in ([0.0, 0.03, 0.1], [0.1, -0.05, 0.0], [-0.2, 0.1, 0.05]):
        seen = see(jnp.asarray(centre + offset))
        distance = np.linalg.norm(offset) / 0.25
        assert seen.within == (distance < 1.0)
        np.testing.assert_allclose(seen.signed, distance - 0.5, atol=2e-6)
        # Differences over a cell, a tenth of the box around the ball.
        corners, step = np.asarray(hash_grid.TETRAHEDRON), 0.2
        around, _ = _ball(np.asarray(offset) / 0.25 + step * corners)
        np.testing.assert_allclose(seen.slope, around @ corners / (4.0 * step), atol=1e-5)
        bend = np.sum(around - (distance - 0.5)) / (2.0 * step**2)
        np.testing.assert_allclose(seen.curvature, bend, atol=1e-4)
    assert not see(jnp.asarray(centre + np.array([0.0, 0.0, 0.26]))).within


@pytest.mark.slow
def test_only_the_field_of_a_place_learns_there():
    params = _trained(_NEUS)

    def seen(params, point):
        found = neus.radiance(params, _NEUS, _at(point), _TOWARDS)
        return jnp.sum(found.rgb)

    slopes = jax.jit(jax.grad(seen))
    size = lambda tree: sum(float(jnp.sum(jnp.abs(x))) for x in jax.tree.leaves(tree))
    inside, beyond = slopes(params, [0.5, 0.5, 0.5]), slopes(params, [0.9, 0.5, 0.5])
    assert size(inside.surface) > 0.0 and size(inside.around) == 0.0
    assert size(beyond.surface) == 0.0 and size(beyond.around) > 0.0


@pytest.mark.slow
def test_beyond_the_ball_it_is_zipnerf():
    params = _trained(_NEUS)
    shape = zipnerf.RadianceFieldConfig(
        _GRID, density_width=8, bottleneck=4, colour_width=8, colour_depth=1
    )
    ours = neus.radiance(params, _NEUS, _at([0.9, 0.5, 0.5]), _TOWARDS)
    theirs = zipnerf.radiance(params.around, shape, _at([0.9, 0.5, 0.5]), _TOWARDS)
    np.testing.assert_array_equal(ours.rgb, theirs.rgb)
    np.testing.assert_array_equal(ours.density, theirs.density)


def test_sizes_are_those_of_zipnerf_and_the_published_ones():
    published = neus.KIND.sizes["paper"]
    grid = published.field.grid
    assert (grid.levels, grid.base_res, grid.max_res, grid.hashmap_size) == (16, 16, 2048, 2**19)
    assert published.samples == (256, 96, 48) and published.field.head_on == (0.0, 0.4)
    assert [each.grid.max_res for each in published.proposals] == [64, 256]
    for name in ("tiny", "small"):
        size, plain = neus.KIND.sizes[name], zipnerf.KIND.sizes[name]
        assert size.samples == plain.samples and size.proposals[0].grid == plain.proposals[0].grid
        assert 2 * size.field.around.hashmap_size == plain.field.grid.hashmap_size
    for name, size in neus.UNISURF.sizes.items():
        assert size.field.sharpness == 10.0
        assert size.field.grid == neus.KIND.sizes[name].field.grid


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ball_radius": 0.0}, r"ball_radius=0\.0 .* is invalid"),
        ({"ball_radius": 0.6}, r"ball_radius=0\.6 .* Give a radius of at most half"),
        ({"start": 1.0}, r"start=1\.0 is invalid"),
        ({"sharpness": 0.0}, r"sharpness is 0\.0\. Give 1e-06 to 1e\+06"),
        ({"sharpness": float("nan")}, r"sharpness is nan"),
        ({"head_on": (0.0, 1.5)}, r"head_on is \(0\.0, 1\.5\)"),
    ],
)
def test_a_shape_is_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(_NEUS, **changes)
