"""A multiresolution hash grid: features of a point, interpolated from tables at many scales.

Each level covers the unit cube with `n` cells a side. A coarse level stores every grid vertex; a
fine one hashes its vertices into a table of fixed size. A level whose cells are finer than the
Gaussian being queried is faded out, which anti-aliases the field.

Source: Mueller et al., Instant NGP (2022), section 3; Barron et al., Zip-NeRF (2023), section 2,
for the down-weighting.
"""

import dataclasses
import itertools
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from refref_jax import numerics
from refref_jax.sampling.cones import Gaussians

# The primes of Instant NGP's spatial hash.
_PRIMES = (1, 2654435761, 805459861)

_CORNERS = tuple(itertools.product((0, 1), repeat=3))

_INITIAL_RANGE = 1e-4

_TABLE = "hash_table_"


@dataclasses.dataclass(frozen=True)
class HashGridConfig:
    """Shape of a hash grid.

    Attributes:
      levels: number of resolutions.
      coarsest: cells a side of the first level.
      finest: cells a side of the last; those between grow geometrically.
      entries: most entries of a level's table, a power of two.
      features: values an entry.
    """

    levels: int
    coarsest: int
    finest: int
    entries: int
    features: int

    def __post_init__(self) -> None:
        """Checks what the shapes below rely on."""
        if self.levels < 1 or self.features < 1 or not 1 <= self.coarsest <= self.finest:
            raise ValueError(
                f"A hash grid needs at least one level and feature, and 1 <= coarsest <= finest; "
                f"got {self}. Correct the field's configuration."
            )
        if self.entries < 2 or self.entries & (self.entries - 1):
            raise ValueError(
                f"A hash table has a power of two entries, not {self.entries}. Use for example "
                f"{2 ** max(1, self.entries.bit_length())}."
            )


def resolutions(config: HashGridConfig) -> list[int]:
    """Returns the cells a side of each level."""
    if config.levels == 1:
        return [config.coarsest]
    growth = (config.finest / config.coarsest) ** (1.0 / (config.levels - 1))
    return [round(config.coarsest * growth**level) for level in range(config.levels)]


def tables(params: Any) -> list[Float[Array, "_ _"]]:
    """Returns the tables of all hash grids in a tree of parameters."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return [leaf for path, leaf in leaves if _TABLE in jax.tree_util.keystr(path)]


def vertex_index(vertex: UInt32[Array, "3"], resolution: int, entries: int) -> UInt32[Array, ""]:
    """Returns the table entry of a grid vertex, `0 .. resolution` along each axis.

    Dense where every vertex has an entry of its own, hashed where not.
    """
    side = resolution + 1
    if side**3 <= entries:
        strides = jnp.array((1, side, side * side), jnp.uint32)
        return jnp.sum(vertex * strides, dtype=jnp.uint32)
    x, y, z = vertex * jnp.array(_PRIMES, jnp.uint32)
    return (x ^ y ^ z) & jnp.uint32(entries - 1)


class HashGrid(nn.Module):
    """The tables, as a linen module over one Gaussian."""

    config: HashGridConfig

    @nn.compact
    def __call__(
        self, position: Float[Array, "3"], scale: Float[Array, ""]
    ) -> Float[Array, " features"]:
        """Returns the features of a Gaussian in the unit cube.

        Args:
          position: mean, in `[0, 1]^3`.
          scale: standard deviation, as a fraction of the cube's edge.
        """
        levels = []
        for level, resolution in enumerate(resolutions(self.config)):
            size = min(self.config.entries, (resolution + 1) ** 3)
            table = self.param(f"{_TABLE}{level:02d}", _initialise, (size, self.config.features))
            levels.append(_interpolate(table, position, resolution) * fading(scale, resolution))
        return jnp.concatenate(levels)


class MultisampledGrid(nn.Module):
    """A hash grid over the multisamples of one interval: the mean of their features."""

    config: HashGridConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians) -> Float[Array, " features"]:
        """Returns the mean features of Gaussians in the unit cube."""
        every = nn.vmap(HashGrid, variable_axes={"params": None}, split_rngs={"params": False})
        features = every(self.config, name="grid")(gaussians.positions, gaussians.scales)
        return jnp.mean(features, axis=0)


def fading(scale: Float[Array, ""], resolution: int) -> Float[Array, ""]:
    """Returns how much of a level a Gaussian still sees: `erf(1 / sqrt(8 scale^2 n^2))`.

    1 for a point (`scale = 0`), falling to 0 as it outgrows the cells.
    """
    return jax.lax.erf(numerics.safe_reciprocal(math.sqrt(8.0) * resolution * scale))


def _initialise(key: Array, shape: tuple[int, int]) -> Float[Array, "entries features"]:
    return jax.random.uniform(key, shape, minval=-_INITIAL_RANGE, maxval=_INITIAL_RANGE)


def _interpolate(
    table: Float[Array, "entries features"], position: Float[Array, "3"], resolution: int
) -> Float[Array, " features"]:
    """Blends the entries at the eight corners of a point's cell (trilinear)."""
    scaled = position * resolution
    cell = jnp.clip(jnp.floor(scaled), 0, resolution - 1)
    corners = cell.astype(jnp.uint32)[None] + jnp.array(_CORNERS, jnp.uint32)
    entries = jax.vmap(lambda corner: vertex_index(corner, resolution, table.shape[0]))(corners)
    # The corners of one axis after the other, in the order of `_CORNERS`.
    x, y, z = jnp.stack([1.0 - (scaled - cell), scaled - cell], axis=1)
    weights = x[:, None, None] * y[None, :, None] * z[None, None, :]
    rows = table.at[entries].get(mode="promise_in_bounds")
    return weights.reshape(-1) @ rows
