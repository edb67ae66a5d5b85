import functools

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from experiments.dataset.objects import (
    cow,
    curios,
    figures,
    monkey,
    pets,
    polyhedra,
    quadrics,
    sleeping_dragon,
    tableware,
)
from experiments.dataset.objects.formed import WALL, centred, spacing
from experiments.dataset.objects.isosurface import Surface
from experiments.dataset.parts import RADIUS
from refref_jax.data.containment import find_containment
from refref_jax.data.convexity import is_convex
from refref_jax.data.lint import lint
from refref_jax.data.meshes import INDEX_OF_REFRACTION, MeshPart

_MODULES = (polyhedra, quadrics, tableware, curios, pets, cow, sleeping_dragon, figures)
_OBJECTS = {entry.name: entry for module in _MODULES for entry in module.OBJECTS}
_FORMED = [name for module in _MODULES[2:] for name in [entry.name for entry in module.OBJECTS]]

# Each takes a second or more.
_SLOW = {"teacup", "water_pitcher", "wisolt_kettle", "skull_bottle", "sleeping_dragon"}
_SLOW |= {"cat", "dog", "cow", "woman_sculpture"}

_VESSELS = ("teapot", "water_pitcher", "wisolt_kettle", "skull_bottle")

_DETAIL = 0.3
_GAP = 0.008


@functools.cache
def _made(name):
    return tuple(_OBJECTS[name].make(_DETAIL))


def _each(names):
    return [pytest.param(n, marks=pytest.mark.slow if n in _SLOW else ()) for n in names]


def _mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def _mesh_parts(parts):
    return [
        MeshPart(part.name, part.vertices, part.faces, INDEX_OF_REFRACTION[part.material], "auto")
        for part in parts
    ]


def _no_surprises(parts):
    bodies = _mesh_parts(parts)
    containment = find_containment(bodies)
    findings = [f for f in lint(bodies, containment) if f.severity != "note"]
    assert findings == [] and containment.overlaps == ()
    return containment.parents


def test_names_and_categories():
    single = {"smcvx": 9, "smncvx": 10, "mmncvx": 6}
    categories = [entry.category for entry in _OBJECTS.values()]
    assert {category: categories.count(category) for category in single} == single
    assert sum(len(module.OBJECTS) for module in _MODULES) == len(_OBJECTS)


@pytest.mark.parametrize("name", _each(_OBJECTS))
def test_objects_are_clean(name):
    parts = _made(name)
    parents = _no_surprises(parts)
    assert len({part.name for part in parts}) == len(parts)
    if _OBJECTS[name].category == "mmncvx":
        assert parents == (-1, 0) and parts[0].material != parts[1].material
    else:
        assert parents == (-1,)
    for part in parts:
        assert _mesh(part).is_watertight and _mesh(part).volume > 0.0
        assert np.all(np.isfinite(part.vertices))
        assert all(0.0 < channel <= 1.0 for channel in part.tint)


@pytest.mark.parametrize("name", _each(_OBJECTS))
def test_objects_fill_their_place(name):
    points = np.concatenate([part.vertices for part in _made(name)])
    assert 1.4 - 1e-9 <= np.max(np.linalg.norm(points, axis=-1)) < RADIUS
    assert np.all(np.abs(points.max(axis=0) + points.min(axis=0)) < 0.02)


@pytest.mark.parametrize("name", _each(_OBJECTS))
def test_only_convex_objects_are_convex(name):
    convex = [is_convex(part) for part in _mesh_parts(_made(name))]
    assert all(convex) if _OBJECTS[name].category == "smcvx" else not convex[0]


@pytest.mark.parametrize("name", _each(n for n in _FORMED if _OBJECTS[n].category == "mmncvx"))
def test_cores_keep_their_distance(name):
    body, core = _made(name)
    # Of the surfaces, not of the vertices: triangles are sampled densely.
    outer, inner = (trimesh.sample.sample_surface(_mesh(p), 20000, seed=0)[0] for p in (body, core))
    gap = np.min(KDTree(outer).query(inner)[0])
    scale = np.max(np.ptp(body.vertices, axis=0)) / 4.0
    assert gap >= max(_GAP, 0.6 * WALL * scale)
    assert _mesh(core).body_count == 1
    assert 0.1 < _mesh(core).volume / _mesh(body).volume < 0.8
    # Only what no other part lies in absorbs.
    assert body.absorption == (0.0, 0.0, 0.0) and max(core.absorption) > 0.0


@pytest.mark.parametrize("name", _each(_VESSELS))
def test_vessels_are_hollow_and_open(name):
    [body] = _made(name)
    mesh = _mesh(body)
    # One surface, through whose opening the room inside is joined to the outside.
    assert mesh.body_count == 1
    assert mesh.volume < 0.6 * mesh.convex_hull.volume
    assert find_containment(_mesh_parts([body])).parents == (-1,)
    assert not mesh.contains(np.array([[0.0, 0.0, -0.05]])).any()


@pytest.mark.slow
def test_the_cup_stands_apart_from_its_saucer():
    cup, saucer = (
        trimesh.sample.sample_surface(piece, 20000, seed=0)[0]
        for piece in _mesh(_made("teacup")[0]).split()
    )
    assert _GAP < np.min(KDTree(cup).query(saucer)[0]) < 0.12


def test_a_coloured_object_differs_by_its_tint_alone():
    for name in ("ball", "cube", "cylinder", "pyramid", "torus"):
        [clear], [coloured] = _made(name), _made(f"{name}_coloured")
        np.testing.assert_array_equal(clear.vertices, coloured.vertices)
        assert clear.tint == (1.0, 1.0, 1.0) and min(coloured.tint) < 0.8


@pytest.mark.parametrize("name", ["ball", "torus", "magnifier", "fox"])
def test_objects_are_the_same_every_time(name):
    again = _OBJECTS[name].make(_DETAIL)
    for one, other in zip(_made(name), again, strict=True):
        assert one.vertices.tobytes() == other.vertices.tobytes()
        assert one.faces.tobytes() == other.faces.tobytes()
        assert one[4:] == other[4:]


def test_detail_makes_finer_triangles_but_walls_set_the_coarsest():
    assert spacing(1.0, thinnest=1.0) == pytest.approx(0.5 * spacing(0.5, thinnest=1.0))
    assert spacing(0.1, thinnest=0.1) < 0.12


def test_centring():
    [part] = _made("cube")
    moved = part._replace(vertices=0.3 * part.vertices + [1.0, 2.0, 3.0])
    [back] = centred([moved], 1.5)
    np.testing.assert_allclose(back.vertices, part.vertices * 1.5 / np.sqrt(3 * 0.95**2))


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
    entry = monkey.monkey(_head_with_open_eyes())
    assert (entry.name, entry.category) == ("monkey", "smncvx")
    [part] = entry.make(_DETAIL)
    assert _no_surprises([part]) == (-1,)
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
    loaded = monkey.load_suzanne(tmp_path / "made.npz")
    np.testing.assert_array_equal(loaded.vertices, mesh.vertices)
