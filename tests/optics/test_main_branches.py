"""The main branches: those of the tree that carry most, each once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import path_tracing
from refref_jax.optics.differentiable_paths import follow_main_branches
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import PathSettings
from tests.factories import scenes

pytestmark = pytest.mark.computing

_SETTINGS = PathSettings(max_bends=6, reflections="all", min_throughput=0.02)


@functools.partial(jax.jit, static_argnums=2)
def _followed(scene, rays, reflections):
    follow = functools.partial(
        follow_main_branches, scene, settings=_SETTINGS, reflections=reflections
    )
    return jax.vmap(follow)(rays)


def _follow(scene, rays, reflections=3):
    return jax.tree.map(np.asarray, _followed(scene, rays, reflections))


def _towards(count, seed=3):
    targets = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3))
    return scenes.rays([-4.0, 0.2, 0.1], targets - [-4.0, 0.2, 0.1])


def test_a_slab_from_above_has_the_shares_of_fresnel():
    scene = scenes.build(scenes.box((4.0, 4.0, 1.0)))
    found = _follow(scene, scenes.rays([0.1, 0.2, 4.0], [0.0, 0.0, -1.0]))
    part = 0.04
    # A second reflection has 0.0369 of the light, and the third one 0.0015, below the cut.
    expected = [(1 - part) ** 2, part, (1 - part) * part, 0.0]
    np.testing.assert_allclose(found.throughput[0, :, 0], expected, atol=1e-6)
    assert list(found.num_bends[0, :3]) == [2, 1, 3]
    assert found.statuses[0, 3] == PathStatus.EMPTY


@pytest.mark.slow
def test_they_are_the_branches_of_the_tree_and_nearly_all_of_its_light():
    scene = scenes.build(scenes.ball(1.0, subdivisions=3))
    rays = _towards(64)
    found = _follow(scene, rays)
    total = found.throughput[..., 0].sum(axis=1)
    assert np.all(total <= 1.0 + 1e-5) and total.mean() > 0.99
    trace = jax.jit(functools.partial(path_tracing.trace, settings=_SETTINGS, capacity=512))
    tree = jax.tree.map(np.asarray, trace(scene, rays).paths)
    last = np.arange(64)[:, None], np.arange(4)[None], found.num_bends
    for ray, branch in np.argwhere((found.statuses != PathStatus.EMPTY) & (total[:, None] > 0)):
        if found.throughput[ray, branch, 0] == 0.0:
            continue
        same = (tree.rays == ray) & (tree.num_bends == found.num_bends[ray, branch])
        ends = tree.directions[same, found.num_bends[ray, branch]]
        apart = np.abs(ends - found.directions[last][ray, branch]).max(axis=-1)
        assert apart.min() < 1e-4


@pytest.mark.slow
def test_a_total_reflection_is_not_counted_twice():
    # Through a leg of the prism onto its hypotenuse, at 45 degrees: beyond the critical angle.
    scene = scenes.build(scenes.right_prism())
    found = _follow(scene, scenes.rays([0.4, 0.0, -3.0], [0.0, 0.0, 1.0]))
    assert found.num_bends[0, 0] == 3
    assert found.statuses[0, 2] == PathStatus.EMPTY
    assert found.throughput[0, :, 0].sum() <= 1.0 + 1e-6


def test_a_ray_that_misses_has_one_path():
    scene = scenes.build(scenes.box())
    found = _follow(scene, scenes.rays([-4.0, 0.0, 0.0], [-1.0, 0.0, 0.0]))
    assert list(found.statuses[0]) == [PathStatus.MISSED, *[PathStatus.EMPTY] * 3]


@pytest.mark.slow
def test_the_index_has_the_gradient_of_a_slab():
    """Shift across a slab of thickness 1: `sin a - cos a sin b / cos b`, Snell's law for `b`."""
    scene = scenes.build(scenes.box((40.0, 40.0, 1.0)))
    angle = 0.6
    ray = jax.tree.map(
        lambda x: x[0], scenes.rays([0.0, 0.0, 3.0], [np.sin(angle), 0.0, -np.cos(angle)])
    )

    def shift(index):
        inside = jnp.full_like(scene.interfaces.index_inside, index)
        changed = scene._replace(interfaces=scene.interfaces._replace(index_inside=inside))
        path = follow_main_branches(changed, ray, settings=_SETTINGS, reflections=1)
        return path.points[0, 2, 0]

    def expected(index):
        return np.tan(np.arcsin(np.sin(angle) / index)) + 2.5 * np.tan(angle)

    value, slope = jax.jit(lambda *x: jax.jvp(shift, *x))((jnp.float32(1.5),), (jnp.float32(1.0),))
    assert value == pytest.approx(expected(1.5), abs=1e-5)
    assert slope == pytest.approx((expected(1.5001) - expected(1.4999)) / 2e-4, rel=1e-3)


def test_more_reflections_than_bends_are_refused():
    with pytest.raises(ValueError, match="reflections is 7, outside 0 to 6"):
        _follow(scenes.build(scenes.box()), _towards(1), reflections=7)
