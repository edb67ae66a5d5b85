import numpy as np
import pytest

from experiments.dataset.objects.profiles import (
    filleted,
    joined,
    resampled,
    sampling,
)
from experiments.dataset.objects.regions import (
    box,
    offset,
    profiles,
    region,
    ring,
    rounded,
)
from tests.oracles.polylines import distances


def _turns(curve):
    sides = np.diff(curve, axis=0)
    return np.diff(np.unwrap(np.arctan2(sides[:, 1], sides[:, 0])))


def _bottle():
    return filleted((0, 0), (1.0, 0, 0.2), (1.0, 1.5, 0.3), (0.4, 2.0, 0.2), (0.4, 2.5), (0, 2.5))


@pytest.mark.parametrize("corner", [(1.0, 0.0), (1.3, 0.4), (0.6, -0.7), (0.2, 0.1)])
def test_a_fillet_is_an_arc_tangent_to_both_sides(corner):
    first, last, radius = np.array([0.0, 0.0]), np.array([0.9, 2.0]), 0.06
    curve = filleted(tuple(first), (*corner, radius), tuple(last))
    into, out = (way / np.linalg.norm(way) for way in (corner - first, last - corner))
    half = 0.5 * np.arccos(into @ out)
    inward = (out - into) / np.linalg.norm(out - into)
    centre = corner + radius / np.cos(half) * inward
    np.testing.assert_allclose(np.linalg.norm(curve[1:-1] - centre, axis=1), radius, rtol=1e-9)
    # Tangent: where the arc begins and ends, its radius is perpendicular to the side.
    assert (curve[1] - centre) @ into == pytest.approx(0.0, abs=1e-9)
    assert (curve[-2] - centre) @ out == pytest.approx(0.0, abs=1e-9)
    assert np.max(np.abs(_turns(curve))) <= np.radians(2.0) + 1e-9


def test_fillets_that_have_no_room_are_refused():
    with pytest.raises(ValueError, match=r"fillets at \(1, 0, 0.3\) and \(1, 0.5, 0.3\) overlap"):
        filleted((0, 0), (1, 0, 0.3), (1, 0.5, 0.3), (0, 0.5))
    filleted((0, 0), (1, 0, 0.25), (1, 0.5, 0.25), (0, 0.5))  # just fits


# Splines and arcs.


@pytest.mark.parametrize("detail", [0.3, 1.0])
def test_edges_keep_to_the_sampling_and_to_the_curve(detail):
    cut = sampling(detail)
    curve = _bottle()[:-1]  # without its one sharp corner
    points = resampled(curve, cut)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert lengths.max() <= cut.edge * (1.0 + 1e-9)
    assert np.max(np.abs(_turns(points))) <= 1.2 * cut.turn
    assert distances(points, curve).max() < 1e-9
    assert np.max(np.maximum(lengths[1:] / lengths[:-1], lengths[:-1] / lengths[1:])) < 1.7
    np.testing.assert_array_equal(points[[0, -1]], curve[[0, -1]])


@pytest.mark.parametrize("distance", [-0.06, -0.25, 0.1])
def test_an_offset_lies_at_its_distance_everywhere(distance):
    curve = _bottle()
    [found] = profiles(offset(region(curve), distance))
    whole = joined(curve, (curve * [-1.0, 1.0])[::-1])
    np.testing.assert_allclose(distances(found, whole), abs(distance), atol=2e-4)
    assert found[0, 0] == 0.0 == found[-1, 0]
    assert offset(region(curve), -1.1).is_empty()


def test_an_offset_does_not_cross_itself_where_a_neck_closes():
    [found] = profiles(offset(region(_bottle()), -0.45))  # wider than the neck's 0.4
    assert found[:, 1].max() < 1.9
    assert np.all(np.diff(np.unwrap(np.arctan2(found[:, 1] - 0.9, found[:, 0]))) > 0.0)


# Regions.


def test_rounding_gives_edges_their_radius():
    shape = rounded(box(1.0, 0.0, 2.0), convex=0.2)
    assert shape.area() == pytest.approx(4.0 - (4.0 - np.pi) * 0.04, rel=1e-4)
    notched = rounded(box(1.0, 0.0, 2.0) + box(0.3, 1.0, 3.0), concave=0.2)
    assert notched.area() == pytest.approx(4.6 + 2.0 * (1.0 - np.pi / 4.0) * 0.04, rel=1e-4)


def test_a_cavity_is_traversed_downwards_and_a_ring_ends_where_it_began():
    hollow = box(1.0, 0.0, 2.0) - box(0.5, 0.5, 1.5)
    outer, inner = profiles(hollow)
    assert outer[0, 1] < outer[-1, 1] and inner[0, 1] > inner[-1, 1]
    [loop] = profiles(ring(1.0, 0.5, 0.2))
    np.testing.assert_array_equal(loop[0], loop[-1])
    np.testing.assert_allclose(np.linalg.norm(loop - [1.0, 0.5], axis=1), 0.1, atol=1e-6)
