import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.rays import orthonormal_basis
from refref_jax.optics import footprints, path_tracing
from refref_jax.optics.budgets import TREE, Budget
from refref_jax.optics.details import Detail
from refref_jax.optics.light_paths import exists
from refref_jax.optics.single_path import follow_branch
from refref_jax.sampling import polylines
from tests import scenes

_RADIUS = 1e-3  # of every ray of tests.scenes
_WHOLE = Detail("all", TREE.bends + 1, "differential")


@functools.partial(jax.jit, static_argnames=("budget", "detail"))
def _traced(geometry, rays, *, budget=TREE, detail=_WHOLE):
    return path_tracing.trace(geometry, rays, budget=budget, capacity=64, detail=detail).paths


def _one(paths, index):
    return jax.tree.map(lambda x: x[index], paths)


def _footprint(path, t):
    return np.asarray(polylines.point_at(polylines.whole_path(path), jnp.float32(t)).footprint)


def _gram(axes):
    """Returns what does not depend on which axes span an ellipse: its second moments."""
    return axes.T @ axes


@pytest.mark.parametrize("t", [0.0, 0.5, 7.0])
def test_a_ray_that_meets_nothing_has_the_footprint_of_its_cone(t):
    rays = scenes.rays([0.0, 0.0, -4.0], [0.3, 0.9, 0.2])
    glass = scenes.geometry(scenes.ball(0.5, subdivisions=2))
    bent = _one(_traced(glass, rays), 0)
    cone = _one(_traced(glass, rays, detail=Detail("all", TREE.bends + 1)), 0)
    assert bent.spreads.points.shape[-2:] == (2, 3) and cone.spreads.points.shape[-2:] == (0, 3)
    np.testing.assert_allclose(_footprint(bent, t), _footprint(cone, t), atol=1e-9)
    np.testing.assert_allclose(
        _footprint(cone, t) @ _footprint(cone, t).T, (_RADIUS * t) ** 2 * np.eye(2), atol=1e-9
    )


def test_a_slab_narrows_a_footprint_by_its_index():
    slab = scenes.geometry(scenes.box((10.0, 10.0, 0.6), index=1.5))
    rays = scenes.rays([0.1, 0.05, -4.0], [0.0, 0.0, 1.0])
    paths = _traced(slab, rays)
    through = int(np.argmax(paths.weights[:, 0]))
    # 3.7 through air, 0.6 through glass, 2 through air.
    axes = _footprint(_one(paths, through), 3.7 + 0.6 + 2.0)
    np.testing.assert_allclose(
        axes @ axes.T, (_RADIUS * (3.7 + 0.6 / 1.5 + 2.0)) ** 2 * np.eye(2), rtol=1e-4, atol=1e-12
    )


def test_a_mirror_leaves_a_footprint_as_wide_as_it_was():
    block = scenes.geometry(scenes.box((10.0, 10.0, 0.6)))
    paths = _traced(block, scenes.rays([0.1, 0.05, -4.0], [0.3, 0.1, 1.0]))
    mirrored = next(i for i in range(64) if exists(paths)[i] and int(paths.bends[i]) == 1)
    path = _one(paths, mirrored)
    t = float(path.tau[1]) + 3.0
    axes = _footprint(path, t)
    np.testing.assert_allclose(axes @ axes.T, (_RADIUS * t) ** 2 * np.eye(2), rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.3, 0.2), (-0.6, 0.45), (0.1, -0.9)])
def test_spreads_are_the_derivatives_of_the_differentiable_tracer(offset):
    """The main path through a smooth ball, against forward-mode derivatives of the scan."""
    budget = Budget(bends=4, reflections="none")
    glass = scenes.geometry(scenes.ball(1.0, subdivisions=3))
    rays = scenes.rays([offset[0], offset[1], -4.0], [0.02, -0.01, 1.0])
    path = _one(_traced(glass, rays, budget=budget, detail=Detail("all", 5, "differential")), 0)
    assert int(path.bends) == 2

    def last(direction):
        ray = jax.tree.map(lambda x: x[0], rays)._replace(directions=direction)
        scanned = follow_branch(glass, ray, jnp.zeros(4, bool), budget=budget)
        return scanned.points[2], scanned.directions[2]

    for axis, across in enumerate(orthonormal_basis(rays.directions[0])):
        _, (point, direction) = jax.jvp(last, (rays.directions[0],), (_RADIUS * across,))
        np.testing.assert_allclose(path.spreads.points[2, axis], point, rtol=2e-3, atol=2e-6)
        np.testing.assert_allclose(
            path.spreads.directions[2, axis], direction, rtol=2e-3, atol=2e-6
        )


def test_spreads_are_the_differences_of_neighbouring_rays():
    """Behind a ball, against rays that are traced beside the middle one."""
    glass = scenes.geometry(scenes.ball(1.0, subdivisions=5))
    ray = scenes.rays([0.35, 0.2, -4.0], [0.0, 0.0, 1.0])
    budget = Budget(bends=4, reflections="none")
    detail = Detail("all", 5, "differential")
    trace = functools.partial(_traced, glass, budget=budget, detail=detail)
    middle = _one(trace(ray), 0)
    t, step = float(middle.tau[2]) + 5.0, 4.0
    axes = _footprint(middle, t)
    for axis, across in zip(axes, orthonormal_basis(ray.directions[0]), strict=True):
        ends = []
        for sign in (1.0, -1.0):
            moved = ray.directions + sign * step * _RADIUS * across
            moved = moved / jnp.linalg.norm(moved)
            path = _one(trace(ray._replace(directions=moved)), 0)
            line = polylines.whole_path(path)
            ends.append(np.asarray(polylines.point_at(line, jnp.float32(t)).position))
        difference = (ends[0] - ends[1]) / (2.0 * step)
        direction = np.asarray(middle.directions[2])
        difference -= (difference @ direction) * direction
        # Faces of an inscribed ball: positions are piecewise linear, off by a percent or two.
        assert np.linalg.norm(difference - axis) < 0.05 * np.linalg.norm(axes)


def test_a_ball_of_glass_widens_pixels():
    glass = scenes.geometry(scenes.ball(1.0))
    ray = scenes.rays([0.5, 0.0, -4.0], [0.0, 0.0, 1.0])
    paths = _traced(glass, ray)
    through = int(np.argmax(paths.weights[:, 0]))
    path = _one(paths, through)
    axes = _footprint(path, float(path.tau[path.bends]) + 7.0)
    cone = _RADIUS * (float(path.tau[path.bends]) + 7.0)
    assert np.sqrt(np.trace(_gram(axes)) / 2.0) > 1.5 * cone


@pytest.mark.parametrize("index", [1.0, 1.0 + 1e-6, 1.5, 2.418])
def test_spreads_are_finite_at_grazing_and_critical_angles(index):
    glass = scenes.geometry(scenes.ball(1.0, index=index, subdivisions=2), scenes.box((3, 3, 1e-3)))
    heights = np.concatenate([np.linspace(-1.0, 1.0, 41), 1.0 - np.logspace(-8, -2, 20)])
    rays = scenes.rays([[y, 0.0, -4.0] for y in heights], [0.0, 0.0, 1.0])
    detail = Detail("outside", 4, "differential")
    paths = path_tracing.trace(glass, rays, budget=TREE, capacity=1024, detail=detail).paths
    for leaf in paths.spreads:
        assert np.isfinite(leaf).all()


def test_nothing_is_carried_for_a_cone():
    spread = footprints.begin(
        jax.tree.map(lambda x: x[0], scenes.rays([0, 0, 0], [0, 0, 1])), "cone"
    )
    assert spread.points.size == 0 and spread.directions.size == 0
