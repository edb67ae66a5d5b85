"""Errors at the extremes stay within their bounds, on a coarse lattice (docs/stability.md)."""

import numpy as np
import pytest

from benchmarks.stability import cases, laws
from benchmarks.stability.measures import MEASURES

pytestmark = pytest.mark.longest


# Whole paths whose single interfaces are quick, double precision, what
# `tests/geometry/test_hit_robustness.py` has of single hits, scales beside powers of two, and
# starts on surfaces, of which `tests/optics/test_path_tree.py` has a few.
_SLOW = (
    "ball",
    "index-matched bodies",
    "there and back",
    "starting on surfaces",
    "ball, float64",
    "slabs of all ratios and angles, float64",
    "offsets 1 to 1e4",
    "scales 1e-3 to 1e3",
    "triangles of aspect 1e4 to 1e6",
    "spheres of 80 triangles and more",
    "in faces and along edges",
)


def _case(measure):
    slow = measure.slow or measure.name in _SLOW
    return pytest.param(measure, id=measure.name, marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize("measure", [_case(measure) for measure in MEASURES])
def test_the_worst_error_is_within_its_bound(measure):
    found = measure.run(1)
    assert found.cases > 0
    assert found.worst <= measure.bound


def test_the_lattice_reaches_what_it_claims():
    lattice = laws.lattice(2)
    cosine = -np.sum(lattice.normals * lattice.directions, axis=-1)
    assert np.sum(lattice.near == lattice.far) > 10
    assert cosine.min() < 1.1e-6
    squared = 1.0 - (lattice.near / lattice.far) ** 2 * (1.0 - cosine**2)
    assert np.sum(np.abs(squared) < 1e-5) > 10 and np.any(squared < 0)
    assert (lattice.near / lattice.far).min() == pytest.approx(0.4)
    assert (lattice.near / lattice.far).max() == pytest.approx(2.5)


def test_needles_are_closed_and_thin():
    body = cases.paths.needles(2e-6)
    edges = np.sort(body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
    corners = body.vertices[body.faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    assert np.max(sides.max(axis=1) ** 2 / (2.0 * area)) > 0.99e6
