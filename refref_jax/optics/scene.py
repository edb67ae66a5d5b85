"""What light meets, and what may be changed of it without building it anew."""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from refref_jax.geometry import surfaces
from refref_jax.geometry.rays import Rays
from refref_jax.optics import media

_Tree = TypeVar("_Tree")


class Scene(NamedTuple):
    """All that light meets: surfaces, and the interfaces that they stand for."""

    surfaces: surfaces.Surfaces
    interfaces: media.Interfaces


def with_index(geometry: Scene, index: Float[ArrayLike, ""], *, part: int = 0) -> Scene:
    """Returns a scene in which one part has another index of refraction.

    So it has wherever it lies around another part, if that part had its index outside before: not
    under the rule `facing`, where air is outside of every part. Differentiable; no shape changes,
    so that what is compiled for one index serves all.

    Args:
      geometry: the scene.
      index: of refraction, relative to air.
      part: number of the part, in the order in which the parts were given; those of a scene folder
        are ordered by name.

    Raises:
      ValueError: if there is no such part.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> box = refref_jax.single_body(trimesh.creation.box(), index=1.5)
      >>> float(refref_jax.with_index(box, 1.25).interfaces.index_inside[0])
      1.25
    """
    new = jnp.asarray(index)
    interfaces = jax.tree.map(jnp.asarray, geometry.interfaces)
    # A number of Python's has no precision of its own.
    decisive = interfaces if new.weak_type else (interfaces, new)
    interfaces = _in_precision(_highest(decisive), interfaces)
    parts = interfaces.index_inside.shape[0]
    if not 0 <= part < parts:
        raise ValueError(
            f"There is no part {part}: the scene has {parts}. Give a number from 0 to {parts - 1}."
        )
    new = new.astype(interfaces.index_inside.dtype)
    had = interfaces.index_outside == interfaces.index_inside[part]
    around = (interfaces.medium_outside == 1 + part) & had
    changed = interfaces._replace(
        index_inside=interfaces.index_inside.at[part].set(new),
        index_outside=jnp.where(around, new, interfaces.index_outside),
    )
    return geometry._replace(interfaces=changed)


def in_one_precision(geometry: Scene, rays: Rays) -> tuple[Scene, Rays]:
    """Returns a scene and rays as JAX arrays of one precision, the highest of their numbers'.

    Scenes are built in single precision, so rays in double precision are traced in double
    precision through the corners as they were rounded.
    """
    both = jax.tree.map(jnp.asarray, (geometry, rays))
    return _in_precision(_highest(both), both)


def _highest(tree: _Tree) -> DTypeLike:
    """Returns the widest type of the real numbers in a tree of arrays."""
    kinds = {x.dtype for x in jax.tree.leaves(tree) if _is_real(x)}
    return max(kinds, key=lambda each: each.itemsize)


def _in_precision(kind: DTypeLike, tree: _Tree) -> _Tree:
    return jax.tree.map(lambda x: x.astype(kind) if _is_real(x) else x, tree)


def _is_real(array: Array) -> bool:
    return jnp.issubdtype(array.dtype, jnp.floating)
