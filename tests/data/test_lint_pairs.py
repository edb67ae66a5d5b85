import re

import numpy as np
import pytest
import trimesh

from refref_jax.data.mesh_checks import lint_pairs
from refref_jax.data.mesh_queries import find_containment
from tests.factories.scenes import volume_of
from tests.factories.solids import as_part, ball, box, shell
from tests.laws.expectations import only


def _findings(*parts):
    return lint_pairs(parts, find_containment(parts))


def _warnings(*parts):
    return [finding for finding in _findings(*parts) if finding.severity != "note"]


def _cylinder(name, radius, height, *, index, bottom=0.0):
    mesh = trimesh.creation.cylinder(radius, height, sections=48)
    return as_part(mesh.apply_translation([0.0, 0.0, bottom + 0.5 * height]), name, index=index)


def _cup():
    """A cup of radius 1.1 and wall 0.1, open at its top at height 2: one body of one surface."""
    outline = [[0, -0.1], [1.1, -0.1], [1.1, 2], [1.0, 2], [1.0, 0], [0, 0]]
    mesh = trimesh.creation.revolve(np.array(outline, np.float64), sections=48)
    return as_part(mesh, "cup_glass", index=1.5)


def _drink(radius, bottom):
    """Water up to height 1.5."""
    return _cylinder("drink_water", radius, 1.5 - bottom, index=1.333, bottom=bottom)


def _share(message):
    return int(re.search(r"over (\d+)%", message).group(1)) / 100.0


# What is right.


def test_the_cup_is_a_body():
    # The cylinder of 48 sides has 0.997 of the area of the circle.
    expected = 0.997 * np.pi * (1.1**2 * 2.1 - 1.0**2 * 2.0)
    assert volume_of(_cup()) == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [ball()],
        [ball(), ball(centre=(5.0, 0.0, 0.0))],
        [ball(), ball(centre=(2.001, 0.0, 0.0))],
        [box(), box(centre=(1.2, 0.0, 0.0))],
        [shell(), ball(radius=1.0)],
    ],
    ids=["none", "one", "apart", "at-a-point", "side-by-side", "loose-in-a-shell"],
)
def test_parts_that_are_apart_have_no_findings(parts):
    assert _findings(*parts) == []


def test_a_part_inside_another_is_noted():
    finding = only(_findings(ball("drink_water", radius=0.5), ball("cup_glass")))
    assert (finding.severity, finding.part) == ("note", "drink_water")
    assert finding.message == "lies inside cup_glass."


def test_a_thin_wall_is_no_gap():
    """Glass around water, 1 % thick: light is bent there, not trapped."""
    assert _warnings(ball("cup_glass"), ball("drink_water", radius=0.985, index=1.333)) == []


def test_a_pane_between_two_liquids_is_no_gap():
    block = box("block_glass", size=(3.0, 2.0, 2.0))
    water = box("left_water", centre=(-0.51, 0.0, 0.0), index=1.333)
    air = box("right_air", centre=(0.51, 0.0, 0.0), index=1.0)
    assert _warnings(block, water, air) == []


# Cutting.


@pytest.mark.parametrize("shift", [0.3, 1.0])
def test_parts_that_cut_each_other_are_warned_about(shift):
    parts = (ball("a_glass"), ball("b_water", centre=(shift, 0.0, 0.0)))
    finding = only(_findings(*parts))
    assert (finding.severity, finding.part) == ("warning", "a_glass")
    assert "cuts or touches b_water" in finding.message
    assert "use the rule 'priority'" in finding.message


def test_a_drink_that_overlaps_its_cup_cuts_it():
    finding = only(_warnings(_cup(), _drink(1.05, -0.05)))
    assert "cuts or touches" in finding.message


# Coincident walls.


@pytest.mark.parametrize("part", [ball("b_water"), box("b_water")])
def test_coincident_parts_are_warned_about(part):
    finding = only(_findings(part._replace(name="a_glass"), part))
    assert finding.severity == "warning"
    assert "coincides with" in finding.message
    assert "a_glass" in str(finding) and "b_water" in str(finding)
    assert _share(finding.message) == 1.0
    assert "overlap a little and use the rule 'priority'" in finding.message


def test_boxes_that_share_one_side():
    finding = only(_findings(box("a_glass"), box("b_glass", centre=(1.0, 0.0, 0.0))))
    assert "coincides" in finding.message
    assert _share(finding.message) == pytest.approx(1 / 6, abs=0.02)


def test_a_drink_that_fills_its_cup():
    """Its side and its bottom coincide with the cup, its top is free."""
    finding = only(_warnings(_cup(), _drink(1.0, 0.0)))
    assert (finding.severity, finding.part) == ("warning", "drink_water")
    assert "coincides with cup_glass" in finding.message
    side, end = 2 * np.pi * 1.5, np.pi
    assert _share(finding.message) == pytest.approx((side + end) / (side + 2 * end), abs=0.02)


@pytest.mark.parametrize("closer", [1e-6, 3e-5])
def test_walls_too_close_to_be_told_apart_coincide(closer):
    parts = [ball("a_glass"), ball("b_water", radius=1.0 - closer, index=1.333)]
    assert "coincides" in only(_warnings(*parts)).message


# Gaps.


def test_a_drink_that_is_shrunk_in_its_cup():
    finding = only(_warnings(_cup(), _drink(0.99, 0.01)))
    assert (finding.severity, finding.part) == ("warning", "drink_water")
    assert "separated from cup_glass by a gap of 0.01 " in finding.message
    assert _share(finding.message) > 0.7
    assert "overlap a little and use the rule 'priority'" in finding.message


def test_a_drink_that_is_shrunk_in_a_hollow_ball():
    drink = ball("drink_water", radius=1.48, index=1.333)
    finding = only(_warnings(shell("jar_glass"), drink))
    assert finding.part == "drink_water"
    assert "gap of 0.02 " in finding.message
    assert _share(finding.message) == 1.0


def test_a_drink_that_is_shrunk_in_the_air_of_a_cavity():
    """The cavity is a part of its own, so that the layer lies between a part and its parent."""
    parts = [
        ball("jar_glass", radius=2.0),
        ball("cavity_air", radius=1.5, index=1.0),
        ball("drink_water", radius=1.48, index=1.333),
    ]
    finding = only(_warnings(*parts))
    assert (finding.part, _share(finding.message)) == ("drink_water", 1.0)
    assert "separated from cavity_air by a gap of 0.02 " in finding.message


@pytest.mark.parametrize(("distance", "found"), [(0.02, True), (0.2, False)])
def test_blocks_that_nearly_touch(distance, found):
    parts = [box("a_glass"), box("b_glass", centre=(1.0 + distance, 0.0, 0.0))]
    assert len(_warnings(*parts)) == found


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 30.0), (1.0, 0.0), (1e4, 0.0)])
def test_findings_know_no_size(scale, shift):
    def placed(part):
        return part._replace(vertices=scale * (part.vertices + shift))

    cup, *drinks = map(placed, [_cup(), _drink(1.0, 0.0), _drink(0.99, 0.01), _drink(1.05, -0.05)])
    for drink, words in zip(drinks, ("coincides", "gap", "cuts"), strict=True):
        assert words in only(_warnings(cup, drink)).message


def test_the_order_of_parts_does_not_matter():
    assert _warnings(_cup(), _drink(0.99, 0.01)) == _warnings(_drink(0.99, 0.01), _cup())


def test_faces_without_area_are_borne():
    cup, drink = _cup(), _drink(1.0, 0.0)
    sliver = np.array([[0, 0, 1], [2, 2, 2]])
    torn = drink._replace(faces=np.concatenate([sliver, drink.faces]))
    assert _warnings(cup, torn) == _warnings(cup, drink)
    assert _warnings(cup, drink._replace(faces=sliver)) == []
