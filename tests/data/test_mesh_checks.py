import numpy as np
import pytest
import trimesh

from refref_jax.data.mesh_checks import Finding, lint
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


def test_no_parts():
    assert _findings() == []


def test_the_bundled_ball_is_clean(ball_scene):
    assert _findings(*read_meshes(ball_scene)) == []


def test_an_open_mesh():
    part = ball()._replace(faces=ball().faces[1:])
    finding = only(_findings(part))
    assert finding.severity == "warning"
    assert "not watertight: 3 edges" in finding.message
    assert "close the holes" in finding.message


def test_a_soup_of_triangles_is_open_everywhere():
    corners = box().vertices[box().faces].reshape(-1, 3)
    part = box()._replace(vertices=corners, faces=np.arange(36).reshape(12, 3))
    assert "36 edges" in only(_findings(part)).message


def test_a_fin_on_a_closed_mesh():
    """Three faces meet at its root, and its two other edges belong to it alone."""
    tip = len(ball().vertices)
    part = _with_faces(ball(), (*ball().faces[0, :2], tip))
    part = part._replace(vertices=np.vstack([part.vertices, [0.0, 0.0, 3.0]]))
    assert "3 edges" in only(_findings(part)).message


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
    assert "cuts or touches b_water" in findings[1].message


def test_a_finding_reads_as_one_line():
    finding = Finding("warning", "ball_glass", "is not watertight.")
    assert str(finding) == "warning: ball_glass: is not watertight."
