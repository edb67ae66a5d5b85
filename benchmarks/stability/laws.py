"""How exactly the laws of one interface are computed, over lattices that reach their edges.

Each function takes the number of lattice points a decade and returns the worst error found. The
reference works in extended precision from the same rounded vectors. Letters as in `snell`.
"""

import contextlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.optics import fresnel

# Nearest that the lattice comes to grazing, normal and critical incidence, in radians.
_NEAREST = 1e-6

# From here on the critical angle is far enough for float32.
_NEAR_CRITICAL = 1e-2

LARGEST_RATIO = 2.5


class Found(NamedTuple):
    """The worst error of some cases."""

    worst: float
    cases: int


class Lattice(NamedTuple):
    """Cases: unit vectors in double precision, and indices."""

    directions: np.ndarray
    normals: np.ndarray
    near: np.ndarray
    far: np.ndarray


class Law(NamedTuple):
    """What happens at the interface; `gamma_squared` is negative in total reflection."""

    gamma_squared: np.ndarray
    refracted: np.ndarray
    reflected: np.ndarray
    reflectance: np.ndarray


def ratios(density: int) -> np.ndarray:
    """Returns ratios of indices from 1/2.5 to 2.5, of which the middle one is exactly 1."""
    logarithms = np.linspace(-1.0, 1.0, 4 * density + 1)
    logarithms[2 * density] = 0.0
    return LARGEST_RATIO**logarithms


def angles(density: int, ratio: float) -> np.ndarray:
    """Returns angles of incidence that crowd at normal, grazing and critical incidence."""
    steps = np.logspace(np.log10(_NEAREST), 0.0, 6 * density + 1)
    crowds = [[0.0], steps, 0.5 * np.pi - steps]
    if ratio > 1.0:
        critical = np.arcsin(1.0 / ratio)
        crowds += [critical - steps, [critical], critical + steps]
    found = np.concatenate(crowds)
    return found[(found >= 0.0) & (found <= 0.5 * np.pi - 0.99 * _NEAREST)]


def lattice(density: int) -> Lattice:
    """Returns every angle with every ratio, each in an orientation of its own."""
    near, theta = np.concatenate(
        [np.stack(np.broadcast_arrays(r, angles(density, r))) for r in ratios(density)], axis=1
    )
    frames, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(len(theta), 3, 3)))
    normals, tangents = frames[..., 0], frames[..., 1]
    directions = np.sin(theta)[:, None] * tangents - np.cos(theta)[:, None] * normals
    return Lattice(directions, normals, near, np.ones_like(near))


def rounded(cases: Lattice, kind: type) -> Lattice:
    return Lattice(*(x.astype(kind) for x in cases))


def ours(cases: Lattice) -> Law:
    """Returns what the library makes of cases, in their precision."""
    double = cases.directions.dtype == np.float64

    def one(direction, normal, near, far):
        beta = -jnp.dot(direction, normal)
        gamma, total = fresnel.transmission(beta, near, far)
        squared = jnp.where(total, -1.0, jnp.square(gamma))
        refracted = fresnel.refract(direction, normal, near, far)
        reflectance = fresnel.reflectance(beta, near, far)
        return Law(squared, refracted, fresnel.reflect(direction, normal), reflectance)

    with jax.enable_x64(True) if double else contextlib.nullcontext():
        law = jax.jit(jax.vmap(one))(*(jnp.asarray(x) for x in cases))
        return Law(*(np.asarray(x, np.longdouble) for x in law))


def textbook(cases: Lattice) -> Law:
    """Returns Snell's, the mirror's and Fresnel's laws in extended precision."""
    exact = rounded(cases, np.longdouble)
    n = exact.normals / np.sqrt(np.sum(exact.normals**2, -1, keepdims=True))
    d = exact.directions / np.sqrt(np.sum(exact.directions**2, -1, keepdims=True))
    cosine = -np.sum(n * d, -1)
    tangent = d + cosine[:, None] * n
    across = (exact.near / exact.far)[:, None] * tangent
    squared = 1.0 - np.sum(across**2, -1)
    inner = np.sqrt(np.maximum(squared, 0.0))
    perpendicular = (exact.near * cosine - exact.far * inner) / (
        exact.near * cosine + exact.far * inner
    )
    parallel = (exact.far * cosine - exact.near * inner) / (exact.far * cosine + exact.near * inner)
    reflectance = np.where(squared < 0.0, 1.0, 0.5 * (perpendicular**2 + parallel**2))
    refracted = across - inner[:, None] * n
    return Law(squared, refracted, d + 2.0 * cosine[:, None] * n, reflectance)


def _both(density: int, kind: type) -> tuple[Lattice, Law, Law]:
    cases = rounded(lattice(density), kind)
    return cases, ours(cases), textbook(cases)


def _off_critical(cases: Lattice) -> np.ndarray:
    sine = np.minimum(1.0, cases.far / cases.near).astype(float)
    cosine = -np.sum(cases.normals * cases.directions, axis=-1).astype(float)
    theta = np.arccos(np.clip(cosine, -1.0, 1.0))
    return (np.abs(theta - np.arcsin(sine)) > _NEAR_CRITICAL) | (cases.near <= cases.far)


def refracted_cosine(density: int, kind: type) -> Found:
    """Squares of the cosine beyond, relative to the larger of the two terms that form it."""
    cases, found, true = _both(density, kind)
    terms = np.maximum(1.0, (cases.near / cases.far).astype(float) ** 2)
    both = (found.gamma_squared >= 0.0) & (true.gamma_squared >= 0.0)
    # Where only one of the two is total, the other's square is the error.
    error = np.abs(np.where(both, found.gamma_squared - true.gamma_squared, true.gamma_squared))
    total = (found.gamma_squared < 0.0) & (true.gamma_squared < 0.0)
    return Found(float(np.max(np.where(total, 0.0, error) / terms)), len(terms))


def refracted_direction(density: int, kind: type) -> Found:
    """Directions, at least 0.01 rad from the critical angle."""
    cases, found, true = _both(density, kind)
    counted = _off_critical(cases) & (true.gamma_squared >= 0.0)
    error = np.linalg.norm((found.refracted - true.refracted).astype(float), axis=-1)
    return Found(float(error[counted].max()), int(counted.sum()))


def refracted_direction_anywhere(density: int, kind: type) -> Found:
    """Directions at all angles: near the critical one an error of `eps` becomes its root."""
    _, found, true = _both(density, kind)
    counted = (true.gamma_squared >= 0.0) & (found.gamma_squared >= 0.0)
    error = np.linalg.norm((found.refracted - true.refracted).astype(float), axis=-1)
    return Found(float(error[counted].max()), int(counted.sum()))


def mirrored_direction(density: int, kind: type) -> Found:
    """Mirrored directions at all angles."""
    _, found, true = _both(density, kind)
    error = np.linalg.norm((found.reflected - true.reflected).astype(float), axis=-1)
    return Found(float(error.max()), len(error))


def fresnel_reflectance(density: int, kind: type) -> Found:
    """Reflectances, at least 0.01 rad from the critical angle."""
    cases, found, true = _both(density, kind)
    counted = _off_critical(cases)
    error = np.abs(found.reflectance - true.reflectance).astype(float)
    return Found(float(error[counted].max()), int(counted.sum()))


def fresnel_reflectance_anywhere(density: int, kind: type) -> Found:
    """Reflectances at all angles."""
    _, found, true = _both(density, kind)
    error = np.abs(found.reflectance - true.reflectance).astype(float)
    return Found(float(error.max()), len(error))
