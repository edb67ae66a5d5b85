"""Sections of closed meshes by horizontal planes."""

import numpy as np
import pytest

from refref_jax.geometry.triangle_meshes import slice_faces
from tests.factories import bodies


def _areas(mesh, bottom, step):
    """Area inside the cuts of each level, positive if the body is to their left."""
    start, end, level = slice_faces(mesh.vertices, mesh.faces, bottom, step)
    area = 0.5 * (start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0])
    return {int(each): area[level == each].sum() for each in np.unique(level)}


@pytest.mark.parametrize("bottom", [-1.0, -1.05, -0.3])
def test_sections_of_a_box_have_its_area(bottom):
    """Planes at -1.05 + (level + 0.5) 0.1 pass through vertices, and through the lid."""
    found = _areas(bodies.fine_box(half=1.0, spacing=0.1), bottom, 0.1)
    assert min(found) == np.ceil((-1.0 - bottom) / 0.1 - 0.5)
    np.testing.assert_allclose(list(found.values()), 4.0, rtol=1e-9)


def test_sections_of_a_ball_are_circles():
    found = _areas(bodies.icosphere(5), -1.0, 0.02)
    heights = -1.0 + 0.02 * (np.array(list(found)) + 0.5)
    np.testing.assert_allclose(list(found.values()), np.pi * (1.0 - heights**2), atol=0.01)


def test_no_faces_have_no_sections():
    nothing = slice_faces(np.zeros((0, 3)), np.zeros((0, 3), int), 0.0, 0.1)
    assert [len(each) for each in nothing] == [0, 0, 0]
