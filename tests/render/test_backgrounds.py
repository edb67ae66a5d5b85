import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.oracles import colours
from benchmarks.oracles.backgrounds import CubeBackground as SlowCube
from benchmarks.oracles.backgrounds import look_at_environment
from refref_jax.data.scene_assembly import read_background
from refref_jax.render import backgrounds, radiance_of
from refref_jax.render.backgrounds import (
    CubeBackground,
    Environment,
    LinearTexture,
    SphereBackground,
    SrgbTexture,
)
from tests.laws import gradients, transformations

# A texel is 1/512 of a wall: float32 places a point to 1e-4 of one, and the bundled images step
# from dark to bright between two texels.
_LOOKUP = 1e-3
_ROUNDING = 2e-6

_HALF_EXTENT = 3.0
_NORMALS = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
_U_AXES = np.roll(_NORMALS, 1, axis=1)
_V_AXES = np.abs(np.roll(_NORMALS, 2, axis=1))


def _images(*shape, seed=0):
    return np.random.default_rng(seed).uniform(size=(*shape, 3)).astype(np.float32)


def _cube(texture):
    texture = jax.tree.map(jnp.asarray, texture)
    axes = (jnp.asarray(axes) for axes in (_NORMALS, _U_AXES, _V_AXES))
    return CubeBackground(texture, *axes, jnp.float32(_HALF_EXTENT))


CUBE = _cube(SrgbTexture(_images(6, 8, 8)))
SPHERE = SphereBackground(LinearTexture(jnp.asarray(_images(8, 16))), jnp.float32(_HALF_EXTENT))
ENVIRONMENT = Environment(SPHERE.texture)

_ALL = {"cube": CUBE, "sphere": SPHERE, "env": ENVIRONMENT}


def _see(background, origin, direction):
    direction = np.asarray(direction, np.float64)
    direction = direction / np.linalg.norm(direction)
    ray = (jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32))
    return np.asarray(radiance_of(background)(*ray))


def _random_rays(count, reach=_HALF_EXTENT):
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.uniform(-reach, reach, (count, 3)), directions


def _see_all(background, origins, directions):
    see = jax.jit(lambda radiance, *rays: jax.vmap(radiance)(*rays))
    rays = (jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32))
    return np.asarray(see(radiance_of(background), *rays))


@pytest.mark.parametrize("wall", range(6))
@pytest.mark.parametrize(("row", "column"), [(0, 0), (2, 5), (7, 7)])
def test_a_texel_of_a_wall_is_where_the_mapping_says(wall, row, column):
    u, v = (column + 0.5) / 8, 1.0 - (row + 0.5) / 8
    point = _HALF_EXTENT * (
        _NORMALS[wall] + (2 * u - 1) * _U_AXES[wall] + (2 * v - 1) * _V_AXES[wall]
    )
    expected = colours.srgb_to_linear(np.asarray(CUBE.texture.texels)[wall, row, column])
    for origin in ([0.0, 0.0, 0.0], [0.5, -1.0, 2.0]):
        np.testing.assert_allclose(_see(CUBE, origin, point - origin), expected, atol=1e-5)


def test_srgb_is_interpolated_before_it_is_decoded_and_linear_as_it_is():
    texels = np.zeros((6, 2, 2, 3), np.float32)
    texels[:, :, 1] = 1.0
    middle = [1.0, 0.0, 0.3]  # of the wall +x, whose u axis is y
    linear, srgb = (
        _see(_cube(kind(texels)), [0, 0, 0], middle) for kind in (LinearTexture, SrgbTexture)
    )
    np.testing.assert_allclose(linear, 0.5, rtol=1e-5)
    np.testing.assert_allclose(srgb, colours.srgb_to_linear(0.5), rtol=1e-5)


def test_a_wall_s_image_repeats_over_its_border():
    texels = np.zeros((6, 2, 2, 3), np.float32)
    texels[:, :, 1] = 1.0
    border = _see(_cube(LinearTexture(texels)), [0, 0, 0], [1.0, 1.0 - 1e-6, 0.3])
    np.testing.assert_allclose(border, 0.5, atol=1e-5)


def test_the_bundled_walls_are_those_of_the_reference(ball_scene):
    origins, directions = _random_rays(4000, reach=7.2)
    ours = _see_all(read_background(ball_scene), origins, directions)
    expected, _ = SlowCube(ball_scene).look(origins, directions)
    np.testing.assert_allclose(ours, expected, atol=_LOOKUP)


def test_an_environment_is_that_of_the_reference():
    origins, directions = _random_rays(2000)
    ours = _see_all(ENVIRONMENT, origins, directions)
    expected = look_at_environment(np.asarray(ENVIRONMENT.texture.texels), directions)
    np.testing.assert_allclose(ours, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("direction", "u", "v"),
    [
        ([1, 0, 0], 0.5, 0.5),
        ([0, 1, 0], 0.25, 0.5),
        ([0, -1, 0], 0.75, 0.5),
        ([-1, 1e-9, 0], 0.0, 0.5),
        ([-1, -1e-9, 0], 1.0, 0.5),
        ([0, 0, 1], 0.5, 1.0),
        ([0, 0, -1], 0.5, 0.0),
        ([1, 0, 1], 0.5, 0.75),
    ],
)
def test_directions_of_an_environment_by_hand(direction, u, v):
    rows, columns = np.mgrid[0:8, 0:16]
    at = np.stack([(columns + 0.5) / 16, 1.0 - (rows + 0.5) / 8, np.zeros_like(rows)], axis=-1)
    seen = _see(Environment(LinearTexture(jnp.asarray(at, jnp.float32))), [0, 0, 0], direction)
    # The image's outermost half texels: u wraps around, so both ends meet in the middle; v stays.
    expected = [0.5 if u in (0.0, 1.0) else u, np.clip(v, 1 / 16, 15 / 16), 0.0]
    np.testing.assert_allclose(seen, expected, atol=_ROUNDING)


def test_a_sphere_shows_the_direction_of_its_hit_point():
    origins, directions = _random_rays(500, reach=0.5 * _HALF_EXTENT)
    ours = _see_all(SPHERE, origins, directions)
    along = np.sum(origins * directions, axis=1)
    chord = np.sqrt(along**2 - np.sum(origins**2, axis=1) + _HALF_EXTENT**2)
    points = origins + (chord - along)[:, None] * directions
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), _HALF_EXTENT)
    expected = look_at_environment(np.asarray(SPHERE.texture.texels), points / _HALF_EXTENT)
    np.testing.assert_allclose(ours, expected, atol=2e-5)


# On a wall, in a corner, outside and far outside; along an axis, at a pole, on the seam, nowhere.
_ORIGINS = [
    [0.0, 0.0, 0.0],
    [_HALF_EXTENT, 0.0, 0.0],
    [_HALF_EXTENT, _HALF_EXTENT, _HALF_EXTENT],
    [0.0, 0.0, np.nextafter(np.float32(_HALF_EXTENT), np.float32(9))],
    [0.0, 5.0, 0.0],
    [1e6, -1e6, 1e6],
    [1e15, 0.0, 0.0],
]
_DIRECTIONS = [
    [1.0, 0.0, 0.0],
    [-1.0, 0.0, 0.0],
    [-1.0, -0.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.0, 0.0, -1.0],
    [1e-30, -1e-30, 1.0],
    [1e-13, 1e-10, -1.0],
    [0.57735026, 0.57735026, 0.57735026],
    [0.0, 0.0, 0.0],
]


@pytest.mark.parametrize("name", _ALL)
def test_values_and_gradients_are_finite_at_the_extremes(name):
    origins, directions = np.array(
        list(itertools.product(_ORIGINS, _DIRECTIONS)), np.float32
    ).swapaxes(0, 1)

    def brightness(background, origin, direction):
        return jnp.sum(radiance_of(background)(origin, direction))

    derive = jax.jit(jax.vmap(jax.value_and_grad(brightness, (0, 1, 2)), in_axes=(None, 0, 0)))
    value, derivatives = derive(_ALL[name], jnp.asarray(origins), jnp.asarray(directions))
    assert gradients.all_finite((value, derivatives))
    assert np.all(value >= 0.0) and np.all(value <= 3.0)


@pytest.mark.parametrize("name", _ALL)
def test_a_background_of_one_colour_has_it_everywhere(name):
    texels = jnp.full_like(_ALL[name].texture.texels, 0.25)
    background = _ALL[name]._replace(texture=LinearTexture(texels))
    origins, directions = np.array(
        list(itertools.product(_ORIGINS, _DIRECTIONS)), np.float32
    ).swapaxes(0, 1)
    np.testing.assert_array_equal(_see_all(background, origins, directions), 0.25)


def test_a_ray_beyond_a_wall_sees_it_where_it_stands():
    on = _see(CUBE, [_HALF_EXTENT, 0.7, -0.4], [1.0, 0.2, 0.1])
    np.testing.assert_allclose(_see(CUBE, [_HALF_EXTENT + 1e-6, 0.7, -0.4], [1, 0.2, 0.1]), on)
    np.testing.assert_allclose(
        _see(CUBE, [_HALF_EXTENT - 1e-6, 0.7, -0.4], [1, 0.2, 0.1]), on, 1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", _ALL)
def test_gradients_are_those_of_finite_differences(name):
    background = _ALL[name]
    texels = np.asarray(background.texture.texels, np.float64)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float64)), background)

    def see(origin, direction, texels):
        texture = type(wide.texture)(texels)
        return radiance_of(wide._replace(texture=texture))(origin, direction)

    # Between texel centres, away from every kink.
    gradients.assert_numerical(see, [0.3, -0.2, 0.1], [0.8, 0.31, 0.513], texels)


@pytest.mark.slow
@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _ALL)
def test_transformations_change_nothing(name, transformation):
    origins, directions = (x.astype(np.float32) for x in _random_rays(6))
    transformation(radiance_of(_ALL[name]), (origins, directions))


@pytest.mark.parametrize("name", _ALL)
def test_a_radiance_is_a_tree_of_its_background_s_arrays(name):
    assert len(jax.tree.leaves(radiance_of(_ALL[name]))) == len(jax.tree.leaves(_ALL[name])) >= 1
    assert backgrounds.radiance_of(_ALL[name]).func.__name__.endswith("_radiance")


# A centre that float32 adds to multiples of 1/64 without rounding.
_CENTRE = np.array([1.0, -2.0, 0.5], np.float32)
_MOVED = {name: _ALL[name]._replace(centre=jnp.asarray(_CENTRE)) for name in ("cube", "sphere")}


@pytest.mark.parametrize("wall", range(6))
def test_a_texel_of_a_moved_wall_is_where_the_mapping_says(wall):
    u, v = 2.5 / 8, 1.0 - 5.5 / 8
    point = _CENTRE + _HALF_EXTENT * (
        _NORMALS[wall] + (2 * u - 1) * _U_AXES[wall] + (2 * v - 1) * _V_AXES[wall]
    )
    expected = colours.srgb_to_linear(np.asarray(CUBE.texture.texels)[wall, 5, 2])
    origin = np.array([0.5, -1.0, 2.0])
    np.testing.assert_allclose(_see(_MOVED["cube"], origin, point - origin), expected, atol=1e-5)


def test_the_image_of_a_moved_sphere_is_indexed_from_its_centre():
    row, column = 2, 5
    azimuth, elevation = np.pi * (1.0 - 2.0 * (column + 0.5) / 16), np.pi * (0.5 - (row + 0.5) / 8)
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    towards = np.cos(elevation) * flat + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
    point, origin = _CENTRE + _HALF_EXTENT * towards, np.array([0.5, -1.0, 2.0])
    expected = np.asarray(SPHERE.texture.texels)[row, column]
    np.testing.assert_allclose(_see(_MOVED["sphere"], origin, point - origin), expected, atol=1e-5)


@pytest.mark.parametrize("name", _MOVED)
def test_a_background_and_rays_that_are_moved_together_give_the_same_light(name):
    origins, directions = _random_rays(200)
    origins = np.round(64.0 * origins) / 64.0
    expected = _see_all(_ALL[name], origins, directions)
    np.testing.assert_array_equal(_see_all(_MOVED[name], origins + _CENTRE, directions), expected)
    assert not np.array_equal(_see_all(_MOVED[name], origins, directions), expected)


@pytest.mark.parametrize("name", _MOVED)
def test_a_background_around_the_origin_computes_no_offset(name):
    ray = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0])
    operations = [
        len(jax.make_jaxpr(radiance_of(each))(*ray).eqns) for each in (_ALL[name], _MOVED[name])
    ]
    assert operations[1] == operations[0] + 1
