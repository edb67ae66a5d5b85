import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from refref_jax.data import SceneError, scene_assembly
from refref_jax.geometry.rays import Rays
from refref_jax.optics import interface_rules, path_tracing
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import AMBIENT, crossing, empty_interior_list
from refref_jax.optics.path_settings import make_path_settings

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
    ranked = 1 if rule is interface_rules.priority else 0
    assert [len(field) for field in interfaces] == [1, 1, 1, 1, 1, ranked, *[0] * 6]
    np.testing.assert_array_equal(interfaces.tint, 1.0)
    np.testing.assert_array_equal(interfaces.absorption, 0.0)


@pytest.mark.parametrize("entering", [True, False])
def test_a_crossing_exchanges_the_sides(entering):
    interfaces = interface_rules.nested(_INDICES, _PARENTS)
    interfaces = jax.tree.map(jnp.asarray, interfaces)
    found = crossing(
        interfaces, empty_interior_list(interfaces), jnp.int32(1), jnp.asarray(entering)
    )
    inside, outside = (1.333, 2), (1.5, 1)
    near, far = (outside, inside) if entering else (inside, outside)
    assert (float(found.index_near), int(found.medium_near)) == pytest.approx(near)
    assert (float(found.index_far), int(found.medium_far)) == pytest.approx(far)


@pytest.mark.parametrize("rule", interface_rules.RULES.values())
def test_colours_belong_to_their_parts(rule):
    tints, absorptions = np.linspace(0.1, 0.9, 9).reshape(3, 3), np.arange(9.0).reshape(3, 3)
    interfaces = rule(_INDICES, _PARENTS, tints=tints.tolist(), absorptions=absorptions.tolist())
    np.testing.assert_allclose(interfaces.tint, tints, rtol=1e-6)
    np.testing.assert_array_equal(interfaces.absorption, absorptions)
    clear = rule(_INDICES, _PARENTS)
    np.testing.assert_array_equal(clear.tint, np.ones((3, 3)))
    np.testing.assert_array_equal(clear.absorption, np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("priorities", "order"),
    [
        ([3, 1, 2], [2, 0, 1]),
        # Of equal ones the first is the higher, so all places differ.
        ([0, 0, 0], [2, 1, 0]),
        ([1, 5, 1], [1, 2, 0]),
        (None, [2, 1, 0]),
        ([-(10**12), 10**12, 0], [0, 2, 1]),
    ],
)
def test_priorities_are_ranked_the_highest_first(priorities, order):
    interfaces = interface_rules.priority(_INDICES, _PARENTS, priorities=priorities)
    np.testing.assert_array_equal(interfaces.priority, order)
    assert interfaces.priority.dtype == np.int32


@pytest.mark.parametrize("rule", ["nested", "facing"])
def test_other_rules_take_no_notice_of_priorities(rule):
    made = interface_rules.RULES[rule](_INDICES, _PARENTS, priorities=[3, 2, 1])
    for field, other in zip(made, interface_rules.RULES[rule](_INDICES, _PARENTS), strict=True):
        np.testing.assert_array_equal(field, other)


def test_facing_ranks_media_of_overlapping_parts_by_depth_then_priority():
    # A bubble in a cup, and a drink that overlaps the cup.
    made = interface_rules.facing(
        [1.5, 1.0, 1.33], [NO_PARENT, 0, NO_PARENT], priorities=[1, 0, 2], overlaps=[(0, 2)]
    )
    np.testing.assert_array_equal(np.argsort(made.priority), [0, 2, 1])
    np.testing.assert_array_equal(made.index_outside, 1.0)
    assert made.index_by_face.tolist() == [True]


@pytest.mark.parametrize(
    ("rule", "outside"),
    [("nested", [1.25, 1.5, 1.333]), ("facing", [1.25] * 3), ("priority", [1.25] * 3)],
)
def test_the_ambient_medium_is_outside_all_parts(rule, outside):
    interfaces = interface_rules.RULES[rule](_INDICES, _PARENTS, ambient=1.25)
    np.testing.assert_allclose(interfaces.index_outside, outside)
    assert interface_rules.ambient_of(interfaces) == 1.25


_trace_ends = jax.jit(
    functools.partial(path_tracing.trace_ends, settings=make_path_settings("tree"))
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "rule",
    ["nested", "facing", "priority"],
)
def test_only_the_ratio_of_indices_bends_light(rule):
    parts = [
        scene_assembly.make_part(trimesh.creation.icosphere(radius=radius), index=index, name=name)
        for name, radius, index in (("glass", 1.0, 1.5), ("water", 0.6, 1.333))
    ]
    parts = [part._replace(priority=number) for number, part in enumerate(parts)]
    scaled = [part._replace(index=1.25 * part.index) for part in parts]
    in_air = scene_assembly.assemble(parts, rule=rule)
    immersed = scene_assembly.assemble(scaled, rule=rule, ambient=1.25)
    other = scene_assembly.assemble(parts, rule=rule, ambient=1.25)
    heights = np.linspace(-0.9, 0.9, 12)
    origins = np.stack([np.full(12, -3.0), heights, np.full(12, 0.1)], axis=-1)
    directions = np.tile([1.0, 0.0, 0.0], (12, 1))
    rays = Rays(*(jnp.asarray(x, jnp.float32) for x in (origins, directions, np.full(12, 1e-3))))
    ours, same, different = (_trace_ends(scene, rays).ends for scene in (in_air, immersed, other))
    close = {"rtol": 1e-3, "atol": 1e-3}
    np.testing.assert_allclose(ours.directions, same.directions, **close)
    np.testing.assert_allclose(ours.throughput, same.throughput, **close)
    assert np.abs(np.asarray(ours.directions) - np.asarray(different.directions)).max() > 0.05


def test_the_index_of_the_ambient_medium_is_positive():
    part = scene_assembly.make_part(trimesh.creation.box(), index=1.5)
    with pytest.raises(SceneError, match="'ambient' is 0"):
        scene_assembly.assemble([part], ambient=0.0)
