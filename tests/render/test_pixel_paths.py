"""The light paths of one pixel: a slab by hand, a ball against the tracer, tables and pieces."""

import dataclasses

import numpy as np
import pytest

from refref_jax.geometry.rays import Rays
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import STRAIGHT, TREE
from refref_jax.render import Model, pixel_paths
from refref_jax.render.pixel_paths import PixelPaths
from tests.factories.small_model import MODEL, initial

_SETTINGS = dataclasses.replace(TREE, max_bends=6, min_throughput=1e-3)


def _ray(origin, direction):
    direction = np.asarray(direction, np.float64)
    return Rays(np.asarray(origin), direction / np.linalg.norm(direction), np.float64(1e-3))


@pytest.fixture(scope="module")
def straight_down(slab):
    return pixel_paths.trace_pixel(
        slab, _ray((0.1, 0.2, 4.0), (0.0, 0.0, -1.0)), settings=_SETTINGS, reach=2.0
    )


def test_a_slab_seen_head_on_has_the_paths_of_a_textbook(straight_down):
    paths, r = straight_down, 0.04  # ((1.5 - 1) / (1.5 + 1))^2
    x = (0.1, 0.2)
    through, mirrored, twice = paths.polylines[:3]
    np.testing.assert_allclose(through, [[*x, 4.0], [*x, 0.5], [*x, -0.5], [*x, -2.5]], atol=1e-5)
    # Of nearly equal weight are the outer mirror's path and the one of the back wall.
    assert np.allclose(mirrored, [[*x, 4.0], [*x, 0.5], [*x, 2.5]], atol=1e-5)
    assert np.allclose(twice, [[*x, 4.0], [*x, 0.5], [*x, -0.5], [*x, 0.5], [*x, 2.5]], atol=1e-5)
    expected = [(1 - r) ** 2, r, r * (1 - r) ** 2]
    np.testing.assert_allclose(paths.throughput[:3].mean(-1), expected, rtol=0.05)
    assert paths.num_bends[:3].tolist() == [2, 1, 3]
    assert set(paths.statuses) <= {PathStatus.ESCAPED, PathStatus.OUT_OF_BENDS}
    np.testing.assert_allclose(paths.throughput.sum(0) + paths.dropped, 1.0, atol=1e-5)
    assert np.all(np.diff(paths.throughput.mean(-1)) <= 0.0)


def test_pieces_are_the_tree_with_each_segment_once(straight_down):
    pieces = pixel_paths.pieces(straight_down)
    first = np.flatnonzero(pieces.ends[:, 0, 2] == 4.0)
    assert first.size == 1 and pieces.shares[first[0]] == pytest.approx(1.0, abs=1e-5)
    keys = {piece.tobytes() for piece in pieces.ends}
    assert len(keys) == len(pieces.ends)
    # What reaches a point goes on from there: light is neither made nor lost on the way.
    for ends, share in zip(pieces.ends, pieces.shares, strict=True):
        after = [
            other
            for start, other in zip(pieces.ends[:, 0], pieces.shares, strict=True)
            if start.tobytes() == ends[1].tobytes()
        ]
        assert not after or sum(after) >= share - 1e-6
    last = [line[-2:] for line in straight_down.polylines]
    total = sum(
        pieces.shares[i]
        for i in range(len(keys))
        if any(np.array_equal(pieces.ends[i], x) for x in last)
    )
    assert total == pytest.approx(straight_down.throughput.mean(-1).sum(), abs=1e-5)


def test_a_ray_that_meets_nothing_is_one_straight_line(slab):
    paths = pixel_paths.trace_pixel(
        slab, _ray((0.0, 0.0, 4.0), (0.0, 0.0, 1.0)), settings=_SETTINGS, reach=2.0
    )
    assert paths.statuses == (PathStatus.MISSED,) and paths.num_bends.tolist() == [0]
    np.testing.assert_allclose(paths.polylines[0], [[0, 0, 4], [0, 0, 6]], atol=1e-6)
    np.testing.assert_array_equal(paths.throughput, [[1.0, 1.0, 1.0]])


def test_in_a_bounded_scene_last_segments_end_at_its_walls(slab):
    model = Model(MODEL, STRAIGHT, slab, initial(MODEL))
    paths = pixel_paths.trace_pixel(model, _ray((0.5, 0.0, 4.0), (0.0, 0.0, -1.0)))
    np.testing.assert_allclose(paths.polylines[0], [[0.5, 0, 4], [0.5, 0, -7.5]], atol=1e-5)
    assert paths.statuses == (PathStatus.NOT_TRACED,)
    # From outside, away from the walls, none is met.
    paths = pixel_paths.trace_pixel(model, _ray((0.0, 0.0, 9.0), (0.0, 0.0, 1.0)), reach=1.5)
    np.testing.assert_allclose(paths.polylines[0][-1], [0.0, 0.0, 10.5], atol=1e-5)


def test_geometry_alone_needs_a_budget(slab):
    with pytest.raises(ValueError, match="Give path settings"):
        pixel_paths.trace_pixel(slab, _ray((0, 0, 4), (0, 0, 1)))


def _made(shares):
    lines = tuple(np.array([[0, 0, 0], [0, 0, 1 + i]], np.float32) for i in range(len(shares)))
    weights = np.repeat(np.asarray(shares, np.float32)[:, None], 3, axis=1)
    statuses = (PathStatus.ESCAPED,) * (len(shares) - 1) + (PathStatus.OUT_OF_BENDS,)
    bends = np.arange(len(shares), dtype=np.int32)
    return PixelPaths(lines, weights, statuses, bends, np.full(3, 0.01, np.float32))


def test_the_table_says_number_status_and_weights():
    table = pixel_paths.describe(_made([0.8, 0.15, 0.03, 0.01]), most=3)
    assert "**4 light paths**" in table
    assert "| 1 | 80.00 % | 0.800, 0.800, 0.800 | 0 | left the objects |" in table
    assert table.count("\n| ") == 4 and "and 1 more, 1 % together" in table
    assert set(pixel_paths.ENDINGS) == set(PathStatus) - {PathStatus.EMPTY}
