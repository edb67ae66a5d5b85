"""Combines fields (see `distance_fields`): union, subtraction, walls, and motions (NumPy only).

Where two distances differ by less than the *blending length*, their union (or intersection) is
rounded, by up to a sixth of this length, where both are equal. Elsewhere it is sharp. A blended
field is 1-Lipschitz if its operands are, since its gradient is a mean of theirs. Therefore an
inward offset leaves a wall of at least that thickness.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

from experiments.dataset.objects.distance_fields import (
    Distances,
    Field,
    Points,
    Vector,
)


def union(*fields: Field, blend: float = 0.0) -> Field:
    """Returns the union of solids, rounded where they meet.

    Args:
      *fields: operands, combined one by one with the union of the previous ones.
      blend: blending length, 0 or more.
    """
    balls = [(np.asarray(field.centre), field.radius) for field in fields]

    def distance(points: Points) -> Distances:
        nearest = fields[0](points)
        for field, (centre, radius) in zip(fields[1:], balls[1:], strict=True):
            # Evaluated only where the solid is close enough to matter, which skips most points.
            near = np.linalg.norm(points - centre, axis=-1) - radius < nearest + blend
            nearest[near] = smooth_minimum(nearest[near], field(points[near]), blend)
        return nearest

    middle = np.mean([centre for centre, _ in balls], axis=0)
    reach = max(float(np.linalg.norm(centre - middle)) + radius for centre, radius in balls)
    # A union may exceed its operands by a sixth of the blend at each blending.
    grown = reach + blend / 6.0 * (len(fields) - 1)
    return Field(distance, (float(middle[0]), float(middle[1]), float(middle[2])), grown)


def subtraction(solid: Field, tool: Field, *, blend: float = 0.0) -> Field:
    """Returns the difference of two solids, rounded at the new edge."""
    centre = np.asarray(tool.centre)

    def distance(points: Points) -> Distances:
        beyond = -solid(points)
        near = np.linalg.norm(points - centre, axis=-1) - tool.radius < beyond + blend
        beyond[near] = smooth_minimum(beyond[near], tool(points[near]), blend)
        return -beyond

    return solid._replace(distance=distance)


def intersection(solid: Field, other: Field, *, blend: float = 0.0) -> Field:
    """Returns the intersection of two solids, rounded at the edge between them."""
    return solid._replace(distance=lambda p: -smooth_minimum(-solid(p), -other(p), blend))


def smooth_minimum(a: Distances, b: Distances, blend: float) -> Distances:
    """Returns the smaller distance, less up to a sixth of the blending length where they are close.

    Twice differentiable. Source: Quilez, Smooth minimum (2013), the cubic one.
    """
    if blend <= 0.0:
        return np.minimum(a, b)
    share = np.maximum(1.0 - np.abs(a - b) / blend, 0.0)
    return np.minimum(a, b) - blend / 6.0 * share**3


def offset(field: Field, distance: float) -> Field:
    """Returns a solid grown by a distance on all sides; shrunk, if it is negative."""
    return Field(lambda p: field(p) - distance, field.centre, field.radius + max(distance, 0.0))


def moved(field: Field, shift: Vector) -> Field:
    """Returns a translated solid."""
    step = np.asarray(shift, float)
    x, y, z = (np.asarray(field.centre) + step).tolist()
    return Field(lambda p: field(p - step), (x, y, z), field.radius)


def turned(field: Field, rotation: Rotation) -> Field:
    """Returns a solid rotated around the origin."""
    back = rotation.as_matrix()
    x, y, z = rotation.apply(np.asarray(field.centre)).tolist()
    return Field(lambda p: field(p @ back), (x, y, z), field.radius)


def mirrored(field: Field) -> Field:
    """Returns a solid reflected in the plane x = 0."""
    flip = np.array([-1.0, 1.0, 1.0])
    x, y, z = field.centre
    return Field(lambda p: field(p * flip), (-x, y, z), field.radius)


def both_sides(*fields: Field) -> list[Field]:
    """Returns solids, each followed by its mirror image in the plane x = 0."""
    return [side for field in fields for side in (field, mirrored(field))]


def warped(field: Field, warp: Callable[[Points], Points], reach: float) -> Field:
    """Returns a solid under a change of coordinates; the distance is then not exact.

    Args:
      field: solid to warp.
      warp: function from points to the points where the solid is evaluated instead.
      reach: largest distance by which the warp moves the surface.
    """
    return Field(lambda p: field(warp(p)), field.centre, field.radius + reach)


def gridded(
    values: Float[np.ndarray, "nx ny nz"], low: Float[np.ndarray, "3"], spacing: float
) -> Field:
    """Returns the cubic spline through samples on a grid, extended by the nearest values.

    Args:
      values: signed distances.
      low: position of the first sample.
      spacing: distance between samples, along all axes.
    """
    coefficients = spline_filter(values, order=3)

    def distance(points: Points) -> Distances:
        at = (points - low).T / spacing
        return map_coordinates(coefficients, at, order=3, mode="nearest", prefilter=False)

    return Field(distance, (0.0, 0.0, 0.0), np.inf)
