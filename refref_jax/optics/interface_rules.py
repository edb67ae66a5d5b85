"""Decides on the host what lies outside each part (NumPy only).

A part knows its own index of refraction. The index on its other side follows from a rule:

- `nested`: bodies lie strictly inside one another, so it is the material of the innermost part
  that contains this one, and air for the outermost. Physical.
- `facing`: always air. Blender Cycles does this when every material has its index relative to
  air: it takes the index on a front face and its inverse on a back face, and keeps no record of
  the media a ray is in.
"""

from collections.abc import Callable, Sequence

import numpy as np

from refref_jax.optics.media import AMBIENT, Interfaces

INDEX_OF_AIR = 1.0

NO_PARENT = -1
"""The parent of a part that no other part contains."""


def nested(indices: Sequence[float], parents: Sequence[int]) -> Interfaces:
    """Applies the `nested` rule.

    Args:
      indices: index of refraction of each part's material.
      parents: the innermost part that contains each part, or `NO_PARENT`.
    """
    outside = [INDEX_OF_AIR if parent == NO_PARENT else indices[parent] for parent in parents]
    return _interfaces(indices, outside, parents)


def facing(indices: Sequence[float], parents: Sequence[int]) -> Interfaces:
    """Applies the `facing` rule; `parents` still name the media, but not their indices.

    Args:
      indices: index of refraction of each part's material relative to air.
      parents: the innermost part that contains each part, or `NO_PARENT`.
    """
    return _interfaces(indices, [INDEX_OF_AIR] * len(indices), parents)


RULES: dict[str, Callable[[Sequence[float], Sequence[int]], Interfaces]] = {
    "nested": nested,
    "facing": facing,
}


def _interfaces(
    inside: Sequence[float], outside: Sequence[float], parents: Sequence[int]
) -> Interfaces:
    media = [AMBIENT if parent == NO_PARENT else parent + 1 for parent in parents]
    if not media:
        # A scene without parts: one interface that no triangle refers to can be indexed.
        inside, outside, media = [INDEX_OF_AIR], [INDEX_OF_AIR], [AMBIENT]
    return Interfaces(
        np.asarray(inside, np.float32),
        np.asarray(outside, np.float32),
        np.asarray(media, np.int32),
    )
