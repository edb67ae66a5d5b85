"""Decides on the host what lies outside each part (NumPy only).

A part knows its own medium. What is on the other side of its surface follows from a rule:

- `nested`: bodies lie strictly inside one another, so it is the material of the innermost part
  that contains this one, and air for the outermost. Physical.
- `facing`: always air. Blender Cycles does this when every material has its index relative to
  air: it takes the index on a front face and its inverse on a back face, and keeps no record of
  the media a ray is in.
- `priority`: bodies may overlap, and where they do THE HIGHEST PRIORITY WINS. Physical; it is how
  a liquid is modelled that fills its glass without a gap: overlapping the wall a little, with the
  glass above it (glass 3, ice 2, liquid 1). A body *inside* another needs the higher one of the
  two (bubble 2, glass 1), which is why no rule can tell the priorities from the materials. Of
  equal priorities the part that is listed first wins: the media are then defined, but by chance.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from refref_jax.choices import CLEAR, NO_ABSORPTION, RuleName
from refref_jax.optics.media import AMBIENT, INDEX_OF_AIR, Interfaces

NO_PARENT = -1
"""The parent of a part that no other part contains."""

Colours = Sequence[Sequence[float]]
"""Linear RGB, one a part."""


class Rule(Protocol):
    """The signature of every rule."""

    def __call__(
        self,
        indices: Sequence[float],
        parents: Sequence[int],
        *,
        tints: Colours | None = None,
        absorptions: Colours | None = None,
        priorities: Sequence[int] | None = None,
    ) -> Interfaces:
        """Makes the interfaces of a scene.

        Args:
          indices: index of refraction of each part's material, relative to air.
          parents: the innermost part that contains each part, or `NO_PARENT`.
          tints: factor of light at each part's surface, `CLEAR` if not given.
          absorptions: of each part's medium, per world unit, `NO_ABSORPTION` if not given.
          priorities: of each part, 0 if not given; the highest wins.
        """


def nested(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
) -> Interfaces:
    """Applies the `nested` rule; arguments of `Rule`. It takes no notice of priorities."""
    del priorities
    outside = [INDEX_OF_AIR if parent == NO_PARENT else indices[parent] for parent in parents]
    return _interfaces(indices, outside, parents, tints, absorptions)


def facing(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
) -> Interfaces:
    """Applies the `facing` rule; arguments of `Rule`. It takes no notice of priorities.

    The parents name the media, and so what absorbs, but not the indices.
    """
    del priorities
    return _interfaces(indices, [INDEX_OF_AIR] * len(indices), parents, tints, absorptions)


def priority(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
) -> Interfaces:
    """Applies the `priority` rule; arguments of `Rule`. It takes no notice of parents.

    Source: Schmidt and Budge, Simple Nested Dielectrics in Ray Traced Images (2002).
    """
    alone = [NO_PARENT] * len(parents)
    made = _interfaces(indices, [INDEX_OF_AIR] * len(indices), alone, tints, absorptions)
    return made._replace(priority=_order(priorities or [0] * len(made.index_inside)))


RULES: dict[RuleName, Rule] = {"nested": nested, "facing": facing, "priority": priority}


def _order(priorities: Sequence[int]) -> Int[np.ndarray, " parts"]:
    """Returns the place of each part in the order of priority; of equals the first is higher."""
    ascending = sorted(range(len(priorities)), key=lambda part: (priorities[part], -part))
    return np.argsort(ascending).astype(np.int32)


def _interfaces(
    inside: Sequence[float],
    outside: Sequence[float],
    parents: Sequence[int],
    tints: Colours | None,
    absorptions: Colours | None,
) -> Interfaces:
    media = [AMBIENT if parent == NO_PARENT else parent + 1 for parent in parents]
    if not media:
        # A scene without parts: one interface that no triangle refers to can be indexed.
        inside, outside, media, tints, absorptions = (
            [INDEX_OF_AIR],
            [INDEX_OF_AIR],
            [AMBIENT],
            None,
            None,
        )
    return Interfaces(
        np.asarray(inside, np.float32),
        np.asarray(outside, np.float32),
        np.asarray(media, np.int32),
        _colours(tints, CLEAR, len(media)),
        _colours(absorptions, NO_ABSORPTION, len(media)),
        np.zeros(0, np.int32),
    )


def _colours(
    given: Colours | None, default: Sequence[float], count: int
) -> Float[np.ndarray, "parts 3"]:
    return np.asarray([default] * count if given is None else given, np.float32)
