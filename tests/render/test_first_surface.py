import jax
import numpy as np
import pytest

from refref_jax.geometry.rays import Rays
from refref_jax.render.images import NO_PART, find_first_surface
from tests.factories import scenes


def _cast(*parts, origins, directions, **options):
    return find_first_surface(
        scenes.build(*parts).surfaces, scenes.rays(origins, directions), **options
    )


def test_distance_normal_and_part_of_two_boxes_by_hand():
    near, far = scenes.box((1.0, 1.0, 1.0)), scenes.box((1.0, 4.0, 4.0), name="wall_glass")
    far = far._replace(vertices=far.vertices - [3.0, 0.0, 0.0])
    origins = [[4.0, 0.1, 0.2], [4.0, 1.0, 1.0], [4.0, 3.0, 0.0], [0.0, 0.0, 0.1]]
    directions = [[-1.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 1.0]]
    found = _cast(near, far, origins=origins, directions=directions)
    np.testing.assert_allclose(found.distances, [3.5, 6.5, np.inf, 0.4], rtol=1e-6)
    np.testing.assert_array_equal(found.parts, [0, 1, NO_PART, 0])
    # The last ray leaves a box: normals point out of bodies, not against rays.
    np.testing.assert_allclose(
        found.normals, [[1.0, 0, 0], [1.0, 0, 0], [0, 0, 0], [0, 0, 1.0]], atol=1e-6
    )


def test_a_ball_is_met_where_the_sphere_is_with_its_normal():
    rng = np.random.default_rng(0)
    targets = rng.uniform(-0.6, 0.6, (500, 3))
    origins = 4.0 * targets / np.linalg.norm(targets, axis=-1, keepdims=True)
    directions = rng.uniform(-0.5, 0.5, (500, 3)) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    along = np.sum(origins * directions, axis=-1)
    wanted = -along - np.sqrt(along**2 - (16.0 - 1.0))
    found = _cast(scenes.ball(subdivisions=6), origins=origins, directions=directions)
    # Triangles of the ball lie up to 1.5e-4 below the sphere, more along an oblique ray.
    np.testing.assert_allclose(found.distances, wanted, atol=1e-3)
    points = origins + wanted[:, None] * directions
    assert np.min(np.sum(points * found.normals, axis=-1)) > np.cos(np.radians(0.2))


@pytest.mark.slow
def test_tiles_and_leading_axes_change_nothing():
    rng = np.random.default_rng(1)
    origins, directions = rng.normal(size=(2, 35, 3))
    whole = _cast(scenes.ball(), origins=origins, directions=directions)
    rays = jax.tree.map(lambda x: x.reshape(7, 5, *x.shape[1:]), scenes.rays(origins, directions))
    cut = find_first_surface(scenes.build(scenes.ball()).surfaces, rays, tile=16)
    assert cut.distances.shape == (7, 5) and cut.normals.shape == (7, 5, 3)
    for one, other in zip(whole, cut, strict=True):
        np.testing.assert_array_equal(one, other.reshape(one.shape))


def test_an_empty_scene_and_no_rays_and_no_tile():
    missed = _cast(origins=[0.0, 0.0, 0.0], directions=[1.0, 0.0, 0.0])
    assert missed.distances[0] == np.inf and missed.parts[0] == NO_PART
    np.testing.assert_array_equal(missed.normals, [[0.0, 0.0, 0.0]])
    surfaces = scenes.build(scenes.ball()).surfaces
    nothing = Rays(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (3,), ())))
    assert find_first_surface(surfaces, nothing).distances.shape == (0,)
    with pytest.raises(ValueError, match="tile is"):
        find_first_surface(surfaces, nothing, tile=0)
