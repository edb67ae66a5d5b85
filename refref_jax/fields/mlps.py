"""MLPs on hash grid features, and encodings of directions, shared by several field kinds.

The network functions must be called in a compact method of a linen module, which owns their layers.
"""

import dataclasses
import functools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import ColourNetwork, Precision
from refref_jax.fields.base import DensityConfig, RadianceConfig, dense, dot_general
from refref_jax.fields.hash_grid import HashGridConfig, MultisampledGrid
from refref_jax.sampling.polylines import Gaussians


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
    """

    grid: HashGridConfig
    density_width: int
    bottleneck: int
    colour_width: int
    colour_depth: int
    colour_network: ColourNetwork = "plain"


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
    hidden = nn.relu(layer(width)(features))
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
    layer = dense(config.precision)
    features = MultisampledGrid(config.grid, config.precision)(gaussians)
    hidden = nn.relu(layer(config.density_width)(features))
    if config.colour_network == "skip" or not config.colour_depth:
        raw = layer(1 + config.bottleneck)(hidden)
        return raw[0], _colour(raw[1:], direction, config)
    encoded = spherical_harmonics(direction)
    # Names are those that flax would give to layers, as checkpoints contain them.
    widths = config.bottleneck + encoded.size, config.colour_width
    multiply = multiplied_by(config.precision)
    density, hidden = jax.lax.platform_dependent(
        hidden,
        encoded,
        _Weights(config.density_width, 1 + config.bottleneck, name="Dense_1")(),
        _Weights(*widths, name="Dense_2")(),
        cpu=functools.partial(in_turn, multiply),
        default=functools.partial(joined, multiply),
    )
    hidden = nn.relu(hidden)
    for i in range(1, config.colour_depth):
        hidden = nn.relu(layer(config.colour_width, name=f"Dense_{2 + i}")(hidden))
    return density, jax.nn.sigmoid(layer(3, name=f"Dense_{2 + config.colour_depth}")(hidden))


class _Weights(nn.Module):
    """Kernel and bias of a dense layer of flax."""

    inputs: int
    outputs: int

    @nn.compact
    def __call__(self) -> tuple[Float[Array, "inputs outputs"], Float[Array, " outputs"]]:
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (self.inputs, self.outputs))
        return kernel, self.param("bias", nn.initializers.zeros_init(), (self.outputs,))


_Layer = tuple[Float[Array, "_ _"], Float[Array, " _"]]
"""Kernel and bias."""

_Multiply = Callable[[Array, Array], Array]


def multiplied_by(precision: Precision) -> _Multiply:
    """Returns the product of a vector and a kernel, as in flax's dense layer."""
    dot = dot_general(precision)
    return lambda values, kernel: dot(values, kernel, (((0,), (0,)), ((), ())), precision=None)


def in_turn(
    multiply: _Multiply,
    hidden: Float[Array, " width"],
    encoded: Float[Array, "16"],
    head: _Layer,
    first: _Layer,
) -> tuple[Float[Array, ""], Float[Array, " colour_width"]]:
    """Returns density, and outputs of the first layer of colour, both without activation.

    Args:
      multiply: product of a vector and a kernel.
      hidden: outputs of the hidden layer of density.
      encoded: encoded direction.
      head: layer with the outputs density and bottleneck.
      first: layer of bottleneck and encoded direction.
    """
    with jax.named_scope("Dense_1"):
        raw = multiply(hidden, head[0]) + head[1]
    with jax.named_scope("Dense_2"):
        inputs = jnp.concatenate([raw[1:], encoded])
        return raw[0], multiply(inputs, first[0]) + first[1]


def joined(
    multiply: _Multiply,
    hidden: Float[Array, " width"],
    encoded: Float[Array, "16"],
    head: _Layer,
    first: _Layer,
) -> tuple[Float[Array, ""], Float[Array, " colour_width"]]:
    """Returns the same as `in_turn`, as one layer whose weights are the product of both."""
    kernel, bias = head
    bottleneck = kernel.shape[1] - 1
    with jax.named_scope("Dense_1"):
        density = multiply(hidden, kernel[:, :1])[0] + bias[0]
    with jax.named_scope("Dense_2"):
        of_bottleneck, of_direction = first[0][:bottleneck], first[0][bottleneck:]
        both = numerics.product(kernel[:, 1:], of_bottleneck)
        shift = numerics.product(bias[1:], of_bottleneck) + first[1]
        inputs = jnp.concatenate([hidden, encoded])
        outputs = multiply(inputs, jnp.concatenate([both, of_direction])) + shift
    return density, outputs


def _colour(
    bottleneck: Float[Array, " bottleneck"],
    direction: Float[Array, "3"],
    config: GridRadianceConfig,
) -> Float[Array, "3"]:
    """Returns a colour in `[0, 1]` from the bottleneck features and a unit direction.

    Source: Zip-NeRF's code in PyTorch, on which the paper's is based, for the skip connection.
    """
    layer = dense(config.precision)
    inputs = hidden = jnp.concatenate([bottleneck, spherical_harmonics(direction)])
    for i in range(config.colour_depth):
        hidden = nn.relu(layer(config.colour_width)(hidden))
        if i == 0 and config.colour_network == "skip":
            hidden = jnp.concatenate([hidden, inputs])
    return jax.nn.sigmoid(layer(3)(hidden))
