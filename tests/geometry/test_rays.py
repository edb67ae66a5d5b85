"""Tests of `geometry.rays`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.rays import chord

_AWAY = 0.6  # distance of the lines from the centre, radii


def _lines(distance, count=64):
    """Lines that begin at a distance from the centre and pass it by `_AWAY`, in float32."""
    generator = np.random.default_rng(0)
    towards = generator.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    aside = np.cross(towards, generator.normal(size=(count, 3)))
    aside *= _AWAY / np.linalg.norm(aside, axis=-1, keepdims=True)
    origins = (aside - distance * towards).astype(np.float32)
    return origins, towards.astype(np.float32)


def _chord_in_float64(origins, directions):
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    middles = -np.sum(origins * directions, axis=-1)
    nearest = origins + middles[:, None] * directions
    return middles, np.sqrt(1.0 - np.sum(nearest**2, axis=-1))


@pytest.mark.parametrize("distance", [0.0, 1.0, 100.0, 1e4])
def test_chord_of_a_unit_sphere_from_afar(distance):
    origins, directions = _lines(distance)
    middles, halves = jax.vmap(chord, in_axes=(None, 0, 0))(1.0, origins, directions)
    expected = _chord_in_float64(origins, directions)
    rounded = 4.0 * np.finfo(np.float32).eps * max(distance, 1.0)
    np.testing.assert_allclose(middles, expected[0], atol=rounded)
    np.testing.assert_allclose(halves, expected[1], atol=rounded)


def test_chord_of_a_line_beside_the_sphere_is_empty_and_has_finite_gradients():
    origin, direction = jnp.array([-3.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 0.0])
    for radius in (1.0, 0.5, 0.0):  # a tangent, a miss, and a point
        middle, half = chord(radius, origin, direction)
        assert (middle, half) == (3.0, 0.0)
        gradient = jax.grad(lambda x, radius=radius: sum(chord(radius, x, direction)))(origin)
        np.testing.assert_array_equal(gradient, -direction)
