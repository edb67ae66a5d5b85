"""Claim: on a GPU, the kernel of NVIDIA Warp finds the hits of pure JAX, and no slower.

    python -m benchmarks.gpu_traversal [--rays=N,N,...] [--any_speed]

Casts rays at a ball and a torus on the default device: parallel rays in the order of an image's
pixels, and shuffled ones from around the middle in all directions. The lock-step traversal of pure
JAX and the kernel (extra `warp`) are timed in turn, each by the fastest of several calls. Both have
the same rules, but round products differently, so that a ray at an edge may hit another triangle.
Without Warp only the lock-step is timed. On a CPU, `benchmarks.traversal --warp` compares both with
packets.
"""

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import trimesh
from absl import app, flags

from experiments.accelerator.measuring import best_of
from refref_jax.geometry import bvh, bvh_build, traversal

_RAYS = flags.DEFINE_list("rays", [str(1 << n) for n in (12, 17, 20)], "Numbers of rays to cast.")
_ANY_SPEED = flags.DEFINE_bool("any_speed", False, "Assert nothing about the speed.")

# Largest share of rays with another triangle (a single ray is always allowed), and largest relative
# difference of a distance.
_MOST_HITS, _MOST_DISTANCE = 1e-4, 1e-4

_MESHES = {
    "ball 20k": lambda: trimesh.creation.icosphere(5),
    "ball 328k": lambda: trimesh.creation.icosphere(7),
    "torus 40k": lambda: trimesh.creation.torus(0.8, 0.3, major_sections=200, minor_sections=100),
}


class _Query(NamedTuple):
    """Arguments of a traversal after the tables."""

    origins: np.ndarray
    directions: np.ndarray
    limits: np.ndarray
    exclude_primitive: np.ndarray


def _query(origins: np.ndarray, directions: np.ndarray) -> _Query:
    count = len(directions)
    return _Query(
        np.float32(np.broadcast_to(origins, directions.shape)),
        np.float32(directions / np.linalg.norm(directions, axis=-1, keepdims=True)),
        np.full(count, np.inf, np.float32),
        np.full(count, bvh.NO_PRIMITIVE, np.int32),
    )


def _in_order(count: int) -> _Query:
    """Returns parallel rays, row by row."""
    side = int(np.ceil(np.sqrt(count)))
    y, x = np.divmod(np.arange(count), side)
    x, y = (2.2 * (each + 0.5) / side - 1.1 for each in (x, y))
    return _query(
        np.stack([x, y, np.full(count, 3.0)], -1), np.tile([0.02, 0.01, -1.0], (count, 1))
    )


def _shuffled(count: int) -> _Query:
    """Returns rays from a cube inside the meshes' bounds, in all directions."""
    generator = np.random.default_rng(0)
    return _query(generator.uniform(-0.5, 0.5, (count, 3)), generator.normal(size=(count, 3)))


def _lock_step(nodes: jax.Array, packed: jax.Array, *query: jax.Array) -> tuple:
    walk = jax.vmap(traversal.trace_ray, in_axes=(None, None, 0, 0, 0, 0))
    return walk(nodes, packed, *query)


def _kinds() -> dict[str, Callable]:
    """Returns the traversals that can be had."""
    kinds = {"pure JAX": jax.jit(_lock_step)}
    if importlib.util.find_spec("warp"):
        kinds["Warp"] = jax.jit(traversal.trace_in_warp)
    return kinds


def main(arguments: list[str]) -> None:
    del arguments
    kinds, wrong = _kinds(), []
    names = ",".join(f"{name} million rays/s" for name in kinds)
    print(f"device: {jax.devices()[0].device_kind}\nmesh,rays,number,{names},other triangles")
    for mesh, make in _MESHES.items():
        tree, _ = bvh_build.build(np.float32(make().triangles))
        for kind, draw in {"in order": _in_order, "shuffled": _shuffled}.items():
            for count in map(int, _RAYS.value):
                case = f"{mesh},{kind},{count}"
                wrong += _compare(case, kinds, jax.device_put((*_tables(tree), *draw(count))))
    assert not wrong, "; ".join(wrong)


def _tables(tree: bvh.BVH) -> tuple:
    return tree.nodes.reshape(-1, bvh.WORDS), tree.facets


def _compare(case: str, kinds: dict[str, Callable], arguments: tuple) -> list[str]:
    """Prints the rates of a case, and returns what is wrong with it."""
    count = arguments[2].shape[0]
    rates, found = {}, {}
    for name, trace in kinds.items():
        found[name] = jax.device_get(trace(*arguments))
        rates[name] = count / best_of(lambda trace=trace: trace(*arguments)) / 1e6
    wrong, share = [], "-"
    if "Warp" in found:
        (mine, slots), (theirs, others) = found["Warp"], found["pure JAX"]
        hit = np.isfinite(mine) & (slots == others)
        off = float(np.mean(slots != others))
        apart = float(np.max(np.abs(mine[hit] / theirs[hit] - 1.0), initial=0.0))
        share = f"{off:.2g}"
        wrong += [f"{case}: {off:.2g} other triangles"] if off > max(_MOST_HITS, 1 / count) else []
        wrong += [f"{case}: distances off by {apart:.2g}"] if apart > _MOST_DISTANCE else []
        slower = rates["Warp"] < rates["pure JAX"] and not _ANY_SPEED.value
        wrong += [f"{case}: Warp is slower"] if slower else []
    print(f"{case},{','.join(f'{rate:.4g}' for rate in rates.values())},{share}", flush=True)
    return wrong


if __name__ == "__main__":
    app.run(main)
