"""Weights of LPIPS made at random, in the form in which the true ones are published."""

from pathlib import Path

import numpy as np

ALEXNET = {
    "features.0": (64, 3, 11, 11),
    "features.3": (192, 64, 5, 5),
    "features.6": (384, 192, 3, 3),
    "features.8": (256, 384, 3, 3),
    "features.10": (256, 256, 3, 3),
}
"""Kernels of torchvision's AlexNet, by its own names."""


def state_dicts(seed=0):
    """Returns a state dict of AlexNet and one of LPIPS, in single precision."""
    rng = np.random.default_rng(seed)
    alexnet, linear = {}, {}
    for i, (name, shape) in enumerate(ALEXNET.items()):
        # As large as what they are given, so that no layer fades.
        kernel = rng.normal(size=shape) * np.sqrt(2.0 / np.prod(shape[1:]))
        alexnet[f"{name}.weight"] = kernel.astype(np.float32)
        alexnet[f"{name}.bias"] = rng.normal(scale=0.1, size=shape[0]).astype(np.float32)
        weights = rng.uniform(size=(1, shape[0], 1, 1))
        linear[f"lin{i}.model.1.weight"] = weights.astype(np.float32)
    return alexnet, linear


def write(path: Path, seed=0) -> Path:
    """Writes weights as `experiments.convert_lpips` does."""
    alexnet, linear = state_dicts(seed)
    np.savez(path, **alexnet, **linear)
    return path
