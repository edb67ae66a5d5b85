import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import interface_rules
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import AMBIENT, crossing

# Glass holds water, and the water holds a bubble of air.
_INDICES = (1.5, 1.333, 1.0)
_PARENTS = (NO_PARENT, 0, 1)


def test_nested_looks_at_the_part_around():
    interfaces = interface_rules.nested(_INDICES, _PARENTS)
    np.testing.assert_allclose(interfaces.index_inside, _INDICES)
    np.testing.assert_allclose(interfaces.index_outside, [1.0, 1.5, 1.333])
    np.testing.assert_array_equal(interfaces.medium_outside, [AMBIENT, 1, 2])


def test_facing_takes_air_everywhere_but_knows_the_media():
    interfaces = interface_rules.facing(_INDICES, _PARENTS)
    np.testing.assert_allclose(interfaces.index_inside, _INDICES)
    np.testing.assert_allclose(interfaces.index_outside, [1.0, 1.0, 1.0])
    np.testing.assert_array_equal(interfaces.medium_outside, [AMBIENT, 1, 2])


@pytest.mark.parametrize("rule", interface_rules.RULES.values())
def test_a_scene_without_parts_can_be_indexed(rule):
    interfaces = rule((), ())
    assert all(len(field) == 1 for field in interfaces)


@pytest.mark.parametrize("entering", [True, False])
def test_a_crossing_exchanges_the_sides(entering):
    interfaces = interface_rules.nested(_INDICES, _PARENTS)
    found = crossing(jax.tree.map(jnp.asarray, interfaces), jnp.int32(1), jnp.asarray(entering))
    inside, outside = (1.333, 2), (1.5, 1)
    near, far = (outside, inside) if entering else (inside, outside)
    assert (float(found.index_near), int(found.medium_near)) == pytest.approx(near)
    assert (float(found.index_far), int(found.medium_far)) == pytest.approx(far)
