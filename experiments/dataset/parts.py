"""Describes the parts of an object of the data set (NumPy only)."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour

Category = Literal["smcvx", "smncvx", "mmncvx"]
"""Convex with one material, not convex with one material, not convex with several materials."""

RADIUS = 2.0
"""Largest distance of a vertex of any object from the origin, world units."""


class ObjectPart(NamedTuple):
    """A closed surface and the medium inside.

    A part inside another is separated from it by a gap, so that the media on both sides of a
    surface never depend on rounding.

    Attributes:
      name: name of the part, such as `body`, `shell` or `liquid`; unique in the object.
      material: medium inside; a name of `refref_jax.data.meshes.INDEX_OF_REFRACTION`.
      vertices: positions, world units, z up, within `RADIUS` of the origin.
      faces: vertex indices, counter-clockwise seen from outside; closed, without degenerate faces.
      smooth: whether the part is shaded with vertex normals; with face normals otherwise. A sharp
        edge of a smooth part has to be rounded in its geometry.
      tint: factor of linear RGB radiance at every reflection and every crossing of the surface, 0
        to 1.
      absorption: absorption coefficient of the medium inside, linear RGB, per world unit. Only for
        parts that contain no other part, because Blender continues to absorb there.
    """

    name: str
    material: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    smooth: bool = True
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION


class Object(NamedTuple):
    """One of the fifty objects of the data set.

    Attributes:
      name: name in the published data set, in lower case with underscores.
      category: category of geometry and materials.
      make: function from a level of detail to the parts. The renders use 1; the number of triangles
        grows with its square, and 0.3 suffices to test the shape. It is deterministic.
    """

    name: str
    category: Category
    make: Callable[[float], list[ObjectPart]]
