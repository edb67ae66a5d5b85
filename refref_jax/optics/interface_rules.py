"""Determines the medium outside each part, on the host (NumPy only).

A part defines the medium inside it. The medium on the other side of its surface follows from a
rule:

- `nested`: objects lie strictly inside one another, so it is the medium of the innermost part that
  contains this one, or the ambient medium. Physical.
- `facing`: always the ambient medium. This is the behaviour of Blender Cycles with indices relative
  to air: it uses the index on a front face and its inverse on a back face, and does not track the
  media that a ray is in.
- `priority`: objects may overlap, and THE HIGHEST PRIORITY WINS in the overlap. Physical. It models
  a liquid that fills a glass without a gap: the liquid overlaps the wall a little, and the glass
  has the higher priority (glass 3, ice 2, liquid 1). If one object lies *inside* another, the inner
  one needs the higher priority (bubble 2, glass 1), so priorities cannot be derived from materials.
  Among equal priorities the part listed first wins: the result is well-defined, but arbitrary.

The ambient medium, outside all parts, is air unless another index is given (`ambient`).
"""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from refref_jax.choices import CLEAR, NO_ABSORPTION, RuleName
from refref_jax.numerics import host_array
from refref_jax.optics.media import AMBIENT, INDEX_OF_AIR, Interfaces

NO_PARENT = -1
"""Parent of a part that is not inside another part."""

Colours = Sequence[Sequence[float]]
"""Linear RGB values, one per part."""


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
        overlaps: Sequence[tuple[int, int]] = (),
        ambient: float = INDEX_OF_AIR,
    ) -> Interfaces:
        """Builds the interfaces of a scene.

        Args:
          indices: index of refraction of each part's material, relative to vacuum.
          parents: innermost part that contains each part, or `NO_PARENT`.
          tints: factor on light at each part's surface, `CLEAR` by default.
          absorptions: absorption of each part's medium, per world unit, `NO_ABSORPTION` by default.
          priorities: priority of each part, 0 by default; the highest wins.
          overlaps: pairs of parts that overlap; only `facing` needs them.
          ambient: index of refraction of the ambient medium.
        """


def nested(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
    overlaps: Sequence[tuple[int, int]] = (),
    ambient: float = INDEX_OF_AIR,
) -> Interfaces:
    """Applies the `nested` rule; arguments as in `Rule`. Priorities and overlaps are ignored."""
    del priorities, overlaps
    outside = [ambient if parent == NO_PARENT else indices[parent] for parent in parents]
    return _interfaces(indices, outside, parents, tints, absorptions)


def facing(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
    overlaps: Sequence[tuple[int, int]] = (),
    ambient: float = INDEX_OF_AIR,
) -> Interfaces:
    """Applies the `facing` rule; arguments as in `Rule`.

    Parents determine the media, and therefore absorption, but not the indices. If parts overlap,
    rays carry an interior list for the media. The medium of an overlap is that of the part with
    more parts around it, then that of the higher priority.
    """
    made = _interfaces(indices, [ambient] * len(indices), parents, tints, absorptions)
    if not overlaps:
        return made
    given = priorities or [0] * len(indices)
    order = _order([(_depth(parents, part), given[part]) for part in range(len(indices))])
    return made._replace(priority=host_array(order), index_by_face=host_array(np.ones(1, bool)))


def priority(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
    overlaps: Sequence[tuple[int, int]] = (),
    ambient: float = INDEX_OF_AIR,
) -> Interfaces:
    """Applies the `priority` rule; arguments as in `Rule`. Parents and overlaps are ignored.

    Source: Schmidt and Budge, Simple Nested Dielectrics in Ray Traced Images (2002).
    """
    del overlaps
    alone = [NO_PARENT] * len(parents)
    made = _interfaces(indices, [ambient] * len(indices), alone, tints, absorptions)
    order = _order(priorities or [0] * len(made.index_inside))
    return made._replace(priority=host_array(order))


RULES: dict[RuleName, Rule] = {"nested": nested, "facing": facing, "priority": priority}


def ambient_of(interfaces: Interfaces) -> float:
    """Returns the index of refraction of the ambient medium; at least one part must be in it."""
    return float(interfaces.index_outside[np.argmin(interfaces.medium_outside)])


def _depth(parents: Sequence[int], part: int) -> int:
    """Returns the number of parts around a part."""
    return 0 if parents[part] == NO_PARENT else 1 + _depth(parents, parents[part])


def _order(priorities: Sequence[Any]) -> Int[np.ndarray, " parts"]:
    """Returns the rank of each part by priority; among equals, the first part ranks highest."""
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
        # A scene without parts gets one unused interface, so that arrays can be indexed.
        inside, outside, media, tints, absorptions = (
            [INDEX_OF_AIR],
            [INDEX_OF_AIR],
            [AMBIENT],
            None,
            None,
        )
    return Interfaces(
        host_array(np.asarray(inside, np.float32)),
        host_array(np.asarray(outside, np.float32)),
        host_array(np.asarray(media, np.int32)),
        host_array(_colours(tints, CLEAR, len(media))),
        host_array(_colours(absorptions, NO_ABSORPTION, len(media))),
        host_array(np.zeros(0, np.int32)),
        host_array(np.zeros(0, bool)),
    )


def _colours(
    given: Colours | None, default: Sequence[float], count: int
) -> Float[np.ndarray, "parts 3"]:
    return np.asarray([default] * count if given is None else given, np.float32)
