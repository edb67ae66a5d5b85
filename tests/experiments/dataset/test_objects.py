"""The objects at a detail that shows their shape, and at the one that is rendered."""

import collections
import functools
import itertools
import re

import manifold3d
import numpy as np
import pytest
import trimesh

from experiments.dataset import catalogue, scene_record
from experiments.dataset.objects import (
    bottles,
    clear_glass,
    household,
    household_set,
    lab,
    medical,
    monkey,
    perfumes,
    quadrics,
)
from experiments.dataset.objects.isosurface import Surface
from experiments.dataset.parts import RADIUS
from refref_jax.choices import CLEAR, NO_ABSORPTION
from refref_jax.data.mesh_checks import lint
from refref_jax.data.mesh_queries import (
    Containment,
    beside_faces,
    find_containment,
    is_convex,
    winding_number,
)
from refref_jax.optics.interface_rules import NO_PARENT
from tests.processes.command import ROOT

_OBJECTS = catalogue.OBJECTS
_NAMES = [name for name in _OBJECTS if name != "monkey"]  # whose mesh Blender has to export
_TURNED = [
    each.name
    for module in (bottles, clear_glass, household, household_set, lab, medical, perfumes)
    for each in module.OBJECTS
]

# Each takes a second or more.
_SLOW = {"teacup", "water_pitcher", "wisolt_kettle", "skull_bottle", "sleeping_dragon"}
_SLOW |= {"cat", "dog", "cow", "woman_sculpture"}

_PAGE = ROOT / "docs" / "dataset.md"

_DETAIL = 0.3
_GAP = 0.008
_SEARCH = 0.012  # no farther than needed: the cost grows with it


@functools.cache
def _made(name):
    """An object's parts, and the tree of them by exact Booleans."""
    parts = _OBJECTS[name].make(_DETAIL)
    return parts, _containment([_manifold(part.vertices, part.faces) for part in parts])


def _each(names):
    return [pytest.param(n, marks=pytest.mark.slow if n in _SLOW else ()) for n in names]


def _mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def _only(name):
    (part,) = _OBJECTS[name].make(1.0)
    return part


def _findings(parts, tree):
    found = lint([scene_record.mesh_part(part) for part in parts], tree)
    return [str(each) for each in found if each.severity != "note"]


def test_there_are_as_many_of_each_category_as_in_the_paper():
    counts = collections.Counter(each.category for each in _OBJECTS.values())
    assert counts == {"smcvx": 9, "smncvx": 20, "mmncvx": 21}


# Every object.


@pytest.mark.parametrize("name", _each(_NAMES))
def test_parts_are_closed_outward_and_without_waste(name):
    parts, tree = _made(name)
    assert _findings(parts, tree) == []
    assert len({part.name for part in parts}) == len(parts)
    for part in parts:
        mesh = _mesh(part)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0, part.name
        assert len(np.unique(part.faces)) == len(part.vertices), part.name
        assert len(np.unique(part.vertices, axis=0)) == len(part.vertices), part.name


@pytest.mark.parametrize("name", _each(_NAMES))
def test_materials_and_shape_fit_the_category(name):
    parts, tree = _made(name)
    category = _OBJECTS[name].category
    clear = [part for part in parts if part.kind == "dielectric"]
    if category == "mmncvx":
        assert len({part.material for part in clear}) >= 2
        assert any(parent != NO_PARENT for parent in tree.parents)
    else:
        (part,) = clear
        # A lens is convex, but not the object that it is part of.
        convex = is_convex(scene_record.mesh_part(part)) and len(parts) == 1
        assert convex == (category == "smcvx")
    for number, part in enumerate(parts):
        assert all(0.0 < share <= 1.0 for share in part.tint)
        assert all(each >= 0.0 for each in part.absorption)
        if part.absorption != NO_ABSORPTION:
            inside = [parts[i].kind for i, parent in enumerate(tree.parents) if parent == number]
            assert set(inside) <= {"opaque"}, part.name
        if part.kind == "opaque":
            assert part.material == "opaque" and number not in tree.parents
            assert all(0.0 < share < 0.9 for share in part.albedo), part.name
        else:
            assert part.albedo is None and part.radiance is None


def test_opaque_parts_are_those_of_the_documented_table():
    """The table of docs/dataset.md, which readers choose objects by."""
    rows = re.findall(r"^\| (\w+) \| `(.+)` \|", _PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    documented = {name: set(parts.split("`, `")) for name, parts in rows}
    made = {
        name: {part.name for part in _made(name)[0] if part.kind == "opaque"}
        for name in _NAMES
        if name not in _SLOW
    }
    assert documented == {name: parts for name, parts in made.items() if parts}
    assert len(documented) == 11


@pytest.mark.parametrize("name", _each(_NAMES))
def test_it_fills_the_room_for_it(name):
    vertices = np.concatenate([part.vertices for part in _made(name)[0]])
    assert 1.4 - 1e-9 <= np.linalg.norm(vertices, axis=1).max() < RADIUS
    # A body that is tilted is centred along itself.
    assert np.abs(vertices.max(axis=0) + vertices.min(axis=0)).max() < 0.3


@pytest.mark.parametrize("name", _each(_NAMES))
def test_all_surfaces_are_apart(name):
    """Exact distances, by a library that knows nothing of how objects are made."""
    parts, tree = _made(name)
    bodies = [_manifold(part.vertices, part.faces) for part in parts]
    for one, other in itertools.combinations(range(len(parts)), 2):
        if {one, other} & {tree.parents[one], tree.parents[other]} or (
            tree.parents[one] == tree.parents[other]  # else another surface lies between them
        ):
            gap = _distance(bodies[one], bodies[other])
            assert gap >= _GAP, (parts[one].name, parts[other].name, gap)
    for part in parts:
        pieces = [_manifold(p.vertices, _outward(p)) for p in _mesh(part).split()]
        for one, other in itertools.combinations(pieces, 2):
            assert _distance(one, other) >= _GAP, part.name


@pytest.mark.parametrize("name", [*_TURNED, "ball", "torus", "magnifier", "fox"])
def test_it_is_the_same_every_time(name):
    for part, again in zip(_made(name)[0], _OBJECTS[name].make(_DETAIL), strict=True):
        assert part.vertices.tobytes() == again.vertices.tobytes()
        assert part.faces.tobytes() == again.faces.tobytes()
        assert part[:2] + part[4:] == again[:2] + again[4:]


@pytest.mark.slow
@pytest.mark.parametrize("name", _TURNED)
def test_no_surface_folds_over_itself(name):
    """In front of each face is the outside, behind it the inside; the library's tree is exact."""
    parts, tree = _made(name)
    meshes = [scene_record.mesh_part(part) for part in parts]
    assert find_containment(meshes) == tree
    for mesh in meshes:
        faces = np.random.default_rng(0).choice(len(mesh.faces), 80)
        for side, expected in ((1.0, 0.0), (-1.0, 1.0)):
            winding = winding_number(mesh, beside_faces(mesh, faces, side))
            np.testing.assert_allclose(winding, expected, atol=1e-6, err_msg=mesh.name)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(_OBJECTS))
def test_at_the_detail_that_is_rendered_the_lint_finds_nothing(name):
    if name == "monkey" and not catalogue.SUZANNE.is_file():
        pytest.skip("the monkey is exported by the first dataset.make that renders it")
    parts = _OBJECTS[name].make(1.0)
    tree = find_containment([scene_record.mesh_part(part) for part in parts])
    assert _findings(parts, tree) == []
    assert max(np.linalg.norm(part.vertices, axis=1).max() for part in parts) <= RADIUS
    for part in parts if name in _TURNED else ():
        angles = _mesh(part).face_adjacency_angles
        assert np.degrees(angles.max()) < 30.0 and len(part.faces) < 80_000, part.name


# Some of them.


@pytest.mark.parametrize("name", ["ball", "cube", "cylinder", "pyramid", "torus"])
def test_a_coloured_object_differs_by_its_tint_alone(name):
    ([clear], _), ([coloured], _) = _made(name), _made(f"{name}_coloured")
    np.testing.assert_array_equal(clear.vertices, coloured.vertices)
    assert clear.tint == CLEAR and min(coloured.tint) < 0.8


def test_volumes_known_by_hand():
    box, spire = _only("cube"), _only("pyramid")
    base, height = np.ptp(spire.vertices[:, 0]), np.ptp(spire.vertices[:, 2])
    radius, thickness = quadrics.TORUS_RADIUS, quadrics.TORUS_THICKNESS
    whole, fillet = quadrics.CYLINDER_RADIUS, quadrics.CYLINDER_FILLET
    # The fillet takes away the corner outside of a quarter circle, by Pappus.
    corner, arc = fillet**2 * (1.0 - np.pi / 4.0), (10 - 3 * np.pi) / (12 - 3 * np.pi)
    lost = 2.0 * corner * 2.0 * np.pi * (whole - (1.0 - arc) * fillet)
    for name, volume, rel in (
        ("cube", np.ptp(box.vertices[:, 0]) ** 3, 1e-9),
        ("pyramid", base**2 * height / 3.0, 1e-9),
        ("ball", 4.0 / 3.0 * np.pi * quadrics.BALL_RADIUS**3, 2e-3),
        ("torus", 2.0 * np.pi**2 * radius * thickness**2, 2e-3),
        ("cylinder", 2.0 * np.pi * whole**2 * quadrics.CYLINDER_HALF_HEIGHT - lost, 2e-3),
    ):
        assert _mesh(_only(name)).volume == pytest.approx(volume, rel=rel), name


# The monkey.


def _head_with_open_eyes():
    """A ball with two holes, in which smaller balls sit that are open at the back."""
    head = trimesh.creation.icosphere(subdivisions=4)
    pieces = []
    for side in (-1.0, 1.0):
        towards = np.array([0.5 * side, -0.8, 0.3]) / np.sqrt(0.98)
        head.update_faces(head.triangles_center @ towards < 0.93)
        eye = trimesh.creation.icosphere(subdivisions=3, radius=0.42)
        eye.update_faces(eye.triangles_center @ towards > -0.3)
        pieces.append(eye.apply_translation(0.75 * towards))
    mesh = trimesh.util.concatenate([head, *pieces])
    mesh.remove_unreferenced_vertices()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_open_pieces_are_closed():
    pieces = monkey.pieces_of(_head_with_open_eyes())
    assert len(pieces) == 3 and len(pieces[0].faces) > len(pieces[1].faces)
    for piece in pieces:
        assert not trimesh.Trimesh(*piece, process=False).is_watertight
        mesh = trimesh.Trimesh(*monkey.closed(piece), process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0


@pytest.mark.slow
def test_a_monkey_is_one_closed_body():
    [part] = monkey.monkey(_head_with_open_eyes()).make(_DETAIL)
    assert _findings([part], Containment((NO_PARENT,), ())) == []
    mesh = _mesh(part)
    assert mesh.is_watertight and mesh.euler_number == 2
    # Scaled to radius 1.7: a ball with two bumps.
    assert 0.6 < mesh.volume / (4.0 / 3.0 * np.pi * 1.7**3) < 1.0


def test_a_file_that_holds_no_monkey_is_refused(tmp_path):
    with pytest.raises(ValueError, match="export_monkey"):
        monkey.load_suzanne(tmp_path / "missing.npz")
    torn = tmp_path / "torn.npz"
    torn.write_bytes(b"PK\x03\x04 half of a file")
    with pytest.raises(ValueError, match="torn"):
        monkey.load_suzanne(torn)
    mesh = _head_with_open_eyes()
    np.savez(tmp_path / "made.npz", vertices=mesh.vertices, faces=mesh.faces)
    np.testing.assert_array_equal(
        monkey.load_suzanne(tmp_path / "made.npz").vertices, mesh.vertices
    )


# Exact geometry.


def _containment(bodies):
    """The tree of containment, by exact Booleans."""
    count = len(bodies)
    inside = np.zeros((count, count), bool)
    for one, other in itertools.permutations(range(count), 2):
        common = bodies[one] ^ bodies[other]
        inside[one, other] = not common.is_empty() and (bodies[one] - bodies[other]).is_empty()
    parents = [
        min(np.flatnonzero(inside[one]), key=lambda body: bodies[body].volume(), default=NO_PARENT)
        for one in range(count)
    ]
    return Containment(tuple(map(int, parents)), ())


def _manifold(vertices, faces):
    return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces.astype(np.uint64)))


def _outward(piece):
    return piece.faces if piece.volume > 0.0 else piece.faces[:, ::-1]


def _distance(one, other):
    """Distance between the surfaces of two bodies, apart or one inside the other; 0 if they cut."""
    if (one ^ other).is_empty():
        return one.min_gap(other, _SEARCH)
    inner, outer = sorted((one, other), key=lambda body: body.volume())
    around = manifold3d.Manifold.cube((9.0, 9.0, 9.0), True) - outer
    return around.min_gap(inner, _SEARCH)
