"""Puts the published weights of LPIPS into one file that this package reads.

python -m experiments.convert_lpips --alexnet=FILE.pth --lpips=FILE.pth --out=lpips.npz

The weights are of others, and are not distributed here; `docs/metrics.md` tells where they are
published. `.pth` files are read by PyTorch, which this package does not need otherwise; `.npz`
files with the same names are read without it.
"""

from pathlib import Path

import numpy as np
from absl import flags

from experiments import commands, state_dicts
from refref_jax.metrics import lpips_weights

_ALEXNET = flags.DEFINE_string(
    "alexnet", None, "State dict of torchvision's AlexNet, .pth or .npz.", required=True
)
_LPIPS = flags.DEFINE_string(
    "lpips", None, "State dict of LPIPS with AlexNet, version 0.1, .pth or .npz.", required=True
)
_OUT = flags.DEFINE_string("out", None, "The .npz to write; must not exist.", required=True)


def main() -> None:
    """Converts the weights."""
    out = Path(_OUT.value)
    if out.suffix != ".npz":
        raise ValueError(f"--out={out} does not end in .npz. Give a name that does.")
    if out.exists():
        raise ValueError(f"{out} exists. Remove it, or give another --out.")
    arrays = {}
    for path, shapes in (
        (Path(_ALEXNET.value), lpips_weights.ALEXNET_SHAPES),
        (Path(_LPIPS.value), lpips_weights.LINEAR_SHAPES),
    ):
        arrays |= lpips_weights.choose(state_dicts.read(path), shapes, source=str(path))
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(out, **arrays)
    print(f"Weights: {out}")
    print("Next: give it as --lpips_weights to experiments.evaluate or experiments.metrics.")


if __name__ == "__main__":
    commands.run(main)
