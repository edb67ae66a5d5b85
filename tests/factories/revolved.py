"""Bodies of revolution and what masks do to meshes: noise, and any place and size."""

import numpy as np

from refref_jax.geometry.triangle_meshes import make_mesh, unit_vectors, vertex_vectors


def revolve(profile, *, closed=False, azimuths=64):
    """Turns points (radius, height), upwards on the outside, around the z axis."""
    angle = 2.0 * np.pi / azimuths * np.arange(azimuths)
    vertices, first = [], []
    for radius, height in profile:
        first.append(len(vertices))
        around = angle if radius > 0.0 else angle[:1]
        vertices += [[radius * np.cos(a), radius * np.sin(a), height] for a in around]
    faces = []
    for i in range(len(profile) if closed else len(profile) - 1):
        low, high = i, (i + 1) % len(profile)
        for j in range(azimuths):
            at = [
                first[k] + (step % azimuths if profile[k][0] > 0.0 else 0)
                for k, step in ((low, j), (low, j + 1), (high, j + 1), (high, j))
            ]
            faces += [[at[0], at[1], at[2]]] if at[0] != at[1] else []
            faces += [[at[0], at[2], at[3]]] if at[2] != at[3] else []
    return make_mesh(np.array(vertices), np.array(faces))


def even(points, count, *, closed=False):
    """Points of a polyline in even steps."""
    line = np.concatenate([points, points[:1]]) if closed else np.asarray(points)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1)))
    ticks = np.linspace(0.0, length[-1], count + 1)
    found = np.stack([np.interp(ticks, length, line[:, i]) for i in (0, 1)], axis=-1)
    return found[:-1] if closed else found


def arc(centre, radius, first, last, count=24):
    angle = np.radians(np.linspace(first, last, count))
    return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def cylinder(*, radius=1.0, half=1.0, rim=0.08):
    inner, top = radius - rim, half - rim
    lower, upper = arc((inner, -top), rim, -90, 0), arc((inner, top), rim, 0, 90)
    return np.concatenate([[[0.0, -half]], lower, upper, [[0.0, half]]])


def vase():
    angle = np.linspace(0.0, np.pi, 200)
    radius = np.sin(angle) * (0.7 + 0.25 * np.cos(3.0 * angle))
    radius[[0, -1]] = 0.0
    return np.stack([radius, -1.3 * np.cos(angle)], axis=-1)


def cup(*, wall=0.1):
    """A hollow cup: the profile goes up outside and down inside."""
    half = 0.5 * wall
    outside = [[[0.0, -1.0]], arc((0.7, -0.8), 0.2, -90, 0), arc((0.9 - half, 1.0), half, 0, 180)]
    inside = [arc((0.8 - wall, -0.7), 0.1, 0, -90), [[0.0, -0.8]]]
    return np.concatenate([*outside, *inside])


def ring(*, large=1.1, small=0.4, count=120):
    return arc((large, 0.0), small, 0, 360, count + 1)[:-1]


def noisy(mesh, deviation, *, seed=0):
    """Moves every vertex along its normal, independently."""
    normals = unit_vectors(vertex_vectors(mesh.vertices, mesh.faces))
    shifts = deviation * np.random.default_rng(seed).normal(size=(len(normals), 1))
    return make_mesh(mesh.vertices + shifts * normals, mesh.faces)


def placed(mesh, *, turn=None, offset=0.0, scale=1.0):
    turn = np.eye(3) if turn is None else turn
    return make_mesh(scale * mesh.vertices @ turn.T + offset, mesh.faces)


def blob(mesh):
    """A ball with humps, like no family."""
    x, y, z = mesh.vertices.T
    factor = 1.0 + 0.3 * np.sin(3.0 * x + 1.0) * np.cos(2.0 * y) + 0.2 * x * z
    return make_mesh(mesh.vertices * factor[:, None], mesh.faces)
