"""Makes parts from fields (see `distance_fields`), and centres objects (NumPy only).

The *core* of a figure of clear glass is a smaller solid of another medium inside it, like the
tinted spirit in a bottle shaped like an animal.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from experiments.dataset.objects.distance_fields import Field
from experiments.dataset.objects.field_operations import gridded, intersection, offset
from experiments.dataset.objects.isosurface import isosurface, largest_piece, sample
from experiments.dataset.parts import RADIUS, Category, Object, ObjectPart
from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour

WALL = 0.09
"""Least thickness of the glass around a core."""

# Margin of the searched cube beyond the largest radius: solids are scaled only afterwards.
_MARGIN = 0.4

# Spacing at detail 1.
_SPACING = 0.036

# Largest spacing as a share of the thinnest wall: walls are found if they contain a grid point.
_OF_THINNEST = 0.75

# Widths of the Gaussians that smooth a complete solid, and a core; and spacings of their grids.
_SOFTNESS, _SOFT_SPACING = 0.032, 0.04
_CORE_SOFTNESS, _CORE_SPACING = 0.09, 0.07

# Initial extra margin of a core, since smoothing fills folds; where it exceeds the margin, the core
# is intersected with the least wall, with this blending length.
_CORE_RESERVE, _CORE_BLEND = 0.025, 0.06


def spacing(detail: float, *, thinnest: float) -> float:
    """Returns the spacing of the grid for a detail, world units.

    Args:
      detail: level of detail; 1 for rendering.
      thinnest: thickness of the thinnest wall, neck or gap.
    """
    return min(_SPACING / detail, _OF_THINNEST * thinnest)


def single_glass(
    name: str,
    field: Callable[[], Field],
    *,
    radius: float,
    thinnest: float,
    fineness: float = 1.0,
    tint: Colour = CLEAR,
) -> Object:
    """Returns an object that is one piece of glass.

    Args:
      name: name of the object.
      field: function that makes its solid.
      radius: distance of the farthest point after centring.
      thinnest: least thickness of any wall; see `spacing`.
      fineness: factor of the detail, for shapes with small features.
      tint: tint of the surface; see `ObjectPart`.
    """

    def make(detail: float) -> list[ObjectPart]:
        step = spacing(fineness * detail, thinnest=thinnest)
        surface = isosurface(softened(field()), spacing=step)
        return centred([ObjectPart("body", "glass", *surface, tint=tint)], radius)

    return Object(name, "smncvx", make)


def filled_glass(
    name: str,
    field: Callable[[], Field],
    *,
    radius: float,
    thinnest: float,
    medium: str,
    tint: Colour = CLEAR,
    absorption: Colour = NO_ABSORPTION,
    wall: float = WALL,
    fineness: float = 1.0,
) -> Object:
    """Returns an object of clear glass around a core.

    Args:
      name: name of the object.
      field: function that makes its solid.
      radius: distance of the farthest point after centring.
      thinnest: least thickness of any wall; see `spacing`.
      medium: material of the core.
      tint: tint of the core's surface.
      absorption: absorption in the core.
      wall: least thickness of the glass around the core.
      fineness: factor of the detail.
    """
    category: Category = "mmncvx"

    def make(detail: float) -> list[ObjectPart]:
        step = spacing(fineness * detail, thinnest=thinnest)
        body = softened(field())
        outer = isosurface(body, spacing=step)
        inner = largest_piece(isosurface(core(body, wall), spacing=step))
        shell = ObjectPart("body", "glass", *outer)
        filling = ObjectPart("core", medium, *inner, tint=tint, absorption=absorption)
        return centred([shell, filling], radius)

    return Object(name, category, make)


def softened(solid: Field) -> Field:
    """Returns a solid without creases and fissures, which a mesh could not represent."""
    return _blurred(solid, width=_SOFTNESS, grid=_SOFT_SPACING)


def core(body: Field, wall: float) -> Field:
    """Returns a rounded core of a 1-Lipschitz field, below a wall of a given thickness."""
    reserved = offset(body, -wall - _CORE_RESERVE)
    rounded = _blurred(reserved, width=_CORE_SOFTNESS, grid=_CORE_SPACING)
    return intersection(rounded, offset(body, -wall), blend=_CORE_BLEND)


def _blurred(solid: Field, *, width: float, grid: float) -> Field:
    values, low = sample(solid, spacing=grid, half_extent=RADIUS + _MARGIN)
    # Samples are exact up to many widths from the surface.
    field = gridded(gaussian_filter(values, width / grid), low, grid)
    return field._replace(centre=solid.centre, radius=solid.radius)


def centred(parts: Sequence[ObjectPart], radius: float) -> list[ObjectPart]:
    """Returns parts translated to the middle of their bounding box and scaled to a radius.

    Args:
      parts: parts of one object.
      radius: distance of the farthest vertex afterwards.
    """
    points = np.concatenate([part.vertices for part in parts])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = radius / np.max(np.linalg.norm(points - middle, axis=-1))
    return [part._replace(vertices=scale * (part.vertices - middle)) for part in parts]
