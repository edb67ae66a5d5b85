"""Denoises a body as far as the outlines in its masks allow (host).

Denoising turns normals to those around, over a length. A fillet that is narrower than the length is
cut off by it, which no noise excuses and masks show.
"""

import numpy as np

from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct.comparison import silhouette_overlap
from refref_jax.reconstruct.errors import ReconstructionError
from refref_jax.reconstruct.silhouettes import Views, some_of
from refref_jax.reconstruct.smoothing import denoise

# Shares of the length that are tried, and the overlap with masks that it may cost: smooth bodies
# lose a tenth of that, those with fillets twice as much.
_SHARES = (1.0, 0.5, 0.25)
_LOST = 0.01

# Views in which the overlap is looked at.
_LOOKS = 20


def denoise_within(mesh: Mesh, length: float, *, crease_angle: float, views: Views | None) -> Mesh:
    """Denoises over the longest of a few lengths that the masks allow.

    Args:
      mesh: closed.
      length: the longest, world units; a half and a quarter of it are tried too.
      crease_angle: at which denoising stops, radians.
      views: masks; without them the longest is taken.

    Raises:
      ReconstructionError: if they allow none.
    """
    few = None if views is None else some_of(views, _LOOKS)
    least = -np.inf if few is None else silhouette_overlap(mesh, *few).mean() - _LOST
    for share in _SHARES:
        after = denoise(mesh, share * length, crease_angle=crease_angle)
        if few is None or silhouette_overlap(after, *few).mean() >= least:
            return after
    raise ReconstructionError("the overlap with the masks would fall")
