import numpy as np
import pytest
import trimesh

from refref_jax.data.mesh_queries import diagonal, sample_surface, surface_gaps
from tests.factories.solids import as_part, ball, box, inverted

_EXACT = 1e-12


def _walls(part, other):
    return surface_gaps(sample_surface(part), sample_surface(other))


def _moved(part, shift):
    return part._replace(vertices=part.vertices + np.asarray(shift))


@pytest.mark.parametrize("size", [(1.0, 1.0, 1.0), (1.0, 2.0, 5.0)])
def test_samples_stand_for_equal_areas(size):
    part = box(size=size)
    surface = sample_surface(part)
    x, y, z = size
    on_side = np.abs(surface.points[:, 0]) > 0.5 * x - _EXACT
    assert np.mean(on_side) == pytest.approx(y * z / (x * y + y * z + z * x), abs=2e-3)
    # Evenly within a side as well: a quarter of it has a quarter of the samples.
    quarter = np.all(surface.points[on_side, 1:] > 0.0, axis=-1)
    assert np.mean(quarter) == pytest.approx(0.25, abs=0.02)


def test_faces_without_area_are_left_out():
    part = ball()
    flat = np.array([[0, 0, 1], [2, 3, 3]])
    surface = sample_surface(part._replace(faces=np.concatenate([flat, part.faces])))
    np.testing.assert_array_equal(surface.points, sample_surface(part).points)
    nothing = sample_surface(part._replace(faces=flat))
    assert nothing.points.shape == (0, 3)


def test_walls_of_boxes_by_hand():
    walls = _walls(box(), box(centre=(1.25, 0.0, 0.0)))
    facing = walls.ahead > 0.999
    assert np.mean(facing) == pytest.approx(1 / 6, abs=1e-2)
    np.testing.assert_allclose(walls.distances[facing], 0.25, atol=_EXACT)
    np.testing.assert_allclose(walls.alignment[facing], -1.0, atol=_EXACT)
    assert walls.distances.max() == pytest.approx(1.25, abs=0.02)


def test_walls_of_a_box_in_a_box_look_the_same_way():
    inner, outer = box(), box(size=(1.1, 1.1, 1.1))
    walls = _walls(inner, outer)
    np.testing.assert_allclose(walls.distances, 0.05, atol=_EXACT)
    np.testing.assert_allclose(walls.ahead, 1.0, atol=1e-6)
    np.testing.assert_allclose(walls.alignment, 1.0, atol=_EXACT)
    behind = _walls(outer, inner)
    assert np.median(behind.ahead) == pytest.approx(-1.0)
    np.testing.assert_allclose(_walls(inner, inverted(outer)).alignment, -1.0, atol=_EXACT)


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (1e4, -1e4, 1e4)])
def test_a_surface_coincides_with_itself(shift):
    part = _moved(ball(), shift)
    walls = _walls(part, part)
    np.testing.assert_allclose(walls.distances, 0.0, atol=1e-10)
    np.testing.assert_allclose(walls.alignment, 1.0, atol=1e-9)


@pytest.mark.parametrize(
    "other",
    [
        as_part(trimesh.creation.icosphere(subdivisions=3, radius=0.7), "ball_glass"),
        as_part(trimesh.creation.torus(1.0, 0.4), "torus_glass"),
        box(size=(3.0, 0.1, 2.0)),
        as_part(trimesh.creation.cylinder(0.5, 3.0, sections=64), "needles_glass"),
    ],
    ids=["ball", "torus", "plate", "cylinder"],
)
def test_distances_agree_with_a_search_over_all_triangles(other):
    generator = np.random.default_rng(0)
    part = _moved(ball(), [0.3, -0.2, 0.1])
    found = _walls(part, other).distances
    points = sample_surface(part).points
    triangles = other.vertices[other.faces]
    for sample in generator.choice(len(points), 60, replace=False):
        repeated = np.broadcast_to(points[sample], (len(triangles), 3))
        closest = trimesh.triangles.closest_point(triangles, repeated)
        expected = np.min(np.linalg.norm(closest - points[sample], axis=-1))
        assert expected - _EXACT <= found[sample] <= expected + 5e-3


def test_the_smaller_diagonal():
    assert diagonal([box(size=(1.0, 2.0, 2.0)), ball(radius=9.0)]) == pytest.approx(3.0)
