"""Multiresolution hash grid: features interpolated from tables at many scales.

Each level covers the unit cube with `n` cells per side. A coarse level stores every grid vertex; a
fine level hashes its vertices into a table of fixed size. Levels whose cells are finer than the
queried Gaussian are down-weighted, which anti-aliases the field.

Source: Mueller et al., Instant NGP (2022), section 3; Barron et al., Zip-NeRF (2023), section 2,
for the down-weighting.
"""

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import Precision
from refref_jax.configuration import FORMERLY
from refref_jax.fields.hash_grid_kernels import interpolate
from refref_jax.sampling.polylines import Gaussians

_INITIAL_RANGE = 1e-4

_TABLE = "hash_table_"


@dataclasses.dataclass(frozen=True)
class HashGridConfig:
    """Shape of a hash grid.

    Attributes:
      levels: number of levels.
      base_res: base resolution, cells per side of the first level.
      max_res: finest resolution, cells per side of the last level; resolutions grow geometrically.
      hashmap_size: hash map size, the maximum number of entries per level, a power of two.
      features: number of features per entry.
    """

    levels: int
    base_res: int = dataclasses.field(metadata={FORMERLY: "coarsest"})
    max_res: int = dataclasses.field(metadata={FORMERLY: "finest"})
    hashmap_size: int = dataclasses.field(metadata={FORMERLY: "entries"})
    features: int

    def __post_init__(self) -> None:
        """Validates the shape."""
        if self.levels < 1 or self.features < 1 or not 1 <= self.base_res <= self.max_res:
            raise ValueError(
                f"A hash grid with levels={self.levels}, features={self.features}, "
                f"base_res={self.base_res} and max_res={self.max_res} is invalid. Give at least "
                "one level and one feature, and 1 <= base_res <= max_res."
            )
        if self.hashmap_size < 2 or self.hashmap_size & (self.hashmap_size - 1):
            raise ValueError(
                f"hashmap_size must be a power of two, not {self.hashmap_size}. Use for example "
                f"{2 ** max(1, self.hashmap_size.bit_length())}."
            )


def resolutions(config: HashGridConfig) -> list[int]:
    """Returns the number of cells per side of each level."""
    if config.levels == 1:
        return [config.base_res]
    growth = (config.max_res / config.base_res) ** (1.0 / (config.levels - 1))
    return [round(config.base_res * growth**level) for level in range(config.levels)]


def tables(params: Any) -> list[Float[Array, "_ _"]]:
    """Returns the tables of all hash grids in a pytree of parameters."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return [leaf for path, leaf in leaves if _TABLE in jax.tree_util.keystr(path)]


class HashGrid(nn.Module):
    """The tables of a hash grid, as a linen module that is called with one Gaussian.

    Attributes:
      config: shape of the grid.
      precision: precision in which entries are read.
    """

    config: HashGridConfig
    precision: Precision = "float32"

    @nn.compact
    def __call__(
        self, position: Float[Array, "3"], scale: Float[Array, ""]
    ) -> Float[Array, " features"]:
        """Returns the features of a Gaussian in the unit cube.

        Args:
          position: mean of the Gaussian, in `[0, 1]^3`.
          scale: standard deviation, as a fraction of the cube's edge.
        """
        levels = []
        for level, resolution in enumerate(resolutions(self.config)):
            size = min(self.config.hashmap_size, (resolution + 1) ** 3)
            table = self.param(f"{_TABLE}{level:02d}", _initialise, (size, self.config.features))
            features = interpolate(table, position, resolution=resolution, precision=self.precision)
            levels.append(features * fading(scale, resolution))
        return jnp.concatenate(levels)


class MultisampledGrid(nn.Module):
    """A hash grid over the multisamples of one interval: the mean of their features.

    Attributes:
      config: shape of the grid.
      precision: precision in which entries are read.
    """

    config: HashGridConfig
    precision: Precision = "float32"

    @nn.compact
    def __call__(self, gaussians: Gaussians) -> Float[Array, " features"]:
        """Returns the mean features of Gaussians in the unit cube."""
        every = nn.vmap(HashGrid, variable_axes={"params": None}, split_rngs={"params": False})
        features = every(self.config, self.precision, name="grid")(
            gaussians.positions, gaussians.scales
        )
        return jnp.mean(features, axis=0)


def fading(scale: Float[Array, ""], resolution: int) -> Float[Array, ""]:
    """Returns the weight of a level's features for a Gaussian: `erf(1 / sqrt(8 scale^2 n^2))`.

    The weight is 1 for a point (`scale = 0`) and tends to 0 for Gaussians larger than the cells.
    """
    return jax.lax.erf(numerics.safe_reciprocal(math.sqrt(8.0) * resolution * scale))


def _initialise(key: Array, shape: tuple[int, int]) -> Float[Array, "entries features"]:
    # Fields are in single precision, even if double precision is enabled in JAX.
    return jax.random.uniform(
        key, shape, jnp.float32, minval=-_INITIAL_RANGE, maxval=_INITIAL_RANGE
    )
