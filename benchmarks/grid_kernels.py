"""Claim: on a GPU, the features of a hash grid are read in a kernel without branches, and faster.

    python -m benchmarks.grid_kernels [--grids=tiny,paper,...] [--any_speed]

Times the mean features of multisamples along random chords, for the hash grids of presets, by the
library and by other ways to write the same sums. `branches` is what XLA makes of the shortest one:
a kernel that fuses the concatenation of levels, so that each level is a branch. Nothing is asserted
on a CPU.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from experiments.accelerator.measuring import best_of
from refref_jax.fields import hash_grid
from refref_jax.fields import hash_grid_kernels as kernels
from refref_jax.fields.hash_grid import HashGridConfig

_GRIDS = flags.DEFINE_list("grids", ["tiny", "proposal", "paper"], "Grids to time.")
_ANY_SPEED = flags.DEFINE_bool("any_speed", False, "Assert nothing about the speed.")


class _Case(NamedTuple):
    """A hash grid, and the numbers of paths, samples and multisamples of a step."""

    grid: HashGridConfig
    paths: int
    samples: int
    multisamples: int


_CASES = {
    "tiny": _Case(HashGridConfig(6, 16, 512, 1 << 17, 4), 1632, 20, 1),
    "proposal": _Case(HashGridConfig(8, 16, 2048, 1 << 21, 1), 6528, 64, 6),
    "paper": _Case(HashGridConfig(10, 16, 8192, 1 << 21, 4), 6528, 32, 6),
}

_barrier = jax.lax.optimization_barrier


def _stacked(table: jax.Array, positions: jax.Array, resolution: int) -> jax.Array:
    """Blends the corners' rows by a product of two arrays."""
    corners = kernels.corners(list(jnp.moveaxis(positions, -1, 0)), resolution, table.shape[0])
    entries, weights = (jnp.stack(each, axis=-1) for each in zip(*corners, strict=True))
    rows = table.at[entries].get(mode="promise_in_bounds")
    return jnp.einsum("...c,...cf->...f", weights, rows, precision=jax.lax.Precision.HIGHEST)


def _unrolled(table: jax.Array, positions: jax.Array, resolution: int) -> jax.Array:
    """Blends the corners' rows one after the other."""
    corners = kernels.corners(list(jnp.moveaxis(positions, -1, 0)), resolution, table.shape[0])
    rows = [table.at[entries].get(mode="promise_in_bounds") for entries, _ in corners]
    return sum(w[..., None] * row for (_, w), row in zip(corners, rows, strict=True))


def _library(table: jax.Array, positions: jax.Array, resolution: int) -> jax.Array:
    return kernels.interpolate(table, positions, resolution=resolution, precision="float32")


_WAYS: dict[str, Callable[..., jax.Array]] = {
    "branches": _stacked,
    "product, levels apart": lambda *x: _barrier(_stacked(*x)),
    "corners in turn, levels apart": lambda *x: _barrier(_unrolled(*x)),
    "library": _library,
}


def main(arguments: list[str]) -> None:
    del arguments
    print(f"device: {jax.devices()[0].device_kind}\ngrid,way,milliseconds")
    slow = []
    for name in _GRIDS.value:
        taken, found = {}, {}
        for way, blend in _WAYS.items():
            features = jax.jit(functools.partial(_features, blend, _CASES[name].grid))
            values = jax.device_put(_values(_CASES[name]))
            found[way] = features(*values)
            taken[way] = best_of(functools.partial(features, *values))
            print(f'{name},"{way}",{1e3 * taken[way]:.3f}', flush=True)
            np.testing.assert_allclose(found[way], found["branches"], atol=1e-5)
        slow += [name] if taken["library"] > 0.5 * taken["branches"] else []
    claimed = jax.default_backend() == "gpu" and not _ANY_SPEED.value
    assert not (claimed and "paper" in slow), "the library takes more than half of the time"


def _features(
    blend: Callable[..., jax.Array],
    grid: HashGridConfig,
    tables: list[jax.Array],
    positions: jax.Array,
    scales: jax.Array,
) -> jax.Array:
    levels = [
        blend(table, positions, n) * hash_grid.fading(scales, n)[..., None]
        for table, n in zip(tables, hash_grid.resolutions(grid), strict=True)
    ]
    return jnp.mean(jnp.concatenate(levels, axis=-1), axis=-2)


def _values(case: _Case) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Returns tables, points along chords of the unit cube, and scales."""
    rng = np.random.default_rng(0)
    shape = (case.paths, case.samples, case.multisamples)
    sizes = (min(case.grid.hashmap_size, (n + 1) ** 3) for n in hash_grid.resolutions(case.grid))
    tables = [rng.normal(size=(size, case.grid.features)).astype(np.float32) for size in sizes]
    first, last = rng.uniform(size=(2, case.paths, 1, 3))
    along = np.sort(rng.uniform(size=(case.paths, case.samples * case.multisamples, 1)), axis=1)
    points = (first + along * (last - first)).reshape(*shape, 3)
    return tables, np.float32(points), np.full(shape, 1e-3, np.float32)


if __name__ == "__main__":
    app.run(main)
