import pytest

from refref_jax.data.mesh_checks import Advice, advise, examine_priorities
from refref_jax.data.mesh_queries import find_containment
from tests.factories.solids import ball, box
from tests.laws.expectations import only


def _advice(*parts):
    return advise(parts, find_containment(parts))


def _priorities(*parts):
    return examine_priorities(parts, find_containment(parts))


def _ranked(priority, name, **shape):
    return ball(name, **shape)._replace(priority=priority)


@pytest.mark.parametrize(
    ("count", "words"), [(1, "there is one part"), (3, "all 3 parts lie apart")]
)
def test_rules_are_the_same_for_parts_that_are_apart(count, words):
    advice = _advice(*[ball(centre=(5.0 * i, 0.0, 0.0)) for i in range(count)])
    assert advice.rule == "nested"
    assert words in advice.reason and "are the same" in advice.reason


def test_strictly_nested_parts_need_nested():
    advice = _advice(ball("drink_water", radius=0.5), ball("cup_glass"))
    assert advice.rule == "nested"
    assert "drink_water in cup_glass" in advice.reason


def test_overlapping_parts_need_priority():
    advice = _advice(ball("a_glass"), ball("b_water", centre=(1.0, 0.0, 0.0)))
    assert advice.rule == "priority"
    assert "a_glass and b_water overlap" in advice.reason
    assert "the highest wins" in advice.reason


def test_an_overlap_outweighs_nested_parts():
    cup, drink = ball("cup_glass", radius=3.0), ball("drink_water")
    assert _advice(cup, drink, ball("ice_glass", centre=(1.0, 0.0, 0.0))).rule == "priority"


def test_many_parts_are_counted():
    drops = [ball(f"drop{i}_water", radius=0.1, centre=(0.3 * i, 0.0, 0.0)) for i in range(-3, 3)]
    advice = _advice(*drops, box("block_glass", size=(4.0, 4.0, 4.0)))
    assert "drop-3_water in block_glass" in advice.reason
    assert advice.reason.count(" in block_glass") == 3
    assert "and 3 more" in advice.reason


def test_advice_reads_as_one_line():
    assert str(Advice("nested", "because.")) == "advice: rule nested: because."


# Priorities.


def test_good_priorities_have_no_findings():
    cup = _ranked(1, "cup_glass", radius=3.0)
    ice, drink = _ranked(3, "ice_glass", radius=0.5), _ranked(2, "drink_water")
    apart = _ranked(1, "other_glass", centre=(9.0, 0.0, 0.0))
    assert _priorities(cup, ice, drink, apart) == []
    assert _priorities(_ranked(2, "a"), _ranked(1, "b", centre=(1.0, 0.0, 0.0))) == []


@pytest.mark.parametrize("priority", [1, 0, -1])
def test_a_part_that_would_vanish(priority):
    drink = _ranked(priority, "drink_water", radius=0.5)
    finding = only(_priorities(_ranked(1, "cup_glass"), drink))
    assert (finding.severity, finding.part) == ("warning", "drink_water")
    assert "lies inside cup_glass without a higher priority" in finding.message
    assert "Give it the higher number" in finding.message


def test_a_part_may_vanish_in_one_that_is_not_its_parent():
    parts = [_ranked(p, f"{r}_glass", radius=r) for p, r in ((2, 3.0), (3, 2.0), (1, 1.0))]
    findings = _priorities(*parts)
    assert [finding.part for finding in findings] == ["1.0_glass", "1.0_glass"]


def test_an_overlap_that_is_left_to_chance():
    finding = only(_priorities(ball("a_glass"), ball("b_water", centre=(1.0, 0.0, 0.0))))
    assert (finding.severity, finding.part) == ("warning", "a_glass")
    assert "same priority as b_water (0)" in finding.message
    assert "different numbers" in finding.message
