from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import path_tree


class _Light(NamedTuple):
    throughput: jax.Array
    rays: jax.Array


def _light(values, rays=None):
    values = np.asarray(values, np.float32)
    rays = np.arange(len(values)) if rays is None else rays
    return _Light(jnp.asarray(np.repeat(values[:, None], 3, 1)), jnp.asarray(rays, jnp.int32))


def _values(queue):
    return np.asarray(queue.items.throughput)[: int(queue.count), 0].tolist()


def test_appending_keeps_the_order_of_what_is_kept():
    queue = path_tree.fill(_light([1.0, 2.0]), 2, 8)
    queue = path_tree.append(queue, _light([3.0, 4.0, 5.0]), jnp.array([True, False, True]))
    assert _values(queue) == [1.0, 2.0, 3.0, 5.0]
    queue = path_tree.append(queue, _light([6.0, 7.0]), jnp.array([False, False]))
    assert _values(queue) == [1.0, 2.0, 3.0, 5.0]


def test_appending_equals_a_list():
    generator = np.random.default_rng(0)
    queue, expected = path_tree.fill(_light([]), 0, 100), []
    for _ in range(10):
        block, keep = generator.random(7).astype(np.float32), generator.random(7) < 0.5
        queue = path_tree.append(queue, _light(block), jnp.asarray(keep))
        expected += block[keep].tolist()
    assert _values(queue) == expected


@pytest.mark.parametrize("capacity", [0, 1, 3, 4, 9])
def test_shedding_drops_the_weakest_and_says_whose(capacity):
    values, rays = [0.5, 0.1, 0.4, 0.2], [0, 1, 1, 2]
    queue = path_tree.fill(_light(values, rays), 4, 6)
    kept, dropped = path_tree.drop_weakest(queue, jnp.zeros((3, 3)), capacity)
    strongest = sorted(values, reverse=True)[:capacity]
    assert _values(kept) == pytest.approx([v for v in values if v in strongest])
    expected = np.zeros(3)
    for value, ray in zip(values, rays, strict=True):
        expected[ray] += 0.0 if value in strongest else value
    np.testing.assert_allclose(dropped, np.repeat(expected[:, None], 3, 1), atol=1e-7)


def test_of_equally_strong_records_the_first_stay():
    mask = jnp.array([True, False, True, True, True])
    kept = path_tree.strongest(mask, jnp.ones(5), jnp.int32(2))
    assert kept.tolist() == [True, False, True, False, False]


def test_unmarked_records_never_count():
    mask = jnp.array([False, True, True])
    kept = path_tree.strongest(mask, jnp.array([9.0, 0.0, -1.0]), jnp.int32(1))
    assert kept.tolist() == [False, True, False]
    assert not path_tree.strongest(mask, jnp.ones(3), jnp.int32(-2)).any()


def test_the_marked_come_first():
    keep = np.random.default_rng(1).random(50) < 0.3
    order = np.asarray(path_tree.front_first(jnp.asarray(keep)))
    np.testing.assert_array_equal(order[: keep.sum()], np.flatnonzero(keep))
    assert order.min() >= 0 and order.max() < 50
