"""What must hold of any surface that depends on unknowns."""

import numpy as np

from refref_jax.geometry.triangle_meshes import face_normals, is_watertight, volume
from refref_jax.reconstruct.shapes import mesh_of


class PartOf:
    """One part of a vessel as a surface that depends on unknowns."""

    def __init__(self, vessel, number):
        self.start, self.scales = vessel.start, vessel.scales
        self.pose = lambda x: vessel.pose(x).parts[number]


def assert_closed(posed):
    """The surface is closed, outward, and its normals are unit and on the side of the faces."""
    assert is_watertight(posed.faces)
    assert volume(posed.vertices, posed.faces) > 0.0
    assert np.allclose(np.linalg.norm(posed.normals, axis=-1), 1.0, atol=1e-12)
    flat = face_normals(posed.vertices[posed.faces])
    assert np.sum(mesh_of(posed).normals * flat[:, None], axis=-1).min() > 0.5


def assert_derivatives(shape, *, seed=0, near=0.2, step=1e-5, tolerance=1e-6):
    """Derivatives are central differences, along random directions at random unknowns."""
    random, scales = np.random.default_rng(seed), shape.scales()
    at = shape.start() + near * scales * random.normal(size=scales.shape)
    posed = shape.pose(at)
    for _ in range(2):
        along = scales * random.normal(size=scales.shape)
        after, before = shape.pose(at + step * along), shape.pose(at - step * along)
        for field, slopes in (("vertices", posed.by_vertices), ("normals", posed.by_normals)):
            moved = (getattr(after, field) - getattr(before, field)).ravel() / (2.0 * step)
            found = slopes @ along
            assert found.shape == moved.shape
            assert np.abs(found - moved).max() <= tolerance * max(np.abs(moved).max(), 1e-3), field


def assert_prior(shape, *, seed=1):
    """The gradient is that of the quadratic of the precision, which is positive definite."""
    random, scales = np.random.default_rng(seed), shape.scales()
    along = scales * random.normal(size=scales.shape)
    precision, gradient = shape.prior(shape.start() + along)
    assert np.allclose(shape.prior(shape.start())[1], 0.0)
    assert np.allclose(precision @ along, gradient)
    assert along @ gradient > 0.0
