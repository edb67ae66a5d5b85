"""Scenes for path tracing, and the media on both sides of the interfaces that a ray crosses.

A `Scene` has surfaces, and at each of them an interface between two media. Its index can be changed
without a rebuild.

Every part is the boundary of an object. A *medium* is identified by an integer: 0 is the ambient
medium, usually air (`AMBIENT`), `1 + k` is the inside of part `k`.

Under the rule `nested`, and under `facing` without overlaps, both sides of a part are known in
advance. Under `priority`, objects may overlap, and THE HIGHEST PRIORITY WINS (as in Arnold and in
the paper cited below; Maxwell counts the other way): a point in several objects is filled with the
medium of the highest-ranked one only. A ray then carries its *interior list*, the indices of the
parts that contain it. Surfaces of outranked objects do not separate media and leave the ray
unchanged.

Under `facing`, every face bends light between its part and air, as in Cycles. Where parts overlap,
this does not determine the medium of the next segment: a ray that leaves a liquid inside the wall
of its glass is still in the glass. Rays then carry an interior list, too, which determines media,
but not indices.

Parts that are not dielectrics (opaque parts, conductors, thin sheets) have no medium inside: the
medium of the ray that meets them surrounds them, on both sides. They may be anywhere, half in a
liquid and half in air. Where a scene has such parts, rays carry an interior list, which determines
this medium, under every rule.

A ray of a scene with dispersion carries light of one colour channel only, and
`interfaces_of_channel` gives the indices that it meets.

The list is an unordered array of `SLOTS` part indices, `EMPTY_SLOT` where free, and its updates are
branch-free. The side of a surface that a ray comes from determines whether the ray is inside that
part, regardless of the list. A part entered while the list is full replaces the entry of lowest
priority, or is omitted if its own priority is the lowest: with more than `SLOTS` objects around a
point, the ray tracks those of highest priority, as if it had left the others.

Source: Schmidt and Budge, Simple Nested Dielectrics in Ray Traced Images, Journal of Graphics
Tools 7 (2002).
"""

import functools
from typing import NamedTuple, TypeVar, get_args

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.choices import PartKind
from refref_jax.geometry import surfaces
from refref_jax.geometry.rays import Rays

_Tree = TypeVar("_Tree")

KINDS: tuple[PartKind, ...] = get_args(PartKind)
"""Kinds of parts, in the order of their numbers in `Interfaces.kinds`."""

DIELECTRIC, OPAQUE, CONDUCTOR, THIN_SHEET = range(len(KINDS))

AMBIENT = 0
"""Medium outside all objects."""

INDEX_OF_AIR = 1.0
"""Index of refraction of the usual ambient medium."""

SLOTS = 4
"""Length of the interior list, where rays carry one."""

EMPTY_SLOT = -1
"""Free slot in the interior list."""


class Interfaces(NamedTuple):
    """The interfaces of a scene, one per part; built by `interface_rules`.

    Attributes:
      index_inside: index of refraction inside the part.
      index_outside: index of refraction outside the part; that of the ambient medium under
        `facing` and `priority`.
      medium_outside: medium outside the part, meaningless where rays carry an interior list.
      tint: factor on linear RGB at every reflection and refraction (the colour of the glass BSDF
        in Cycles).
      absorption: absorption of the medium inside the part, linear RGB, per world unit.
      priority: rank of the part, unique, the highest wins; an empty array where rays carry no
        interior list: with dielectrics only, under `nested`, and under `facing` without overlaps.
      index_by_face: one value where faces determine indices and the interior list determines
        media: true under `facing`, false under `nested`; empty without a list, or under `priority`.
      kinds: index of each part's kind in `KINDS`; empty if all parts are dielectrics.
      opaque: mask of opaque parts; empty without any.
      complex_index: `eta` and `k` of each part relative to vacuum, linear RGB; empty without
        conductors.
      alpha: width of each part's distribution of microfacets, 0 where smooth; empty without rough
        parts.
      index_by_channel: indices inside and outside each part for red, green and blue; empty without
        dispersion.
    """

    index_inside: Float[Array, " parts"]
    index_outside: Float[Array, " parts"]
    medium_outside: Int[Array, " parts"]
    tint: Float[Array, "parts 3"]
    absorption: Float[Array, "parts 3"]
    priority: Int[Array, " ranked"]
    index_by_face: Bool[Array, " by_face"]
    kinds: Int[Array, " kinds"]
    opaque: Bool[Array, " opaque"]
    complex_index: Float[Array, "conductors 2 3"]
    alpha: Float[Array, " rough"]
    index_by_channel: Float[Array, "channels 2 parts"]


class Scene(NamedTuple):
    """A scene: surfaces, and the interfaces between media at these surfaces."""

    surfaces: surfaces.Surfaces | surfaces.LevelSet
    interfaces: Interfaces


def meshes_of(scene: Scene) -> surfaces.Surfaces:
    """Returns the surfaces of a scene that are meshes.

    Raises:
      TypeError: if its surface is a level set.
    """
    if isinstance(scene.surfaces, surfaces.LevelSet):
        raise TypeError(
            "The surface of this scene is a level set, which has no triangles. Extract its mesh, "
            "or call a function that takes both, such as trace."
        )
    return scene.surfaces


class Crossing(NamedTuple):
    """The two sides of an interface, as seen by a ray.

    At the surface of an outranked object, both sides have the same medium and the tint is 1, so
    that Snell's and Fresnel's laws leave the ray unchanged.

    Attributes:
      index_near: index of refraction on the incident side.
      index_far: index on the other side.
      medium_near: medium on the incident side.
      medium_far: medium on the other side.
      tint: factor on linear RGB, reflected or transmitted.
      part: part whose surface is hit, or `EMPTY_SLOT` if it is outranked.
      interior_list_after: interior list on the other side; a reflected ray keeps its own.
      kind: kind of the part, or `None` if all parts are dielectrics.
      opaque: whether the part is opaque, or `None` without opaque parts.
    """

    index_near: Float[Array, ""]
    index_far: Float[Array, ""]
    medium_near: Int[Array, ""]
    medium_far: Int[Array, ""]
    tint: Float[Array, "3"]
    part: Int[Array, ""]
    interior_list_after: Int[Array, " slots"]
    kind: Int[Array, ""] | None = None
    opaque: Bool[Array, ""] | None = None


def has_kinds(interfaces: Interfaces) -> bool:
    """Returns whether a scene has parts that are not dielectrics."""
    return interfaces.kinds.shape[0] > 0


def has_opaque(interfaces: Interfaces) -> bool:
    """Returns whether a scene has opaque parts."""
    return interfaces.opaque.shape[0] > 0


def has_dispersion(interfaces: Interfaces) -> bool:
    """Returns whether indices of refraction depend on the colour channel."""
    return interfaces.index_by_channel.shape[0] > 0


def interfaces_of_channel(interfaces: Interfaces, channel: Int[Array, ""]) -> Interfaces:
    """Returns interfaces without dispersion: those that light of one channel meets.

    Args:
      interfaces: interfaces with dispersion.
      channel: 0 for red, 1 for green, 2 for blue.
    """
    inside, outside = interfaces.index_by_channel[channel]
    return interfaces._replace(
        index_inside=inside,
        index_outside=outside,
        index_by_channel=interfaces.index_by_channel[:0],
    )


def interior_length(interfaces: Interfaces) -> int:
    """Returns the length of a ray's interior list: `SLOTS` if it carries one, else 0."""
    return SLOTS if interfaces.priority.shape[0] else 0


def empty_interior_list(interfaces: Interfaces) -> Int[Array, " slots"]:
    """Returns the interior list of a ray outside all parts."""
    return jnp.full(interior_length(interfaces), EMPTY_SLOT, jnp.int32)


def crossing(
    interfaces: Interfaces,
    interior_list: Int[Array, " slots"],
    part: Int[Array, ""],
    entering: Bool[Array, ""],
) -> Crossing:
    """Returns the media on both sides of the surface that a ray hits.

    Args:
      interfaces: interfaces of the scene.
      interior_list: interior list of the ray before the surface, possibly of length 0.
      part: part that is hit.
      entering: whether the ray comes from outside that part.
    """
    sides = _dielectric_crossing(interfaces, interior_list, part, entering)
    if not has_kinds(interfaces):
        return sides
    kind = interfaces.kinds[part]
    embedded = _embedded_crossing(interfaces, interior_list, part)
    sides = jax.tree.map(functools.partial(jnp.where, kind == DIELECTRIC), sides, embedded)
    opaque = interfaces.opaque[part] if has_opaque(interfaces) else None
    return sides._replace(kind=kind, opaque=opaque)


def _embedded_crossing(
    interfaces: Interfaces, interior_list: Int[Array, " slots"], part: Int[Array, ""]
) -> Crossing:
    """Returns the crossing of a part without a medium of its own: both sides have that of the ray.

    The far index is that of the part, for the reflectance of a thin sheet.
    """
    medium = _medium(interfaces, interior_list)
    ambient = interfaces.index_outside[part]  # no part contains this one
    near = _index(interfaces, medium, ambient)
    if interfaces.index_by_face.shape[0]:
        near = jnp.where(interfaces.index_by_face[0], ambient, near)
    return Crossing(
        index_near=near,
        index_far=interfaces.index_inside[part],
        medium_near=medium,
        medium_far=medium,
        tint=interfaces.tint[part],
        part=part,
        interior_list_after=interior_list,
    )


def _dielectric_crossing(
    interfaces: Interfaces,
    interior_list: Int[Array, " slots"],
    part: Int[Array, ""],
    entering: Bool[Array, ""],
) -> Crossing:
    declared = _declared_crossing(interfaces, interior_list, part, entering)
    if interior_length(interfaces) == 0:
        return declared
    without = jnp.where(interior_list == part, EMPTY_SLOT, interior_list)
    within = _add(interfaces, without, part)
    medium_without, medium_within = _medium(interfaces, without), _medium(interfaces, within)
    medium_near = jnp.where(entering, medium_without, medium_within)
    medium_far = jnp.where(entering, medium_within, medium_without)
    after = jnp.where(entering, within, without)
    if interfaces.index_by_face.shape[0]:
        return declared._replace(
            medium_near=medium_near, medium_far=medium_far, interior_list_after=after
        )
    outranked = medium_without == medium_within
    return Crossing(
        index_near=_index(interfaces, medium_near, interfaces.index_outside[0]),
        index_far=_index(interfaces, medium_far, interfaces.index_outside[0]),
        medium_near=medium_near,
        medium_far=medium_far,
        tint=jnp.where(outranked, 1.0, interfaces.tint[part]),
        part=jnp.where(outranked, EMPTY_SLOT, part),
        interior_list_after=after,
    )


def transmittance(
    interfaces: Interfaces, medium: Int[Array, ""], length: Float[Array, ""]
) -> Float[Array, "3"]:
    """Returns the transmittance of linear RGB light along a segment in a medium.

    Args:
      interfaces: interfaces of the scene.
      medium: medium of the segment; `AMBIENT` does not absorb.
      length: length of the segment, world units; may be infinite.

    Source: the Beer-Lambert law.
    """
    part = jnp.maximum(medium - 1, 0)
    absorption = jnp.where(medium == AMBIENT, 0.0, interfaces.absorption[part])
    return numerics.exponential_decay(absorption, length)


def _declared_crossing(
    interfaces: Interfaces,
    interior_list: Int[Array, " slots"],
    part: Int[Array, ""],
    entering: Bool[Array, ""],
) -> Crossing:
    """Returns the crossing of a part whose two sides are known in advance."""
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
        interior_list_after=interior_list,
    )


def _ranks(interfaces: Interfaces, interior_list: Int[Array, " slots"]) -> Int[Array, " slots"]:
    """Returns the rank of every entry of an interior list; free slots rank lowest."""
    return jnp.where(
        interior_list == EMPTY_SLOT, EMPTY_SLOT, interfaces.priority[jnp.maximum(interior_list, 0)]
    )


def _add(
    interfaces: Interfaces, interior_list: Int[Array, " slots"], part: Int[Array, ""]
) -> Int[Array, " slots"]:
    """Adds a part to a free slot, or replaces the lowest entry if the part outranks it."""
    ranks = _ranks(interfaces, interior_list)
    lowest = jnp.argmin(ranks)
    here = (jnp.arange(SLOTS) == lowest) & (interfaces.priority[part] > ranks[lowest])
    return jnp.where(here, part, interior_list)


def _medium(interfaces: Interfaces, interior_list: Int[Array, " slots"]) -> Int[Array, ""]:
    """Returns the medium of the highest entry; `1 + EMPTY_SLOT` is the ambient medium."""
    return 1 + interior_list[jnp.argmax(_ranks(interfaces, interior_list))]


def _index(
    interfaces: Interfaces, medium: Int[Array, ""], ambient: Float[Array, ""]
) -> Float[Array, ""]:
    index = interfaces.index_inside[jnp.maximum(medium - 1, 0)]
    return jnp.where(medium == AMBIENT, ambient, index)


def with_index(scene: Scene, index: Float[ArrayLike, ""], *, part: int = 0) -> Scene:
    """Returns a scene in which one part has another index of refraction.

    The outer index of parts directly inside this part changes too, except under the rule `facing`,
    where air is outside every part. Differentiable; no array shape changes, so that functions
    compiled for one index work for all.

    Args:
      scene: the scene.
      index: index of refraction, relative to air.
      part: index of the part, in the order in which the parts were given; the parts of a scene
        folder are ordered by name.

    Raises:
      ValueError: if the part does not exist, or the scene has dispersion.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> box = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> float(refref_jax.with_index(box, 1.25).interfaces.index_inside[0])
      1.25
    """
    if has_dispersion(scene.interfaces):
        raise ValueError(
            "The scene has dispersion: its indices differ between red, green and blue. Take one "
            "colour first, with of_channel."
        )
    new = jnp.asarray(index)
    interfaces = jax.tree.map(jnp.asarray, scene.interfaces)
    # A Python number has no precision of its own.
    decisive = interfaces if new.weak_type else (interfaces, new)
    interfaces = _in_precision(_highest(decisive), interfaces)
    parts = interfaces.index_inside.shape[0]
    if not 0 <= part < parts:
        raise ValueError(
            f"part is {part}, but the number of parts is {parts}. Give 0 to {parts - 1}."
        )
    new = new.astype(interfaces.index_inside.dtype)
    had = interfaces.index_outside == interfaces.index_inside[part]
    around = (interfaces.medium_outside == 1 + part) & had
    changed = interfaces._replace(
        index_inside=interfaces.index_inside.at[part].set(new),
        index_outside=jnp.where(around, new, interfaces.index_outside),
    )
    return scene._replace(interfaces=changed)


def of_channel(scene: Scene, channel: int) -> Scene:
    """Returns a scene without dispersion, with the indices of one colour channel.

    Args:
      scene: the scene.
      channel: 0 for red, 1 for green, 2 for blue; all are equal in a scene without dispersion.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> flint = refref_jax.Material(dispersion=(1.61, 1.62, 1.64))
      >>> prism = refref_jax.make_part(trimesh.creation.box(), index=1.62, material=flint)
      >>> blue = refref_jax.of_channel(refref_jax.assemble([prism]), 2)
      >>> print(f"{blue.interfaces.index_inside[0]:.2f}")
      1.64
    """
    if not has_dispersion(scene.interfaces):
        return scene
    return scene._replace(interfaces=interfaces_of_channel(scene.interfaces, jnp.int32(channel)))


def in_one_precision(scene: _Tree, rays: Rays) -> tuple[_Tree, Rays]:
    """Converts a scene, or its surfaces, and rays to arrays of the highest precision among them.

    Scenes are built in single precision, so rays in double precision are traced in double
    precision through corners that were rounded to single precision.
    """
    both = jax.tree.map(jnp.asarray, (scene, rays))
    return _in_precision(_highest(both), both)


def _highest(tree: _Tree) -> DTypeLike:
    """Returns the widest real data type in a pytree of arrays."""
    kinds = {x.dtype for x in jax.tree.leaves(tree) if _is_real(x)}
    return max(kinds, key=lambda each: each.itemsize)


def _in_precision(kind: DTypeLike, tree: _Tree) -> _Tree:
    return jax.tree.map(lambda x: x.astype(kind) if _is_real(x) else x, tree)


def _is_real(array: Array) -> bool:
    return jnp.issubdtype(array.dtype, jnp.floating)
