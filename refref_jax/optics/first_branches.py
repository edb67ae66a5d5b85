"""Which of its two branches a light path took at the first surface that it met.

There light divides for the first time, and so the light of a pixel into two images: what was
mirrored by the objects' outside, and all the rest, which went through them or beside them.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool

from refref_jax.optics.light_paths import LightPaths

Branch = Literal["both", "transmitted", "reflected"]
"""Paths of either branch, or of one: `transmitted` has all that are not `reflected`."""


def reflected_first(paths: LightPaths) -> Bool[Array, " paths"]:
    """Returns which paths were reflected at the first surface they met.

    These stay in their medium: the second segment begins where the first one ends. Of a path with
    more segments outside the objects than its record keeps (see `details`) the second one is not
    known, and it counts as transmitted; around one convex body there is none such. The camera is
    taken to be outside of all objects.
    """
    if paths.tau.shape[-1] < 2:
        return jnp.zeros_like(paths.bends, bool)
    at_once = paths.tau[:, 1] == paths.ends[:, 0]
    return (paths.bends > 0) & at_once & (paths.media[:, 1] == paths.media[:, 0])
