"""Bodies known in closed form, cameras around them, and their masks, by code of their own."""

import numpy as np
import trimesh

from refref_jax.geometry.cameras import Cameras, focal_length
from refref_jax.geometry.triangle_meshes import make_mesh

ANGLE = 1.1656107902526855


def ball(points, *, radius=1.0, centre=(0.0, 0.0, 0.0)):
    return np.linalg.norm(points - np.asarray(centre), axis=-1) - radius


def box(points, *, half=(0.8, 0.8, 0.8)):
    beyond = np.abs(points) - np.asarray(half)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return outside + np.minimum(np.max(beyond, axis=-1), 0.0)


def torus(points, *, large=1.1, small=0.4):
    ring = np.hypot(points[..., 0], points[..., 1]) - large
    return np.hypot(ring, points[..., 2]) - small


def cameras_around(views, *, size=64, distance=4.0):
    """Cameras spread evenly over a sphere (golden angle), which look at the origin."""
    poses = []
    for i in range(views):
        height = 1.0 - (2.0 * i + 1.0) / views
        angle = i * np.pi * (3.0 - np.sqrt(5.0))
        back = np.array(
            [*(np.sqrt(1.0 - height**2) * np.array([np.cos(angle), np.sin(angle)])), height]
        )
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        poses.append(np.stack([right, np.cross(back, right), back, distance * back], axis=-1))
    return Cameras(np.stack(poses), size, size, focal_length(size, ANGLE))


def masks_of(distance, cameras, *, steps=60):
    """Marches every pixel's ray by a distance that is never too long (sphere tracing)."""
    row, column = np.indices((cameras.height, cameras.width)) + 0.5
    x = (column - 0.5 * cameras.width) / cameras.focal
    y = -(row - 0.5 * cameras.height) / cameras.focal
    in_camera = np.stack([x, y, -np.ones_like(x)], axis=-1)
    in_camera /= np.linalg.norm(in_camera, axis=-1, keepdims=True)
    masks = []
    for pose in cameras.poses:
        directions = in_camera @ pose[:, :3].T
        away, nearest = np.zeros(x.shape), np.full(x.shape, np.inf)
        for _ in range(steps):
            step = distance(pose[:, 3] + away[..., None] * directions)
            nearest = np.minimum(nearest, step)
            away += np.maximum(step, 0.0)
        masks.append(nearest < 2e-3)
    return np.stack(masks)


def as_mesh(mesh: trimesh.Trimesh):
    return make_mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def icosphere(level=3, *, radius=1.0, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    return as_mesh(mesh.apply_translation(centre))


def joined(*meshes):
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return make_mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def inverted(mesh):
    return make_mesh(mesh.vertices, mesh.faces[:, ::-1])


def fine_box(half=0.8, *, spacing=0.08):
    return as_mesh(trimesh.creation.box((2 * half,) * 3).subdivide_to_size(spacing * 1.5))
