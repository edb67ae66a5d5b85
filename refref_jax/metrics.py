"""Image metrics: PSNR, masked PSNR, SSIM, LPIPS, FLIP, and errors of distance maps.

All metrics are computed per image; tables contain their means over images. `docs/metrics.md` lists
the metrics and their undefined values.

Colours are sRGB in `[0, 1]`. In float32, the variance of a bright and nearly constant image is lost
to rounding (the SSIM of two constant images had an error of 1e-4), so use double precision for
reported numbers.

Distances are arc lengths along each pixel's ray, in world units; DMAE and DRMSE are over the pixels
of a mask. Values outside the mask may be infinite or NaN. For several images, DMAE and DRMSE are
means of the values per image.

FLIP is the perceived difference of two images when flipping between them. It is computed by the
authors' program (NumPy only), an optional dependency: `pip install -e '.[flip]'`.

LPIPS is the perceptual distance of two images by a network trained on human similarity ratings: the
five convolutions of torchvision's AlexNet, and the channel weights of `lin` version 0.1. The user
provides the weights as a `.npz` file with arrays of two published state dicts, under their original
names, so that arrays can be compared with their source:

    features.{0,3,6,8,10}.{weight,bias}    torchvision's AlexNet
    lin{0,1,2,3,4}.model.1.weight          LPIPS, version 0.1

`docs/metrics.md` explains how to create this file.

Sources:
  FLIP: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, FLIP: A Difference
    Evaluator for Alternating Images, Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020.
  LPIPS: Zhang, Isola, Efros, Shechtman, Wang, The Unreasonable Effectiveness of Deep Features as a
    Perceptual Metric (CVPR 2018), equation 1, and the constants of its code, version 0.1.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import dm_pix
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from refref_jax import atomic_files
from refref_jax.numerics import host_array, safe_divide, safe_sqrt

SMALLEST_FOR_SSIM = 11
"""Edge of SSIM's window in pixels; SSIM is undefined for smaller images."""

SMALLEST_FOR_LPIPS = 31
"""Smallest edge of an image in pixels; for smaller images the second pooling has no output."""

# Mean and deviation of AlexNet's training images, in the range [-1, 1].
_MEAN = (-0.030, -0.088, -0.188)
_DEVIATION = (0.458, 0.448, 0.450)

# Added to the norm of a pixel's features, as in the published implementation.
_LENGTH_PADDING = 1e-10

_POOL = 3
_POOL_STRIDE = 2


def psnr(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the peak signal-to-noise ratio in dB, `-10 log10(mean((rendered - target)^2))`.

    The mean is over pixels and channels, and the peak is 1. The result is at least 0 for images in
    `[0, 1]`, and `inf` for equal images; higher is better.
    """
    return dm_pix.psnr(rendered, target)


def psnr_masked(
    rendered: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Bool[Array, "h w"],
) -> Float[Array, ""]:
    """Returns the PSNR over the pixels of a mask in dB.

    This is `psnr` with the mean over the mask's pixels only: `inf` if these are equal, NaN for an
    empty mask. The paper's PSNR_M is the mean of this metric over images.

    Source: paper (arXiv 2505.05848), section 5 (PSNR_M).
    """
    squared = jnp.where(mask[..., None], jnp.square(rendered - target), 0.0)
    error = jnp.sum(squared) / (3.0 * jnp.sum(mask, dtype=rendered.dtype))
    return -10.0 * jnp.log10(error)


def ssim(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the structural similarity, in `[-1, 1]`: 1 for equal images, higher is better.

    With means `m`, variances `v` and the covariance `c` of both images under a window,

        (2 m_a m_b + 0.01^2) (2 c + 0.03^2) / ((m_a^2 + m_b^2 + 0.01^2) (v_a + v_b + 0.03^2)),

    averaged over channels and over all windows that fit into the image. The window is a Gaussian of
    sigma 1.5 on 11 x 11 pixels; the data range is 1.

    Source: Wang, Bovik, Sheikh, Simoncelli, Image Quality Assessment, IEEE TIP 13(4), 2004.

    Raises:
      ValueError: if the image is smaller than the window.
    """
    height, width, _ = rendered.shape
    if min(height, width) < SMALLEST_FOR_SSIM:
        raise ValueError(
            f"SSIM is undefined for an image of {width} x {height} pixels: its window is "
            f"{SMALLEST_FOR_SSIM} x {SMALLEST_FOR_SSIM}. Give larger images."
        )
    return dm_pix.ssim(rendered, target)


def mean_absolute_error(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, ""]:
    """Returns the mean of `|rendered - target|` over a mask, in world units.

    At least 0, lower is better; NaN for an empty mask.

    Source: paper (arXiv 2505.05848), section 5 (DMAE).
    """
    return _mean_over(jnp.abs(_errors(rendered, target, mask)), mask)


def root_mean_square_error(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, ""]:
    """Returns `sqrt(mean((rendered - target)^2))` over a mask, in world units.

    At least 0 and at least the mean absolute error, lower is better; NaN for an empty mask. If all
    distances are equal, the gradient is 0, where the plain formula gives NaN.

    Source: paper (arXiv 2505.05848), supplement, table of the farthest views (DRMSE).
    """
    mean = _mean_over(jnp.square(_errors(rendered, target, mask)), mask)
    return jnp.where(jnp.isnan(mean), mean, safe_sqrt(mean))


def _errors(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, "h w"]:
    """Returns differences inside the mask, and 0 elsewhere."""
    return jnp.where(mask, rendered, 0.0) - jnp.where(mask, target, 0.0)


def _mean_over(values: Float[Array, "h w"], mask: Bool[Array, "h w"]) -> Float[Array, ""]:
    count = jnp.sum(mask, dtype=values.dtype)
    return jnp.where(count > 0, safe_divide(jnp.sum(values), count), jnp.nan)


def flip(rendered: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"]) -> float:
    """Returns the mean of LDR-FLIP's error map, in `[0, 1]`: 0 for equal images, lower is better.

    FLIP depends on the visual angle of a pixel. The program's default is used: 67 pixels per
    degree, for a display of 3840 pixels over 0.7 m, seen from 0.7 m.

    Args:
      rendered: sRGB image in `[0, 1]`, of any size.
      target: sRGB image in `[0, 1]`, of the same size.

    Raises:
      ValueError: if flip-evaluator is not installed.
    """
    flip_evaluator = import_flip()
    pair = (np.ascontiguousarray(image, np.float32) for image in (target, rendered))
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean)


def import_flip() -> Any:
    """Returns the module `flip_evaluator`. Call this early to report that it is missing.

    Raises:
      ValueError: if the module is not installed.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise ValueError(
            "FLIP requires the package flip-evaluator, which is not installed. Install it with "
            "pip install -e '.[flip]'."
        ) from error
    return flip_evaluator


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


# Indices of the convolutions in AlexNet's `features`: the other layers rectify and pool.
_PLACES = (0, 3, 6, 8, 10)

_KERNELS = tuple(f"features.{place}.weight" for place in _PLACES)
_BIASES = tuple(f"features.{place}.bias" for place in _PLACES)
_CHANNELS = tuple(f"lin{i}.model.1.weight" for i in range(len(LAYERS)))

ALEXNET_SHAPES: dict[str, tuple[int, ...]] = {
    name: shape
    for kernel, bias, layer in zip(_KERNELS, _BIASES, LAYERS, strict=True)
    for name, shape in (
        (kernel, (layer.outputs, layer.inputs, layer.side, layer.side)),
        (bias, (layer.outputs,)),
    )
}
"""Shapes of the arrays that are used from AlexNet's state dict."""

LINEAR_SHAPES: dict[str, tuple[int, ...]] = {
    name: (1, layer.outputs, 1, 1) for name, layer in zip(_CHANNELS, LAYERS, strict=True)
}
"""Shapes of the arrays in LPIPS's state dict."""

_NAMES_SHOWN = 4


def load_lpips(path: Path) -> LpipsParams:
    """Loads weights for `lpips` onto the default device.

    Args:
      path: path of a `.npz` file with the arrays of `ALEXNET_SHAPES` and `LINEAR_SHAPES`.

    Raises:
      ValueError: under the conditions of `read_lpips`.
    """
    chosen = read_lpips(path)
    return jax.device_put(
        LpipsParams(
            kernels=tuple(host_array(chosen[name]) for name in _KERNELS),
            biases=tuple(host_array(chosen[name]) for name in _BIASES),
            channels=tuple(host_array(chosen[name].reshape(-1)) for name in _CHANNELS),
        )
    )


def read_lpips(path: Path) -> dict[str, np.ndarray]:
    """Reads and validates weights for `lpips`, without using a device.

    Args:
      path: path of a `.npz` file with the arrays of `ALEXNET_SHAPES` and `LINEAR_SHAPES`.

    Returns:
      The arrays by name, in single precision.

    Raises:
      ValueError: if the file cannot be read, or an array is missing, has the wrong shape, or has
        invalid values, see `choose`.
    """
    try:
        arrays = atomic_files.read_arrays(path)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read as weights of LPIPS ({error}). Give a .npz file of "
            "them; docs/metrics.md says how to make it."
        ) from error
    return choose(arrays, ALEXNET_SHAPES | LINEAR_SHAPES, source=str(path))


def choose(
    arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]], *, source: str
) -> dict[str, np.ndarray]:
    """Selects arrays from a state dict and validates them, in single precision.

    Args:
      arrays: the state dict; other entries are ignored.
      shapes: shapes of the arrays to select, by name.
      source: origin of the state dict, for error messages.

    Raises:
      ValueError: if an array is missing, has the wrong shape, or has invalid values: not finite in
        single precision, weights that are all zero, or negative channel weights, which trained
        LPIPS does not have.
    """
    missing = [name for name in shapes if name not in arrays]
    if missing:
        have = ", ".join([*list(arrays)[:_NAMES_SHOWN], *["..."] * (len(arrays) > _NAMES_SHOWN)])
        raise ValueError(
            f"{source} has no {missing[0]}; it has {have or 'nothing'}. Give the state dict that "
            "docs/metrics.md describes."
        )
    chosen = {}
    for name, shape in shapes.items():
        found = arrays[name]
        if found.shape != shape:
            raise ValueError(
                f"{name} in {source} has the shape {found.shape}, not {shape}, and belongs to "
                "another network. Give weights of LPIPS with AlexNet."
            )
        is_floating = np.issubdtype(found.dtype, np.floating)
        with np.errstate(over="ignore"):  # overflow gives infinity, which is rejected
            chosen[name] = found.astype(np.float32) if is_floating else found
        if not is_floating or not np.all(np.isfinite(chosen[name])):
            raise ValueError(
                f"{name} in {source} has values that are not finite in single precision. Copy or "
                "convert the file again."
            )
        _check_trained(chosen[name], name, source)
    return chosen


def _check_trained(found: np.ndarray, name: str, source: str) -> None:
    """Rejects weights that cannot be the result of training."""
    if name not in _BIASES and not np.any(found):
        raise ValueError(
            f"{name} in {source} has only zero weights, so LPIPS would ignore this layer. Use the "
            "published file."
        )
    if name in _CHANNELS and np.any(found < 0):
        raise ValueError(
            f"{name} in {source} has negative weights, so it may be untrained. Use the published "
            "file, version 0.1."
        )
