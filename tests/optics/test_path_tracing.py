import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.optics import path_tracing
from refref_jax.optics.light_paths import PathStatus, straight
from refref_jax.optics.media import AMBIENT
from refref_jax.optics.path_settings import (
    PAPER,
    STRAIGHT,
    TREE,
    PathSettings,
    capacities,
    capacity_for,
)
from tests.factories import scenes
from tests.oracles import reference
from tests.oracles.reference import Sphere

pytestmark = pytest.mark.longest

# Planar bodies are exact: what is left is float32 rounding near coordinates of 4.
_PLANAR_TOLERANCE = 5e-6

# An icosphere of 20,480 faces with interpolated normals against the true sphere.
_SPHERE_TOLERANCE = 4e-3


@functools.partial(jax.jit, static_argnames=("settings", "capacity"))
def _trace_jitted(scene, rays, *, settings, capacity):
    return path_tracing.trace(scene, rays, settings=settings, capacity=capacity)


def _trace(scene, rays, *, settings=PAPER, capacity=None):
    capacity = capacities(settings, len(rays.radii)).paths if capacity is None else capacity
    traced = _trace_jitted(scene, rays, settings=settings, capacity=capacity)
    return jax.tree.map(np.asarray, traced)


def _existing(paths):
    return jax.tree.map(lambda x: x[paths.statuses != PathStatus.EMPTY], paths)


def _refracted(scene, rays, bends=10):
    """Returns the one path of each ray, in the order of the rays."""
    settings = PathSettings(bends, "none", live_per_ray=1.0, paths_per_ray=1.0)
    return _trace(scene, rays, settings=settings).paths


@functools.cache
def _concentric(inner_index):
    """Returns two balls, and which of them lies in the other: that takes longer than the rest."""
    parts = (
        scenes.ball(1.0, index=1.5, subdivisions=5, name="outer_glass"),
        scenes.ball(0.6, index=inner_index, subdivisions=5, name="inner"),
    )
    return parts, find_containment(parts)


@functools.cache
def _ball_in_ball(rule, inner_index=1.333):
    parts, tree = _concentric(inner_index)
    return jax.device_put(assemble_scene(parts, tree.parents, rule=rule, overlaps=tree.overlaps))


def _check_against_spheres(scene, spheres, heights, bends):
    origins = np.array([[-4.0, y, 0.1] for y in heights])
    paths = _refracted(scene, scenes.rays(origins, [1.0, 0.0, 0.0]))
    for i, origin in enumerate(origins):
        expected = reference.trace_concentric_spheres(
            spheres, origin, np.array([1.0, 0.0, 0.0]), 10
        )
        assert len(expected) == bends == paths.num_bends[i]
        found = slice(1, bends + 1)
        np.testing.assert_allclose(
            paths.points[i, found], [b.point for b in expected], atol=_SPHERE_TOLERANCE
        )
        np.testing.assert_allclose(
            paths.directions[i, found], [b.direction for b in expected], atol=_SPHERE_TOLERANCE
        )
        steps = np.diff([origin, *(b.point for b in expected)], axis=0)
        tau = np.cumsum(np.linalg.norm(steps, axis=-1))
        np.testing.assert_allclose(paths.tau[i, found], tau, atol=_SPHERE_TOLERANCE)
        assert paths.statuses[i] == PathStatus.ESCAPED


@pytest.mark.parametrize("degrees", [0.0, 10.0, 45.0, 70.0])
def test_a_slab_shifts_light_sideways(degrees):
    thickness, theta = 0.5, np.radians(degrees)
    scene = scenes.with_spare_rows(scenes.build(scenes.box((20.0, 20.0, thickness), index=1.5)))
    direction = np.array([np.sin(theta), 0.0, -np.cos(theta)])
    start = -3.0 * direction
    paths = _refracted(scene, scenes.rays(start, direction))
    assert paths.num_bends[0] == 2
    np.testing.assert_allclose(paths.directions[0, 2], direction, atol=_PLANAR_TOLERANCE)
    inner = np.arcsin(np.sin(theta) / 1.5)
    shift = thickness * np.sin(theta - inner) / np.cos(inner)
    offset = paths.points[0, 2] - start
    sideways = np.linalg.norm(offset - np.dot(offset, direction) * direction)
    np.testing.assert_allclose(sideways, shift, atol=_PLANAR_TOLERANCE)
    inside = thickness / np.cos(inner)
    np.testing.assert_allclose(paths.tau[0, 2] - paths.tau[0, 1], inside, atol=_PLANAR_TOLERANCE)


def test_a_right_prism_turns_light_by_total_reflection():
    scene = scenes.with_spare_rows(scenes.build(scenes.right_prism()))
    # Down through the leg z = 1 plane's neighbour x = 0, against the hypotenuse, out at z = 0.
    paths = _refracted(scene, scenes.rays([-2.0, 0.1, 0.3], [1.0, 0.0, 0.0]))
    assert paths.num_bends[0] == 3
    np.testing.assert_allclose(paths.points[0, 2], [0.7, 0.1, 0.3], atol=_PLANAR_TOLERANCE)
    np.testing.assert_allclose(paths.directions[0, 2], [0.0, 0.0, -1.0], atol=_PLANAR_TOLERANCE)
    np.testing.assert_allclose(paths.directions[0, 3], [0.0, 0.0, -1.0], atol=_PLANAR_TOLERANCE)
    np.testing.assert_array_equal(paths.media[0, :4], [AMBIENT, 1, 1, AMBIENT])


def test_a_ball_of_glass():
    scene = scenes.build(scenes.ball(1.0, subdivisions=5))
    _check_against_spheres(scene, [Sphere(1.0, 1.5, 1.0)], [0.0, 0.2, 0.5, 0.8], 2)


@pytest.mark.slow
def test_a_hollow_shell():
    shell = [Sphere(1.0, 1.5, 1.0), Sphere(0.6, 1.0, 1.5)]
    _check_against_spheres(_ball_in_ball("nested", 1.0), shell, [0.0, 0.2, 0.4], 4)


@pytest.mark.slow
def test_water_in_glass_bends_less_where_they_touch():
    nested = [Sphere(1.0, 1.5, 1.0), Sphere(0.6, 1.333, 1.5)]
    _check_against_spheres(_ball_in_ball("nested"), nested, [0.1, 0.3, 0.5], 4)
    facing = [Sphere(1.0, 1.5, 1.0), Sphere(0.6, 1.333, 1.0)]
    _check_against_spheres(_ball_in_ball("facing"), facing, [0.1, 0.3, 0.5], 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("height", "nested", "facing"),
    [(0.1, -2.23, -7.03), (0.5, -11.17, -39.29)],
)
def test_nested_and_facing_differ_as_physics_says(height, nested, facing):
    # Exit angles in degrees from an independent float64 calculation on true spheres.
    rays = scenes.rays([-4.0, height, 0.0], [1.0, 0.0, 0.0])
    for rule, expected in (("nested", nested), ("facing", facing)):
        paths = _refracted(_ball_in_ball(rule), rays)
        x, y, _ = paths.directions[0, paths.num_bends[0]]
        assert np.degrees(np.arctan2(y, x)) == pytest.approx(expected, abs=0.3)


@pytest.mark.slow
def test_media_are_named_along_the_path():
    paths = _refracted(_ball_in_ball("nested"), scenes.rays([-4.0, 0.1, 0.0], [1.0, 0.0, 0.0]))
    # Parts are numbered in the order given: the outer ball is 1, the inner one 2.
    np.testing.assert_array_equal(paths.media[0, :5], [AMBIENT, 1, 2, 1, AMBIENT])


@pytest.mark.slow
def test_equal_indices_are_invisible():
    scene = scenes.build(scenes.ball(1.0, index=1.0, subdivisions=3))
    rays = scenes.rays([[-4.0, y, 0.0] for y in (0.0, 0.5, 0.9)], [1.0, 0.0, 0.0])
    for settings in (PAPER, TREE):
        paths = _existing(_trace(scene, rays, settings=settings).paths)
        np.testing.assert_array_equal(paths.rays, [0, 1, 2])
        for i in range(3):
            np.testing.assert_allclose(
                paths.directions[i, paths.num_bends[i]], [1, 0, 0], atol=1e-6
            )
        np.testing.assert_array_equal(paths.throughput, 1.0)


@pytest.mark.slow
def test_light_paths_are_reversible():
    scene = scenes.build(scenes.box((1.0, 1.2, 1.4), index=1.5))
    generator = np.random.default_rng(3)
    origins = generator.normal(size=(200, 3))
    origins *= 4.0 / np.linalg.norm(origins, axis=-1, keepdims=True)
    there = _refracted(
        scene, scenes.rays(origins, generator.uniform(-0.4, 0.4, (200, 3)) - origins)
    )
    through = np.flatnonzero((there.statuses == PathStatus.ESCAPED) & (there.num_bends <= 8))
    assert through.size > 50
    last = there.num_bends[through]
    ends = there.points[through, last] + 2.0 * there.directions[through, last]
    back = _refracted(scene, scenes.rays(ends, -there.directions[through, last]))
    home = back.directions[np.arange(through.size), back.num_bends]
    # A path that grazes an edge or the critical angle may take another way back.
    same = np.linalg.norm(home + there.directions[through, 0], axis=-1) < 1e-3
    assert same.mean() > 0.97


@pytest.mark.slow
def test_points_directions_and_distances_agree():
    scene = scenes.build(scenes.ball(1.0, subdivisions=4))
    rays = scenes.rays([[-4.0, y, 0.3] for y in np.linspace(-0.9, 0.9, 20)], [1.0, 0.0, 0.0])
    paths = _trace(scene, rays).paths
    for i in np.flatnonzero(paths.statuses != PathStatus.EMPTY):
        for k in range(paths.num_bends[i]):
            length = paths.tau[i, k + 1] - paths.tau[i, k]
            end = paths.points[i, k] + length * paths.directions[i, k]
            np.testing.assert_allclose(end, paths.points[i, k + 1], atol=1e-5)
        assert np.all(np.isinf(paths.tau[i, paths.num_bends[i] + 1 :]))
    np.testing.assert_allclose(np.linalg.norm(paths.directions, axis=-1), 1.0, atol=1e-6)


# At each run, the slab of `test_path_tree` has such paths.
@pytest.mark.slow
@pytest.mark.parametrize("bends", [1, 3])
def test_a_path_out_of_bends_says_so_and_goes_on(bends):
    rays = scenes.rays([-4.0, 0.1, 0.0], [1.0, 0.0, 0.0])
    full = _refracted(_ball_in_ball("nested"), rays)
    cut = _refracted(_ball_in_ball("nested"), rays, bends=bends)
    assert cut.statuses[0] == PathStatus.OUT_OF_BENDS
    assert cut.num_bends[0] == bends
    np.testing.assert_array_equal(cut.directions[0], full.directions[0, : bends + 1])


@pytest.mark.slow
def test_a_budget_that_just_suffices_escapes():
    rays = scenes.rays([-4.0, 0.1, 0.0], [1.0, 0.0, 0.0])
    paths = _refracted(_ball_in_ball("nested"), rays, bends=4)
    assert paths.statuses[0] == PathStatus.ESCAPED


@pytest.mark.slow
def test_rays_that_miss_stay_straight():
    scene = scenes.build(scenes.ball(1.0, subdivisions=3))
    rays = scenes.rays([[-4.0, y, 0.0] for y in (2.0, -1.5, 9.0)], [1.0, 0.0, 0.0])
    paths = _trace(scene, rays).paths
    assert np.all(paths.statuses[:3] == PathStatus.MISSED)
    assert paths.statuses.size > 3 and np.all(paths.statuses[3:] == PathStatus.EMPTY)
    assert np.all(paths.throughput[:3] == 1.0) and np.all(paths.throughput[3:] == 0.0)
    assert np.all(np.isinf(paths.tau[:3, 1:]))


@pytest.mark.slow
def test_the_paper_reflects_once_at_the_first_surface():
    scene = scenes.build(scenes.box((2.0, 2.0, 2.0), index=1.5))
    direction = np.array([0.6, 0.0, -0.8])
    rays = scenes.rays(-4.0 * direction + [0.0, 0.0, 1.0], direction)
    paths = _trace(scene, rays).paths
    reflectance = reference.fresnel_by_angles(np.arccos(0.8), 1.0, 1.5)
    np.testing.assert_allclose(paths.throughput[0], 1.0 - reflectance, atol=1e-6)
    np.testing.assert_allclose(paths.throughput[1], reflectance, atol=1e-6)
    assert paths.statuses[1] == PathStatus.NOT_TRACED
    assert paths.num_bends[1] == 1
    np.testing.assert_allclose(paths.points[1, 1], [0.0, 0.0, 1.0], atol=_PLANAR_TOLERANCE)
    np.testing.assert_allclose(paths.directions[1, 1], [0.6, 0.0, 0.8], atol=_PLANAR_TOLERANCE)
    np.testing.assert_allclose(paths.tau[1, :2], [0.0, 4.0], atol=_PLANAR_TOLERANCE)
    np.testing.assert_array_equal(paths.media[1, :2], [AMBIENT, AMBIENT])


@pytest.mark.slow
def test_fresnel_uses_the_index_of_the_part_that_was_hit():
    diamond = scenes.box((1.0, 1.0, 1.0), index=2.418, name="a_diamond")
    glass = scenes.ball(0.5, index=1.5, centre=(5.0, 0.0, 0.0), name="b_glass")
    rays = scenes.rays([[0.0, 0.0, 4.0], [5.0, 0.0, 4.0]], [0.0, 0.0, -1.0])
    paths = _trace(scenes.build(diamond, glass), rays).paths
    np.testing.assert_allclose(1.0 - paths.throughput[0], (1.418 / 3.418) ** 2, atol=1e-6)
    # The ball's shading normal there is off by the mesh, not by much.
    np.testing.assert_allclose(1.0 - paths.throughput[2], 0.04, atol=1e-4)


def _many_rays():
    generator = np.random.default_rng(0)
    targets = generator.uniform(-1.5, 1.5, (64, 3))
    return scenes.rays([-4.0, 0.0, 0.0], targets + np.array([4.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("settings", "capacity"),
    [
        (TREE, 1),
        (PAPER, 70),
        (TREE, 200),
    ],
)
@pytest.mark.slow
def test_weights_and_losses_of_every_ray_sum_to_one_at_any_capacity(settings, capacity):
    traced = _trace(
        scenes.build(scenes.ball(1.0)), _many_rays(), settings=settings, capacity=capacity
    )
    sums = traced.dropped.copy()
    np.add.at(sums, traced.paths.rays, traced.paths.throughput)
    np.testing.assert_allclose(sums, 1.0, atol=1e-6)
    assert (traced.dropped.max() > 0.0) == (capacity < 100)


@pytest.mark.slow
def test_the_strongest_paths_are_kept():
    scene = scenes.build(scenes.ball(1.0))
    full = _trace(scene, _many_rays(), capacity=200).paths.throughput[:, 0]
    kept = _trace(scene, _many_rays(), capacity=70).paths.throughput[:, 0]
    np.testing.assert_allclose(np.sort(kept)[::-1], np.sort(full)[::-1][:70])


@pytest.mark.slow
def test_paths_come_in_the_order_of_their_rays_the_heaviest_first():
    paths = _trace(scenes.build(scenes.ball(1.0)), _many_rays(), settings=TREE).paths
    exists = paths.statuses != PathStatus.EMPTY
    assert np.all(np.diff(exists.astype(int)) <= 0)
    rays, weights = paths.rays[exists], paths.throughput[exists, 0]
    assert np.all(np.diff(rays) >= 0)
    assert np.all(np.diff(weights)[np.diff(rays) == 0] <= 0.0)


@pytest.mark.slow
def test_tracing_in_a_pool_equals_tracing_batch_by_batch():
    scene = scenes.build(scenes.ball(1.0))
    rays = _many_rays()
    batches = jax.tree.map(lambda x: x.reshape(4, 16, *x.shape[1:]), rays)
    trace_pool = jax.jit(functools.partial(path_tracing.trace_batches, settings=PAPER, capacity=32))
    pool = trace_pool(scene, batches)
    for i in range(4):
        batch = jax.tree.map(lambda x, i=i: x[i], batches)
        single = _trace(scene, batch)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-6), pool, single)


@pytest.mark.slow
def test_no_mesh_of_a_straight_ray_is_said_to_be_missed():
    traced = _trace(scenes.build(scenes.ball(1.0)), _many_rays(), settings=STRAIGHT)
    assert np.all(traced.paths.statuses == PathStatus.NOT_TRACED)
    found = path_tracing.survey(scenes.build(), _many_rays(), settings=STRAIGHT)
    assert (float(found.mean), float(found.hit_fraction)) == (1.0, 0.0)


def test_the_straight_budget_ignores_the_objects():
    rays = _many_rays()
    traced = _trace(scenes.build(scenes.ball(1.0)), rays, settings=STRAIGHT, capacity=0)
    jax.tree.map(np.testing.assert_array_equal, traced.paths, straight(rays))
    assert np.all(traced.dropped == 0.0)


@pytest.mark.parametrize("settings", [PAPER, TREE])
@pytest.mark.slow
def test_an_empty_scene_bends_nothing(settings):
    traced = _trace(scenes.build(), _many_rays(), settings=settings)
    assert np.all(traced.paths.statuses[:64] == PathStatus.MISSED)
    assert np.all(traced.paths.statuses[64:] == PathStatus.EMPTY)
    assert all(np.all(np.isfinite(x)) for x in (traced.paths.points, traced.paths.throughput))


def test_no_rays_have_no_paths():
    rays = jax.tree.map(lambda x: x[:0], _many_rays())
    traced = _trace(scenes.build(scenes.ball(1.0)), rays, settings=TREE, capacity=8)
    assert traced.paths.statuses.shape == (0,)
    assert scenes.trace_ends(scenes.build(), rays, settings=TREE).casts == 0


def test_a_camera_inside_glass_starts_in_its_medium():
    paths = _refracted(scenes.build(scenes.box()), scenes.rays([0.0, 0.0, 0.0], [0.1, 0.0, 1.0]))
    np.testing.assert_array_equal(paths.media[0, :2], [1, AMBIENT])
    sine = 1.5 * 0.1 / np.hypot(0.1, 1.0)
    np.testing.assert_allclose(paths.directions[0, 1, 0], sine, atol=1e-6)


@pytest.mark.slow
def test_total_reflection_at_the_first_surface_needs_no_second_path():
    rays = scenes.rays([0.0, 0.0, 0.0], [0.5, 0.0, 0.45])
    paths = _trace(scenes.build(scenes.box((4.0, 4.0, 1.0))), rays).paths
    np.testing.assert_array_equal(paths.throughput[0], 1.0)
    assert paths.statuses[1] == PathStatus.EMPTY


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_paths_scale_with_the_scene(size):
    part = scenes.ball(1.0, subdivisions=3)
    rays = scenes.rays([[-4.0, y, 0.1] for y in (0.1, 0.5, 0.8)], [1.0, 0.0, 0.0])
    small = _refracted(scenes.build(part), rays)
    scaled = _refracted(
        scenes.build(part._replace(vertices=part.vertices * size)),
        rays._replace(origins=rays.origins * size),
    )
    np.testing.assert_array_equal(scaled.num_bends, small.num_bends)
    np.testing.assert_allclose(scaled.directions, small.directions, atol=1e-5)
    used = np.isfinite(small.tau)
    np.testing.assert_allclose(scaled.tau[used] / size, small.tau[used], atol=1e-5)


@pytest.mark.slow
def test_in_double_precision_a_slab_is_exact():
    with jax.enable_x64(True):
        scene = jax.tree.map(
            lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x,
            scenes.build(scenes.box((8.0, 8.0, 0.5), index=1.5)),
        )
        theta = np.radians(40.0)
        direction = np.array([[np.sin(theta), 0.0, -np.cos(theta)]])
        rays = scenes.rays([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])._replace(
            origins=jnp.asarray(-3.0 * direction),
            directions=jnp.asarray(direction),
            radii=jnp.full(1, 1e-3),
        )
        paths = _trace(scene, rays).paths
        np.testing.assert_allclose(paths.directions[0, 2], direction[0], atol=1e-14)
        inner = np.arcsin(np.sin(theta) / 1.5)
        np.testing.assert_allclose(
            paths.tau[0, 2] - paths.tau[0, 1], 0.5 / np.cos(inner), rtol=1e-13
        )


def test_capacity_covers_the_paths_of_random_batches():
    generator = np.random.default_rng(0)
    for rays, fraction in [(1024, 0.2), (64, 0.5), (4096, 0.01)]:
        deviation = np.sqrt(fraction * (1.0 - fraction))
        capacity = capacity_for(PAPER, rays, mean=1.0 + fraction, deviation=deviation)
        assert capacity <= 2 * rays
        excess = rays + generator.binomial(rays, fraction, 100_000) - capacity
        # A batch in six has paths that do not fit: a tenth of a deviation on average.
        assert np.mean(excess > 0) <= 0.16
        assert np.mean(np.maximum(excess, 0)) <= 0.1 * np.sqrt(rays) * deviation
    assert capacity_for(STRAIGHT, 1000, mean=1.0, deviation=0.0) == 1000
    assert capacity_for(PAPER, 100, mean=2.0, deviation=0.0) == 200


@pytest.mark.slow
def test_a_survey_counts_paths_and_hits():
    rays = _many_rays()
    ball = scenes.build(scenes.ball(1.0))
    found = jax.jit(functools.partial(path_tracing.survey, settings=PAPER))(ball, rays)
    paths = _existing(_trace(ball, rays).paths)
    counts = np.bincount(paths.rays, minlength=64)
    assert float(found.mean) == pytest.approx(counts.mean())
    assert float(found.deviation) == pytest.approx(counts.std(), abs=1e-6)
    assert float(found.hit_fraction) == pytest.approx(np.mean(counts == 2))


@pytest.mark.slow
def test_light_that_escapes_a_closed_body_has_left_its_medium():
    # Aimed next to the edges of a box: through a tolerant face light enters beside the body, and
    # never leaves it. Only rays as close to an edge as rounding may do so.
    box = scenes.build(scenes.box((1.0, 1.0, 1.0)))
    rng = np.random.default_rng(0)
    aim = rng.uniform(-0.5, 0.5, size=(4000, 3))
    aim[:, :2] = 0.5 * np.sign(aim[:, :2]) * (1.0 + rng.uniform(-1e-3, 1e-3, size=(4000, 2)))
    origin = np.array([-3.0, -2.0, 1.0])
    paths = _refracted(box, scenes.rays(origin, aim - origin))
    last = paths.media[np.arange(4000), paths.num_bends]
    escaped = (paths.statuses == PathStatus.ESCAPED) & (paths.num_bends > 0)
    assert escaped.sum() > 500
    assert np.mean(last[escaped] != AMBIENT) <= 5e-3


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
@pytest.mark.parametrize("of", ["rays", "scene"])
def test_derivatives_of_light_paths_are_refused(derivative, of):
    glass = jax.tree.map(jnp.asarray, scenes.build(scenes.ball(1.0, subdivisions=1)))
    rays = jax.tree.map(jnp.asarray, scenes.rays(np.array([[-4.0, 0.2, 0.1]]), [1.0, 0.0, 0.0]))

    def exit_height(x):
        moved = rays._replace(origins=rays.origins + x) if of == "rays" else rays
        surfaces = glass.surfaces._replace(normals=glass.surfaces.normals + x)
        shaped = glass._replace(surfaces=surfaces) if of == "scene" else glass
        return path_tracing.trace(shaped, moved, settings=PAPER, capacity=2).paths.points[0, 2, 1]

    with pytest.raises(TypeError, match="no derivatives"):
        derivative(exit_height)(jnp.float32(0.0))
