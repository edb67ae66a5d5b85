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
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int

from refref_jax.choices import CLEAR, NO_ABSORPTION, Material, RuleName
from refref_jax.numerics import host_array
from refref_jax.optics.media import AMBIENT, CONDUCTOR, INDEX_OF_AIR, KINDS, OPAQUE, Interfaces

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
        materials: Sequence[Material] | None = None,
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
          materials: material of each part, smooth dielectrics by default.
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
    materials: Sequence[Material] | None = None,
) -> Interfaces:
    """Applies the `nested` rule; arguments as in `Rule`. Priorities and overlaps are ignored."""
    del priorities, overlaps
    made = _interfaces(indices, _Around(parents, ambient), tints, absorptions, materials)
    if not _any_embedded(materials):
        return made
    return _with_lists(made, parents, [0] * len(parents), facing=False)


def facing(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
    overlaps: Sequence[tuple[int, int]] = (),
    ambient: float = INDEX_OF_AIR,
    materials: Sequence[Material] | None = None,
) -> Interfaces:
    """Applies the `facing` rule; arguments as in `Rule`.

    Parents determine the media, and therefore absorption, but not the indices. If parts overlap,
    rays carry an interior list for the media. The medium of an overlap is that of the part with
    more parts around it, then that of the higher priority.
    """
    around = _Around(parents, ambient, always=True)
    made = _interfaces(indices, around, tints, absorptions, materials)
    if not overlaps and not _any_embedded(materials):
        return made
    return _with_lists(made, parents, priorities or [0] * len(parents), facing=True)


def priority(
    indices: Sequence[float],
    parents: Sequence[int],
    *,
    tints: Colours | None = None,
    absorptions: Colours | None = None,
    priorities: Sequence[int] | None = None,
    overlaps: Sequence[tuple[int, int]] = (),
    ambient: float = INDEX_OF_AIR,
    materials: Sequence[Material] | None = None,
) -> Interfaces:
    """Applies the `priority` rule; arguments as in `Rule`. Parents and overlaps are ignored.

    Source: Schmidt and Budge, Simple Nested Dielectrics in Ray Traced Images (2002).
    """
    del overlaps
    around = _Around([NO_PARENT] * len(parents), ambient)
    made = _interfaces(indices, around, tints, absorptions, materials)
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


class _Around(NamedTuple):
    """What is around each part.

    Attributes:
      parents: innermost part that contains each part, or `NO_PARENT`.
      ambient: index of refraction of the ambient medium.
      always: whether the index outside a part is always that of the ambient medium.
    """

    parents: Sequence[int]
    ambient: float
    always: bool = False

    def indices(self, inside: Sequence[float]) -> list[float]:
        """Returns the index outside each part, from the indices inside."""
        return [
            self.ambient if self.always or parent == NO_PARENT else inside[parent]
            for parent in self.parents
        ]


def _with_lists(
    made: Interfaces, parents: Sequence[int], priorities: Sequence[int], *, facing: bool
) -> Interfaces:
    """Makes rays carry interior lists, for the media alone."""
    order = _order([(_depth(parents, part), priorities[part]) for part in range(len(parents))])
    by_face = host_array(np.full(1, facing))
    return made._replace(priority=host_array(order), index_by_face=by_face)


def _any_embedded(materials: Sequence[Material] | None) -> bool:
    return any(material.kind != "dielectric" for material in materials or ())


def _interfaces(
    inside: Sequence[float],
    around: _Around,
    tints: Colours | None,
    absorptions: Colours | None,
    materials: Sequence[Material] | None,
) -> Interfaces:
    if not inside:
        # A scene without parts gets one unused interface, so that arrays can be indexed.
        inside, around, tints, absorptions = [INDEX_OF_AIR], _Around([NO_PARENT], 1.0), None, None
    materials = materials or [Material()] * len(inside)
    media = [AMBIENT if parent == NO_PARENT else parent + 1 for parent in around.parents]
    return Interfaces(
        index_inside=_floats(inside, len(inside)),
        index_outside=_floats(around.indices(inside), len(inside)),
        medium_outside=host_array(np.asarray(media, np.int32)),
        tint=host_array(_colours(tints, CLEAR, len(media))),
        absorption=host_array(_colours(absorptions, NO_ABSORPTION, len(media))),
        priority=host_array(np.zeros(0, np.int32)),
        index_by_face=host_array(np.zeros(0, bool)),
        **_material_arrays(inside, around, materials),
    )


def _material_arrays(
    inside: Sequence[float], around: _Around, materials: Sequence[Material]
) -> dict[str, Any]:
    """Returns the arrays of `Interfaces` that are empty unless a part needs them."""
    kinds = [KINDS.index(material.kind) for material in materials]
    metal = [material.complex_index or (CLEAR, NO_ABSORPTION) for material in materials]
    alpha = [material.roughness**2 for material in materials]
    channels = [
        [
            index if material.dispersion is None else material.dispersion[channel]
            for index, material in zip(inside, materials, strict=True)
        ]
        for channel in range(3)
    ]
    pairs = [[indices, around.indices(indices)] for indices in channels]
    spread = any(material.dispersion for material in materials)
    return {
        "kinds": host_array(np.asarray(kinds if any(kinds) else [], np.int32)),
        "opaque": host_array(np.equal(kinds if OPAQUE in kinds else [], OPAQUE)),
        "complex_index": _floats(metal if CONDUCTOR in kinds else [], 0, 2, 3),
        "alpha": _floats(alpha if any(alpha) else [], 0),
        "index_by_channel": _floats(pairs if spread else [], 0, 2, len(inside)),
    }


def _floats(values: Sequence[Any], *shape: int) -> Any:
    """Returns values as an array; without any, it has the given shape."""
    return host_array(np.asarray(values, np.float32) if values else np.zeros(shape, np.float32))


def _colours(
    given: Colours | None, default: Sequence[float], count: int
) -> Float[np.ndarray, "parts 3"]:
    return np.asarray([default] * count if given is None else given, np.float32)
