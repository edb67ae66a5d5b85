"""What an object of the data set consists of (NumPy only)."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour

Category = Literal["smcvx", "smncvx", "mmncvx"]
"""Single material and convex, single and not convex, multiple materials and not convex."""

RADIUS = 2.0
"""No vertex of any object is farther from the origin, world units."""


class ObjectPart(NamedTuple):
    """One closed surface, and the medium inside.

    A part that lies in another is separated from it by a gap all around, so that which medium is
    on either side of a surface never depends on rounding.

    Attributes:
      name: `body`, `shell`, `liquid`; unique in the object.
      material: inside; a name of `refref_jax.data.meshes.INDEX_OF_REFRACTION`.
      vertices: world units, z up, within `RADIUS` of the origin.
      faces: counter-clockwise seen from outside the surface, closed, without degenerate ones.
      smooth: whether all of it is shaded with vertex normals; else with face normals. A sharp edge
        of a smooth part has to be rounded in its geometry.
      tint: factor of linear RGB light at every reflection and every crossing of the surface, 0 to
        1.
      absorption: of the medium inside, linear RGB, per world unit. Only of a part that no other
        part lies in: Blender goes on absorbing there.
    """

    name: str
    material: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    smooth: bool = True
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION


class Object(NamedTuple):
    """One of the fifty.

    Attributes:
      name: as in the published data set, in lower case with underscores.
      category: of geometry and materials.
      make: from a detail to the parts. 1 is what is rendered; the number of triangles grows with
        its square, and 0.3 is enough to test the shape. Always the same parts for the same detail.
    """

    name: str
    category: Category
    make: Callable[[float], list[ObjectPart]]
