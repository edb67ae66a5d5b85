"""Two rays for every pixel; `training/test_deformation_run.py` trains them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid, registry, rosenerf, zipnerf
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.fields.rosenerf import RosenerfConfig, RosenerfParams
from refref_jax.render import learned_media
from refref_jax.sampling.polylines import Gaussians, PolylinePoint
from refref_jax.sampling.scene_bounds import Domain
from tests.factories import arrays
from tests.laws import gradients

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_SHAPE = {"density_width": 8, "bottleneck": 4, "colour_width": 8, "colour_depth": 1}
_CONFIG = RosenerfConfig(_GRID, **_SHAPE, ray_width=6, ray_depth=2)
_ONE = jnp.float32(1.0)

_radiance = jax.jit(rosenerf.radiance, static_argnums=1)
_deform = jax.jit(jax.vmap(registry.deform, in_axes=(None, None, 0, None, None)), static_argnums=1)


def _direction():
    return arrays.single([0.48, -0.6, 0.64])


def _trained(scale=0.6):
    shapes = jax.eval_shape(lambda: rosenerf.init_radiance(jax.random.key(0), _CONFIG))
    return arrays.drawn(shapes, scale=scale)


def _points(origin, count=9):
    """Returns points of a ray in the unit cube, and their distances in scene radii."""
    along = np.linspace(-0.7, 0.6, count)
    centred = np.asarray(origin) + along[:, None] * np.asarray(_direction())
    return jnp.asarray(0.5 + 0.5 * centred, jnp.float32), along


def _moved(params, places, progress=_ONE):
    offsets = _deform(params, _CONFIG, places, _direction(), progress)
    return jax.tree.map(lambda x: np.asarray(x, np.float64), offsets)


def test_the_points_of_a_ray_move_to_one_straight_ray():
    places, along = _points([0.1, 0.2, -0.15])
    offsets = _moved(_trained(), places)
    turned = np.asarray(_direction()) + offsets.direction[0]
    assert np.linalg.norm(turned) == pytest.approx(1.0, abs=1e-6)
    assert np.linalg.norm(offsets.direction[0]) > 0.02
    np.testing.assert_allclose(offsets.direction, offsets.direction[:1].repeat(9, 0), atol=1e-6)
    second = 2.0 * np.asarray(places, np.float64) - 1.0 + offsets.position
    expected = second[:1] + (along - along[0])[:, None] * turned
    np.testing.assert_allclose(second, expected, atol=3e-6)
    assert np.max(np.abs(offsets.position)) > 0.02


def test_another_ray_has_another_second_ray_and_the_camera_does_not_matter():
    (places, _), (others, _) = _points([0.1, 0.2, -0.15]), _points([0.3, 0.2, -0.15])
    one, other = _moved(_trained(), places), _moved(_trained(), others)
    assert np.max(np.abs(one.direction[0] - other.direction[0])) > 1e-3


def test_offsets_by_plain_matrix_products():
    params = _trained()
    layers = jax.tree.map(lambda x: np.asarray(x, np.float64), params.rays["params"])
    place, ray = np.array([0.61, 0.4, 0.72]), np.asarray(_direction(), np.float64)
    centred = 2.0 * place - 1.0
    along = centred @ ray
    harmonics = np.asarray(jax.jit(hash_grid.spherical_harmonics)(_direction()))
    hidden = np.concatenate([centred - along * ray, harmonics])
    for i in range(2):
        layer = layers[f"Dense_{i}"]
        hidden = np.maximum(hidden @ layer["kernel"] + layer["bias"], 0.0)
    raw = 0.1 * (hidden @ layers["Dense_2"]["kernel"] + layers["Dense_2"]["bias"])
    turned = (ray + raw[3:]) / np.linalg.norm(ray + raw[3:])
    found = _moved(params, jnp.asarray(place, jnp.float32)[None])
    np.testing.assert_allclose(found.position[0], raw[:3] + along * (turned - ray), atol=1e-5)
    np.testing.assert_allclose(found.direction[0], turned - ray, atol=1e-5)


def test_at_first_the_second_ray_is_the_first():
    places, _ = _points([0.1, 0.2, -0.15])
    before, after = (_moved(_trained(), places, jnp.float32(x)) for x in (0.024, 0.026))
    np.testing.assert_allclose(np.concatenate(before, axis=1), 0.0, atol=1e-7)
    assert np.max(np.abs(after.position)) > 0.02


def _one(place, scale=0.01):
    return Gaussians(jnp.asarray([place], jnp.float32), jnp.full(1, scale, jnp.float32))


def _pair(*both):
    return Gaussians(*(jnp.concatenate(each) for each in zip(*both, strict=True)))


@pytest.mark.slow
def test_features_of_both_rays_are_added_by_plain_matrix_products():
    params = _trained()
    layers = jax.tree.map(lambda x: np.asarray(x, np.float64), params.field["params"])
    both = _one([0.3, 0.7, 0.55]), _one([0.6, 0.2, 0.4])
    table = {"params": params.field["params"]["MultisampledGrid_0"]}
    look_up = jax.jit(hash_grid.MultisampledGrid(_GRID, _CONFIG.precision).apply)
    hidden = np.zeros(8)
    for ray in both:
        features = np.asarray(look_up(table, ray), np.float64)
        first = layers["Dense_0"]
        hidden += np.maximum(features @ first["kernel"] + first["bias"], 0.0)
    hidden = np.maximum(hidden @ layers["Dense_1"]["kernel"] + layers["Dense_1"]["bias"], 0.0)
    raw = hidden @ layers["Dense_2"]["kernel"] + layers["Dense_2"]["bias"]
    found = _radiance(params, _CONFIG, _pair(*both), _direction())
    expected = zipnerf.activate_density(jnp.float32(raw[0]))
    np.testing.assert_allclose(found.density, expected, rtol=1e-4)
    swapped = _radiance(params, _CONFIG, _pair(*both[::-1]), _direction())
    np.testing.assert_allclose(found.rgb, swapped.rgb, rtol=1e-5)
    alone = _radiance(params, _CONFIG, _pair(both[0], both[0]), _direction())
    assert np.max(np.abs(found.rgb - alone.rgb)) > 1e-4


@pytest.mark.parametrize("space", ["bounded", "spherical", "unbounded"])
def test_samples_are_those_of_both_rays_seen_from_the_first(space):
    params, count = _trained(), 5
    places, _ = _points([0.1, 0.2, -0.15], count)
    towards, domain = np.tile(np.asarray(_direction()), (count, 1)), Domain(2.0, space)

    @jax.jit
    def move(params, places, towards):
        gaussians = Gaussians(places[:, None].repeat(2, 1), jnp.full((count, 2), 0.01))
        none = jnp.zeros(count)
        points = PolylinePoint(places, towards, none, none < 1.0, jnp.zeros((count, 2, 3)))
        return gaussians, *learned_media.move(params, _CONFIG, domain, gaussians, points, _ONE)

    gaussians, moved, seen, bent = move(params, places, towards)
    assert moved.positions.shape == (count, 4, 3) and moved.scales.shape == (count, 4)
    np.testing.assert_array_equal(moved.positions[:, :2], gaussians.positions)
    offsets = _moved(params, places).position
    np.testing.assert_allclose(
        moved.positions[:, 2:] - moved.positions[:, :2],
        0.5 * offsets[:, None].repeat(2, 1),
        atol=1e-6,
    )
    np.testing.assert_array_equal(seen.direction, towards)
    radii = 2.0 if space == "unbounded" else 1.0  # per half edge of the cube
    np.testing.assert_allclose(bent.offsets, radii * offsets, atol=3e-6)


@pytest.mark.slow
def test_gradients_are_numerical():
    leaves, tree = jax.tree.flatten(_trained().rays)

    def offsets(place, direction, *leaves):
        params = RosenerfParams(None, jax.tree.unflatten(tree, leaves))
        return jnp.concatenate(rosenerf.second_ray(params, _CONFIG, place, direction, jnp.ones(())))

    gradients.assert_numerical(offsets, jnp.array([0.3, 0.7, 0.55]), [0.36, 0.48, 0.8], *leaves)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.0, 1.0, 1e4])
@pytest.mark.parametrize("place", [[0.5, 0.5, 0.5], [0.0, 1.0, 0.3]])
def test_offsets_are_finite(scale, place):
    """Also where light travels within a coordinate plane, the singular case of two planes."""

    def size(params, place):
        level = jnp.array([1.0, 0.0, 0.0], jnp.float32)
        found = registry.deform(params, _CONFIG, place, level, jnp.float32(0.1))
        return jnp.sum(jnp.concatenate(found)), found

    slopes, found = jax.jit(jax.grad(size, argnums=(0, 1), has_aux=True))(
        _trained(scale=scale), jnp.asarray(place, jnp.float32)
    )
    assert gradients.all_finite((slopes, found))


def test_a_network_without_layers_is_refused():
    for name in ("ray_width", "ray_depth"):
        with pytest.raises(ValueError, match=rf"{name}=0.* is invalid\. Give at least 1"):
            dataclasses.replace(_CONFIG, **{name: 0})


def test_the_published_network_has_three_layers_of_128():
    published = rosenerf.KIND.sizes["paper"].field
    assert (published.ray_width, published.ray_depth) == (128, 3)
    for name, size in rosenerf.KIND.sizes.items():
        assert size.samples == zipnerf.KIND.sizes[name].samples
        assert registry.has_second_ray(size.field) and not registry.knots(size.field)
