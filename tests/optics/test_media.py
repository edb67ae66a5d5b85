"""Crossings and interior lists, one at a time."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import fresnel, interface_rules, media
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import AMBIENT, EMPTY_SLOT, SLOTS
from tests.laws.gradients import assert_numerical

_SINGLE = 1e-6


def _interfaces(indices, priorities, **colours):
    parents = [NO_PARENT] * len(indices)
    made = interface_rules.priority(indices, parents, priorities=priorities, **colours)
    return jax.tree.map(jnp.asarray, made)


@jax.jit
def _walk(interfaces, inside, parts, entering):
    """Crosses surfaces one after the other."""

    def cross(inside, hit):
        crossing = media.crossing(interfaces, inside, *hit)
        return crossing.interior_list_after, crossing

    return jax.lax.scan(cross, inside, (parts, entering))[1]


def _crossings(interfaces, steps):
    """Returns the crossings of a walk that begins in the air; a step is (part, entering)."""
    parts, entering = zip(*steps, strict=True)
    walk = _walk(
        interfaces, media.empty_interior_list(interfaces), jnp.array(parts), jnp.array(entering)
    )
    return jax.tree.map(np.asarray, walk)


def _sides(walk):
    """Returns (index, medium) on both sides of every crossing that is not an outranked one."""
    return [
        ((float(index_near), int(near)), (float(index_far), int(far)))
        for index_near, near, index_far, far in zip(
            walk.index_near, walk.medium_near, walk.index_far, walk.medium_far, strict=True
        )
        if near != far
    ]


def _media_along(interfaces, steps):
    """Returns the medium after each step."""
    return _crossings(interfaces, steps).medium_far.tolist()


# Lists.


@pytest.mark.parametrize(("rule", "slots"), [("nested", 0), ("facing", 0), ("priority", SLOTS)])
def test_only_the_priority_rule_carries_a_list(rule, slots):
    made = jax.tree.map(jnp.asarray, interface_rules.RULES[rule]([1.5], [NO_PARENT]))
    assert media.interior_length(made) == slots
    np.testing.assert_array_equal(media.empty_interior_list(made), np.full(slots, EMPTY_SLOT))
    assert media.empty_interior_list(made).dtype == jnp.int32


def test_one_body_is_entered_and_left():
    walk = _crossings(_interfaces([1.5], [0]), [(0, True), (0, False)])
    assert _sides(walk) == [((1.0, AMBIENT), (1.5, 1)), ((1.5, 1), (1.0, AMBIENT))]
    assert sorted(walk.interior_list_after[0]) == [EMPTY_SLOT] * (SLOTS - 1) + [0]
    np.testing.assert_array_equal(walk.interior_list_after[1], EMPTY_SLOT)


@pytest.mark.parametrize("rank", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("seed", range(4))
def test_a_walk_agrees_with_sets(rank, seed):
    """Any three overlapping bodies, in any order: the medium is that of the highest."""
    generator = np.random.default_rng(seed)
    inside, steps, expected = set(), [], []
    for part in generator.integers(0, 3, 60):
        steps.append((int(part), part not in inside))
        inside ^= {int(part)}
        expected.append(1 + max(inside, key=lambda p: rank[p]) if inside else AMBIENT)
    walk = _crossings(_interfaces([1.5, 1.3, 1.1], list(rank)), steps)
    assert walk.medium_far.tolist() == expected
    assert walk.medium_near.tolist() == [AMBIENT, *expected[:-1]]
    assert {int(part) for part in walk.interior_list_after[-1]} - {EMPTY_SLOT} == inside


@pytest.mark.parametrize("seed", range(6))
def test_a_full_list_forgets_the_lowest(seed):
    """Six bodies in four slots against a set that is cut to its four highest."""
    generator = np.random.default_rng(seed)
    rank = generator.permutation(6)
    truly, known, steps, expected = set(), set(), [], []
    for part in map(int, generator.integers(0, 6, 80)):
        steps.append((part, part not in truly))
        known = known - {part} if part in truly else known | {part}
        truly ^= {part}
        known = set(sorted(known, key=lambda p: -rank[p])[:SLOTS])
        expected.append(1 + max(known, key=lambda p: rank[p]) if known else AMBIENT)
    assert max(len(truly), 5) > SLOTS
    walk = _crossings(_interfaces([1.5] * 6, rank.tolist()), steps)
    assert walk.medium_far.tolist() == expected
    assert {int(part) for part in walk.interior_list_after[-1]} - {EMPTY_SLOT} == known


def test_a_part_that_was_forgotten_is_left_without_a_trace():
    interfaces = _interfaces([1.1, 1.2, 1.3, 1.4, 1.5], [0, 1, 2, 3, 4])
    steps = [(0, True), (1, True), (2, True), (3, True), (4, True), (0, False)]
    assert _media_along(interfaces, steps) == [1, 2, 3, 4, 5, 5]
    # The lowest is not even written down when the others came first.
    steps = [(1, True), (2, True), (3, True), (4, True), (0, True), (0, False), (4, False)]
    assert _media_along(interfaces, steps) == [2, 3, 4, 5, 5, 5, 4]


def test_the_side_of_the_surface_decides_when_the_list_knows_nothing():
    """A ray that starts inside of a body without being told leaves it all the same."""
    [near_far] = _sides(_crossings(_interfaces([1.5], [0]), [(0, False)]))
    assert near_far == ((1.5, 1), (1.0, AMBIENT))


def test_entering_twice_counts_once():
    steps = [(0, True), (0, True), (0, False)]
    assert _media_along(_interfaces([1.5], [0]), steps) == [1, 1, AMBIENT]


# Physics.


def test_the_inner_of_two_bodies_with_the_higher_priority_is_the_nested_model():
    """A solid ball of glass with a ball of water in it: as glass that has a hole for the water."""
    water = _interfaces([1.5, 1.333], [1, 2])
    steps = [(0, True), (1, True), (1, False), (0, False)]
    nested = interface_rules.nested([1.5, 1.333], [NO_PARENT, 0])
    by_rank = _crossings(water, steps)
    declared = _crossings(jax.tree.map(jnp.asarray, nested), steps)
    for field in ("index_near", "index_far", "medium_near", "medium_far", "tint"):
        np.testing.assert_array_equal(getattr(by_rank, field), getattr(declared, field))


def test_a_contained_body_of_lower_priority_is_not_there():
    steps = [(0, True), (1, True), (1, False), (0, False)]
    walk = _crossings(_interfaces([1.5, 1.0], [2, 1]), steps)
    assert _sides(walk) == [((1.0, AMBIENT), (1.5, 1)), ((1.5, 1), (1.0, AMBIENT))]


def test_the_container_wins_where_a_liquid_overlaps_its_wall():
    """Through the wall of a cup, the drink that reaches into the wall, and out on the other side.

    The cup is its wall alone: it is left where its inner surface is crossed.
    """
    cup, drink = 0, 1
    steps = [
        (cup, True),
        (drink, True),
        (cup, False),
        (cup, True),
        (drink, False),
        (cup, False),
    ]
    walk = _crossings(_interfaces([1.5, 1.333], [3, 1]), steps)
    glass, water, air = (1.5, 1), (pytest.approx(1.333), 2), (1.0, AMBIENT)
    assert _sides(walk) == [(air, glass), (glass, water), (water, glass), (glass, air)]
    # The same light at the two surfaces of the drink within the wall.
    assert [int(medium) for medium in walk.medium_near[[1, 4]]] == [1, 1]
    np.testing.assert_array_equal(walk.index_near[[1, 4]], walk.index_far[[1, 4]])


def test_ice_in_a_drink_in_a_glass():
    """Arnold's example: glass 3, ice 2, liquid 1; the ice floats and sticks out of the drink."""
    glass, ice, drink = 0, 1, 2
    interfaces = _interfaces([1.5, 1.31, 1.333], [3, 2, 1])
    from_above = [(ice, True), (drink, True), (ice, False), (glass, True), (drink, False)]
    assert _media_along(interfaces, [*from_above, (glass, False)]) == [2, 2, 3, 1, 1, AMBIENT]
    # Ice that touches the wall.
    through_wall = [(glass, True), (ice, True), (drink, True), (glass, False), (ice, False)]
    assert _media_along(interfaces, through_wall) == [1, 1, 1, 2, 3]


def test_bubbles_in_glass_need_the_higher_number():
    """Arnold's other example: bubbles 2, glass 1."""
    steps = [(0, True), (1, True), (1, False), (0, False)]
    assert _media_along(_interfaces([1.5, 1.0], [1, 2]), steps) == [1, 2, 1, AMBIENT]


@pytest.mark.parametrize("steps", [[(0, True), (1, True)], [(1, True), (0, True)]])
def test_of_equal_priorities_the_first_part_wins(steps):
    walk = _crossings(_interfaces([1.5, 1.333], [7, 7]), steps)
    assert walk.medium_far[-1] == 1


def test_the_surface_of_an_outranked_body_does_nothing_to_light():
    tints = [[0.9, 0.8, 0.7], [0.1, 0.2, 0.3]]
    interfaces = _interfaces([1.5, 1.333], [2, 1], tints=tints)
    walk = _crossings(interfaces, [(0, True), (1, True), (0, False), (1, False)])
    np.testing.assert_allclose(walk.tint, [tints[0], [1.0] * 3, tints[0], tints[1]], rtol=_SINGLE)
    near, far = jnp.asarray(walk.index_near[1]), jnp.asarray(walk.index_far[1])
    for degrees in (0.0, 30.0, 60.0, 89.0):
        cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        direction = jnp.array([sine, 0.0, -cosine], jnp.float32)
        normal = jnp.array([0.0, 0.0, 1.0])
        onward = fresnel.refract(direction, normal, near, far)
        np.testing.assert_allclose(onward, direction, atol=_SINGLE)
        assert fresnel.reflectance(jnp.float32(cosine), near, far) == pytest.approx(0.0, abs=1e-7)


# Starting inside.


def test_a_ray_that_starts_in_water_leaves_into_glass():
    interfaces = _interfaces([1.5, 1.333], [1, 2])
    inside = jnp.full(SLOTS, EMPTY_SLOT, jnp.int32).at[0].set(0).at[2].set(1)
    found = media.crossing(interfaces, inside, jnp.int32(1), jnp.asarray(False))
    assert (int(found.medium_near), int(found.medium_far)) == (2, 1)
    assert float(found.index_far) == 1.5


# Colour.


@pytest.mark.parametrize("rule", interface_rules.RULES)
def test_a_coloured_surface_tints_from_both_sides(rule):
    made = interface_rules.RULES[rule]([1.5], [NO_PARENT], tints=[[0.5, 0.8, 0.95]])
    walk = _crossings(jax.tree.map(jnp.asarray, made), [(0, True), (0, False)])
    np.testing.assert_allclose(walk.tint, [[0.5, 0.8, 0.95]] * 2, rtol=_SINGLE)


def _absorbing(rule="nested"):
    made = interface_rules.RULES[rule](
        [1.5, 1.333], [NO_PARENT, 0], absorptions=[[0.0, 0.0, 0.0], [0.0, 0.5, 2.0]]
    )
    return jax.tree.map(jnp.asarray, made)


@pytest.mark.parametrize("length", [0.0, 1e-6, 0.7, 30.0, 1e30, np.inf])
@pytest.mark.parametrize("medium", [AMBIENT, 1, 2])
def test_absorption_follows_beer_and_lambert(medium, length):
    found = media.transmittance(_absorbing(), jnp.int32(medium), jnp.float32(length))
    rates = np.array([0.0, 0.5, 2.0]) if medium == 2 else np.zeros(3)
    expected = [np.exp(-rate * length) if rate else 1.0 for rate in rates]
    np.testing.assert_allclose(found, expected, rtol=_SINGLE, atol=1e-30)


@pytest.mark.parametrize("rule", interface_rules.RULES)
def test_two_ways_absorb_like_one(rule):
    interfaces, medium = _absorbing(rule), jnp.int32(2)
    whole = media.transmittance(interfaces, medium, jnp.float32(1.3))
    parts = [media.transmittance(interfaces, medium, jnp.float32(x)) for x in (0.4, 0.9)]
    np.testing.assert_allclose(parts[0] * parts[1], whole, rtol=_SINGLE)


# Gradients.


@pytest.mark.parametrize("medium", [AMBIENT, 1, 2])
def test_gradients_of_absorption(medium):
    interfaces = _absorbing()

    def left(absorption, length):
        changed = interfaces._replace(absorption=absorption)
        return media.transmittance(changed, jnp.int32(medium), length)

    assert_numerical(left, np.array([[0.3, 0.1, 0.0], [0.3, 0.8, 2.3]]), 0.8)


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e30, np.inf])
@pytest.mark.parametrize("medium", [AMBIENT, 1, 2])
def test_gradients_of_absorption_are_finite_at_the_extremes(medium, length):
    interfaces = _absorbing()

    def left(absorption, length):
        changed = interfaces._replace(absorption=absorption)
        return jnp.sum(media.transmittance(changed, jnp.int32(medium), length))

    gradients = jax.grad(left, argnums=(0, 1))(interfaces.absorption, jnp.float32(length))
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)


def test_gradients_reach_the_indices_of_both_sides_only():
    interfaces = _interfaces([1.5, 1.333, 1.2], [1, 2, 3])
    inside = jnp.array([0, EMPTY_SLOT, EMPTY_SLOT, EMPTY_SLOT], jnp.int32)

    def ratio(indices):
        changed = interfaces._replace(index_inside=indices)
        found = media.crossing(changed, inside, jnp.int32(1), jnp.asarray(True))
        return found.index_near / found.index_far

    gradient = jax.grad(ratio)(interfaces.index_inside)
    np.testing.assert_allclose(gradient, [1 / 1.333, -1.5 / 1.333**2, 0.0], rtol=1e-5)
