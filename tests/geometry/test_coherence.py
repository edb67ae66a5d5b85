import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from refref_jax.geometry import bvh, bvh_build, coherence, tiles
from refref_jax.geometry.rays import Rays


@pytest.fixture(scope="module")
def tree():
    triangles = trimesh.creation.icosphere(subdivisions=3).triangles.astype(np.float32)
    return jax.tree.map(jnp.asarray, bvh_build.build(triangles)[0])


def _rays(count, seed=0):
    generator = np.random.default_rng(seed)
    origins = generator.uniform(-1.5, 1.5, (count, 3))
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return Rays(
        jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32), jnp.zeros(count)
    )


def _arguments(count):
    return {"limits": jnp.full(count, jnp.inf), "leaving": jnp.full(count, bvh.NO_SLOT, jnp.int32)}


def _assert_same(hits, expected):
    np.testing.assert_array_equal(hits.slots, expected.slots)
    np.testing.assert_allclose(hits.distances, expected.distances, rtol=2e-6)
    np.testing.assert_allclose(hits.barycentrics, expected.barycentrics, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 1000])
def test_the_order_holds_every_ray_once(tree, count):
    order = jax.jit(coherence.coherent_order)(tree, _rays(count))
    np.testing.assert_array_equal(np.sort(order), np.arange(count))


def test_the_order_puts_octants_together_and_alike_rays_side_by_side(tree):
    rays = _rays(4000)
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), rays)
    order = np.asarray(jax.jit(coherence.coherent_order)(tree, twice))
    octants = np.signbit(np.asarray(twice.directions)[order]) @ [1, 2, 4]
    assert np.all(np.diff(octants) >= 0)
    # A ray and its copy fall into one cell, which holds few others.
    place = np.argsort(order)
    assert np.median(np.abs(place[:4000] - place[4000:])) <= 20


def test_rays_outside_the_box_and_in_no_direction_have_a_place_too(tree):
    rays = _rays(6)
    far = rays._replace(origins=rays.origins * 1e6, directions=rays.directions.at[0].set(0.0))
    order = jax.jit(coherence.coherent_order)(tree, far)
    np.testing.assert_array_equal(np.sort(order), np.arange(6))


def test_sorted_rays_find_the_same_hits(tree):
    rays, arguments = _rays(1001), _arguments(1001)
    arguments["limits"] = arguments["limits"].at[::3].set(0.7).at[1::5].set(-1.0)
    hits = jax.jit(coherence.closest_hits_sorted)(tree, rays, **arguments)
    expected = jax.jit(bvh.closest_hits)(tree, rays, **arguments)
    assert np.isfinite(expected.distances).sum() > 100
    _assert_same(hits, expected)


@pytest.mark.parametrize("trace", [bvh.closest_hits, coherence.closest_hits_sorted])
@pytest.mark.parametrize(
    "count",
    [pytest.param(100, marks=pytest.mark.slow), pytest.param(128, marks=pytest.mark.slow), 600],
)
def test_tiles_find_the_same_hits(tree, trace, count):
    rays, arguments = _rays(count), _arguments(count)
    hits = jax.jit(
        lambda rays: tiles.closest_hits_in_tiles(tree, rays, **arguments, trace=trace, tile=128)
    )(rays)
    _assert_same(hits, jax.jit(bvh.closest_hits)(tree, rays, **arguments))


def test_a_tile_bounds_the_memory_beside_rays_and_hits(tree):
    def temporary(count):
        arguments = (_rays(1), _arguments(1))
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((count, *x.shape[1:]), x.dtype), arguments
        )
        run = jax.jit(
            lambda tree, rays, extra: tiles.closest_hits_in_tiles(tree, rays, **extra, tile=1024)
        )
        return run.lower(tree, *shapes).compile().memory_analysis().temp_size_in_bytes

    # The hits themselves (16 bytes a ray) are gathered before they are returned.
    few, many = temporary(2**13), temporary(2**16)
    assert many - few <= 64 * (2**16 - 2**13)
    untiled = jax.jit(bvh.closest_hits)
    rays, extra = jax.eval_shape(lambda: (_rays(1), _arguments(1)))
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct((2**16, *x.shape[1:]), x.dtype), rays)
    extra = {name: jax.ShapeDtypeStruct((2**16,), x.dtype) for name, x in extra.items()}
    whole = untiled.lower(tree, shapes, **extra).compile().memory_analysis().temp_size_in_bytes
    assert many < whole / 2


def test_a_tile_of_nothing_is_an_error(tree):
    with pytest.raises(ValueError, match="positive number"):
        tiles.closest_hits_in_tiles(tree, _rays(4), **_arguments(4), tile=0)
