"""Reads the named arrays of a network: a state dict, in PyTorch's format or NumPy's."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np


def read(path: Path) -> dict[str, np.ndarray]:
    """Reads named arrays, from PyTorch's format or NumPy's.

    Raises:
      ValueError: if the file can not be read, or PyTorch is needed and not installed.
    """
    if not path.is_file():
        raise ValueError(f"{path} does not exist. docs/metrics.md tells where to get it.")
    reader = _read_npz if path.suffix == ".npz" else _reader_of_torch(path)
    try:
        return reader(path)
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{path} holds more than tensors, or is no such file. Give a state dict as it is "
            "published, not a whole model."
        ) from error
    except Exception as error:  # PyTorch raises what its unpickler does
        raise ValueError(
            f"{path} can not be read as a state dict ({error}). Copy it again."
        ) from error


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _reader_of_torch(path: Path) -> Callable[[Path], dict[str, np.ndarray]]:
    try:
        import torch
    except ImportError as error:
        raise ValueError(
            f"{path} is read by PyTorch, which is not installed. Run this once where it is (pip "
            "install torch), or give the same arrays as .npz."
        ) from error

    def read_torch(path: Path) -> dict[str, np.ndarray]:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise TypeError("it holds no dict")
        tensors = {name: x for name, x in state.items() if isinstance(x, torch.Tensor)}
        return {name: x.detach().numpy() for name, x in tensors.items()}

    return read_torch
