"""The differentiable tracer: equal to the wavefront, and differentiated as closed forms are."""

import dataclasses
import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from refref_jax.optics import path_tracing
from refref_jax.optics.differentiable_paths import follow_branch
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import PAPER, STRAIGHT, TREE, PathSettings
from tests.factories import scenes

_DEPTH = 4


_follow = jax.jit(follow_branch, static_argnames="settings")


def _every_choice():
    return np.array(list(itertools.product([False, True], repeat=_DEPTH)))


def _all_branches(scene, rays, settings):
    """Returns one path a ray and choice, as `[rays, choices]`."""
    follow = functools.partial(follow_branch, scene, settings=settings)
    choices = jnp.asarray(_every_choice())
    each_choice = jax.vmap(follow, in_axes=(None, 0))
    found = jax.jit(jax.vmap(each_choice, in_axes=(0, None)))(rays, choices)
    return jax.tree.map(np.asarray, found)


def _objects():
    return {
        "ball": scenes.ball(1.0, subdivisions=2),
        "box": scenes.box((1.0, 1.2, 1.4)),
        "tinted box": scenes.box()._replace(tint=(0.5, 0.8, 0.9), absorption=(1.0, 0.2, 0.0)),
    }


@pytest.mark.slow
@pytest.mark.parametrize("body", ["tinted box", "ball", "box"])
@pytest.mark.parametrize(
    "settings",
    [
        PathSettings(_DEPTH, "all", min_throughput=0.02),
        PathSettings(_DEPTH, "first"),
        PathSettings(_DEPTH, "none", total_reflection="ended"),
    ],
)
def test_both_tracers_find_the_same_paths(body, settings):
    scene = scenes.build(_objects()[body])
    targets = np.random.default_rng(5).uniform(-0.6, 0.6, (12, 3))
    rays = scenes.rays([-4.0, 0.3, 0.2], targets - [-4.0, 0.3, 0.2])
    ample = dataclasses.replace(
        settings, live_per_ray=20.0, segments_per_ray=40.0, paths_per_ray=20.0
    )
    trace = jax.jit(functools.partial(path_tracing.trace, settings=ample, capacity=240))
    tree = jax.tree.map(np.asarray, trace(scene, rays).paths)
    single = _all_branches(scene, rays, settings)
    there = np.flatnonzero(tree.statuses != PathStatus.EMPTY)
    assert there.size > 12 or settings.reflections == "none"
    weights = np.zeros((12, 3))
    for i in there:
        ray, bends = tree.rays[i], tree.num_bends[i]
        used = slice(0, bends + 1)
        apart = np.abs(single.directions[ray][:, used] - tree.directions[i, used]).max(axis=(1, 2))
        apart = np.where(single.num_bends[ray] == bends, apart, np.inf)
        best = np.argmin(apart)
        np.testing.assert_allclose(single.points[ray, best, used], tree.points[i, used], atol=2e-5)
        np.testing.assert_allclose(apart[best], 0.0, atol=2e-5)
        np.testing.assert_allclose(single.tau[ray, best], tree.tau[i], atol=2e-5)
        np.testing.assert_allclose(single.throughput[ray, best], tree.throughput[i], atol=1e-5)
        np.testing.assert_array_equal(single.media[ray, best, used], tree.media[i, used])
        assert single.statuses[ray, best] == tree.statuses[i]
        weights[ray] += single.throughput[ray, best]
    if body != "tinted box":
        np.testing.assert_allclose(weights, 1.0, atol=1e-5)


def test_the_choices_must_fit_the_budget():
    ray = jax.tree.map(lambda x: x[0], scenes.rays([-4.0, 0.0, 0.0], [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="3 choices for 10 bends"):
        follow_branch(scenes.build(scenes.box()), ray, jnp.zeros(3, bool), settings=PAPER)


def test_without_bends_nothing_is_traced():
    ray = jax.tree.map(lambda x: x[0], scenes.rays([-4.0, 0.0, 0.0], [1.0, 0.0, 0.0]))
    nowhere = jnp.zeros(0, bool)
    path = _follow(scenes.build(scenes.box()), ray, nowhere, settings=STRAIGHT)
    assert (int(path.statuses), int(path.num_bends)) == (PathStatus.NOT_TRACED, 0)
    np.testing.assert_array_equal(path.throughput, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("truncated_paths", "weight"), [("background", 0.96), ("black", 0.0)])
def test_a_path_that_runs_out_of_bends_is_as_bright_as_the_budget_says(truncated_paths, weight):
    slab = scenes.build(scenes.box((20.0, 20.0, 0.5)))
    settings = PathSettings(1, "all", truncated_paths=truncated_paths)
    ray = _ray([0.3, 0.2, 3.0], [0.0, 0.0, -1.0])
    path = _follow(slab, ray, jnp.zeros(1, bool), settings=settings)
    assert path.statuses == PathStatus.OUT_OF_BENDS
    np.testing.assert_allclose(path.throughput, weight, rtol=1e-5)


def test_a_path_that_is_cut_weighs_nothing():
    scene = scenes.build(scenes.box((20.0, 20.0, 0.5)))
    ray = jax.tree.map(lambda x: x[0], scenes.rays([0.0, 0.1, 3.0], [0.0, 0.0, -1.0]))
    settings = PathSettings(2, "all", min_throughput=0.039)
    inner = _follow(scene, ray, jnp.array([False, True]), settings=settings)
    np.testing.assert_array_equal(inner.throughput, 0.0)


# --- gradients ---


def _double(tree):
    return jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def _ray(origin, direction):
    return jax.tree.map(lambda x: x[0], scenes.rays(origin, direction))


_CASES = {
    "slab, reflected inside": (
        lambda: scenes.box((20.0, 20.0, 0.5)),
        [0.3, 0.2, 3.0],
        [0.5, 0.1, -1.0],
        [False, True, False],
    ),
    "ball, reflected inside": (
        lambda: scenes.ball(1.0, subdivisions=2),
        [-4.0, 0.31, 0.17],
        [1.0, 0.02, 0.01],
        [False, True, False],
    ),
    "prism, totally reflected": (
        scenes.right_prism,
        [-2.0, 0.13, 0.3],
        [1.0, 0.05, 0.02],
        [False, False, False],
    ),
}


def _exit(scene, ray, reflects):
    """Returns everything smooth about where a path leaves, and how it ends."""
    settings = PathSettings(len(reflects), "all")
    path = follow_branch(scene, ray, jnp.asarray(reflects), settings=settings)
    last = len(reflects)
    return path.points[last], path.directions[last], path.tau[last], path.throughput, path.statuses


class _Knobs(NamedTuple):
    """All that a path may be differentiated with respect to."""

    index: jax.Array
    corners: jax.Array
    normals: jax.Array
    origin: jax.Array


# The slab has its closed form below as well.
@pytest.mark.parametrize("case", _CASES)
@pytest.mark.slow
def test_gradients_agree_with_differences(case):
    make, origin, direction, reflects = _CASES[case]
    with jax.enable_x64(True):
        scene, ray = _double((scenes.build(make()), _ray(origin, direction)))
        surfaces, interfaces = scene

        def run(knobs):
            tree = surfaces.bvh._replace(triangles=knobs.corners)
            moved = Scene(
                surfaces._replace(bvh=tree, normals=knobs.normals),
                interfaces._replace(index_inside=knobs.index),
            )
            return _exit(moved, ray._replace(origins=knobs.origin), reflects)

        start = _Knobs(
            interfaces.index_inside, surfaces.bvh.triangles, surfaces.normals, ray.origins
        )
        *_, status = jax.jit(run)(start)
        assert status == PathStatus.ESCAPED
        smooth = jax.jit(lambda knobs: run(knobs)[:-1])
        check_grads(smooth, (start,), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-6, rtol=1e-5)


def test_the_gradient_of_a_slab_is_the_closed_form():
    theta = np.radians(30.0)
    with jax.enable_x64(True):
        scene = _double(scenes.build(scenes.box((40.0, 40.0, 0.5))))
        ray = _double(_ray([0.0, 0.0, 3.0], [np.sin(theta), 0.0, -np.cos(theta)]))

        def shift(index):
            media = scene.interfaces._replace(index_inside=index[None])
            return _exit(scene._replace(interfaces=media), ray, [False, False])[0][0]

        # x = 2.75 tan(theta) + 0.5 tan(inner), and sin(inner) = sin(theta) / n.
        n, s = 1.5, np.sin(theta)
        expected = -0.5 * n * s / (n * n - s * s) ** 1.5
        found = jax.jit(jax.grad(shift))(jnp.float64(n))
        np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(
    "derivative", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.jacrev]
)
def test_gradients_at_the_critical_angle_are_finite(derivative):
    scene = scenes.build(scenes.box((20.0, 20.0, 0.5)))

    def leave(index, ray):
        media = scene.interfaces._replace(index_inside=index[None])
        moved = scene._replace(interfaces=media)
        path = follow_branch(moved, ray, jnp.zeros(1, bool), settings=PathSettings(1, "all"))
        return jnp.concatenate([path.points[1], path.directions[1], path.throughput])

    off = np.array([0.0, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3, -1e-3])
    theta = np.arcsin(1.0 / 1.5) + off
    rays = scenes.rays(np.zeros((7, 3)), np.stack([np.sin(theta), 0.0 * off, np.cos(theta)], -1))

    of_all = jax.jit(jax.vmap(derivative(leave), in_axes=(None, 0)))
    slopes = np.asarray(of_all(jnp.float32(1.5), rays))
    assert np.all(np.isfinite(slopes))
    # Beyond the critical angle nothing depends on the index.
    np.testing.assert_array_equal(slopes[[3, 5]], 0.0)


@pytest.mark.slow
def test_rays_that_miss_have_no_gradient_of_the_scene():
    scene = scenes.build(scenes.ball(1.0, subdivisions=1))
    ray = _ray([-4.0, 3.0, 0.0], [1.0, 0.0, 0.0])

    def last(scene):
        path = follow_branch(scene, ray, jnp.zeros(10, bool), settings=PAPER)
        return jnp.sum(path.directions[0] + path.throughput)

    gradient = jax.grad(last, allow_int=True)(scene)
    floats = [x for x in jax.tree.leaves(gradient) if x.dtype == jnp.float32]
    assert floats and all(np.all(x == 0.0) for x in floats)


@pytest.mark.slow
def test_an_index_can_be_found_by_descent():
    scene = scenes.build(scenes.ball(1.0, subdivisions=4))
    rays = scenes.rays([[-4.0, y, 0.1] for y in np.linspace(-0.6, 0.6, 16)], [1.0, 0.0, 0.0])
    settings = PathSettings(2, "none")

    def leave(index):
        media = scene.interfaces._replace(index_inside=index[None])
        follow = functools.partial(follow_branch, scene._replace(interfaces=media))
        paths = jax.vmap(lambda ray: follow(ray, jnp.zeros(2, bool), settings=settings))(rays)
        return paths.directions[:, 2]

    target = leave(jnp.float32(1.5))
    loss = jax.jit(jax.value_and_grad(lambda index: jnp.mean((leave(index) - target) ** 2)))
    index = jnp.float32(1.3)
    for _ in range(100):
        index = index - 0.5 * loss(index)[1]
    assert float(index) == pytest.approx(1.5, abs=2e-3)


def test_scenes_can_not_be_mapped_over():
    scene = scenes.build(scenes.ball(1.0, subdivisions=1))
    twice = jax.tree.map(lambda x: jnp.stack([x, x]), scene)
    ray = _ray([-4.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    follow = lambda scene: follow_branch(scene, ray, jnp.zeros(24, bool), settings=TREE)
    with pytest.raises(TypeError, match="one vmap cannot cast rays into several scenes"):
        jax.vmap(follow)(twice)
