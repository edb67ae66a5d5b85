"""Reads the weights of LPIPS from a user's file (NumPy only).

A file is a `.npz` of the arrays of two published state dicts, under their own names:

    features.{0,3,6,8,10}.{weight,bias}    torchvision's AlexNet
    lin{0,1,2,3,4}.model.1.weight          LPIPS, version 0.1

so that each can be compared with where it came from. `docs/metrics.md` tells how to make one.
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from refref_jax.metrics.lpips_network import LAYERS, LpipsParams

# Places of the convolutions among AlexNet's `features`: the others rectify and pool.
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
"""Shapes of what is used of AlexNet's state dict."""

LINEAR_SHAPES: dict[str, tuple[int, ...]] = {
    name: (1, layer.outputs, 1, 1) for name, layer in zip(_CHANNELS, LAYERS, strict=True)
}
"""Shapes of LPIPS's own state dict."""

_NAMES_SHOWN = 4


def load_lpips(path: Path) -> LpipsParams:
    """Loads weights for `lpips` onto the default device.

    Args:
      path: a `.npz` with the names above.

    Raises:
      ValueError: as `read_lpips`.
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
    """Reads and checks weights for `lpips`, and touches no device.

    Args:
      path: a `.npz` with the names above.

    Returns:
      The arrays under these names, in single precision.

    Raises:
      ValueError: if it can not be read, or an array is missing, has another shape, or numbers that
        can not be, see `choose`.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # NumPy raises what zipfile, zlib and Python's tokenizer do
        raise ValueError(
            f"{path} can not be read as the weights of LPIPS ({error}). Give a .npz file of "
            "them; docs/metrics.md says how to make it."
        ) from error
    return choose(arrays, ALEXNET_SHAPES | LINEAR_SHAPES, source=str(path))


def choose(
    arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]], *, source: str
) -> dict[str, np.ndarray]:
    """Returns the arrays that are wanted of a state dict, in single precision.

    Args:
      arrays: the state dict; what else is in it is left out.
      shapes: of the wanted ones, by name.
      source: what it was read from, for errors.

    Raises:
      ValueError: if one is missing, has another shape, or has numbers that can not be: such that
        are not finite in single precision, weights that are all zero, or negative weights of
        channels, which LPIPS was trained not to have.
    """
    missing = [name for name in shapes if name not in arrays]
    if missing:
        have = ", ".join([*list(arrays)[:_NAMES_SHOWN], *["..."] * (len(arrays) > _NAMES_SHOWN)])
        raise ValueError(
            f"{source} has no {missing[0]}; it has {have or 'nothing'}. Give the state dict of "
            "which docs/metrics.md tells."
        )
    chosen = {}
    for name, shape in shapes.items():
        found = arrays[name]
        if found.shape != shape:
            raise ValueError(
                f"{name} in {source} has the shape {found.shape}, not {shape}. It is of another "
                "network: LPIPS is measured with AlexNet here."
            )
        is_floating = np.issubdtype(found.dtype, np.floating)
        with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused
            chosen[name] = found.astype(np.float32) if is_floating else found
        if not is_floating or not np.all(np.isfinite(chosen[name])):
            raise ValueError(
                f"{name} in {source} has entries that are no finite numbers in single precision. "
                "Copy or convert the file again."
            )
        _check_trained(chosen[name], name, source)
    return chosen


def _check_trained(found: np.ndarray, name: str, source: str) -> None:
    """Refuses weights that no training left."""
    if name not in _BIASES and not np.any(found):
        raise ValueError(
            f"{name} in {source} has no weight but zero, so that nothing would be measured. Take "
            "the published file."
        )
    if name in _CHANNELS and np.any(found < 0):
        raise ValueError(
            f"{name} in {source} has negative weights, which LPIPS does not have. These may be "
            "weights that no training has touched: take the published file, version 0.1."
        )
