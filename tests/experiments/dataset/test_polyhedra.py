import numpy as np
import pytest
import trimesh

from experiments.dataset.objects import polyhedra, quadrics
from experiments.dataset.objects.polyhedra import cube, diamond, pyramid
from experiments.dataset.objects.quadrics import ball, cylinder, torus
from refref_jax.data.convexity import is_convex
from refref_jax.data.meshes import INDEX_OF_REFRACTION, MeshPart
from refref_jax.geometry.corner_normals import corner_normals, face_normals


def _mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def _facets(part):
    """The distinct planes of a part, as unit normals."""
    normals = face_normals(part.vertices[part.faces])
    return np.unique(np.round(normals, 9) + 0.0, axis=0)


def test_volumes_known_by_hand():
    [box], [spire] = cube(1.0), pyramid(1.0)
    edge = np.ptp(box.vertices[:, 0])
    assert _mesh(box).volume == pytest.approx(edge**3)
    base, height = np.ptp(spire.vertices[:, 0]), np.ptp(spire.vertices[:, 2])
    assert _mesh(spire).volume == pytest.approx(base**2 * height / 3.0)


def test_facets_are_planar():
    [box], [spire], [stone] = cube(1.0), pyramid(1.0), diamond(1.0)
    # 57 facets of a brilliant and 16 of its girdle, of which each lies in one plane.
    assert [len(_facets(part)) for part in (box, spire, stone)] == [6, 5, 73]
    assert not any(part.smooth for part in (box, spire, stone))


def test_the_brilliant_has_the_angles_and_shares_of_its_cut():
    [stone] = diamond(1.0)
    normals = _facets(stone)
    tilt = np.degrees(np.arccos(np.abs(normals[:, 2])))
    up, down = normals[:, 2] > 1e-6, normals[:, 2] < -1e-6
    assert np.sum(np.isclose(tilt[up], 34.5, atol=1e-6)) == 8  # the crown's main facets
    assert np.sum(np.isclose(tilt[down], 40.75, atol=1e-6)) == 8  # the pavilion's
    assert np.sum(tilt[up] == 0.0) == 1  # the table
    assert np.sum(np.isclose(normals[:, 2], 0.0, atol=1e-6)) == 16  # the girdle
    # Stars are flatter than the main facets of the crown, halves are steeper.
    assert np.sum((tilt[up] > 0.0) & (tilt[up] < 34.0)) == 8
    assert np.sum((tilt[up] > 35.0) & (tilt[up] < 60.0)) == 16
    assert np.sum((tilt[down] > 41.0) & (tilt[down] < 60.0)) == 16
    width = 2.0 * np.max(np.hypot(*stone.vertices[:, :2].T))
    top = stone.vertices[np.isclose(stone.vertices[:, 2], stone.vertices[:, 2].max())]
    assert 2.0 * np.max(np.hypot(*top[:, :2].T)) / width == pytest.approx(0.57)
    # Crown, girdle and pavilion of 14.8, 3 and 43.1 percent.
    depth = 0.215 * np.tan(np.radians(34.5)) + 0.03 + 0.5 * np.tan(np.radians(40.75))
    assert np.ptp(stone.vertices[:, 2]) / width == pytest.approx(depth)
    assert stone.material == "diamond"


@pytest.mark.parametrize("detail", [0.3, 1.0])
def test_round_bodies_have_their_volumes(detail):
    [globe], [can], [ring] = ball(detail), cylinder(detail), torus(detail)
    rel = 0.002 / detail**2
    assert _mesh(globe).volume == pytest.approx(
        4.0 / 3.0 * np.pi * quadrics.BALL_RADIUS**3, rel=rel
    )
    radius, thickness = quadrics.TORUS_RADIUS, quadrics.TORUS_THICKNESS
    assert _mesh(ring).volume == pytest.approx(2.0 * np.pi**2 * radius * thickness**2, rel=rel)
    # The fillet takes away the corner outside of a quarter circle, by Pappus.
    radius, fillet = quadrics.CYLINDER_RADIUS, quadrics.CYLINDER_FILLET
    corner, arc = fillet**2 * (1.0 - np.pi / 4.0), (10 - 3 * np.pi) / (12 - 3 * np.pi)
    lost = 2.0 * corner * 2.0 * np.pi * (radius - (1.0 - arc) * fillet)
    whole = 2.0 * np.pi * radius**2 * quadrics.CYLINDER_HALF_HEIGHT
    assert _mesh(can).volume == pytest.approx(whole - lost, rel=rel)


def test_normals_of_round_bodies():
    [globe] = ball(1.0)
    normals = corner_normals(globe.vertices, globe.faces)
    exact = globe.vertices[globe.faces] / quadrics.BALL_RADIUS
    assert np.min(np.sum(normals * exact, axis=-1)) > np.cos(np.radians(0.05))
    [can] = cylinder(1.0)
    normals = corner_normals(can.vertices, can.faces)
    corners = can.vertices[can.faces]
    cap = np.isclose(np.abs(corners[..., 2]), quadrics.CYLINDER_HALF_HEIGHT)
    inner = cap & (np.hypot(corners[..., 0], corners[..., 1]) < 0.85)
    assert np.all(np.abs(normals[inner][:, 2]) > 1.0 - 1e-12)


@pytest.mark.parametrize("entry", (*polyhedra.OBJECTS, *quadrics.OBJECTS), ids=lambda o: o.name)
def test_objects_are_convex_as_their_category_says(entry):
    for detail in (0.3, 1.0):
        [part] = entry.make(detail)
        mesh = _mesh(part)
        assert mesh.is_watertight and mesh.volume > 0.0
        index = INDEX_OF_REFRACTION[part.material]
        shading = "smooth" if part.smooth else "flat"
        body = MeshPart(part.name, part.vertices, part.faces, index, shading)
        assert is_convex(body) == (entry.category == "smcvx")
        assert 1.4 - 1e-9 <= np.max(np.linalg.norm(part.vertices, axis=-1)) < 2.0


def test_triangles_grow_with_the_square_of_detail():
    for make in (ball, torus):
        coarse, fine = (len(make(detail)[0].faces) for detail in (0.5, 1.0))
        assert fine == pytest.approx(4 * coarse, rel=0.05)
