"""LPIPS: perceptual distance of two images by a network trained on human similarity ratings.

The network consists of the five convolutions of torchvision's AlexNet; the channel weights are
those of `lin` version 0.1. The user provides the weights: see `lpips_weights`.

Source: Zhang, Isola, Efros, Shechtman, Wang, The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric (CVPR 2018), equation 1, and the constants of its code, version 0.1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.numerics import safe_sqrt

SMALLEST_FOR_LPIPS = 31
"""Smallest edge of an image in pixels; for smaller images the second pooling has no output."""

# Mean and deviation of AlexNet's training images, in the range [-1, 1].
_MEAN = (-0.030, -0.088, -0.188)
_DEVIATION = (0.458, 0.448, 0.450)

# Added to the norm of a pixel's features, as in the published implementation.
_LENGTH_PADDING = 1e-10

_POOL = 3
_POOL_STRIDE = 2


class Layer(NamedTuple):
    """One convolution of AlexNet; its rectified output is compared.

    Attributes:
      inputs: number of input channels.
      outputs: number of output channels.
      side: edge of the kernel, pixels.
      stride: stride, pixels.
      padding: zero padding of the input, pixels.
      pools: whether the input is max-pooled first, 3 x 3 with stride 2.
    """

    inputs: int
    outputs: int
    side: int
    stride: int
    padding: int
    pools: bool


LAYERS = (
    Layer(3, 64, side=11, stride=4, padding=2, pools=False),
    Layer(64, 192, side=5, stride=1, padding=2, pools=True),
    Layer(192, 384, side=3, stride=1, padding=1, pools=True),
    Layer(384, 256, side=3, stride=1, padding=1, pools=False),
    Layer(256, 256, side=3, stride=1, padding=1, pools=False),
)


class LpipsParams(NamedTuple):
    """Weights of LPIPS, with one array per entry of `LAYERS`.

    Attributes:
      kernels: kernels of the convolutions.
      biases: biases of the convolutions.
      channels: weight of each channel's difference; non-negative.
    """

    kernels: tuple[Float[Array, "outputs inputs side side"], ...]
    biases: tuple[Float[Array, " outputs"], ...]
    channels: tuple[Float[Array, " outputs"], ...]


def lpips(
    params: LpipsParams, rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]
) -> Float[Array, ""]:
    """Returns the LPIPS distance of two images.

    The features of both images after each of the five layers are normalised per pixel; their
    squared differences are summed over channels with the weights `params.channels`, averaged over
    pixels, and summed over layers. 0 for equal images (at most 1e-14 when compiled), symmetric,
    non-negative; lower is better, and values rarely reach 1.

    Args:
      params: weights of LPIPS.
      rendered: sRGB image in `[0, 1]`; it is scaled to `[-1, 1]`, the range of the network.
      target: sRGB image in `[0, 1]`, of the same size.

    Raises:
      ValueError: if the images are too small for the network.
    """
    height, width, _ = rendered.shape
    if min(height, width) < SMALLEST_FOR_LPIPS:
        raise ValueError(
            f"LPIPS is undefined for an image of {width} x {height} pixels: its network needs at "
            f"least {SMALLEST_FOR_LPIPS} x {SMALLEST_FOR_LPIPS}. Give larger images."
        )
    images = 2.0 * jnp.stack([rendered, target]) - 1.0
    mean, deviation = (jnp.asarray(x, images.dtype)[None, None, None] for x in (_MEAN, _DEVIATION))
    features = (images - mean) / deviation
    total = jnp.zeros((), images.dtype)
    for layer, kernel, bias, channels in zip(LAYERS, *params, strict=True):
        features = _convolve(features, kernel, bias, layer)
        unit = _unit(features)
        squared = jnp.square(unit[0] - unit[1])
        total = total + jnp.mean(jnp.sum(squared * channels[None, None], axis=-1))
    return total


def _convolve(
    features: Float[Array, "images h w inputs"],
    kernel: Float[Array, "outputs inputs side side"],
    bias: Float[Array, " outputs"],
    layer: Layer,
) -> Float[Array, "images height width outputs"]:
    if layer.pools:
        features = jax.lax.reduce_window(
            features,
            -jnp.inf,
            jax.lax.max,
            window_dimensions=(1, _POOL, _POOL, 1),
            window_strides=(1, _POOL_STRIDE, _POOL_STRIDE, 1),
            padding="VALID",
        )
    convolved = jax.lax.conv_general_dilated(
        features,
        kernel,
        window_strides=(layer.stride, layer.stride),
        padding=[(layer.padding, layer.padding)] * 2,
        dimension_numbers=("NHWC", "OIHW", "NHWC"),
        precision=jax.lax.Precision.HIGHEST,
    )
    return jax.nn.relu(convolved + bias[None, None, None])


def _unit(features: Float[Array, "images h w channels"]) -> Float[Array, "images h w channels"]:
    """Returns features normalised over channels; zero vectors stay zero."""
    length = safe_sqrt(jnp.sum(jnp.square(features), axis=-1, keepdims=True))
    return features / (length + _LENGTH_PADDING)
