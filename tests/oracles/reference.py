"""Slow float64 oracles in NumPy, written from the textbook rather than from the library."""

from typing import NamedTuple

import numpy as np


def snell_angle(theta, index_near, index_far):
    """Returns the angle of refraction, NaN in total reflection."""
    with np.errstate(invalid="ignore"):
        return np.arcsin(index_near / index_far * np.sin(theta))


def fresnel_by_angles(theta, index_near, index_far):
    """Returns the unpolarised reflectance by the sine and tangent laws (Hecht, section 4.6.3)."""
    if index_near == index_far:
        return 0.0
    if theta == 0.0:
        return ((index_near - index_far) / (index_near + index_far)) ** 2
    inner = snell_angle(theta, index_near, index_far)
    if np.isnan(inner):
        return 1.0
    perpendicular = np.sin(theta - inner) / np.sin(theta + inner)
    parallel = np.tan(theta - inner) / np.tan(theta + inner)
    return 0.5 * (perpendicular**2 + parallel**2)


def refract_by_angles(direction, normal, index_near, index_far):
    """Returns the refracted direction built from the angle in the plane of incidence."""
    cosine = -np.dot(direction, normal)
    inner = snell_angle(np.arccos(np.clip(cosine, -1.0, 1.0)), index_near, index_far)
    if np.isnan(inner):
        return None
    tangent = direction + cosine * normal
    size = np.linalg.norm(tangent)
    if size < 1e-15:
        return direction.copy()
    return np.sin(inner) * tangent / size - np.cos(inner) * normal


def hits_by_brute_force(triangles, origins, directions):
    """Returns distance and face of each ray's closest hit, solving one 3 x 3 system a pair."""
    distances = np.full(len(origins), np.inf)
    faces = np.full(len(origins), -1)
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        a, b, c = np.moveaxis(triangles, 1, 0)
        system = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], axis=-1)
        solvable = np.abs(np.linalg.det(system)) > 1e-300
        solution = np.full(a.shape, np.nan)
        solution[solvable] = np.linalg.solve(system[solvable], (origin - a[solvable])[..., None])[
            ..., 0
        ]
        u, v, t = solution.T
        with np.errstate(invalid="ignore"):
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if hit.any():
            faces[i] = np.argmin(np.where(hit, t, np.inf))
            distances[i] = t[faces[i]]
    return distances, faces


class Sphere(NamedTuple):
    """A body with its index of refraction, and the index around it."""

    radius: float
    inside: float
    outside: float


class Bend(NamedTuple):
    """A point of a path and the direction that leaves it."""

    point: np.ndarray
    direction: np.ndarray


def trace_concentric_spheres(spheres, origin, direction, bends):
    """Follows a ray through spheres around the origin; returns the bends."""
    path = []
    for _ in range(bends):
        best = None
        for sphere in spheres:
            b = np.dot(origin, direction)
            discriminant = b * b - np.dot(origin, origin) + sphere.radius**2
            if discriminant <= 0.0:
                continue
            for t in (-b - np.sqrt(discriminant), -b + np.sqrt(discriminant)):
                if t > 1e-9 and (best is None or t < best[0]):
                    best = (t, sphere)
        if best is None:
            break
        t, sphere = best
        origin = origin + t * direction
        outward = origin / sphere.radius
        entering = np.dot(direction, outward) < 0.0
        normal = outward if entering else -outward
        near, far = (sphere.outside, sphere.inside) if entering else (sphere.inside, sphere.outside)
        refracted = refract_by_angles(direction, normal, near, far)
        if refracted is None:
            refracted = direction - 2.0 * np.dot(direction, normal) * normal
        direction = refracted
        path.append(Bend(origin, direction))
    return path
