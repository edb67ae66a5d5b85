"""Separates light paths by the branch that they take at their first surface.

The first surface divides the light of a pixel into two images: light reflected by the outside of
the objects, and the rest, which passes through the objects or misses them.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool

from refref_jax.optics.light_paths import LightPaths

Branch = Literal["both", "transmitted", "reflected"]
"""Paths to select: both branches, `reflected` ones, or `transmitted` ones (all others)."""


def reflected_first(paths: LightPaths) -> Bool[Array, " paths"]:
    """Returns which paths were reflected at the first surface they hit.

    These stay in their medium: their second segment starts at the end of the first. If a path has
    more segments outside the objects than are stored (see `details`), its second segment is unknown
    and it counts as transmitted; with one convex object this never happens. The camera is assumed
    to be outside all objects.
    """
    if paths.tau.shape[-1] < 2:
        return jnp.zeros_like(paths.bends, bool)
    at_once = paths.tau[:, 1] == paths.ends[:, 0]
    return (paths.bends > 0) & at_once & (paths.media[:, 1] == paths.media[:, 0])
