"""Records numbers of gsplat 1.5.3 in float64, for `tests/splats/test_gaussians.py`.

    pip install --target=FOLDER torch
    pip install --target=FOLDER --no-deps gsplat==1.5.3 rich ninja
    PYTHONPATH=FOLDER python tests/oracles/record_gsplat.py

Its implementation in PyTorch runs on a CPU without being compiled. It writes
`tests/splats/gsplat.npz`, which tests read: they need neither gsplat nor PyTorch.
"""

from pathlib import Path

import numpy as np
import torch
from gsplat.cuda import _torch_impl

_SIZE, _TILE, _COUNT = (40, 28), 8, 60


def main():
    draw = np.random.default_rng(1)
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    view, focal = np.eye(4), 35.0
    view[:3, :3], view[2, 3] = turn, 2.0
    width, height = _SIZE
    inputs = {
        "means": draw.uniform(-1.2, 1.2, (_COUNT, 3)),
        "quaternions": draw.normal(size=(_COUNT, 4)),
        "scales": draw.uniform(0.02, 0.25, (_COUNT, 3)),
        "directions": draw.normal(size=(_COUNT, 3)),
        "harmonics": draw.normal(size=(_COUNT, 16, 3)),
    }
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in inputs.items()}
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(
        given["quaternions"], given["scales"], True, False
    )
    intrinsics = torch.tensor(
        [[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64
    )
    radii, means, depths, conics, compensations = _torch_impl._fully_fused_projection(
        given["means"],
        covariances,
        torch.tensor(view)[None],
        intrinsics,
        width,
        height,
        calc_compensations=True,
    )
    tiles = -(-width // _TILE), -(-height // _TILE)
    counts, ids, owners = _torch_impl._isect_tiles(means, radii, depths, _TILE, *tiles)
    offsets = _torch_impl._isect_offset_encode(ids, 1, *tiles)
    colours = _torch_impl._spherical_harmonics(3, given["directions"], given["harmonics"])
    found = {
        "view": view,
        "focal": focal,
        "radii": radii[0],
        "means2d": means[0],
        "depths": depths[0],
        "conics": conics[0],
        "compensations": compensations[0],
        "counts": counts[0],
        "owners": owners,
        "offsets": offsets.reshape(-1),
        "colours": colours,
    }
    arrays = {name: np.asarray(value) for name, value in (inputs | found).items()}
    arrays |= {"size": np.array(_SIZE), "tile": np.array(_TILE)}
    np.savez_compressed(Path(__file__).parents[1] / "splats" / "gsplat.npz", **arrays)


if __name__ == "__main__":
    main()
