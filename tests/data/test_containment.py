import itertools

import numpy as np
import pytest
import trimesh

from refref_jax.data import mesh_queries
from refref_jax.data.mesh_queries import find_containment, parts_around, winding_number
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import EMPTY_SLOT, SLOTS
from tests.factories.scenes import volume_of
from tests.factories.solids import as_part, ball, box, inverted, joined, shell
from tests.laws.expectations import scene_error

# Sums of solid angles in double precision.
_EXACT = 1e-9

_ROTATION = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0])[:3, :3]


def _moved(part):
    return part._replace(vertices=part.vertices @ _ROTATION.T + [0.3, -0.2, 0.1])


def _shuffled(part):
    order = np.random.default_rng(0).permutation(len(part.faces))
    return part._replace(faces=part.faces[order])


def _octant():
    """One triangle that fills an eighth of the view from the origin."""
    return box()._replace(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))


def _open_box(open_faces):
    """A unit box that lacks its first sides."""
    part = box()
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    side = np.argmax(np.abs(normals), axis=1) * 2 + (normals.sum(axis=1) > 0.0)
    return part._replace(faces=part.faces[side >= open_faces])


def _pairs(found):
    return {frozenset(pair) for pair in found.overlaps}


def test_winding_number_of_an_octant_by_hand():
    origin = np.zeros((1, 3))
    np.testing.assert_allclose(winding_number(_octant(), origin), 0.125, atol=_EXACT)
    np.testing.assert_allclose(winding_number(inverted(_octant()), origin), -0.125, atol=_EXACT)


@pytest.mark.parametrize("missing", range(6))
def test_an_open_box_is_seen_from_its_centre_by_sixths(missing):
    centre = np.full((1, 3), 1e-12)
    expected = 1.0 - missing / 6.0
    np.testing.assert_allclose(winding_number(_open_box(missing), centre), expected, atol=_EXACT)


def test_winding_number_is_one_inside_a_torus_and_zero_outside():
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=48, minor_sections=24)
    points = np.random.default_rng(0).uniform([-1.5, -1.5, -0.5], [1.5, 1.5, 0.5], (200, 3))
    from_tube = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1.0, points[:, 2])
    # The facets lie up to 0.01 inside the torus.
    clear = np.abs(from_tube - 0.4) > 0.02
    inside = from_tube < 0.4
    part = as_part(mesh, "torus_glass")
    assert 30 < np.sum(inside & clear) < 170
    winding = winding_number(part, points[clear])
    np.testing.assert_allclose(winding, inside[clear], atol=_EXACT)
    np.testing.assert_allclose(winding_number(inverted(part), points[clear]), -winding, atol=_EXACT)


def test_winding_number_of_nested_surfaces_adds_up():
    points = np.array([[0.0, 0.0, 0.1], [1.7, 0.0, 0.0], [0.0, 2.5, 0.0]])
    twice = joined("twice", ball(radius=2.0), ball(radius=1.5))
    np.testing.assert_allclose(winding_number(twice, points), [2.0, 1.0, 0.0], atol=_EXACT)
    np.testing.assert_allclose(winding_number(shell(), points), [0.0, 1.0, 0.0], atol=_EXACT)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_winding_number_knows_no_size(scale):
    part = ball()._replace(vertices=scale * ball().vertices)
    points = scale * np.array([[0.1, 0.2, 0.3], [0.7, 0.7, 0.7]])
    np.testing.assert_allclose(winding_number(part, points), [1.0, 0.0], atol=_EXACT)


def test_winding_number_is_the_same_in_several_sweeps(monkeypatch):
    part = _open_box(2)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
    whole = winding_number(part, points)
    monkeypatch.setattr(mesh_queries, "_SWEEP", 64)
    np.testing.assert_allclose(winding_number(part, points), whole, atol=_EXACT)


def test_winding_number_of_no_points():
    assert winding_number(ball(), np.zeros((0, 3))).shape == (0,)


def test_winding_number_beyond_the_bounding_box_is_exactly_zero():
    points = np.array([[0.51, 0.0, 0.0], [0.0, -3.0, 0.0], [1e6, 1e6, 1e6]])
    np.testing.assert_array_equal(winding_number(_open_box(3), points), 0.0)


def test_volume_does_not_change_far_from_the_origin():
    moved = ball(centre=(1.1e6, -1.3e6, 1.7e6))
    assert volume_of(moved) == pytest.approx(volume_of(ball()), rel=1e-7)


# Trees.


def test_no_parts():
    assert find_containment([]) == ((), ())


def test_one_part():
    assert find_containment([ball()]) == ((NO_PARENT,), ())


_TURNS = (lambda part: part, inverted, _moved, _shuffled)


# Every order, and every turn by turns.
@pytest.mark.parametrize(
    ("order", "turn"),
    [
        pytest.param(order, turn, marks=() if number < len(_TURNS) else pytest.mark.slow)
        for number, (order, turn) in enumerate(
            zip(itertools.permutations(range(3)), itertools.cycle(_TURNS), strict=False)
        )
    ],
)
def test_each_of_three_nested_parts_lies_in_the_next(order, turn):
    parts = [ball(radius=0.5, centre=(0.2, 0.0, 0.0)), box(size=(2.0, 2.0, 2.0)), ball(radius=3.0)]
    parents = [1, 2, NO_PARENT]
    found = find_containment([turn(parts[i]) for i in order])
    expected = [NO_PARENT if parents[i] == NO_PARENT else order.index(parents[i]) for i in order]
    assert list(found.parents) == expected
    assert found.overlaps == ()


def test_two_balls_in_one():
    parts = [
        ball(radius=0.4, centre=(-0.5, 0.0, 0.0)),
        ball(radius=2.0),
        ball(radius=0.4, centre=(0.5, 0.0, 0.0)),
    ]
    assert find_containment(parts) == ((1, NO_PARENT, 1), ())


@pytest.mark.parametrize("shift", [(2.1, 0.0, 0.0), (1.3, 1.3, 1.3), (1e3, 0.0, 0.0)])
def test_balls_side_by_side(shift):
    assert find_containment([ball(), ball(centre=shift)]) == ((NO_PARENT, NO_PARENT), ())


@pytest.mark.parametrize("shift", [0.3, 1.0, 1.4])
def test_balls_that_cut_each_other(shift):
    found = find_containment([ball(), ball(centre=(shift, 0.0, 0.0))])
    assert found.parents == (NO_PARENT, NO_PARENT)
    assert _pairs(found) == {frozenset({0, 1})}


@pytest.mark.parametrize(
    "part",
    [box(), pytest.param(ball(), marks=pytest.mark.slow), _moved(box()), _moved(ball())],
)
def test_coincident_parts_overlap_and_do_not_contain_each_other(part):
    found = find_containment([part, part._replace(name="twin_water")])
    assert found.parents == (NO_PARENT, NO_PARENT)
    assert _pairs(found) == {frozenset({0, 1})}


@pytest.mark.parametrize("place", [lambda part: part, _moved])
def test_a_body_that_touches_the_wall_of_another_is_reported(place):
    cup = place(as_part(trimesh.creation.cylinder(1.0, 2.0, sections=24), "cup_glass"))
    drink = place(as_part(trimesh.creation.cylinder(1.0, 1.0, sections=24), "drink_water"))
    assert _pairs(find_containment([cup, drink])) == {frozenset({0, 1})}


@pytest.mark.parametrize("place", [lambda part: part, _moved])
def test_boxes_that_share_one_side_are_reported(place):
    parts = [place(box()), place(box(centre=(1.0, 0.0, 0.0)))]
    found = find_containment(parts)
    assert found.parents == (NO_PARENT, NO_PARENT)
    assert _pairs(found) == {frozenset({0, 1})}


def test_the_cavity_of_a_hollow_body_is_outside_of_it():
    in_cavity, in_wall = ball(radius=0.5), ball(radius=0.1, centre=(1.7, 0.0, 0.0))
    found = find_containment([shell(), in_cavity, in_wall])
    assert found == ((NO_PARENT, NO_PARENT, 0), ())


def test_a_hollow_body_lies_in_what_surrounds_it():
    found = find_containment([shell(), ball(radius=5.0), ball(radius=0.5)])
    assert found == ((1, NO_PARENT, 1), ())


def test_an_open_box_still_contains_what_is_deep_inside():
    found = find_containment([_open_box(1), ball(radius=0.1)])
    assert found == ((NO_PARENT, 0), ())


def test_the_parts_around_points():
    parts = [ball(radius=2.0), box(size=(2.0, 2.0, 2.0)), ball(centre=(2.0, 0.0, 0.0))]
    points = np.array([[0.0, 0.0, 0.0], [0.9, 0.9, 0.0], [1.5, 0.0, 0.0], [2.5, 0.0, 0.0]])
    points = np.concatenate([points, [[9.0, 0.0, 0.0]]])
    found = parts_around(parts, points)
    free = EMPTY_SLOT
    expected = [
        [0, 1, free, free],
        [0, 1, free, free],
        [0, 2, free, free],
        [2, free, free, free],
        [free, free, free, free],
    ]
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.int32
    turned = parts_around([inverted(part) for part in parts], points)
    np.testing.assert_array_equal(turned, expected)


def test_the_last_of_many_parts_is_listed():
    parts = [ball(centre=(9.0 * i, 0.0, 0.0)) for i in range(6)]
    found = parts_around(parts, np.array([[45.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(found[:, 0], [5, 0])
    np.testing.assert_array_equal(found[:, 1:], EMPTY_SLOT)


def test_no_part_is_around_points_of_an_empty_scene():
    np.testing.assert_array_equal(parts_around([], np.zeros((2, 3))), np.full((2, SLOTS), -1))
    assert parts_around([ball()], np.zeros((0, 3))).shape == (0, SLOTS)


def test_too_many_parts_around_a_point():
    parts = [ball(f"layer{i}_glass", radius=1.0 + i) for i in range(SLOTS + 1)]
    assert np.all(parts_around(parts[:SLOTS], np.zeros((1, 3))) != EMPTY_SLOT)
    with scene_error("[0.0, 0.0, 0.0]", "layer0_glass", "layer4_glass", "Move the camera"):
        parts_around(parts, np.array([[20.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        # Two corners that share a tenth of an edge; a cross, whose middles lie outside each other.
        (box("a"), box("b", centre=(0.9, 0.9, 0.9))),
        (box("a", size=(2.0, 0.3, 0.3)), box("b", size=(0.3, 2.0, 0.31))),
    ],
)
def test_coarse_bodies_that_cut_each_other_are_found(first, second):
    found = find_containment([first, second])
    assert found.overlaps == ((0, 1),)
    assert found.parents == (NO_PARENT, NO_PARENT)
