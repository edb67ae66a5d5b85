"""Converts the published weights of LPIPS into one file that this package reads.

python -m experiments.convert_lpips --alexnet=FILE.pth --lpips=FILE.pth --out=lpips.npz

The weights are third-party work and are not distributed here; `docs/metrics.md` lists their
sources. `.pth` files require PyTorch, which this package does not need otherwise; `.npz` files with
the same names do not.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags

with epy.lazy_imports():
    import numpy as np

    from refref_jax import atomic_files, metrics

_ALEXNET = flags.DEFINE_string(
    "alexnet", None, "State dict of torchvision's AlexNet, .pth or .npz.", required=True
)
_LPIPS = flags.DEFINE_string(
    "lpips", None, "State dict of LPIPS with AlexNet, version 0.1, .pth or .npz.", required=True
)
_OUT = cli_flags.out("The .npz file to write.")
_OVERWRITE = cli_flags.overwrite("the file if it exists")


def main() -> None:
    """Converts the weights."""
    out = Path(_OUT.value)
    outputs.check_file(out, overwrite=_OVERWRITE.value)
    arrays = {}
    for path, shapes in (
        (Path(_ALEXNET.value), metrics.ALEXNET_SHAPES),
        (Path(_LPIPS.value), metrics.LINEAR_SHAPES),
    ):
        arrays |= metrics.choose(read_state_dict(path), shapes, source=str(path))
    with outputs.fresh_file(out, overwrite=_OVERWRITE.value) as draft:
        _write(draft, arrays)
    print(f"Weights: {out}")
    print("Next: give it as --lpips_weights to experiments.evaluate or experiments.metrics.")


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Reads named arrays from PyTorch's or NumPy's format.

    Raises:
      ValueError: if the file cannot be read, or PyTorch is required but not installed.
    """
    if not path.is_file():
        raise ValueError(f"{path} does not exist. See docs/metrics.md for its source.")
    reader = _read_npz if path.suffix == ".npz" else _reader_of_torch(path)
    try:
        return reader(path)
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{path} contains more than tensors, or is not a PyTorch file. Give the published "
            "state dict, not a pickled model."
        ) from error
    except Exception as error:  # PyTorch raises the errors of its unpickler
        raise ValueError(
            f"{path} cannot be read as a state dict ({error}). Copy it again."
        ) from error


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    return atomic_files.read_arrays(path)


def _reader_of_torch(path: Path) -> Callable[[Path], dict[str, np.ndarray]]:
    try:
        import torch
    except ImportError as error:
        raise ValueError(
            f"{path} requires PyTorch, which is not installed. Run this command where it is (pip "
            "install torch), or give the same arrays as .npz."
        ) from error

    def read_torch(path: Path) -> dict[str, np.ndarray]:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise TypeError("it is not a dict")
        tensors = {name: x for name, x in state.items() if isinstance(x, torch.Tensor)}
        return {name: x.detach().numpy() for name, x in tensors.items()}

    return read_torch


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    # NumPy appends .npz to paths, but not to open files.
    with path.open("wb") as file:
        np.savez(file, **arrays)


def _refuse_other_files(out: str | None) -> None:
    if out is not None and not out.endswith(".npz"):
        raise ValueError(f"--out={out} does not end in .npz. Give a name with this ending.")


app.check(_OUT, _refuse_other_files)


if __name__ == "__main__":
    app.run(main, again="repeat the command to convert again; --overwrite replaces the file.")
