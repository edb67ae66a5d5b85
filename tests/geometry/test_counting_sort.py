import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry import counting_sort


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
@pytest.mark.parametrize("bits", [1, 11, 12, 21, 32])
def test_the_order_is_that_of_a_stable_sort(count, bits):
    keys = np.random.default_rng(bits).integers(0, 2**bits, count, dtype=np.uint32)
    keys[::3] = keys[:1]
    order = jax.jit(counting_sort.stable_order, static_argnames="bits")(
        jnp.asarray(keys), bits=bits
    )
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))


def test_equal_keys_keep_their_order():
    keys = jnp.full(50, 5, jnp.uint32)
    np.testing.assert_array_equal(counting_sort.stable_order(keys, bits=3), np.arange(50))


def test_an_accelerator_sorts():
    shape = jax.ShapeDtypeStruct((64,), jnp.uint32)
    sort = jax.jit(lambda keys: counting_sort.stable_order(keys, bits=21))
    text = sort.trace(shape).lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo.sort" in text
    assert "stablehlo.while" not in text
