"""Interfaces between media: what a ray crosses when it meets a mesh part.

Every part is the boundary of a body. A *medium* is named by an integer: 0 is the surrounding air
(`AMBIENT`), `1 + k` is the inside of part `k`.

Under the rules `nested` and `facing` a part knows both of its sides. Under `priority` bodies may
overlap, and of all the bodies around a point THE HIGHEST PRIORITY WINS (as in Arnold and in the
paper below; Maxwell counts the other way): the point is filled with that body's medium alone. A
ray then carries its *interior list*, the numbers of the parts that it is inside of, and meets
surfaces that part nothing: those of outranked bodies.

The list is an unordered array of `SLOTS` part numbers, `EMPTY_SLOT` where free, and needs no
branches. The side of a surface that a ray comes from decides whether it is inside that part, be
the part on the list or not. A part that is entered while the list is full takes the place of the
entry of lowest priority, or is left out if it is itself the lowest: of more than `SLOTS` bodies
around a point the ray knows the highest, and takes a forgotten one to have been left.

Source: Schmidt and Budge, Simple Nested Dielectrics in Ray Traced Images, Journal of Graphics
Tools 7 (2002).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics

AMBIENT = 0
"""The medium outside every body."""

INDEX_OF_AIR = 1.0
"""The index of refraction of the ambient medium."""

SLOTS = 4
"""Most parts that a ray of the rule `priority` knows itself to be inside of."""

EMPTY_SLOT = -1
"""A free place in the interior list."""


class Interfaces(NamedTuple):
    """The interfaces of a scene, one a part; made by `interface_rules`.

    Attributes:
      index_inside: index of refraction inside the part.
      index_outside: index on the other side of its surface, without meaning under `priority`.
      medium_outside: the medium on the other side, without meaning under `priority`.
      tint: factor of linear RGB light at every reflection and every crossing (the colour of
        Cycles' glass).
      absorption: of the medium inside the part, linear RGB, per world unit.
      priority: the part's place in the order of priority, the highest wins and no two are equal;
        no element at all under `nested` and `facing`, where no ray carries an interior list.
    """

    index_inside: Float[Array, " parts"]
    index_outside: Float[Array, " parts"]
    medium_outside: Int[Array, " parts"]
    tint: Float[Array, "parts 3"]
    absorption: Float[Array, "parts 3"]
    priority: Int[Array, " ranked"]


class Crossing(NamedTuple):
    """The two sides of an interface as a ray meets them.

    At the surface of an outranked body both sides are one medium and the tint is 1, so that
    Snell's and Fresnel's laws leave the ray alone.

    Attributes:
      index_near: index of refraction on the incident side.
      index_far: index on the other side.
      medium_near: medium on the incident side.
      medium_far: medium on the other side.
      tint: factor of linear RGB light, reflected or transmitted.
      part: the part whose surface it is, or `EMPTY_SLOT` if it is outranked.
      inside_after: interior list on the other side; a reflected ray keeps its own.
    """

    index_near: Float[Array, ""]
    index_far: Float[Array, ""]
    medium_near: Int[Array, ""]
    medium_far: Int[Array, ""]
    tint: Float[Array, "3"]
    part: Int[Array, ""]
    inside_after: Int[Array, " slots"]


def interior_slots(interfaces: Interfaces) -> int:
    """Returns the length of a ray's interior list: `SLOTS` under `priority`, else 0."""
    return SLOTS if interfaces.priority.shape[0] else 0


def nowhere(interfaces: Interfaces) -> Int[Array, " slots"]:
    """Returns the interior list of a ray that is outside of every part."""
    return jnp.full(interior_slots(interfaces), EMPTY_SLOT, jnp.int32)


def crossing(
    interfaces: Interfaces,
    inside: Int[Array, " slots"],
    part: Int[Array, ""],
    entering: Bool[Array, ""],
) -> Crossing:
    """Returns the media on both sides of the surface that a ray meets.

    Args:
      interfaces: the scene's interfaces.
      inside: the ray's interior list before it; of no length under `nested` and `facing`.
      part: the part that is met.
      entering: whether the ray comes from the outside of that part.
    """
    if interior_slots(interfaces) == 0:
        return _declared_crossing(interfaces, inside, part, entering)
    without = jnp.where(inside == part, EMPTY_SLOT, inside)
    within = _add(interfaces, without, part)
    medium_without, medium_within = _medium(interfaces, without), _medium(interfaces, within)
    medium_near = jnp.where(entering, medium_without, medium_within)
    medium_far = jnp.where(entering, medium_within, medium_without)
    outranked = medium_without == medium_within
    return Crossing(
        index_near=_index(interfaces, medium_near),
        index_far=_index(interfaces, medium_far),
        medium_near=medium_near,
        medium_far=medium_far,
        tint=jnp.where(outranked, 1.0, interfaces.tint[part]),
        part=jnp.where(outranked, EMPTY_SLOT, part),
        inside_after=jnp.where(entering, within, without),
    )


def transmittance(
    interfaces: Interfaces, medium: Int[Array, ""], length: Float[Array, ""]
) -> Float[Array, "3"]:
    """Returns the share of linear RGB light that is left after a way through a medium.

    Args:
      interfaces: the scene's interfaces.
      medium: where the way lies; `AMBIENT` absorbs nothing.
      length: in world units; may be infinite.

    Source: the law of Beer and Lambert.
    """
    part = jnp.maximum(medium - 1, 0)
    absorption = jnp.where(medium == AMBIENT, 0.0, interfaces.absorption[part])
    return numerics.exponential_decay(absorption, length)


def _declared_crossing(
    interfaces: Interfaces,
    inside: Int[Array, " slots"],
    part: Int[Array, ""],
    entering: Bool[Array, ""],
) -> Crossing:
    """Returns the crossing of a part that knows both of its sides."""
    index_inside = interfaces.index_inside[part]
    index_outside = interfaces.index_outside[part]
    within = part + 1
    without = interfaces.medium_outside[part]
    return Crossing(
        index_near=jnp.where(entering, index_outside, index_inside),
        index_far=jnp.where(entering, index_inside, index_outside),
        medium_near=jnp.where(entering, without, within),
        medium_far=jnp.where(entering, within, without),
        tint=interfaces.tint[part],
        part=part,
        inside_after=inside,
    )


def _ranks(interfaces: Interfaces, inside: Int[Array, " slots"]) -> Int[Array, " slots"]:
    """Returns the priority of every entry of a list; free slots rank lowest."""
    return jnp.where(inside == EMPTY_SLOT, EMPTY_SLOT, interfaces.priority[jnp.maximum(inside, 0)])


def _add(
    interfaces: Interfaces, inside: Int[Array, " slots"], part: Int[Array, ""]
) -> Int[Array, " slots"]:
    """Writes a part into a free slot, or over the lowest entry if the part outranks it."""
    ranks = _ranks(interfaces, inside)
    lowest = jnp.argmin(ranks)
    here = (jnp.arange(SLOTS) == lowest) & (interfaces.priority[part] > ranks[lowest])
    return jnp.where(here, part, inside)


def _medium(interfaces: Interfaces, inside: Int[Array, " slots"]) -> Int[Array, ""]:
    """Returns the medium of the highest entry; `1 + EMPTY_SLOT` is the ambient one."""
    return 1 + inside[jnp.argmax(_ranks(interfaces, inside))]


def _index(interfaces: Interfaces, medium: Int[Array, ""]) -> Float[Array, ""]:
    index = interfaces.index_inside[jnp.maximum(medium - 1, 0)]
    return jnp.where(medium == AMBIENT, INDEX_OF_AIR, index)
