"""Reads the weights of LPIPS from a file that the user provides (NumPy only).

The file is a `.npz` with arrays of two published state dicts, under their original names:

    features.{0,3,6,8,10}.{weight,bias}    torchvision's AlexNet
    lin{0,1,2,3,4}.model.1.weight          LPIPS, version 0.1

so that arrays can be compared with their source. `docs/metrics.md` explains how to create it.
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from refref_jax.metrics.lpips_network import LAYERS, LpipsParams

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
            kernels=tuple(chosen[name] for name in _KERNELS),
            biases=tuple(chosen[name] for name in _BIASES),
            channels=tuple(chosen[name].reshape(-1) for name in _CHANNELS),
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
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # NumPy passes on errors of zipfile, zlib and the tokenizer
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
