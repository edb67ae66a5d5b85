"""Multiresolution hash grid, and the small networks on its features.

Each level covers the unit cube with `n` cells per side. A coarse level stores every grid vertex; a
fine level hashes its vertices into a table of fixed size. Levels whose cells are finer than the
queried Gaussian are down-weighted, which anti-aliases the field. Several field kinds share the
networks, which must be called in a compact method of a linen module that owns their layers.

Source: Mueller et al., Instant NGP (2022), section 3; Barron et al., Zip-NeRF (2023), section 2,
for the down-weighting.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import ColourNetwork, Precision
from refref_jax.configuration import FORMERLY
from refref_jax.fields.base import (
    DensityConfig,
    RadianceConfig,
    between_layers,
    dense,
    dot_general,
    hidden_dot_general,
    hidden_layer,
)
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


TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))
"""Corners of a regular tetrahedron, whose outer products sum to 4 times the identity."""


def slope(values: Float[Array, "4"], *, step: float) -> Float[Array, "3"]:
    """Returns the gradient of a function of a grid's features, by finite differences.

    They span the boundaries of the grid's cells, where the derivative jumps, and can be
    differentiated with respect to the parameters at the cost of four values. The error is about the
    step times the second derivative.

    Args:
      values: values of the function at the corners of `TETRAHEDRON`, times the step, around a
        point.
      step: offset of each coordinate; about a cell of the finest level.
    """
    return numerics.product(values, jnp.asarray(TETRAHEDRON, values.dtype)) / (4.0 * step)


def laplacian(
    middle: Float[Array, ""], values: Float[Array, "4"], *, step: float
) -> Float[Array, ""]:
    """Returns the Laplacian of a function, by finite differences; see `slope`.

    Args:
      middle: value of the function at the point.
      values: values at the corners around it.
      step: offset of each coordinate.
    """
    return 0.5 * jnp.sum(values - middle) / (step * step)


def _initialise(key: Array, shape: tuple[int, int]) -> Float[Array, "entries features"]:
    # Fields are in single precision, even if double precision is enabled in JAX.
    return jax.random.uniform(
        key, shape, jnp.float32, minval=-_INITIAL_RANGE, maxval=_INITIAL_RANGE
    )


def spherical_harmonics(direction: Float[Array, "3"]) -> Float[Array, "16"]:
    """Returns the real spherical harmonics of degree 0 to 3 at a unit direction.

    Ordered by degree `l`, then by order `m = -l .. l`; orthonormal over the sphere; without the
    Condon-Shortley phase.

    Source: paper (arXiv 2505.05848), supplement (direction encoding); Sloan, Stupid Spherical
    Harmonics Tricks (2008), appendix A2.
    """
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    return jnp.stack(
        [
            0.28209479177387814 * jnp.ones_like(x),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3.0 * zz - 1.0),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5.0 * zz - 1.0),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            0.4570457994644658 * x * (5.0 * zz - 1.0),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3.0 * yy),
        ]
    )


@dataclasses.dataclass(frozen=True)
class GridRadianceConfig(RadianceConfig):
    """Shape of a radiance field on a hash grid.

    Attributes:
      grid: shape of the hash grid.
      density_width: width of the density network's hidden layer.
      bottleneck: number of features passed from the density network to the colour network.
      colour_width: width of the colour network's hidden layers.
      colour_depth: number of hidden layers of the colour network.
      colour_network: `skip` appends the colour network's inputs to the outputs of its first layer.
      brightest: largest linear radiance; above 1 (white) where lamps or windows shine.
    """

    grid: HashGridConfig
    density_width: int
    bottleneck: int
    colour_width: int
    colour_depth: int
    colour_network: ColourNetwork = "plain"
    brightest: float = 1.0


@dataclasses.dataclass(frozen=True)
class GridDensityConfig(DensityConfig):
    """Shape of a density field on a hash grid.

    Attributes:
      grid: shape of the hash grid.
      width: width of the hidden layer.
    """

    grid: HashGridConfig
    width: int


def nowhere() -> Gaussians:
    """Returns one point, as an example input for initialising a module."""
    return Gaussians(jnp.zeros((1, 3), jnp.float32), jnp.zeros(1, jnp.float32))


def grid_network(
    gaussians: Gaussians,
    grid: HashGridConfig,
    *,
    width: int,
    outputs: int,
    precision: Precision,
) -> Float[Array, " outputs"]:
    """Returns the output of an MLP with one hidden layer on the grid's mean features.

    Args:
      gaussians: multisamples in the unit cube.
      grid: shape of the hash grid.
      width: width of the hidden layer.
      outputs: number of outputs, without activation.
      precision: precision of tables and matrix products.
    """
    layer = dense(precision)
    features = MultisampledGrid(grid, precision)(gaussians)
    # Flax numbers layers in order of creation, and checkpoints contain these names.
    hidden = hidden_layer(precision)(width)(features)
    return layer(outputs)(hidden)


def density_and_colour(
    gaussians: Gaussians, direction: Float[Array, "3"], config: GridRadianceConfig
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Returns a density without activation, and a colour in `[0, 1]`, on the grid's mean features.

    A hidden layer gives density and bottleneck; the colour network takes the latter and the
    encoded direction. Off CPUs, the bottleneck is not formed: between it and the first layer of
    colour there is no non-linearity, so that both are one layer, whose weights are a product. What
    a step writes and reads for networks is then halved, and only rounding differs.

    Args:
      gaussians: multisamples in the unit cube.
      direction: unit direction of travel.
      config: shape of the field.
    """
    layer, between = dense(config.precision), hidden_layer(config.precision)
    features = MultisampledGrid(config.grid, config.precision)(gaussians)
    hidden = between(config.density_width)(features)
    if config.colour_network == "skip" or not config.colour_depth:
        raw = layer(1 + config.bottleneck)(hidden)
        return raw[0], colour(raw[1:], direction, config)
    encoded = spherical_harmonics(direction).astype(hidden.dtype)
    # Names are those that flax would give to layers, as checkpoints contain them.
    widths = config.bottleneck + encoded.size, config.colour_width
    layers = affine(config.precision)
    density, hidden = jax.lax.platform_dependent(
        hidden,
        encoded,
        _Weights(config.density_width, 1 + config.bottleneck, name="Dense_1")(),
        _Weights(*widths, name="Dense_2")(),
        cpu=functools.partial(in_turn, layers),
        default=functools.partial(joined, layers),
    )
    hidden = nn.relu(hidden)
    for i in range(1, config.colour_depth):
        hidden = between(config.colour_width, name=f"Dense_{2 + i}")(hidden)
    return density, jax.nn.sigmoid(layer(3, name=f"Dense_{2 + config.colour_depth}")(hidden))


class _Weights(nn.Module):
    """Kernel and bias of a dense layer of flax."""

    inputs: int
    outputs: int

    @nn.compact
    def __call__(self) -> tuple[Float[Array, "inputs outputs"], Float[Array, " outputs"]]:
        shape, kind = (self.inputs, self.outputs), jnp.float32
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape, kind)
        return kernel, self.param("bias", nn.initializers.zeros_init(), shape[1:], kind)


_Layer = tuple[Float[Array, "_ _"], Float[Array, " _"]]
"""Kernel and bias."""

_Apply = Callable[[Array, _Layer], Array]
"""Product of a vector and a kernel, plus the bias."""

_ALONG_FIRST = (((0,), (0,)), ((), ()))
"""Axes of both factors that a product sums over, as in `jax.lax.dot_general`."""


class Affine(NamedTuple):
    """What dense layers of flax do to a vector.

    Attributes:
      last: function of a vector and a layer whose result leaves the network, see `dense`.
      hidden: the same for a layer that is followed by others, see `hidden_layer`.
    """

    last: _Apply
    hidden: _Apply


def affine(precision: Precision) -> Affine:
    """Returns these functions for a precision."""

    def last(values: Array, layer: _Layer) -> Array:
        return dot_general(precision)(values, layer[0], _ALONG_FIRST, precision=None) + layer[1]

    def hidden(values: Array, layer: _Layer) -> Array:
        product = hidden_dot_general(precision)(values, layer[0], _ALONG_FIRST, precision=None)
        return (product + layer[1]).astype(between_layers(precision))

    return Affine(last, hidden)


def in_turn(
    layers: Affine,
    hidden: Float[Array, " width"],
    encoded: Float[Array, "16"],
    head: _Layer,
    first: _Layer,
) -> tuple[Float[Array, ""], Float[Array, " colour_width"]]:
    """Returns density, and outputs of the first layer of colour, both without activation.

    Args:
      layers: products of vectors and layers.
      hidden: outputs of the hidden layer of density.
      encoded: encoded direction.
      head: layer with the outputs density and bottleneck.
      first: layer of bottleneck and encoded direction.
    """
    with jax.named_scope("Dense_1"):
        raw = layers.last(hidden, head)
    with jax.named_scope("Dense_2"):
        inputs = jnp.concatenate([raw[1:].astype(encoded.dtype), encoded])
        return raw[0], layers.hidden(inputs, first)


def joined(
    layers: Affine,
    hidden: Float[Array, " width"],
    encoded: Float[Array, "16"],
    head: _Layer,
    first: _Layer,
) -> tuple[Float[Array, ""], Float[Array, " colour_width"]]:
    """Returns the same as `in_turn`, as one layer whose weights are the product of both."""
    kernel, bias = head
    bottleneck = kernel.shape[1] - 1
    with jax.named_scope("Dense_1"):
        density = layers.last(hidden, (kernel[:, :1], bias[:1]))[0]
    with jax.named_scope("Dense_2"):
        of_bottleneck, of_direction = first[0][:bottleneck], first[0][bottleneck:]
        both = numerics.product(kernel[:, 1:], of_bottleneck)
        shift = numerics.product(bias[1:], of_bottleneck) + first[1]
        inputs = jnp.concatenate([hidden, encoded])
        weights = jnp.concatenate([both, of_direction])
        return density, layers.hidden(inputs, (weights, shift))


def colour(
    bottleneck: Float[Array, " bottleneck"],
    direction: Float[Array, "3"],
    config: GridRadianceConfig,
) -> Float[Array, "3"]:
    """Returns a colour in `[0, 1]` from the bottleneck features and a unit direction."""
    return jax.nn.sigmoid(directional_network(bottleneck, direction, config, outputs=3))


def directional_network(
    bottleneck: Float[Array, " bottleneck"],
    direction: Float[Array, "3"],
    config: GridRadianceConfig,
    *,
    outputs: int,
) -> Float[Array, " outputs"]:
    """Returns the output of the colour network, without activation.

    Source: Zip-NeRF's code in PyTorch, on which the paper's is based, for the skip connection.
    """
    layer, between = dense(config.precision), hidden_layer(config.precision)
    inputs = hidden = jnp.concatenate([bottleneck, spherical_harmonics(direction)])
    for i in range(config.colour_depth):
        hidden = between(config.colour_width)(hidden)
        if i == 0 and config.colour_network == "skip":
            hidden = jnp.concatenate([hidden, inputs.astype(hidden.dtype)])
    return layer(outputs)(hidden)
