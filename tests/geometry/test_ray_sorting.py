import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from benchmarks import ray_sorting
from refref_jax.geometry import bvh, bvh_build
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
    return {
        "limits": jnp.full(count, jnp.inf),
        "exclude_primitive": jnp.full(count, bvh.NO_PRIMITIVE, jnp.int32),
    }


def _assert_same(hits, expected):
    np.testing.assert_array_equal(hits.primitive_ids, expected.primitive_ids)
    np.testing.assert_allclose(hits.distances, expected.distances, rtol=2e-6)
    np.testing.assert_allclose(hits.barycentrics, expected.barycentrics, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 1000])
def test_the_order_holds_every_ray_once(tree, count):
    order = jax.jit(ray_sorting.coherent_order)(tree, _rays(count))
    np.testing.assert_array_equal(np.sort(order), np.arange(count))


def test_the_order_puts_octants_together_and_alike_rays_side_by_side(tree):
    rays = _rays(4000)
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), rays)
    order = np.asarray(jax.jit(ray_sorting.coherent_order)(tree, twice))
    octants = np.signbit(np.asarray(twice.directions)[order]) @ [1, 2, 4]
    assert np.all(np.diff(octants) >= 0)
    # A ray and its copy fall into one cell, which holds few others.
    place = np.argsort(order)
    assert np.median(np.abs(place[:4000] - place[4000:])) <= 20


def test_rays_outside_the_box_and_in_no_direction_have_a_place_too(tree):
    rays = _rays(6)
    far = rays._replace(origins=rays.origins * 1e6, directions=rays.directions.at[0].set(0.0))
    order = jax.jit(ray_sorting.coherent_order)(tree, far)
    np.testing.assert_array_equal(np.sort(order), np.arange(6))


@pytest.mark.slow
def test_sorted_rays_find_the_same_hits(tree):
    rays, arguments = _rays(1001), _arguments(1001)
    arguments["limits"] = arguments["limits"].at[::3].set(0.7).at[1::5].set(-1.0)
    hits = jax.jit(ray_sorting.closest_hits_sorted)(tree, rays, **arguments)
    expected = jax.jit(bvh.closest_hits)(tree, rays, **arguments)
    assert np.isfinite(expected.distances).sum() > 100
    _assert_same(hits, expected)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
@pytest.mark.parametrize("bits", [1, 11, 12, 21, 32])
def test_the_order_is_that_of_a_stable_sort(count, bits):
    keys = np.random.default_rng(bits).integers(0, 2**bits, count, dtype=np.uint32)
    keys[::3] = keys[:1]
    order = jax.jit(ray_sorting.stable_order, static_argnames="bits")(jnp.asarray(keys), bits=bits)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))


def test_equal_keys_keep_their_order():
    keys = jnp.full(50, 5, jnp.uint32)
    np.testing.assert_array_equal(ray_sorting.stable_order(keys, bits=3), np.arange(50))


def test_an_accelerator_sorts():
    shape = jax.ShapeDtypeStruct((64,), jnp.uint32)
    sort = jax.jit(lambda keys: ray_sorting.stable_order(keys, bits=21))
    text = sort.trace(shape).lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo.sort" in text
    assert "stablehlo.while" not in text
