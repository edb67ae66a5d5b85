import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.rays import orthonormal_basis
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.differentiable_paths import follow_branch
from refref_jax.optics.light_paths import exists, straight
from refref_jax.optics.path_settings import TREE, Detail, PathSettings
from refref_jax.sampling import polylines
from tests.factories import scenes

_RADIUS = 1e-3  # of every ray of tests.factories.scenes
_GLASS = scenes.build(scenes.ball(1.0, subdivisions=3))
_SLAB = scenes.build(scenes.box((10.0, 10.0, 0.6)))
_THROUGH = PathSettings(max_bends=2, reflections="none")
_WHOLE = Detail("all", TREE.max_bends + 1, "differential")


@jax.jit
def _traced(scene, rays):
    return path_tracing.trace(scene, rays, settings=TREE, capacity=64, detail=_WHOLE).paths


def _one(paths, index):
    return jax.tree.map(lambda x: x[index], paths)


def _footprint(path, t):
    return np.asarray(polylines.point_at(polylines.whole_path(path), jnp.float32(t)).footprint)


def _gram(axes):
    """Returns what does not depend on which axes span an ellipse: its second moments."""
    return axes.T @ axes


@pytest.mark.parametrize("t", [0.0, 0.5, 7.0])
@pytest.mark.slow
def test_a_ray_that_meets_nothing_has_the_footprint_of_its_cone(t):
    rays = scenes.rays([0.0, 0.0, -4.0], [0.3, 0.9, 0.2])
    bent = _one(_traced(_GLASS, rays), 0)
    cone = jax.tree.map(lambda x: x[0], straight(rays))
    assert bent.differentials.points.shape[-2:] == (2, 3) and cone.differentials.points.shape[
        -2:
    ] == (0, 3)
    np.testing.assert_allclose(_footprint(bent, t), _footprint(cone, t), atol=1e-9)
    np.testing.assert_allclose(
        _footprint(cone, t) @ _footprint(cone, t).T, (_RADIUS * t) ** 2 * np.eye(2), atol=1e-9
    )


@pytest.mark.slow
def test_a_slab_narrows_a_footprint_by_its_index():
    rays = scenes.rays([0.1, 0.05, -4.0], [0.0, 0.0, 1.0])
    paths = _traced(_SLAB, rays)
    through = int(np.argmax(paths.throughput[:, 0]))
    # 3.7 through air, 0.6 through glass, 2 through air.
    axes = _footprint(_one(paths, through), 3.7 + 0.6 + 2.0)
    np.testing.assert_allclose(
        axes @ axes.T, (_RADIUS * (3.7 + 0.6 / 1.5 + 2.0)) ** 2 * np.eye(2), rtol=1e-4, atol=1e-9
    )


@pytest.mark.slow
def test_a_mirror_leaves_a_footprint_as_wide_as_it_was():
    paths = _traced(_SLAB, scenes.rays([0.1, 0.05, -4.0], [0.3, 0.1, 1.0]))
    mirrored = next(i for i in range(64) if exists(paths)[i] and int(paths.num_bends[i]) == 1)
    path = _one(paths, mirrored)
    t = float(path.tau[1]) + 3.0
    axes = _footprint(path, t)
    np.testing.assert_allclose(axes @ axes.T, (_RADIUS * t) ** 2 * np.eye(2), rtol=1e-4, atol=1e-9)


@jax.jit
def _push(ray, across):
    """Moves a ray across its pixel; returns its end behind the ball, and how that moves."""

    def last(direction):
        moved = ray._replace(directions=direction)
        scanned = follow_branch(_GLASS, moved, jnp.zeros(2, bool), settings=_THROUGH)
        return scanned.points[2], scanned.directions[2]

    return jax.jvp(last, (ray.directions,), (across,))


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.3, 0.2), (-0.6, 0.45), (0.1, -0.9)])
def test_spreads_are_the_derivatives_of_the_differentiable_tracer(offset):
    """The main path through a smooth ball, against forward-mode derivatives of the scan."""
    rays = scenes.rays([offset[0], offset[1], -4.0], [0.02, -0.01, 1.0])
    path = _one(_traced(_GLASS, rays), 0)  # the heaviest: straight through
    assert int(path.num_bends) == 2

    for axis, across in enumerate(orthonormal_basis(rays.directions[0])):
        _, (point, direction) = _push(jax.tree.map(lambda x: x[0], rays), _RADIUS * across)
        np.testing.assert_allclose(path.differentials.points[2, axis], point, rtol=2e-3, atol=2e-6)
        np.testing.assert_allclose(
            path.differentials.directions[2, axis], direction, rtol=2e-3, atol=2e-6
        )


def test_a_ball_of_glass_widens_pixels():
    ray = scenes.rays([0.9, 0.0, -4.0], [0.0, 0.0, 1.0])
    paths = _traced(_GLASS, ray)
    through = int(np.argmax(paths.throughput[:, 0]))
    path = _one(paths, through)
    axes = _footprint(path, float(path.tau[path.num_bends]) + 7.0)
    cone = _RADIUS * (float(path.tau[path.num_bends]) + 7.0)
    assert np.sqrt(np.trace(_gram(axes)) / 2.0) > 1.5 * cone


@jax.jit
def _legs(scene, rays):
    detail = Detail("outside", 4, "differential")
    return path_tracing.trace(scene, rays, settings=TREE, capacity=1024, detail=detail).paths


@pytest.mark.slow
@pytest.mark.parametrize("index", [1.0, 1.0 + 1e-6, 1.5, 2.418])
def test_spreads_are_finite_at_grazing_and_critical_angles(index):
    glass = scenes.build(scenes.ball(1.0, index=index, subdivisions=2), scenes.box((3, 3, 1e-3)))
    heights = np.concatenate([np.linspace(-1.0, 1.0, 41), 1.0 - np.logspace(-8, -2, 20)])
    rays = scenes.rays([[y, 0.0, -4.0] for y in heights], [0.0, 0.0, 1.0])
    for leaf in _legs(glass, rays).differentials:
        assert np.isfinite(leaf).all()


def test_nothing_is_carried_for_a_cone():
    differential = light_paths.begin_differential(
        jax.tree.map(lambda x: x[0], scenes.rays([0, 0, 0], [0, 0, 1])), "cone"
    )
    assert differential.points.size == 0 and differential.directions.size == 0
