"""Claim: on one core, rays are traced at Embree's speed, or 0.8 of it if they are shuffled.

    taskset -c 0 python -m benchmarks.traversal [--rounds=N] [--meshes=NAME,...] [--any_speed]

Single rays of Embree (`rtcIntersect1`, through embreex) are compared with packets in XLA, in turn
and in one process, each by the median CPU time of its rounds, 262,144 rays at once: with fewer,
shuffled rays have less similar neighbours and are slower. Camera rays come in tiles of 4 x 4 pixels
and must reach 0.9 of Embree's rate up to 100k triangles and 0.65 above. Shuffled rays that start
anywhere inside the object, in any direction, must reach 0.8, including the time to sort them. The
hits are compared as well. The tree of a mesh must be built in 5 seconds of CPU time per million
triangles; the least of three builds counts. Mitsuba's distance render (`scalar_rgb`) is shown next
to them if it is installed. All must run on one core, which the caller has to ensure; a core shared
with other processes slows wide arithmetic more than it slows Embree.

With `--any_speed` the table is printed and only the hits are asserted.

With `--warp` the same rays are traced by the kernel of NVIDIA Warp (`REFREF_TRAVERSAL=warp`), which
traces one after the other on a CPU, and in lock-step, as pure JAX does on a GPU. The claim is then
that the kernel finds the hits of the packets, except for ties within rounding, and has at least a
quarter of their speed and three times that of the lock-step. Its rays are not sorted.
"""

import functools
import importlib.util
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from absl import app, flags
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from benchmarks import ray_sorting
from refref_jax.geometry import bvh, bvh_build, traversal
from refref_jax.geometry.rays import Rays

_ROUNDS = flags.DEFINE_integer("rounds", 15, "Timed repeats of every case.")
_MESHES = flags.DEFINE_list("meshes", [], "Meshes to trace; all by default.")
_ANY_SPEED = flags.DEFINE_bool("any_speed", False, "Assert nothing about the speed.")

_WARP = flags.DEFINE_bool("warp", False, "Compare packets with Warp and the lock-step instead.")

_SIDE = 512
_COUNT = _SIDE * _SIDE

# The camera: its position, and half the width of its image at unit distance.
_EYE = np.array([2.2, 1.6, 2.0])
_HALF_WIDTH = 0.42

_CAMERA_LIMIT = 0.9
_LARGE_CAMERA_LIMIT = 0.65
_LARGE = 150_000
_SHUFFLED_LIMIT = 0.8

# Seconds of CPU time to build the tree of a mesh, per triangle and for any mesh.
_BUILD_LIMIT = 5e-6
_BUILD_OF_FEW = 0.03

_WARP_LIMIT = 0.25
_LOCKSTEP_LIMIT = 3.0


class _Case(NamedTuple):
    """Rays, the function that traces them, and the least ratio to Embree's rate."""

    name: str
    rays: Rays
    trace: Callable
    limit: float


def _jar() -> np.ndarray:
    """Returns a thick-walled surface of revolution with 103k triangles."""
    height = np.linspace(0.0, 1.0, 201)
    radius = 0.7 + 0.15 * np.sin(3.0 * height)
    outer = np.stack([radius, 2.0 * height - 1.0], axis=1)
    inner = np.stack([radius - 0.08, np.maximum(2.0 * height - 1.0, -0.92)], axis=1)[::-1]
    profile = np.concatenate([[[0.0, -1.0]], outer, inner, [[0.0, -0.92]]])
    return trimesh.creation.revolve(profile, sections=128).triangles


def _torus() -> np.ndarray:
    return trimesh.creation.torus(1.0, 0.4, major_sections=200, minor_sections=100).triangles


_ALL = {
    "ball 1k": lambda: trimesh.creation.icosphere(3).triangles,
    "ball 20k": lambda: trimesh.creation.icosphere(5).triangles,
    "torus 40k": _torus,
    "ball 82k": lambda: trimesh.creation.icosphere(6).triangles,
    "jar 103k": _jar,
    "ball 328k": lambda: trimesh.creation.icosphere(7).triangles,
}


def _rays(origins: np.ndarray, directions: np.ndarray) -> Rays:
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = np.broadcast_to(origins, directions.shape)
    return Rays(
        origins.astype(np.float32), directions.astype(np.float32), np.zeros(_COUNT, np.float32)
    )


def _camera_rays() -> Rays:
    """Returns the rays of an image, in tiles of 4 x 4 pixels."""
    tiles = np.arange(_COUNT).reshape(_SIDE // 4, 4, _SIDE // 4, 4).swapaxes(1, 2).ravel()
    y, x = np.divmod(tiles, _SIDE)
    ahead = -_EYE / np.linalg.norm(_EYE)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    plane = _HALF_WIDTH * (2.0 * (np.stack([x, y], axis=-1) + 0.5) / _SIDE - 1.0)
    directions = ahead + plane[:, :1] * right + plane[:, 1:] * np.cross(right, ahead)
    return _rays(_EYE, directions)


def _inner_rays(triangles: np.ndarray, scene: EmbreeScene) -> Rays:
    """Returns rays from random points inside the object in random directions."""
    generator = np.random.default_rng(0)
    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inside = np.zeros((0, 3), np.float32)
    probe = np.tile(np.array([[0.3, 0.5, 0.81]], np.float32), (_COUNT, 1))
    while len(inside) < _COUNT:
        points = generator.uniform(lower, upper, (_COUNT, 3)).astype(np.float32)
        face = scene.run(points, probe)
        leaves = (face >= 0) & (np.sum(normals[face] * probe, axis=-1) > 0.0)
        inside = np.concatenate([inside, points[leaves]])
    return _rays(inside[:_COUNT], generator.normal(size=(_COUNT, 3)))


def _mitsuba_rate(triangles: np.ndarray) -> float:
    """Returns the rate at which Mitsuba renders distances, one ray per pixel."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    mesh = mitsuba.Mesh("mesh", vertex_count=3 * len(triangles), face_count=len(triangles))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = triangles.astype(np.float32).ravel()
    parameters["faces"] = np.arange(3 * len(triangles), dtype=np.uint32)
    parameters.update()
    view = mitsuba.ScalarTransform4f().look_at(_EYE.tolist(), [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": _SIDE, "height": _SIDE, "rfilter": {"type": "box"}}
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            "mesh": mesh,
            "integrator": {"type": "depth"},
            "sensor": {
                "type": "perspective",
                "to_world": view,
                "fov": float(2.0 * np.degrees(np.arctan(_HALF_WIDTH))),
                "film": film,
                "sampler": {"type": "independent", "sample_count": 1},
            },
        }
    )
    rounds = [_seconds(lambda: np.asarray(mitsuba.render(scene))) for _ in range(_ROUNDS.value)]
    return _COUNT / float(np.median(rounds))


def _seconds(function: Callable, *arguments: object) -> float:
    begin = time.process_time()
    jax.block_until_ready(function(*arguments))
    return time.process_time() - begin


def _compare(hits: bvh.Hits, theirs: dict) -> None:
    """Asserts that the hits equal Embree's, except for rays that graze an edge."""
    expected = np.where(theirs["primID"] >= 0, theirs["tfar"], np.inf)
    distances = np.asarray(hits.distances)
    met = np.isfinite(distances) & np.isfinite(expected)
    assert np.mean(np.isfinite(distances) != np.isfinite(expected)) <= 1e-4
    assert np.mean(np.abs(distances[met] - expected[met]) > 1e-4) <= 1e-4


def _measure(case: _Case, tree: bvh.BVH, scene: EmbreeScene) -> tuple[float, float]:
    """Returns seconds for all rays, ours and Embree's."""
    limits, exclude_primitive = _no_bounds()
    rays = jax.tree.map(jnp.asarray, case.rays)

    def theirs() -> dict:
        return scene.run(case.rays.origins, case.rays.directions, output=1)

    def ours() -> bvh.Hits:
        return case.trace(tree, rays, limits=limits, exclude_primitive=exclude_primitive)

    _compare(ours(), theirs())
    pairs = [(_seconds(ours), _seconds(theirs)) for _ in range(_ROUNDS.value)]
    mine, embree = np.median(pairs, axis=0)
    return mine, embree


def _lockstep(tree: bvh.BVH, rays: Rays) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(traversal.trace_ray, in_axes=(None, None, 0, 0, 0, 0))(*_of(tree, rays))


def _in_warp(tree: bvh.BVH, rays: Rays) -> tuple[jax.Array, jax.Array]:
    return traversal.trace_in_warp(*_of(tree, rays))


def _of(tree: bvh.BVH, rays: Rays) -> tuple[jax.Array, ...]:
    """Returns the arguments of a traversal."""
    nodes = tree.nodes.reshape(-1, bvh.WORDS)
    return nodes, tree.facets, rays.origins, rays.directions, *_no_bounds()


def _no_bounds() -> tuple[jax.Array, jax.Array]:
    """Returns limits, and primitives to exclude."""
    return jnp.full(_COUNT, jnp.inf), jnp.full(_COUNT, bvh.NO_PRIMITIVE, jnp.int32)


def _compare_with_warp() -> None:
    """Prints rates of packets, of the kernel and of the lock-step, and asserts the claim."""
    warp, lockstep = jax.jit(_in_warp), jax.jit(_lockstep)
    limits, exclude_primitive = _no_bounds()
    print("mesh        rays      packets    Warp  lock-step  Warp/packets  Warp/lock-step  slots")
    missed = []
    for name in _MESHES.value or _ALL:
        triangles = _ALL[name]().astype(np.float32)
        tree = jax.tree.map(jnp.asarray, bvh_build.build(triangles)[0])
        for case in _cases(triangles, _embree(triangles)):
            rays = jax.tree.map(jnp.asarray, case.rays)
            packets = functools.partial(
                case.trace, tree, rays, limits=limits, exclude_primitive=exclude_primitive
            )
            runs = (
                packets,
                functools.partial(warp, tree, rays),
                functools.partial(lockstep, tree, rays),
            )
            other = _different_slots(*(jax.block_until_ready(run()) for run in runs[:2]))
            runs[2]()
            seconds = [[_seconds(run) for run in runs] for _ in range(_ROUNDS.value)]
            mine, theirs, slow = np.median(seconds, axis=0)
            rates = " ".join(f"{_COUNT / each / 1e6:9.2f}" for each in (mine, theirs, slow))
            ratios = f"{mine / theirs:9.2f} {slow / theirs:14.1f}"
            print(f"{name:11s} {case.name:8s} {rates} {ratios} {other:9d}")
            if mine < _WARP_LIMIT * theirs or slow < _LOCKSTEP_LIMIT * theirs:
                missed.append(f"{name}, {case.name}")
    assert _ANY_SPEED.value or not missed, f"Warp is too slow: {'; '.join(missed)}"


def _different_slots(hits: bvh.Hits, found: tuple[jax.Array, jax.Array]) -> int:
    """Asserts that hits are the same except for ties within rounding, and returns their number."""
    distances, primitive_ids = np.asarray(hits.distances), np.asarray(hits.primitive_ids)
    theirs, slots = map(np.asarray, found)
    hit = np.isfinite(distances)
    assert np.mean(hit != np.isfinite(theirs)) <= 1e-5
    both = hit & np.isfinite(theirs)
    np.testing.assert_allclose(theirs[both], distances[both], rtol=1e-4, atol=1e-5)
    different = int(np.sum(slots[both] != primitive_ids[both]))
    assert different <= 1e-4 * _COUNT
    return different


def _embree(triangles: np.ndarray) -> EmbreeScene:
    scene = EmbreeScene()
    TriangleMesh(scene, triangles)
    return scene


def _cases(triangles: np.ndarray, scene: EmbreeScene) -> tuple[_Case, _Case]:
    plain, sorted_first = jax.jit(bvh.closest_hits), jax.jit(ray_sorting.closest_hits_sorted)
    camera = _LARGE_CAMERA_LIMIT if len(triangles) > _LARGE else _CAMERA_LIMIT
    shuffled = _inner_rays(triangles, scene)
    return (
        _Case("camera", _camera_rays(), plain, camera),
        _Case("shuffled", shuffled, sorted_first, _SHUFFLED_LIMIT),
    )


def main(arguments: list[str]) -> None:
    del arguments
    if _WARP.value:
        return _compare_with_warp()
    if importlib.util.find_spec("mitsuba") is None:
        print("Mitsuba is not installed and is omitted. `pip install mitsuba` adds it.")
    print("mesh        build s  rays      Mrays/s  Embree  ratio  bound")
    missed = []
    for name in _MESHES.value or _ALL:
        triangles = _ALL[name]().astype(np.float32)
        tree = jax.tree.map(jnp.asarray, bvh_build.build(triangles)[0])
        build = min(_seconds(bvh_build.build, triangles) for _ in range(3))
        if build > _BUILD_LIMIT * len(triangles) + _BUILD_OF_FEW:
            missed.append(f"{name}: its tree took {build:.2f} s")
        scene = _embree(triangles)
        for case in _cases(triangles, scene):
            mine, embree = _measure(case, tree, scene)
            ratio = embree / mine
            rates = f"{_COUNT / mine / 1e6:7.2f} {_COUNT / embree / 1e6:7.2f}"
            print(f"{name:11s} {build:7.2f}  {case.name:8s} {rates} {ratio:6.2f} {case.limit:6.2f}")
            if ratio < case.limit:
                missed.append(f"{name}, {case.name}: {ratio:.2f} of Embree, below {case.limit}")
        if importlib.util.find_spec("mitsuba") is not None:
            print(f"{name:11s}          camera   {_mitsuba_rate(triangles) / 1e6:7.2f}  (Mitsuba)")
    assert _ANY_SPEED.value or not missed, "; ".join(missed)


if __name__ == "__main__":
    app.run(main)
