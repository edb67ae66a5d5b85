"""Scenes for path tracing, and changes to a scene that do not require a rebuild."""

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
    """A scene: surfaces, and the interfaces between media at these surfaces."""

    surfaces: surfaces.Surfaces
    interfaces: media.Interfaces


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
    if media.has_dispersion(scene.interfaces):
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
    """
    if not media.has_dispersion(scene.interfaces):
        return scene
    return scene._replace(interfaces=media.of_channel(scene.interfaces, jnp.int32(channel)))


def in_one_precision(scene: Scene, rays: Rays) -> tuple[Scene, Rays]:
    """Converts a scene and rays to JAX arrays, all in the highest precision that one of them has.

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
