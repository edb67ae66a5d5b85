"""The kernel of NVIDIA Warp on a CPU, through the binding that serves NVIDIA GPUs too.

Where XLA fuses no multiply-adds, hits of the kernel are those of pure JAX to the last bit.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from refref_jax import compilation
from refref_jax.geometry import bvh, bvh_build, traversal
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.path_settings import PathSettings
from tests.factories import arrays, scenes

wp = pytest.importorskip("warp", reason="Warp is not installed: pip install -e '.[warp]'")
if jax.default_backend() != "cpu":
    pytest.skip("only on a CPU are programs of XLA compared to the bit", allow_module_level=True)

_RAYS = 100_000

# Options with which XLA fuses no multiply-adds on a CPU.
_UNFUSED = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": True}

_LOCKSTEP = jax.vmap(traversal.trace_ray, in_axes=(None, None, 0, 0, 0, 0))


def _soup():
    """Returns triangles anywhere, some of which are points, lines or needles."""
    generator = np.random.default_rng(0)
    triangles = generator.uniform(-1, 1, (600, 1, 3)) + generator.normal(size=(600, 3, 3)) * 0.1
    triangles[:50] = triangles[:50, :1]
    triangles[50:100, 2] = 0.5 * (triangles[50:100, 0] + triangles[50:100, 1])
    triangles[100:150, 2] = triangles[100:150, 1] + 1e-5
    return triangles


def _torus():
    return trimesh.creation.torus(1.0, 0.4, major_sections=40, minor_sections=20).triangles


def _touching_boxes():
    """Returns two boxes that share a wall."""
    box = trimesh.creation.box(extents=(1, 1, 1)).triangles
    shift = np.array([0.5, 0.0, 0.0])
    return np.concatenate([box - shift, box + shift])


_FAR = np.array([1000.0, -2000.0, 500.0])

_SCENES = {
    "ball": lambda: trimesh.creation.icosphere(3).triangles,
    "torus": _torus,
    "box": lambda: trimesh.creation.box(extents=(1.2, 1.3, 1.4)).triangles,
    "coincident faces": lambda: np.concatenate([_torus(), _torus()]),
    "touching boxes": _touching_boxes,
    "soup, partly degenerate": _soup,
    "far from the origin": lambda: trimesh.creation.icosphere(3).triangles + _FAR,
    "one triangle": lambda: _soup()[-1:],
    "empty": lambda: np.zeros((0, 3, 3)),
}


def _rays(triangles, seed=1):
    """Returns origins, directions, limits and primitives to exclude, eight kinds in turn.

    The kinds start outside and inside; go anywhere, to corners, to edges, along an axis, leave a
    triangle of the mesh, have a limit, or are not to be cast.
    """
    generator = np.random.default_rng(seed)
    centre = triangles.reshape(-1, 3).mean(axis=0) if len(triangles) else np.zeros(3)
    kind = np.arange(_RAYS) % 8
    origins = 3.0 * arrays.unit(generator.normal(size=(_RAYS, 3)))
    inside = generator.uniform(size=_RAYS) < 0.5
    origins[inside] = generator.uniform(-0.3, 0.3, (inside.sum(), 3))
    targets = centre + generator.uniform(-1, 1, (_RAYS, 3))
    excluded = np.full(_RAYS, bvh.NO_PRIMITIVE)
    origins += centre
    if len(triangles):
        face = generator.integers(len(triangles), size=_RAYS)
        targets = np.where((kind == 1)[:, None], triangles[face, 0], targets)
        targets = np.where((kind == 2)[:, None], triangles[face, :2].mean(axis=1), targets)
        leaves = kind == 3
        origins[leaves] = triangles[face[leaves]].mean(axis=1)
        excluded[leaves] = face[leaves]
    directions = arrays.unit(targets - origins)
    axes = np.concatenate([np.eye(3), -np.eye(3)]) * np.where(generator.uniform() < 0.5, 1, -1)
    directions[kind == 4] = axes[generator.integers(6, size=(kind == 4).sum())]
    limits = np.full(_RAYS, np.inf)
    limits[kind == 5] = generator.uniform(0.0, 4.0, (kind == 5).sum())
    limits[kind == 6] = -1.0
    return origins, directions, limits, excluded


@functools.cache
def _case(name):
    """Returns the arguments of a traversal."""
    triangles = np.asarray(_SCENES[name](), np.float32)
    tree, _ = bvh_build.build(triangles)
    # Faces to leave are numbered as the tree has them.
    origins, directions, limits, excluded = _rays(np.float64(tree.triangles[: len(triangles)]))
    return (
        jnp.asarray(tree.nodes.reshape(-1, 8)),
        jnp.asarray(tree.facets),
        *arrays.singles(origins, directions, limits),
        jnp.asarray(excluded, jnp.int32),
    )


def _run(function, arguments, **options):
    # A function of its own, or JAX would take what it has compiled with other options.
    program = jax.jit(lambda *each: function(*each)).lower(*arguments)
    found = program.compile(compiler_options=options)(*arguments)
    return [np.asarray(each) for each in found]


@functools.cache
def _in_warp(name):
    return _run(traversal.trace_in_warp, _case(name))


def _is_hit(distances, primitive_ids):
    return np.isfinite(distances) & (primitive_ids != bvh.NONE)


@pytest.mark.parametrize("name", _SCENES)
def test_hits_are_those_of_pure_jax_to_the_bit_without_fused_multiply_adds(name):
    expected = _run(_LOCKSTEP, _case(name), **_UNFUSED)
    for found, wanted in zip(_in_warp(name), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.computing
@pytest.mark.parametrize("name", _SCENES)
def test_hits_are_those_of_packets_except_for_ties_within_rounding(name):
    """As users compile them, packets fuse multiply-adds."""
    arguments = _case(name)
    distances, primitive_ids = _in_warp(name)
    expected, expected_ids = _run(bvh._closest_in_packets, arguments)
    anywhere = np.isin(np.arange(_RAYS) % 8, [0, 5, 7])  # not at corners and edges
    hit = _is_hit(distances, primitive_ids)
    # A ray may be on either side of an outline, or within the tolerance of an edge but outside of
    # the box of its face, and one that leaves a face on either side of another in the same place.
    lost = hit != _is_hit(expected, expected_ids)
    assert np.sum(lost & anywhere) <= 1e-4 * _RAYS
    assert np.sum(lost) <= 5e-3 * _RAYS
    size = np.abs(np.asarray(arguments[2])).max(initial=1.0)
    both = hit & ~lost & anywhere
    np.testing.assert_allclose(distances[both], expected[both], rtol=1e-5, atol=2e-6 * size)
    assert np.sum((primitive_ids != expected_ids) & both) <= 1e-4 * _RAYS


def test_a_scene_is_hit_and_missed():
    """Or the comparisons above would compare nothing."""
    for name in set(_SCENES) - {"empty"}:
        assert 0.0005 < _is_hit(*_in_warp(name)).mean() < 0.9, name
    assert not np.any(_is_hit(*_in_warp("empty")))


@pytest.mark.parametrize("target", ["vertices", "edges"])
def test_no_ray_leaves_a_closed_surface(target):
    mesh = trimesh.creation.icosphere(5)
    edges = mesh.vertices[mesh.edges_unique].mean(axis=1)
    points = {"vertices": mesh.vertices, "edges": edges}[target]
    origins = np.random.default_rng(0).uniform(-0.2, 0.2, points.shape)
    tree, _ = bvh_build.build(np.float32(mesh.triangles))
    rays = arrays.singles(origins, arrays.unit(points - origins), np.full(len(points), np.inf))
    nothing = jnp.full(len(points), bvh.NO_PRIMITIVE, jnp.int32)
    nodes = jnp.asarray(tree.nodes.reshape(-1, 8))
    distances, _ = traversal.trace_in_warp(nodes, jnp.asarray(tree.facets), *rays, nothing)
    np.testing.assert_allclose(distances, np.linalg.norm(points - origins, axis=-1), atol=2e-5)


@pytest.fixture
def chosen(monkeypatch):
    monkeypatch.setenv(compilation.TRAVERSAL, "warp")


@functools.cache
def _ball():
    tree, _ = bvh_build.build(np.float32(trimesh.creation.icosphere(2).triangles))
    origins = 3.0 * arrays.unit(np.random.default_rng(2).normal(size=(20, 3)))
    return jax.tree.map(jnp.asarray, tree), *arrays.singles(origins, arrays.unit(-origins))


def _cast(tree, origins, directions):
    count = len(origins)
    return bvh.closest_hits(
        tree,
        Rays(origins, directions, jnp.zeros(count)),
        limits=jnp.full(count, jnp.inf),
        exclude_primitive=jnp.full(count, bvh.NO_PRIMITIVE, jnp.int32),
    ).distances


def _find(tree, origins, directions):
    limit, nothing = jnp.float32(jnp.inf), jnp.int32(bvh.NO_PRIMITIVE)
    one = lambda origin, direction: bvh.closest_primitive(tree, origin, direction, limit, nothing)
    return jax.vmap(jax.vmap(one))(origins.reshape(4, 5, 3), directions.reshape(4, 5, 3))


_CONTEXTS = {
    "not compiled": _cast,
    "jit": jax.jit(lambda *args: _cast(*args)),
    "constants": lambda *args: jax.jit(lambda: _cast(*args))(),
    "scan": jax.jit(
        lambda t, o, d: jax.lax.scan(lambda c, _: (c, _cast(t, c, d)), o, None, length=2)[1][1]
    ),
    "while": jax.jit(
        lambda t, o, d: jax.lax.while_loop(
            lambda c: c[0] < 2, lambda c: (c[0] + 1, _cast(t, o, d)), (0, jnp.zeros(20))
        )[1]
    ),
    "cond": jax.jit(
        lambda t, o, d: jax.lax.cond(o[0, 0] > -9, lambda: _cast(t, o, d), lambda: jnp.zeros(20))
    ),
    "vmap": jax.jit(lambda t, o, d: jax.vmap(lambda x: _cast(t, x, d))(jnp.stack([o, o]))[1]),
    "map": jax.jit(lambda t, o, d: jax.lax.map(lambda x: _cast(t, x, d), jnp.stack([o, o]))[1]),
    "gradient": jax.jit(
        lambda t, o, d: jax.grad(lambda x: jnp.sum(x[:, 0] * _cast(t, x, d)))(o)[
            :, 0
        ]  # d: a constant
    ),
    "remat": jax.jit(lambda t, o, d: jax.checkpoint(lambda x: _cast(t, x, d))(o)),
}


@pytest.mark.parametrize("context", _CONTEXTS)
def test_the_kernel_runs_in_any_context(chosen, context):
    tree, origins, directions = _ball()
    distances = _CONTEXTS[context](tree, origins, directions)
    nodes = tree.nodes.reshape(-1, 8)
    limits, nothing = jnp.full(20, jnp.inf), jnp.full(20, bvh.NO_PRIMITIVE, jnp.int32)
    expected, _ = _LOCKSTEP(nodes, tree.facets, origins, directions, limits, nothing)
    np.testing.assert_allclose(distances, expected, rtol=1e-6)


def test_mapped_rays_are_cast_in_one_call(chosen):
    tree, origins, directions = _ball()
    program = jax.jit(lambda *args: _find(*args)).trace(tree, origins, directions)
    assert program.lower().as_text().count("custom_call @") == 1
    found = np.asarray(_find(tree, origins, directions))
    expected = np.asarray(_ids_in_jax(tree, origins, directions)).reshape(4, 5)
    np.testing.assert_array_equal(found, expected)


def _ids_in_jax(tree, origins, directions):
    limits, nothing = jnp.full(20, jnp.inf), jnp.full(20, bvh.NO_PRIMITIVE, jnp.int32)
    return bvh._closest_in_packets(
        tree.nodes.reshape(-1, 8), tree.facets, origins, directions, limits, nothing
    )[1]


def test_light_paths_are_those_of_pure_jax(monkeypatch):
    glass = scenes.build(
        scenes.ball(1.0), scenes.ball(0.6, index=1.0, name="hollow_air"), scenes.box()
    )
    origins = 4.0 * arrays.unit(np.random.default_rng(3).normal(size=(500, 3)))
    targets = np.random.default_rng(4).uniform(-0.9, 0.9, (500, 3))
    rays = scenes.rays(origins, targets - origins)
    settings = PathSettings(max_bends=8, reflections="all", min_throughput=0.02)
    found = {}
    for choice in ("xla", "warp"):
        monkeypatch.setenv(compilation.TRAVERSAL, choice)
        trace = jax.jit(lambda glass, rays: path_tracing.trace(glass, rays, settings=settings))
        lowered = trace.lower(glass, rays)
        assert ("custom_call @_warp_walk" in lowered.as_text()) == (choice == "warp")
        found[choice] = jax.tree.map(np.asarray, lowered.compile()(glass, rays))
    paths, expected = found["warp"].paths, found["xla"].paths
    assert len(np.unique(expected.statuses)) >= 3
    np.testing.assert_array_equal(paths.statuses, expected.statuses)
    np.testing.assert_array_equal(paths.num_bends, expected.num_bends)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    jax.tree.map(close, paths, expected)


@pytest.mark.parametrize(("platform", "loops"), [("cuda", 0), ("tpu", 1)])
def test_programs_for_gpus_call_the_kernel(chosen, platform, loops):
    traced = jax.jit(lambda *args: _cast(*args)).trace(*_ball())
    text = traced.lower(lowering_platforms=(platform,)).as_text()
    assert text.count("custom_call @_warp_walk") == 1 - loops
    assert text.count("stablehlo.while") == loops


def test_the_kernel_for_gpus_computes_the_same_operations(tmp_path):
    """It is compiled without a GPU: no multiply-adds are fused, and division is exact."""
    module = traversal._warp_walk().kernel.module
    (path,) = wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    code = path.read_bytes()
    assert b"fma." not in code
    assert b"div.rn.f32" in code and b"div.approx" not in code and b"div.full" not in code


def test_rays_in_double_precision_are_refused(chosen):
    tree, origins, directions = _ball()
    with jax.enable_x64(True), pytest.raises(TypeError, match="takes rays of float32, not float64"):
        _cast(tree, jnp.float64(origins), jnp.float64(directions))
