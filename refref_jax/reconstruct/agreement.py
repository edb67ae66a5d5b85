"""Which masks a body does not agree with, and which of them spoils it (host).

Masks that are right agree with the silhouettes of their hull. One that marks too much is overruled
by the others, and alone disagrees. One that marks too little takes its part of the body away: it
agrees, and all others disagree. What a mask alone carves away tells it from them.
"""

import numpy as np

from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct.comparison import silhouette_overlap
from refref_jax.reconstruct.errors import ReconstructionError
from refref_jax.reconstruct.grids import Box, Values, lattice
from refref_jax.reconstruct.silhouettes import Views, check_masks, views_at
from refref_jax.reconstruct.visual_hull import REACH, values_by_view

# Points along each edge of the cube in which a body is looked for.
_POINTS = 64


def without_outliers(mesh: Mesh, views: Views, count: int) -> Views:
    """Returns views without so many whose masks overlap least with the silhouettes of a mesh.

    Raises:
      ReconstructionError: if no view would be left, or masks and cameras do not fit each other.
    """
    check_masks(*views)
    if not 0 <= count < len(views.masks):
        raise ReconstructionError(
            f"{count} of {len(views.masks)} views can not be left out. Give fewer, 0 or more."
        )
    if count == 0:
        return views
    overlaps = silhouette_overlap(mesh, *views)
    return views_at(views, np.sort(np.argsort(overlaps, kind="stable")[count:]))


def carved_alone(views: Views) -> Values:
    """Returns for each view the share of what all others leave that it carves away.

    Measured on a lattice of 64 points along each edge of the cube in which a body is looked for,
    see `visual_hull.REACH`; 0 where the others leave none of them.

    Raises:
      ReconstructionError: if masks and cameras do not fit each other.
    """
    check_masks(*views)
    ends = np.full(3, REACH)
    values = values_by_view(*views, lattice(Box(-ends, ends), _POINTS))
    carved, seen = values > 0.0, np.any(values > -np.inf, axis=0)
    times = carved.sum(axis=0)
    alone = np.sum(carved & (times == 1), axis=1)
    return alone / np.maximum(alone + np.sum(seen & (times == 0)), 1)
