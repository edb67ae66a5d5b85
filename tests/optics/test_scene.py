"""Changes of a scene that is built."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.data.scene_assembly import assemble
from refref_jax.geometry.rays import Rays
from refref_jax.optics.media import in_one_precision, with_index
from tests.factories import scenes


def _glass_with_a_bubble(rule="nested"):
    bubble = scenes.ball(0.3, index=1.0, subdivisions=1, name="bubble_air")
    return assemble([scenes.box(), bubble._replace(priority=1)], rule=rule)


def test_an_index_is_changed_inside_and_where_it_lies_around_another():
    interfaces = with_index(_glass_with_a_bubble(), jnp.float32(1.7)).interfaces
    np.testing.assert_allclose(interfaces.index_inside, [1.7, 1.0])
    np.testing.assert_allclose(interfaces.index_outside, [1.0, 1.7])
    again = with_index(with_index(_glass_with_a_bubble(), 1.7), 1.2, part=1).interfaces
    np.testing.assert_allclose(again.index_inside, [1.7, 1.2])
    np.testing.assert_allclose(again.index_outside, [1.0, 1.7])


@pytest.mark.parametrize("rule", ["facing", "priority"])
def test_other_rules_keep_what_is_outside(rule):
    scene = _glass_with_a_bubble(rule)
    interfaces = with_index(scene, 1.7).interfaces
    np.testing.assert_allclose(interfaces.index_inside[0], 1.7)
    np.testing.assert_array_equal(interfaces.index_outside, 1.0)


@pytest.mark.parametrize("part", [-1, 2])
def test_a_part_that_is_not_there_is_refused(part):
    with pytest.raises(ValueError, match=f"part is {part}, but .* parts is 2. Give 0 to 1"):
        with_index(_glass_with_a_bubble(), 1.5, part=part)


def test_an_index_has_its_share_of_the_gradient():
    def total(index):
        interfaces = with_index(_glass_with_a_bubble(), index).interfaces
        return jnp.sum(interfaces.index_inside) + 10.0 * jnp.sum(interfaces.index_outside)

    assert jax.grad(total)(1.5) == 11.0


def test_a_precise_index_makes_a_precise_scene_and_a_plain_number_does_not():
    scene = _glass_with_a_bubble()
    with jax.enable_x64(True):
        precise = with_index(scene, jnp.float64(1.1)).interfaces
        assert precise.index_inside.dtype == precise.tint.dtype == jnp.float64
        assert float(precise.index_inside[0]) == 1.1
        assert with_index(scene, 1.1).interfaces.index_inside.dtype == jnp.float32


def test_scene_and_rays_take_the_highest_precision_among_them():
    scene = _glass_with_a_bubble()
    ray = Rays(np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-3)
    with jax.enable_x64(True):
        both = in_one_precision(scene, ray)
        half = in_one_precision(scene, jax.tree.map(np.float16, ray))
    single = in_one_precision(scene, ray)
    for tree, kind in ((both, jnp.float64), (half, jnp.float32), (single, jnp.float32)):
        reals = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
        assert len(reals) > 6 and {x.dtype for x in reals} == {jnp.dtype(kind)}
        assert tree[0].interfaces.medium_outside.dtype == jnp.int32
