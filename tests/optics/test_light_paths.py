"""Which branch a path took first: by hand, and against a tracer that was told to reflect."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import path_tracing
from refref_jax.optics.differentiable_paths import follow_branch
from refref_jax.optics.light_paths import PathStatus, exists, heaviest, reflected_first, straight
from refref_jax.optics.path_settings import TREE
from tests.factories import made_paths, scenes

_TURN = [(0.0, 0.0, -1.0), (0.0, 0.1, 1.0), (0.0, 1.0, 0.0)]


def test_a_path_that_stays_in_its_medium_was_reflected():
    paths = made_paths.stack(
        [
            made_paths.path([2.0], _TURN[:2], [0, 0], segments=3),  # mirrored, and away
            made_paths.path([2.0, 1.0], _TURN, [0, 1, 0], segments=3),  # through
            made_paths.path([2.0, 1.0], _TURN, [0, 0, 2], segments=3),  # mirrored, into another
            made_paths.path([2.0], _TURN[:2], [0, 1], segments=3),  # out of bends inside
            made_paths.path([], _TURN[:1], [0], segments=3, status=PathStatus.MISSED),
        ]
    )
    assert reflected_first(paths).tolist() == [True, False, True, False, False]


def test_segments_inside_may_be_left_out():
    whole = made_paths.path([2.0, 1.0], _TURN, [0, 1, 0])
    outside = whole._replace(
        **{
            name: getattr(whole, name)[jnp.array([0, 2])]
            for name in ("points", "directions", "tau", "ends", "media")
        }
    )
    assert reflected_first(made_paths.stack([outside])).tolist() == [False]


def test_straight_light_is_never_reflected():
    rays = scenes.rays([[0.0, 0.0, 4.0]] * 3, [0.0, 0.0, -1.0])
    assert reflected_first(straight(rays)).tolist() == [False] * 3


@pytest.mark.slow
def test_the_tree_s_reflected_paths_set_out_as_the_single_reflection_does():
    scene = scenes.build(scenes.ball(1.0, subdivisions=3))
    settings = dataclasses.replace(TREE, max_bends=4, min_throughput=1e-3)
    rays = scenes.rays([[-4.0, 0.2, 0.1]] * 5, [[4.0, y, 0.1] for y in np.linspace(-0.9, 0.5, 5)])
    trace = jax.jit(functools.partial(path_tracing.trace, settings=settings, capacity=256))
    paths = trace(scene, rays).paths
    mirrored, real = np.asarray(reflected_first(paths)), np.asarray(exists(paths))
    paths = jax.tree.map(np.asarray, paths)
    for i in range(5):
        ray = jax.tree.map(lambda x, i=i: x[i], rays)
        for choice in (True, False):
            branch = follow_branch(
                scene, ray, jnp.array([choice, False, False, False]), settings=settings
            )
            ours = paths.directions[real & (paths.rays == i) & (mirrored == choice), 1]
            assert len(ours) >= 1
            np.testing.assert_allclose(
                ours, np.broadcast_to(branch.directions[1], ours.shape), atol=1e-5
            )


def test_the_heaviest_paths_of_rays():
    of_rays = jnp.array([0, 0, 2, 2, 2, 3, 0], jnp.int32)
    share = jnp.array([0.2, 0.7, 0.5, 0.5, 0.1, 0.0, 0.9], jnp.float32)
    held = jnp.array([1, 1, 1, 1, 1, 1, 0], bool)
    share = jnp.where(held, share, 0.0)
    found = heaviest(share, of_rays, held, rays=4)
    # Equal ones both count, one without light counts alone, and an empty slot never does.
    assert found.tolist() == [False, True, True, True, False, True, False]
