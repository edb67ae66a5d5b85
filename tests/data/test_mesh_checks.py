import re

import numpy as np
import pytest
import trimesh

from refref_jax.data.mesh_checks import advise, lint
from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.meshes import read_meshes
from tests.factories.solids import as_part, ball, box, inverted, joined, shell
from tests.laws.expectations import only


def _findings(*parts):
    return lint(parts, find_containment(parts))


def _with_faces(part, *faces):
    return part._replace(faces=np.concatenate([part.faces, np.array(faces)]))


def _globe(sections):
    """A ball of rings, whose polar quadrangles have two corners at the pole."""
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 6)
    longitude = 2.0 * np.pi * np.arange(sections) / sections
    grid = np.zeros((6, sections), np.int64)
    grid[1:5] = np.arange(4 * sections).reshape(4, sections) + 1
    grid[5] = 4 * sections + 1
    rings = [
        [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)]
        for b in latitude[1:5]
        for a in longitude
    ]
    below, above = grid[:-1], grid[1:]
    right_below, right_above = np.roll(below, -1, axis=1), np.roll(above, -1, axis=1)
    faces = np.concatenate(
        [
            np.stack([below, right_below, right_above], axis=-1).reshape(-1, 3),
            np.stack([below, right_above, above], axis=-1).reshape(-1, 3),
        ]
    )
    vertices = np.array([[0.0, 0.0, -1.0], *rings, [0.0, 0.0, 1.0]])
    return ball()._replace(vertices=vertices, faces=faces)


@pytest.mark.parametrize(
    "part",
    [
        ball(),
        box(),
        shell(),
        joined("pair_glass", ball(), ball(centre=(5.0, 0.0, 0.0))),
        as_part(trimesh.creation.torus(1.0, 0.4), "torus_glass"),
        box(centre=(1e4, 1e4, 1e4)),
    ],
    ids=["ball", "box", "hollow", "two-pieces", "torus", "far-away"],
)
def test_a_clean_part_has_no_findings(part):
    assert _findings(part) == []


def test_the_bundled_ball_is_clean(ball_scene):
    assert _findings(*read_meshes(ball_scene)) == []


def test_an_open_mesh():
    part = ball()._replace(faces=ball().faces[1:])
    finding = only(_findings(part))
    assert finding.severity == "warning"
    assert "not watertight: 3 edges" in finding.message
    assert "close the holes" in finding.message


def test_a_fin_on_a_closed_mesh():
    """Three faces meet at its root, and its two other edges belong to it alone."""
    tip = len(ball().vertices)
    part = _with_faces(ball(), (*ball().faces[0, :2], tip))
    part = part._replace(vertices=np.vstack([part.vertices, [0.0, 0.0, 3.0]]))
    assert "3 edges" in only(_findings(part)).message


@pytest.mark.parametrize("turned", [False, True])
def test_a_fold_is_not_an_inverted_mesh(turned):
    """A vertex of its top comes out of the bottom of a box: the largest faces point inwards."""
    part = as_part(trimesh.creation.box((2.0, 2.0, 2.0)).subdivide_to_size(0.4), "box_glass")
    top = np.argmin(np.linalg.norm(part.vertices - [0.0, 0.0, 1.0], axis=-1))
    part.vertices[top] = [0.0, 0.0, -10.0]
    # In the middle of all faces: one place of a piece alone would be there.
    folded = np.any(part.faces == top, axis=1)
    others = part.faces[~folded]
    middle = len(others) // 2
    faces = np.concatenate([others[:middle], part.faces[folded], others[middle:]])
    part = part._replace(faces=faces)
    found = _findings(inverted(part) if turned else part)
    assert any("point inwards" in each.message for each in found) == turned


@pytest.mark.parametrize("part", [ball(), box(centre=(1e4, 1e4, 1e4)), shell()])
def test_an_inverted_mesh(part):
    finding = only(_findings(inverted(part)))
    assert finding.severity == "error"
    assert "point inwards" in finding.message
    assert "Flip those faces" in finding.message


def test_one_inverted_piece_among_others():
    pieces = [ball(), inverted(ball(centre=(5.0, 0.0, 0.0))), box(centre=(0.0, 5.0, 0.0))]
    finding = only(_findings(joined("three_glass", *pieces)))
    assert finding.severity == "error"
    assert "1 of its 3 pieces" in finding.message


def test_one_flipped_face():
    faces = ball().faces.copy()
    faces[7] = faces[7, ::-1]
    finding = only(_findings(ball()._replace(faces=faces)))
    assert finding.severity == "error"
    assert "disagree across 3 edges" in finding.message
    assert "Recalculate its normals" in finding.message


@pytest.mark.parametrize("share", [np.array([0.5, 0.5]), np.array([0.7, 0.3])], ids=str)
def test_a_collinear_face_is_noted(share):
    """A ball with an edge split on one side only, and the gap filled by a face without area."""
    part = ball()
    first, second, opposite = part.faces[0]
    middle, position = len(part.vertices), share @ part.vertices[[first, second]]
    split = [[first, middle, opposite], [middle, second, opposite], [first, second, middle]]
    part = part._replace(
        vertices=np.vstack([part.vertices, position]),
        faces=np.concatenate([part.faces[1:], split]),
    )
    finding = only(_findings(part))
    assert finding.severity == "note"
    assert "1 degenerate faces" in finding.message


@pytest.mark.parametrize("count", [1, 2])
def test_a_face_with_a_repeated_corner_is_noted_and_opens_nothing(count):
    corner = ball().faces[0, 0]
    others = ball().faces[:count, 1]
    part = _with_faces(ball(), *[(corner, corner, other) for other in others])
    finding = only(_findings(part))
    assert finding.severity == "note"
    assert f"{count} degenerate faces" in finding.message


@pytest.mark.parametrize("sections", [8, 9])
def test_a_globe_of_quadrangles_is_closed(sections):
    finding = only(_findings(_globe(sections)))
    assert finding.severity == "note"
    assert f"{2 * sections} degenerate faces" in finding.message


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)], ids=str)
def test_a_duplicate_face(order):
    findings = _findings(_with_faces(ball(), ball().faces[5][list(order)]))
    duplicates = [finding for finding in findings if "duplicate" in finding.message]
    assert only(duplicates).severity == "error"
    assert "1 duplicate faces" in duplicates[0].message
    assert "Remove them" in duplicates[0].message


def test_findings_belong_to_their_parts():
    holed = ball("b_glass", centre=(9.0, 0.0, 0.0))
    parts = [
        ball("a_glass"),
        holed._replace(faces=holed.faces[1:]),
        inverted(ball("c_glass", centre=(-9.0, 0.0, 0.0))),
    ]
    findings = _findings(*parts)
    assert [(f.part, f.severity) for f in findings] == [
        ("b_glass", "warning"),
        ("c_glass", "error"),
    ]


def test_pairs_of_parts_are_examined_too():
    holed = ball("b_water", centre=(1.0, 0.0, 0.0))
    findings = _findings(ball("a_glass"), holed._replace(faces=holed.faces[1:]))
    assert [finding.part for finding in findings] == ["b_water", "a_glass"]
    assert "intersects or touches b_water" in findings[1].message


def _advice(*parts):
    return advise(parts, find_containment(parts))


def _priorities(*parts):
    findings = lint(parts, find_containment(parts), rule="priority")
    return [finding for finding in findings if finding.severity != "note"]


def _ranked(priority, name, **shape):
    return ball(name, **shape)._replace(priority=priority)


@pytest.mark.parametrize(
    ("count", "words"), [(1, "there is one part"), (3, "all 3 parts are apart")]
)
def test_rules_are_the_same_for_parts_that_are_apart(count, words):
    advice = _advice(*[ball(centre=(5.0 * i, 0.0, 0.0)) for i in range(count)])
    assert advice.rule == "nested"
    assert words in advice.reason and "are equivalent" in advice.reason


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


def test_good_priorities_have_no_findings():
    cup = _ranked(1, "cup_glass", radius=3.0)
    ice, drink = _ranked(3, "ice_glass", radius=0.5), _ranked(2, "drink_water")
    apart = _ranked(1, "other_glass", centre=(9.0, 0.0, 0.0))
    assert _priorities(cup, ice, drink, apart) == []
    assert _priorities(_ranked(2, "a"), _ranked(1, "b", centre=(1.0, 0.0, 0.0))) == []


@pytest.mark.parametrize(
    "priority", [1, *(pytest.param(number, marks=pytest.mark.slow) for number in (0, -1))]
)
def test_a_part_that_would_vanish(priority):
    drink = _ranked(priority, "drink_water", radius=0.5)
    finding = only(_priorities(_ranked(1, "cup_glass"), drink))
    assert (finding.severity, finding.part) == ("warning", "drink_water")
    assert "lies inside cup_glass without a higher priority" in finding.message
    assert "Give it the higher number" in finding.message


@pytest.mark.slow
def test_a_part_may_vanish_in_one_that_is_not_its_parent():
    parts = [_ranked(p, f"{r}_glass", radius=r) for p, r in ((2, 3.0), (3, 2.0), (1, 1.0))]
    findings = _priorities(*parts)
    assert [finding.part for finding in findings] == ["1.0_glass", "1.0_glass"]


def test_an_overlap_that_is_left_to_chance():
    finding = only(_priorities(ball("a_glass"), ball("b_water", centre=(1.0, 0.0, 0.0))))
    assert (finding.severity, finding.part) == ("warning", "a_glass")
    assert "same priority as b_water (0)" in finding.message
    assert "different priorities" in finding.message


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


@pytest.mark.parametrize("shift", [0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_parts_that_cut_each_other_are_warned_about(shift):
    parts = (ball("a_glass"), ball("b_water", centre=(shift, 0.0, 0.0)))
    finding = only(_findings(*parts))
    assert (finding.severity, finding.part) == ("warning", "a_glass")
    assert "intersects or touches b_water" in finding.message
    assert "use the rule 'priority'" in finding.message


@pytest.mark.parametrize(
    "part", [pytest.param(ball("b_water"), marks=pytest.mark.slow), box("b_water")]
)
def test_coincident_parts_are_warned_about(part):
    finding = only(_findings(part._replace(name="a_glass"), part))
    assert finding.severity == "warning"
    assert "coincides with" in finding.message
    assert "a_glass" in str(finding) and "b_water" in str(finding)
    assert _share(finding.message) == 1.0
    assert "overlap a little and use the rule 'priority'" in finding.message


def test_a_drink_that_fills_its_cup():
    """Its side and its bottom coincide with the cup, its top is free."""
    finding = only(_warnings(_cup(), _drink(1.0, 0.0)))
    assert (finding.severity, finding.part) == ("warning", "drink_water")
    assert "coincides with cup_glass" in finding.message
    side, end = 2 * np.pi * 1.5, np.pi
    assert _share(finding.message) == pytest.approx((side + end) / (side + 2 * end), abs=0.02)


@pytest.mark.parametrize("closer", [pytest.param(1e-6, marks=pytest.mark.slow), 3e-5])
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "shift"),
    [(1e-4, 30.0), (1.0, 0.0), (1e4, 0.0)],
)
def test_findings_know_no_size(scale, shift):
    def placed(part):
        return part._replace(vertices=scale * (part.vertices + shift))

    cup, *drinks = map(placed, [_cup(), _drink(1.0, 0.0), _drink(0.99, 0.01), _drink(1.05, -0.05)])
    for drink, words in zip(drinks, ("coincides", "gap", "intersects"), strict=True):
        assert words in only(_warnings(cup, drink)).message


def test_the_order_of_parts_does_not_matter():
    assert _warnings(_cup(), _drink(0.99, 0.01)) == _warnings(_drink(0.99, 0.01), _cup())


def test_faces_without_area_are_borne():
    cup, drink = _cup(), _drink(1.0, 0.0)
    sliver = np.array([[0, 0, 1], [2, 2, 2]])
    torn = drink._replace(faces=np.concatenate([sliver, drink.faces]))
    assert _warnings(cup, torn) == _warnings(cup, drink)
    assert _warnings(cup, drink._replace(faces=sliver)) == []
