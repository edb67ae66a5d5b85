"""Describes the parts of an object of the data set (NumPy only)."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour

Category = Literal["smcvx", "smncvx", "mmncvx", "materials"]
"""Convex with one material, not convex with one material, not convex with several materials; and
the scenes that compare materials with Cycles, which are not part of the data set."""

PartKind = Literal["dielectric", "opaque", "conductor", "thin_sheet"]
"""Optical kind of a part."""

OPAQUE, CONDUCTOR = "opaque", "conductor"
"""Names of materials that have no index of refraction."""

RADIUS = 2.0
"""Largest distance of a vertex of any object from the origin, world units."""


class ObjectPart(NamedTuple):
    """A surface and the medium inside.

    A part inside another is separated from it by a gap, so that the media on both sides of a
    surface never depend on rounding.

    Attributes:
      name: name of the part, such as `body`, `shell` or `liquid`; unique in the object.
      material: medium inside; a name of `refref_jax.data.meshes.INDEX_OF_REFRACTION`, or `OPAQUE`
        or `CONDUCTOR` for parts of these kinds.
      vertices: positions, world units, z up, within `RADIUS` of the origin.
      faces: vertex indices, counter-clockwise seen from outside; without degenerate faces, and
        closed unless the part is a thin sheet.
      smooth: whether the part is shaded with vertex normals; with face normals otherwise. A sharp
        edge of a smooth part has to be rounded in its geometry.
      tint: factor of linear RGB radiance at every reflection and every crossing of the surface, 0
        to 1.
      absorption: absorption coefficient of the medium inside, linear RGB, per world unit. Only for
        parts that contain no other part, because Blender continues to absorb there.
      kind: optical kind of the part.
      index: index of refraction relative to vacuum, one per colour channel if it disperses light;
        `None` for that of the material.
      roughness: roughness of a dielectric or conductor, 0 to 1; GGX's alpha is its square.
      radiance: linear RGB radiance of an opaque part that emits light.
      colours: light that an opaque part emits at its vertices, 8-bit sRGB; in place of `radiance`.
      albedo: linear RGB albedo of an opaque part that is lit by the scene, a diffuse reflector.
      eta: real part of a conductor's index of refraction relative to vacuum, linear RGB.
      k: imaginary part of it.
    """

    name: str
    material: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    smooth: bool = True
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION
    kind: PartKind = "dielectric"
    index: float | Colour | None = None  # type: ignore[assignment]  # hides tuple.index
    roughness: float = 0.0
    radiance: Colour | None = None
    colours: UInt8[np.ndarray, "vertices 3"] | None = None
    albedo: Colour | None = None
    eta: Colour | None = None
    k: Colour | None = None


class Object(NamedTuple):
    """One of the fifty objects of the data set, or an object that compares materials.

    Attributes:
      name: name in the published data set, if it is one of it, in lower case with underscores.
      category: category of geometry and materials.
      make: function from a level of detail to the parts. The renders use 1; the number of triangles
        grows with its square, and 0.3 suffices to test the shape. It is deterministic.
    """

    name: str
    category: Category
    make: Callable[[float], list[ObjectPart]]
