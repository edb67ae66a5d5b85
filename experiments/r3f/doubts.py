"""What is told of masks that the reconstructed body does not agree with."""

from collections.abc import Sequence

import numpy as np

from refref_jax.reconstruct.agreement import carved_alone
from refref_jax.reconstruct.comparison import silhouette_overlap
from refref_jax.reconstruct.silhouettes import Views
from refref_jax.reconstruct.triangles import Mesh

# The overlap of a mask and the body's silhouette below which they do not agree: of right masks of
# bodies some tens of pixels wide it is above 0.97.
_AGREES = 0.9

# Masks that are named.
_NAMED = 5

# The share of a body that no mask carves away alone, when it is right and there are many others.
_MUCH = 0.05


def about_masks(
    mesh: Mesh, views: Views, names: Sequence[str], *, outliers: int
) -> tuple[str, ...]:
    """Says which masks the body does not agree with, and which of them may have spoilt it.

    Args:
      mesh: the body.
      views: all masks that it was made from.
      names: what they are called.
      outliers: as many as may disagree without a word.
    """
    overlaps = silhouette_overlap(mesh, *views)
    doubtful = np.flatnonzero(overlaps < _AGREES)
    if len(doubtful) <= outliers:
        return ()
    worst = doubtful[np.argsort(overlaps[doubtful])][:_NAMED]
    named = ", ".join(f"{names[view]} ({overlaps[view]:.2f})" for view in worst)
    told = (
        f"{len(doubtful)} of {len(overlaps)} training masks overlap with the body by less than "
        f"{_AGREES}, least {named}. Check the masks and the poses."
    )
    shares = carved_alone(views)
    taker = int(np.argmax(shares))
    if shares[taker] < _MUCH:
        return (told,)
    return (
        told,
        f"{names[taker]} alone carves away {shares[taker]:.0%} of what all others leave. If it is "
        f"wrong, mend it or leave its frame out, or let --outliers={outliers + 1} masks be wrong.",
    )
