"""The reference itself: known values, and its two ways to find hits."""

import numpy as np
import pytest
import trimesh

from benchmarks.oracles import reference_surfaces, reference_tree
from benchmarks.oracles.reference_surfaces import BruteForce, Embree, Part
from benchmarks.oracles.reference_tree import OUT_OF_BENDS, PAPER, TREE, Rule
from tests.oracles import reference


def _solid(mesh, *, smooth=False, inside=1.5, tint=(1.0, 1.0, 1.0)):
    return Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), smooth, inside, tint=tint)


def _ball(subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return reference_surfaces.join([_solid(mesh, smooth=True)])


def _rays(count, seed=0):
    random = np.random.default_rng(seed)
    origins = 3.0 * reference_surfaces.unit(random.normal(size=(count, 3)))
    towards = random.uniform(-0.9, 0.9, (count, 3)) - origins
    return origins, reference_surfaces.unit(towards)


def _shares(ends, count):
    return np.stack(
        [np.bincount(ends.rays, w, minlength=count) for w in ends.throughput.T], axis=-1
    )


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_a_slab_splits_light_into_a_geometric_series(degrees):
    theta = np.radians(degrees)
    slab = reference_surfaces.join([_solid(trimesh.creation.box((50.0, 50.0, 0.5)))])
    direction = np.array([[np.sin(theta), 0.0, -np.cos(theta)]])
    origins = -3.0 * direction + [[0.013, 0.004, 0.0]]
    ends = reference_tree.trace(slab, BruteForce(slab), origins, direction, Rule(30, "all", 1e-9))
    r = reference.fresnel_by_angles(theta, 1.0, 1.5)
    series = [r, (1 - r) ** 2, r * (1 - r) ** 2, r**2 * (1 - r) ** 2]
    np.testing.assert_allclose(ends.throughput[:4, 0], series, rtol=1e-12)
    up = np.where(ends.directions[:, 2] > 0, 1.0, 0.0)
    np.testing.assert_allclose(ends.throughput[:, 0] @ up, 2 * r / (1 + r), rtol=1e-7)


def test_the_main_path_through_a_ball_obeys_snell():
    surfaces = _ball(5)
    origins = np.array([[-4.0, y, 0.1] for y in (0.0, 0.3, 0.6, 0.9)])
    directions = np.broadcast_to([1.0, 0.0, 0.0], origins.shape)
    ends = reference_tree.trace(surfaces, Embree(surfaces), origins, directions, Rule(10, "none"))
    order = np.argsort(ends.rays)
    spheres = [reference.Sphere(1.0, 1.5, 1.0)]
    for i, end in enumerate(order):
        path = reference.trace_concentric_spheres(spheres, origins[i], directions[i], 10)
        assert len(path) == ends.num_bends[end] == 2
        np.testing.assert_allclose(ends.origins[end], path[-1].point, atol=4e-3)
        np.testing.assert_allclose(ends.directions[end], path[-1].direction, atol=4e-3)


@pytest.mark.parametrize("rule", [PAPER, TREE, Rule(3, "all", 0.0), Rule(2, "all", 0.7)])
def test_clear_glass_loses_no_light(rule):
    surfaces = _ball()
    origins, directions = _rays(500)
    ends = reference_tree.trace(surfaces, Embree(surfaces), origins, directions, rule)
    np.testing.assert_allclose(_shares(ends, 500), 1.0, rtol=1e-12)
    assert ends.num_bends.max() <= rule.bends
    assert np.all(ends.num_bends[ends.statuses == OUT_OF_BENDS] == rule.bends)


def test_embree_and_brute_force_find_the_same_paths():
    surfaces = _ball(2)
    origins, directions = _rays(300)
    ways = [
        reference_tree.trace(surfaces, caster(surfaces), origins, directions, TREE)
        for caster in (BruteForce, Embree)
    ]
    assert ways[0].casts == ways[1].casts > 600
    for exact, found in zip(*ways, strict=True):
        np.testing.assert_allclose(found, exact, atol=1e-9)


def test_tint_is_taken_at_every_meeting():
    tint = np.array([0.9, 0.5, 0.1])
    box = reference_surfaces.join([_solid(trimesh.creation.box(), inside=1.0, tint=tuple(tint))])
    origins, directions = np.array([[3.0, 0.1, 0.2]]), np.array([[-1.0, 0.0, 0.0]])
    ends = reference_tree.trace(box, BruteForce(box), origins, directions, TREE)
    np.testing.assert_allclose(ends.throughput, tint[None] ** 2, rtol=1e-12)
    np.testing.assert_allclose(ends.directions, directions, atol=1e-15)
    assert ends.casts == 3
