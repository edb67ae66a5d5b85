"""Light paths through level sets: against Snell's law in a ball, meshes, Embree, differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from benchmarks.oracles import reference_surfaces, reference_tree
from benchmarks.oracles.reference_surfaces import Embree, Part
from benchmarks.oracles.reference_tree import Rule
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.differentiable_paths import follow_branch
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.media import AMBIENT, meshes_of
from refref_jax.optics.path_settings import PathSettings
from tests.factories import level_sets, scenes
from tests.laws import gradients
from tests.oracles import reference

pytestmark = pytest.mark.longest

_TWO = PathSettings(max_bends=2, reflections="first")
_ORIGIN = np.zeros(3)
_TORUS = np.array([1.1, 0.4])


def _rays(count, seed=0, spread=0.8):
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= 4.0 / np.linalg.norm(origins, axis=-1, keepdims=True)
    return scenes.rays(origins, rng.uniform(-spread, spread, (count, 3)) - origins)


@functools.partial(jax.jit, static_argnames="settings")
def _trace(scene, rays, settings=_TWO):
    return path_tracing.trace_level_set(scene, rays, settings=settings)


def _main(traced):
    branches = traced.paths.rays.size // traced.dropped.shape[0]
    return jax.tree.map(lambda x: np.asarray(x[::branches]), traced.paths)


def _unit(vectors):
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def _sorted(ends):
    """Returns directions and throughput of all paths by ray, the heaviest of each first."""
    real = np.flatnonzero(np.asarray(ends.statuses) != PathStatus.EMPTY)
    share = np.asarray(ends.throughput)[real, 0]
    order = real[np.lexsort((-share, np.asarray(ends.rays)[real]))]
    return np.asarray(ends.directions)[order], np.asarray(ends.throughput)[order]


@pytest.mark.slow
def test_a_ball_bends_light_as_the_analytic_ball_does():
    with jax.enable_x64(True):
        rays = jax.tree.map(lambda x: x.astype(jnp.float64), _rays(60))
        rays = rays._replace(directions=_unit(rays.directions))
        main = _main(_trace(level_sets.scene(level_sets.ball(_ORIGIN, 1.2)), rays))
    bent = 0
    for i in range(60):
        origin, direction = np.asarray(rays.origins[i]), np.asarray(rays.directions[i])
        path = reference.trace_concentric_spheres(
            [reference.Sphere(1.2, 1.5, 1.0)], origin, direction, 2
        )
        assert main.num_bends[i] == len(path)
        for bend, (point, towards) in enumerate(path):
            np.testing.assert_allclose(main.points[i, bend + 1], point, atol=1e-10)
            np.testing.assert_allclose(main.directions[i, bend + 1], towards, atol=1e-10)
            bent += 1
    assert bent > 60


@pytest.mark.slow
def test_every_ray_has_its_reflection_and_all_of_its_light():
    rays = _rays(200, spread=1.6)
    traced = _trace(level_sets.scene(level_sets.ball(_ORIGIN, 1.2)), rays)
    paths = traced.paths
    assert paths.rays.tolist() == np.repeat(np.arange(200), 2).tolist()
    main, other = (jax.tree.map(lambda x, i=i: np.asarray(x[i::2]), paths) for i in (0, 1))
    met = main.num_bends > 0
    assert 20 < met.sum() < 180
    np.testing.assert_array_equal(other.statuses[met], PathStatus.NOT_TRACED)
    np.testing.assert_array_equal(other.statuses[~met], PathStatus.EMPTY)
    np.testing.assert_array_equal(main.statuses[met], PathStatus.ESCAPED)
    np.testing.assert_array_equal(main.statuses[~met], PathStatus.MISSED)
    np.testing.assert_array_equal(main.media[met][:, :3], [[AMBIENT, 1, AMBIENT]] * met.sum())
    np.testing.assert_allclose(main.throughput + other.throughput, 1.0, atol=1e-6)
    np.testing.assert_allclose(traced.dropped, 0.0, atol=1e-6)
    normals = main.points[met, 1] / 1.2
    towards = main.directions[met, 0]
    mirrored = towards - 2.0 * np.sum(towards * normals, -1, keepdims=True) * normals
    np.testing.assert_allclose(other.directions[met, 1], mirrored, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("reflections", ["none", "all"])
def test_light_that_is_not_followed_is_counted_as_dropped(reflections):
    settings = PathSettings(max_bends=4, reflections=reflections, min_throughput=0.02)
    traced = _trace(level_sets.scene(level_sets.ball(_ORIGIN, 1.2)), _rays(100), settings)
    branches = {"none": 1, "all": 4}[reflections]
    assert path_tracing.branches_of(settings) == branches
    assert traced.paths.rays.size == 100 * branches
    total = np.asarray(traced.paths.throughput).reshape(100, branches, 3).sum(axis=1)
    np.testing.assert_allclose(total + traced.dropped, 1.0, atol=1e-5)
    assert np.mean(traced.dropped) < 0.01


@pytest.mark.slow
def test_trace_and_trace_ends_take_level_sets():
    scene, rays = level_sets.scene(level_sets.ball(_ORIGIN, 1.2)), _rays(200)
    expected = _trace(scene, rays)
    found = jax.jit(functools.partial(path_tracing.trace, settings=_TWO))(scene, rays)
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-4)
    ends = scenes.trace_ends(scene, rays, settings=_TWO).ends
    last = np.sum(np.isfinite(expected.paths.tau), axis=1) - 1
    chosen = np.arange(400), np.maximum(last, 0)
    np.testing.assert_allclose(ends.directions, expected.paths.directions[chosen], atol=2e-4)
    with pytest.raises(TypeError, match="surface of this scene is a level set"):
        meshes_of(scene)


@pytest.mark.slow
def test_paths_are_those_of_a_fine_mesh_with_smooth_normals():
    rays = _rays(200, seed=3)
    mesh = scenes.build(scenes.ball(1.2, subdivisions=5))
    theirs = scenes.trace_ends(mesh, rays, settings=_TWO).ends
    glass = level_sets.scene(level_sets.ball(_ORIGIN, 1.2))
    ours = scenes.trace_ends(glass, rays, settings=_TWO).ends
    expected, found = _sorted(theirs), _sorted(ours)
    assert len(expected[0]) == len(found[0]) > 250
    for one, other in zip(expected, found, strict=True):
        # A facet decides otherwise near the edge of the ball, where the light is bent the most.
        assert np.mean(np.abs(one - other).max(axis=-1) < 2e-3) > 0.95


def test_paths_through_a_torus_are_those_of_embree():
    """Light leaves and enters again: four bends, of a fine mesh by an independent program."""
    mesh = trimesh.creation.torus(*_TORUS, major_sections=400, minor_sections=200)
    part = Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), True, 1.5)
    surfaces, rays = reference_surfaces.join([part]), _rays(300, seed=4, spread=1.2)
    origins, directions = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))
    settings = PathSettings(max_bends=4, reflections="none")
    theirs = reference_tree.trace(surfaces, Embree(surfaces), origins, directions, Rule(4, "none"))
    main = _main(_trace(level_sets.scene(level_sets.torus(_TORUS)), rays, settings))
    order = np.argsort(theirs.rays)
    same = main.num_bends == theirs.num_bends[order]
    # The others graze the torus, or end within rounding of another choice.
    assert (
        same.mean() > 0.95 and np.sum(main.num_bends == 2) > 50 and np.sum(main.num_bends > 2) > 10
    )
    last = main.directions[np.arange(300), main.num_bends]
    apart = np.linalg.norm(last - theirs.directions[order], axis=-1)[same]
    assert np.median(apart) < 2e-3 and np.mean(apart < 0.05) > 0.97


def _exit(origin, centre, radius, index, aim):
    """Point and direction after two bends, by the level set."""
    direction = aim / jnp.linalg.norm(aim)
    scene = level_sets.scene(level_sets.ball(centre, radius, 1.7), index)
    ray = Rays(origin, direction, jnp.full_like(origin[0], 1e-3))
    path = follow_branch(scene, ray, jnp.zeros(2, bool), settings=_TWO)
    return path.points[2], path.directions[2]


def _expected_exit(origin, centre, radius, index, aim):
    """The same by formulas of the ball, in NumPy, without any of the library's code."""
    direction = aim / np.linalg.norm(aim)
    path = reference.trace_concentric_spheres(
        [reference.Sphere(float(radius), float(index), 1.0)], origin - centre, direction, 2
    )
    point, towards = path[1]
    return point + centre, towards


@pytest.mark.slow
def test_gradients_at_both_surfaces_are_differences_of_the_analytic_ball():
    """The second point depends on the first as the origin of its ray: once, not twice."""
    start = [
        np.array([-4.0, 0.5, 0.3]),
        np.array([0.1, 0.2, -0.1]),
        np.float64(1.2),
        np.float64(1.5),
    ]
    aim = np.array([1.0, 0.02, -0.05])
    with jax.enable_x64(True):
        arguments = [jnp.asarray(x) for x in start]
        found = jax.jit(jax.jacrev(_exit, argnums=(0, 1, 2, 3)))(*arguments, jnp.asarray(aim))
        value = jax.jit(_exit)(*arguments, jnp.asarray(aim))
    for one, other in zip(value, _expected_exit(*start, aim), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10)
    step = 1e-6
    for place, at in enumerate(start):
        for axis in range(np.size(at)):
            change = step * np.eye(np.size(at))[axis].reshape(np.shape(at))
            ends = []
            for sign in (1.0, -1.0):
                moved = [x + sign * change if i == place else x for i, x in enumerate(start)]
                ends.append(_expected_exit(*moved, aim))
            for output, (plus, minus) in enumerate(zip(*ends, strict=True)):
                expected = (plus - minus) / (2.0 * step)
                ours = np.asarray(found[output][place]).reshape(3, -1)[:, axis]
                np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_differentials_are_those_of_neighbouring_rays():
    with jax.enable_x64(True):
        scene = level_sets.scene(level_sets.ball(_ORIGIN, 1.2))

        def end(shift):
            aim = jnp.array([4.0, 0.3, 0.2]) + jnp.array([0.0, 4.0, 0.0]) * shift
            ray = Rays(jnp.array([-4.0, 0.0, 0.0]), aim / jnp.linalg.norm(aim), jnp.float64(1e-3))
            path = follow_branch(
                scene, ray, jnp.zeros(2, bool), settings=_TWO, footprint="differential"
            )
            return path.points[2], path.differentials.points[2]

        moved, carried = jax.jit(jax.jacfwd(end, has_aux=True))(jnp.float64(0.0))
    # Of the plane of the two derivatives, whose axes are arbitrary.
    across = np.linalg.lstsq(np.asarray(carried).T, np.asarray(moved), rcond=None)
    np.testing.assert_allclose(np.asarray(carried).T @ across[0], moved, atol=1e-6)
    assert np.linalg.norm(carried) > 1e-4


@pytest.mark.slow
def test_gradients_of_all_rays_are_finite():
    rays = _rays(100, seed=7, spread=1.6)

    def total(radius, index):
        scene = level_sets.scene(level_sets.ball(_ORIGIN, radius), index)
        paths = path_tracing.trace_level_set(scene, rays, settings=_TWO).paths
        used = jnp.isfinite(paths.tau)
        return jnp.sum(jnp.where(used[..., None], paths.directions, 0.0)) + jnp.sum(
            paths.throughput
        )

    found = jax.jit(jax.grad(total, argnums=(0, 1)))(jnp.float32(1.2), jnp.float32(1.5))
    assert gradients.all_finite(found) and np.any(np.asarray(found) != 0.0)
