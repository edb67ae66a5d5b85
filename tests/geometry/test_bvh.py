import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from refref_jax.geometry import bvh, bvh_build, traversal
from refref_jax.geometry.rays import Rays
from tests.factories import arrays
from tests.oracles import reference

# Distances are float32 sums of terms near 10.
_DISTANCE_TOLERANCE = 2e-5


@functools.partial(jax.jit, static_argnames="lockstep")
def _trace(tree, origins, directions, limits, exclude_primitive, *, lockstep=False):
    if lockstep:
        nodes = tree.nodes.reshape(-1, 8)
        walk = jax.vmap(traversal.trace_ray, in_axes=(None, None, 0, 0, 0, 0))
        found = walk(nodes, tree.facets, origins, directions, limits, exclude_primitive)
        return bvh._finish(tree, origins, directions, *found)
    rays = Rays(origins, directions, jnp.zeros(len(origins)))
    return bvh.closest_hits(tree, rays, limits=limits, exclude_primitive=exclude_primitive)


def _closest(
    triangles,
    origins,
    directions,
    *,
    limits=None,
    exclude_primitive=None,
    lockstep=False,
    division=None,
):
    """Builds a tree and traces rays; returns distances, faces and barycentrics."""
    tree, slots = bvh_build.build(np.asarray(triangles, np.float32), division=division)
    count = len(origins)
    limits = np.full(count, np.inf) if limits is None else limits
    exclude_primitive = (
        np.full(count, bvh.NO_PRIMITIVE) if exclude_primitive is None else exclude_primitive
    )
    hits = _trace(
        jax.tree.map(jnp.asarray, tree),
        jnp.asarray(origins, jnp.float32),
        jnp.asarray(directions, jnp.float32),
        jnp.asarray(limits, jnp.float32),
        jnp.asarray(exclude_primitive, jnp.int32),
        lockstep=lockstep,
    )
    found = np.asarray(hits.primitive_ids)
    faces = np.where(found >= 0, slots[found], -1)
    return np.asarray(hits.distances), faces, np.asarray(hits.barycentrics)


def _soup(count, seed=0):
    generator = np.random.default_rng(seed)
    centres = generator.uniform(-1, 1, (count, 1, 3))
    return centres + generator.normal(size=(count, 3, 3)) * 0.1


def _random_rays(count, seed=1, reach=3.0):
    generator = np.random.default_rng(seed)
    origins = reach * arrays.unit(generator.normal(size=(count, 3)))
    return origins, arrays.unit(generator.uniform(-1, 1, (count, 3)) - origins)


@pytest.mark.slow
@pytest.mark.parametrize("moved", [0.01, 3.0])
def test_a_tree_divided_like_that_of_other_places_has_the_same_hits(moved):
    triangles, (origins, directions) = _soup(400), _random_rays(200)
    shifts = moved * np.random.default_rng(3).normal(size=(400, 1, 3))
    division = bvh_build.divide(np.float32(triangles + shifts))
    own = _closest(triangles, origins, directions)
    found = _closest(triangles, origins, directions, division=division)
    assert np.any(np.isfinite(own[0]))
    for each, expected in zip(found, own, strict=True):
        np.testing.assert_array_equal(each, expected)


def test_the_division_of_another_number_of_faces_is_refused():
    with pytest.raises(ValueError, match="division has 39 faces, the mesh 40"):
        bvh_build.build(np.float32(_soup(40)), division=bvh_build.divide(np.float32(_soup(39))))


@pytest.mark.parametrize(
    "faces", [1, *(pytest.param(few, marks=pytest.mark.slow) for few in (2, 5)), 40, 400]
)
def test_hits_of_random_rays_equal_brute_force(faces):
    triangles = _soup(faces)
    origins, directions = _random_rays(200)
    distances, found, _ = _closest(triangles, origins, directions)
    expected, expected_faces = reference.hits_by_brute_force(triangles, origins, directions)
    # Rays within the edge tolerance of an open edge may differ: a tiny share of a soup's.
    agree = np.isfinite(distances) == np.isfinite(expected)
    assert agree.mean() >= 0.995
    both = np.isfinite(distances) & np.isfinite(expected)
    np.testing.assert_array_equal(found[both], expected_faces[both])
    np.testing.assert_allclose(distances[both], expected[both], atol=_DISTANCE_TOLERANCE)


@pytest.mark.parametrize("kind", ["inside", "outside"])
def test_axis_aligned_rays_against_a_box_are_exact(kind):
    mesh = trimesh.creation.box(extents=(2, 2, 2))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    start = np.array([0.3, -0.2, 0.1])
    origins = np.broadcast_to(start, (6, 3)) if kind == "inside" else start - 4.0 * axes
    distances, _, _ = _closest(mesh.triangles, origins, axes)
    along = np.sum(axes * origins, axis=-1)
    expected = 1.0 - along if kind == "inside" else -1.0 - along
    np.testing.assert_allclose(distances, expected, rtol=1e-6)


def test_a_ray_in_the_plane_of_a_triangle_misses():
    triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
    origins = np.stack([np.full(200, -1.0), np.linspace(-0.1, 1.1, 200), np.zeros(200)], axis=-1)
    distances, faces, _ = _closest(triangle, origins, np.tile([1.0, 0.0, 0.0], (200, 1)))
    assert np.all(distances == np.inf)
    assert np.all(faces == -1)


@pytest.mark.parametrize("target", ["vertices", "edges", "faces"])
@pytest.mark.parametrize("subdivisions", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_no_ray_slips_through_a_closed_surface(target, subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    points = {
        "vertices": mesh.vertices,
        "edges": mesh.vertices[mesh.edges_unique].mean(axis=1),
        "faces": mesh.triangles_center,
    }[target]
    points = np.resize(points, (1920, 3))  # as many as the edges of the finer one
    generator = np.random.default_rng(0)
    origins = generator.uniform(-0.2, 0.2, points.shape)
    directions = arrays.unit(points - origins)
    distances, _, _ = _closest(mesh.triangles, origins, directions)
    expected = np.linalg.norm(points - origins, axis=-1)
    np.testing.assert_allclose(distances, expected, atol=_DISTANCE_TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 15, 16, 17, 100])
def test_packets_and_lockstep_give_the_same_hits(count):
    triangles = _soup(60)
    origins, directions = _random_rays(count)
    packets = _closest(triangles, origins, directions)
    lockstep = _closest(triangles, origins, directions, lockstep=True)
    np.testing.assert_array_equal(packets[1], lockstep[1])
    # Multiply-adds are fused differently: the last places differ.
    np.testing.assert_allclose(packets[0], lockstep[0], rtol=2e-6)
    np.testing.assert_allclose(packets[2], lockstep[2], atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("faces", [0, 1, 12, 300, 1500])
@pytest.mark.parametrize("lockstep", [False, True])
def test_spare_rows_change_no_hit(faces, lockstep):
    tree, slots = bvh_build.build(_soup(faces).astype(np.float32))
    filled = bvh_build.filled_up(tree)
    sizes = [(each.nodes.shape[1], len(each.facets)) for each in (tree, filled)]
    for plain, round_number in zip(*sizes, strict=True):
        assert round_number == plain + bvh_build.spare_rows(plain)
        assert bvh_build.spare_rows(round_number) == 0
    np.testing.assert_array_equal(filled.triangles[: len(slots)], tree.triangles)
    origins, directions = _random_rays(200)
    nothing = np.full(200, np.inf, np.float32), np.full(200, bvh.NO_PRIMITIVE, np.int32)
    rays = [x.astype(np.float32) for x in (origins, directions)]
    plain, spare = (_trace(each, *rays, *nothing, lockstep=lockstep) for each in (tree, filled))
    jax.tree.map(np.testing.assert_array_equal, plain, spare)
    assert faces < 300 or np.any(np.isfinite(plain.distances))


@pytest.mark.parametrize("faces", [1, 300])
def test_the_spare_rows_of_a_tree_lead_to_its_end(faces):
    """Else a walk that ends at the last row would never come to it."""
    nodes = bvh_build.filled_up(bvh_build.build(np.float32(_soup(faces)))[0]).nodes
    rows = np.arange(nodes[..., 6].size).reshape(nodes.shape[:2])
    last = np.broadcast_to(rows[:, -1:], rows.shape)
    spare = nodes[..., 7] < 0
    assert spare.sum(axis=1).min() > 1
    np.testing.assert_array_equal(nodes[..., 6][spare], last[spare])
    # All others lead onwards, within their table.
    assert np.all(nodes[..., 6][~spare] > rows[~spare])
    assert np.all(nodes[..., 6][~spare] <= last[~spare])


@pytest.mark.parametrize(
    "rows, spare", [(1, 4095), (4096, 0), (4097, 126_975), (131_072, 0), (131_073, 131_071)]
)
def test_tables_are_filled_up_to_few_sizes(rows, spare):
    assert bvh_build.spare_rows(rows) == spare


def test_meshes_of_similar_size_have_trees_of_the_same_shape():
    sizes = {
        jax.tree.map(np.shape, bvh_build.filled_up(bvh_build.build(np.float32(_soup(n)))[0]))
        for n in (1290, 1300, 1310)
    }
    assert len(sizes) == 1


def test_an_empty_scene_is_missed():
    distances, faces, _ = _closest(np.zeros((0, 3, 3)), *_random_rays(200))
    assert np.all(distances == np.inf)
    assert np.all(faces == -1)


def test_degenerate_and_duplicate_triangles_do_no_harm():
    triangles = _soup(40)
    point = np.repeat(triangles[:5, :1], 3, axis=1)
    line = triangles[5:10].copy()
    line[:, 2] = 0.5 * (line[:, 0] + line[:, 1])
    origins, directions = _random_rays(200)
    clean, _, _ = _closest(triangles, origins, directions)
    soiled, _, _ = _closest(
        np.concatenate([triangles, point, line, triangles]), origins, directions
    )
    np.testing.assert_array_equal(soiled, clean)


def test_triangles_in_one_place_still_make_a_tree():
    triangles = np.repeat(_soup(1), 50, axis=0)
    tree, _ = bvh_build.build(triangles.astype(np.float32))
    starts = np.sort(tree.nodes[0, :-1, 7])
    counts = np.diff(np.append(starts[starts > 0], 51))
    assert counts.sum() == 50
    assert counts.max() <= bvh.LEAF_SIZE


def test_hits_beyond_the_limit_do_not_count():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    origins, directions = _random_rays(200)
    free, _, _ = _closest(mesh.triangles, origins, directions)
    limits = np.where(np.arange(200) % 2, 2.2, -1.0)
    limited, _, _ = _closest(mesh.triangles, origins, directions, limits=limits)
    np.testing.assert_array_equal(limited, np.where(free <= limits, free, np.inf))


def test_a_ray_does_not_hit_the_triangle_it_leaves():
    triangles = np.array([[[0, -1, -1], [0, 1, -1], [0, 0, 1]]], float)
    triangles = np.concatenate([triangles, triangles + np.array([1.0, 0.0, 0.0])])
    _, slots = bvh_build.build(triangles.astype(np.float32))
    first = int(np.flatnonzero(slots[:2] == 0)[0])
    distances, faces, _ = _closest(
        triangles,
        np.tile([-1e-7, 0.0, 0.0], (200, 1)),
        np.tile([1.0, 0.0, 0.0], (200, 1)),
        exclude_primitive=np.full(200, first),
    )
    assert np.all(faces == 1)
    np.testing.assert_allclose(distances, 1.0, atol=1e-6)


def test_barycentrics_give_back_the_hit_point():
    triangles = _soup(40)
    origins, directions = _random_rays(200)
    distances, faces, barycentrics = _closest(triangles, origins, directions)
    hit = faces >= 0
    u, v = barycentrics[hit].T[..., None]
    a, b, c = np.moveaxis(triangles[faces[hit]], 1, 0)
    points = (1 - u - v) * a + u * b + v * c
    expected = origins[hit] + distances[hit, None] * directions[hit]
    np.testing.assert_allclose(points, expected, atol=1e-5)


@pytest.mark.parametrize("faces", [1, 4, 5, 33, 500])
def test_the_tree_holds_every_face_once_and_bounds_it(faces):
    triangles = _soup(faces).astype(np.float32)
    tree, slots = bvh_build.build(triangles)
    np.testing.assert_array_equal(np.sort(slots[:faces]), np.arange(faces))
    for octant, table in enumerate(tree.nodes):
        rows = table[:-1]
        skips, leaves = rows[:, 6] - octant * len(table), rows[:, 7]
        starts = np.sort(leaves[leaves > 0] - 1)
        counts = np.diff(np.append(starts, faces))
        assert starts[0] == 0
        assert counts.min() >= 1 and counts.max() <= bvh.LEAF_SIZE
        corners = rows[:, :6].copy().view(np.float32).reshape(-1, 2, 3)
        held = dict(zip(starts, counts, strict=True))
        for node, (entry, exit) in enumerate(corners):
            below = leaves[node : skips[node]]
            runs = [np.arange(s, s + held[s]) for s in below[below > 0] - 1]
            points = tree.triangles[np.concatenate(runs)].reshape(-1, 3)
            lower, upper = np.minimum(entry, exit), np.maximum(entry, exit)
            assert np.all(lower < points.min(axis=0)) and np.all(points.max(axis=0) < upper)
            np.testing.assert_allclose([lower, upper], [points.min(0), points.max(0)], atol=1e-6)
            assert (leaves[node] > 0) == (skips[node] == node + 1)
        assert table[-1, 7] == -1


def _cheapest_split(lower, upper):
    """Returns the least cost of a split along one axis, of boxes in their order, by brute force."""

    def cost(part):
        x, y, z = upper[part].max(axis=0) - lower[part].min(axis=0)
        return (x * y + y * z + z * x) * -(-len(part) // bvh.LEAF_SIZE)

    count = len(lower)
    costs = [cost(range(n)) + cost(range(n, count)) for n in range(1, count)]
    at_least = np.flatnonzero(np.array(costs) <= min(costs) * (1 + 1e-9)) + 1
    return min(costs), at_least[np.argmin(np.abs(2 * at_least - count))]


# Nodes of one column and of several, of one size and of many.
@pytest.mark.parametrize("counts", [[2], [8, 9, 5], [300], [7, 200, 64, 2, 65, 500], [6] * 40])
def test_every_split_is_the_cheapest(counts):
    generator = np.random.default_rng(sum(counts))
    lower = generator.uniform(-1, 1, (sum(counts), 3)).astype(np.float32)
    upper = lower + generator.uniform(0, 0.3, lower.shape).astype(np.float32)
    node = np.repeat(np.arange(len(counts)), counts)
    orders = [np.lexsort((along, node)) for along in (lower + upper).T]
    reach = np.ascontiguousarray(np.concatenate([upper, -lower], axis=1).T)
    left, axis = bvh_build.best_splits(orders, np.array(counts), reach)
    for index, (chosen, place) in enumerate(zip(axis, left, strict=True)):
        ordered = [order[node[order] == index] for order in orders]
        exact = [(lower[each].astype(float), upper[each].astype(float)) for each in ordered]
        found = [_cheapest_split(*boxes) for boxes in exact]
        assert chosen == np.argmin([cost for cost, _ in found])
        assert place == found[chosen][1]


def test_a_coordinate_that_is_not_finite_is_an_error():
    triangles = _soup(3)
    triangles[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        bvh_build.build(triangles)


def test_only_the_traversal_of_the_platform_is_traced(monkeypatch):
    monkeypatch.setattr(traversal, "trace_ray", lambda *_: pytest.fail("the other one"))
    tree, _ = bvh_build.build(np.asarray(_soup(3), np.float32))
    rays = [jnp.ones((7, 3)), jnp.ones((7, 3)), jnp.ones(7), jnp.ones(7, jnp.int32)]
    program = _trace.trace(jax.tree.map(jnp.asarray, tree), *rays)
    program.lower(lowering_platforms=("cpu",))
    with pytest.raises(pytest.fail.Exception):
        program.lower(lowering_platforms=("cuda",))


def test_the_traversal_is_compiled_as_one_native_loop_on_cpu():
    if jax.default_backend() != "cpu":
        pytest.skip("the native loop is for the CPU")
    tree, _ = bvh_build.build(_soup(10).astype(np.float32))
    rays = (jnp.zeros((32, 3)), jnp.ones((32, 3)), jnp.ones(32), jnp.zeros(32, jnp.int32))
    text = _trace.lower(jax.tree.map(jnp.asarray, tree), *rays).compile().as_text()
    assert 'xla_cpu_small_call="true"' in text, f"JAX {jax.__version__} drops the mark"
