"""Every vessel, bottle and jar, at a detail that shows its shape."""

import itertools

import manifold3d
import numpy as np
import pytest
import trimesh

from experiments.dataset.objects import (
    bottles,
    clear_glass,
    household,
    household_set,
    lab,
    medical,
    perfumes,
)
from experiments.dataset.parts import RADIUS
from refref_jax.choices import NO_ABSORPTION
from refref_jax.data.containment import (
    Containment,
    beside_faces,
    find_containment,
    winding_number,
)
from refref_jax.data.convexity import is_convex
from refref_jax.data.lint import lint
from refref_jax.data.meshes import INDEX_OF_REFRACTION, MeshPart
from refref_jax.optics.interface_rules import NO_PARENT

_MODULES = (bottles, clear_glass, household, household_set, lab, medical, perfumes)
_OBJECTS = [each for module in _MODULES for each in module.OBJECTS]
_GAP = 0.008
_SEARCH = 0.012  # no farther than needed: the cost grows with it


@pytest.fixture(scope="module", params=_OBJECTS, ids=lambda each: each.name)
def made(request):
    """An object with its parts, as bodies and as the library reads them."""
    parts = request.param.make(0.3)
    meshes = [
        MeshPart(
            part.name,
            part.vertices,
            part.faces,
            INDEX_OF_REFRACTION[part.material],
            "smooth",
        )
        for part in parts
    ]
    bodies = [_manifold(part.vertices, part.faces) for part in parts]
    return request.param, parts, meshes, _containment(bodies)


def test_the_list_is_complete():
    names = {each.name for each in _OBJECTS}
    assert len(names) == len(_OBJECTS) == 24
    assert sum(each.category == "smncvx" for each in _OBJECTS) == 9


def test_parts_are_closed_outward_and_without_waste(made):
    _, parts, _, _ = made
    for part in parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0, part.name
        assert len(np.unique(part.faces)) == len(part.vertices), part.name
        assert len(np.unique(part.vertices, axis=0)) == len(part.vertices), part.name


@pytest.mark.slow
def test_no_surface_folds_over_itself(made):
    """In front of each face is the outside, behind it the inside."""
    _, _, meshes, _ = made
    for mesh in meshes:
        faces = np.random.default_rng(0).choice(len(mesh.faces), 80)
        for side, expected in ((1.0, 0.0), (-1.0, 1.0)):
            winding = winding_number(mesh, beside_faces(mesh, faces, side))
            np.testing.assert_allclose(winding, expected, atol=1e-6, err_msg=mesh.name)


def test_the_lint_has_no_finding(made):
    _, _, meshes, tree = made
    findings = [f for f in lint(meshes, tree) if "lies inside" not in f.message]
    assert findings == []


def test_it_fills_the_room_for_it(made):
    _, parts, _, _ = made
    vertices = np.concatenate([part.vertices for part in parts])
    assert 1.6 < np.linalg.norm(vertices, axis=1).max() < min(RADIUS, 1.96)
    # A body that is tilted is centred along itself.
    assert np.abs(vertices.max(axis=0) + vertices.min(axis=0)).max() < 0.3


def test_materials_and_parts_fit_the_category(made):
    thing, parts, meshes, tree = made
    assert len({part.name for part in parts}) == len(parts)
    if thing.category == "smncvx":
        assert len(parts) == 1 and not is_convex(meshes[0])
    else:
        assert len({part.material for part in parts}) >= 2
        assert any(parent != NO_PARENT for parent in tree.parents)


def test_colours_are_colours_and_only_innermost_parts_absorb(made):
    _, parts, _, tree = made
    for number, part in enumerate(parts):
        assert all(0.0 < share <= 1.0 for share in part.tint)
        assert all(each >= 0.0 for each in part.absorption)
        if part.absorption != NO_ABSORPTION:
            assert number not in tree.parents, part.name


def test_all_surfaces_are_apart(made):
    """Exact distances, by a library that knows nothing of profiles."""
    _, parts, _, tree = made
    bodies = [_manifold(part.vertices, part.faces) for part in parts]
    for one, other in itertools.combinations(range(len(parts)), 2):
        if not {one, other} & {tree.parents[one], tree.parents[other]} and (
            tree.parents[one] != tree.parents[other]
        ):
            continue  # another surface lies between them
        gap = _distance(bodies[one], bodies[other])
        assert gap >= _GAP, (parts[one].name, parts[other].name, gap)


def test_pieces_of_one_part_are_apart(made):
    _, parts, _, _ = made
    for part in parts:
        pieces = trimesh.Trimesh(part.vertices, part.faces, process=False).split()
        bodies = [_manifold(piece.vertices, _outward(piece)) for piece in pieces]
        for one, other in itertools.combinations(bodies, 2):
            assert _distance(one, other) >= _GAP, part.name


def test_it_is_the_same_every_time(made):
    thing, parts, _, _ = made
    for part, again in zip(parts, thing.make(0.3), strict=True):
        assert part.vertices.tobytes() == again.vertices.tobytes()
        assert part.faces.tobytes() == again.faces.tobytes()
        assert part[:2] + part[4:] == again[:2] + again[4:]


def test_more_detail_is_the_same_shape_with_more_triangles(made):
    thing, parts, _, _ = made
    if len(parts) > 5:
        pytest.skip("sets are made of what the others test")
    for part, finer in zip(parts, thing.make(0.6), strict=True):
        assert len(finer.faces) > 1.5 * len(part.faces)
        np.testing.assert_allclose(
            np.ptp(finer.vertices, axis=0), np.ptp(part.vertices, axis=0), rtol=0.05
        )


@pytest.mark.slow
def test_edges_are_rounded_and_parts_are_small_enough():
    for thing in _OBJECTS:
        for part in thing.make(1.0):
            mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
            assert np.degrees(mesh.face_adjacency_angles.max()) < 30.0, (thing.name, part.name)
            assert len(part.faces) < 80_000, (thing.name, part.name)


@pytest.mark.slow
def test_the_library_finds_the_same_containment(made):
    _, _, meshes, tree = made
    assert find_containment(meshes) == tree


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
