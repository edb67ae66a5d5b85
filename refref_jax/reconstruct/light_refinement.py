"""Refines a mesh and its index of refraction with the light refracted through it.

Masks determine the outlines of an object; the background seen through it determines its normals,
because rays are deflected in proportion to the tilt of the surface. With the field of the
background held fixed, gradient descent on the pixel errors adjusts the shape and the index of
refraction together, under a prior that neighbouring handles move alike.

The shape is deformed by a few handles, which are vertices spread evenly over the surface. A vertex
moves by a weighted mean of the shifts of its nearest handles; with as many handles as vertices each
vertex has its own. Shading normals rotate with the normals of the surrounding faces, so that zero
shifts leave the original normals unchanged, however they were made.

The host builds the handles (`build`), the device moves them (`move`). The BVH stays that of the
undeformed mesh: it selects the triangle that a ray hits, and the hit point is computed on the
deformed triangle. This is valid for shifts well below the length of an edge.

This is one of the modules that call `jax.jit`.

Source: ours; the paper (arXiv 2505.05848) smooths by hand instead.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from refref_jax import numerics
from refref_jax.geometry import bvh_build
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.geometry.triangle_meshes import Mesh, Vertices, smooth_groups
from refref_jax.numerics import host_array
from refref_jax.optics.media import Interfaces
from refref_jax.optics.scene import Scene, with_index
from refref_jax.reconstruct import ReconstructionError, refractive_index
from refref_jax.reconstruct.refractive_index import Evidence
from refref_jax.render.model import ModelConfig

HANDLES = 256
"""Sufficient for errors of a twentieth of the object's size; finer detail is noise of masks."""

# Handles per vertex.
_NEAREST = 6


class Rig(NamedTuple):
    """A mesh and the handles that deform it.

    Attributes:
      surfaces: packed surfaces at rest.
      vertices: vertices at rest, world units.
      faces: faces of the mesh.
      groups: number of the smoothing group that each corner of a face belongs to.
      primitive_faces: face number of each primitive of the surfaces.
      handles: handles that move each vertex.
      shares: weights of these handles, which sum to 1.
      neighbours: handles next to each handle.
    """

    surfaces: Surfaces
    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    groups: Int[Array, "faces 3"]
    primitive_faces: Int[Array, " primitives"]
    handles: Int[Array, "vertices nearest"]
    shares: Float[Array, "vertices nearest"]
    neighbours: Int[Array, "handles around"]


def build(mesh: Mesh, *, handles: int = HANDLES) -> Rig:
    """Places handles on a mesh; the arrays are NumPy arrays on the host.

    Args:
      mesh: mesh at rest.
      handles: largest number of handles, at least 4.

    Raises:
      ReconstructionError: if `handles` is below 4.
    """
    if handles < 4:
        raise ReconstructionError(f"handles={handles} is too small. Pass 4 or more.")
    bvh, order = bvh_build.build(mesh.vertices[mesh.faces].astype(np.float32))
    surfaces = Surfaces(
        bvh,
        host_array(mesh.normals[order].astype(np.float32)),
        host_array(np.zeros(len(order), np.int32)),
        host_array(np.zeros((0, 3, 3), np.float32)),
    )
    chosen = _spread(mesh.vertices, handles)
    hung, shares = _hang(mesh.vertices, mesh.vertices[chosen])
    around = KDTree(mesh.vertices[chosen]).query(
        mesh.vertices[chosen], k=[*range(2, 2 + min(_NEAREST, len(chosen) - 1))]
    )[1]
    return Rig(
        surfaces,
        host_array(mesh.vertices.astype(np.float32)),
        host_array(mesh.faces.astype(np.int32)),
        host_array(smooth_groups(mesh.vertices, mesh.faces).astype(np.int32)),
        host_array(order),
        host_array(hung.astype(np.int32)),
        host_array(shares.astype(np.float32)),
        around.astype(np.int32),
    )


def move(rig: Rig, shifts: Float[Array, "handles 3"]) -> Surfaces:
    """Returns the surfaces after shifting the handles, in world units."""
    corners = _moved(rig, shifts)[rig.faces]
    still = rig.vertices[rig.faces]
    turned = _group_normals(rig, corners) - _group_normals(rig, still)
    normals = jax.vmap(jax.vmap(numerics.normalize))(
        rig.surfaces.normals + turned[rig.primitive_faces]
    )
    bvh = rig.surfaces.bvh._replace(triangles=corners[rig.primitive_faces])
    return rig.surfaces._replace(bvh=bvh, normals=normals)


def moved_mesh(mesh: Mesh, rig: Rig, shifts: Float[np.ndarray, "handles 3"]) -> Mesh:
    """Returns a mesh with its handles shifted permanently, from which a new BVH can be built."""
    moved = np.einsum("vn,vnk->vk", rig.shares, shifts[rig.handles])
    device = jax.device_put((rig, shifts.astype(np.float32)))
    normals = np.zeros(mesh.normals.shape)
    # Primitives at the end are padding, which repeats a face.
    normals[rig.primitive_faces] = np.asarray(move(*device).normals, np.float64)
    return Mesh(mesh.vertices + moved, mesh.faces, normals)


def unevenness(rig: Rig, shifts: Float[Array, "handles 3"]) -> Float[Array, ""]:
    """Returns the mean squared difference between a handle's shift and its neighbours' mean."""
    if rig.neighbours.shape[1] == 0:
        return jnp.zeros((), shifts.dtype)
    around = jnp.mean(shifts[rig.neighbours], axis=1)
    return jnp.mean(jnp.sum(jnp.square(shifts - around), axis=-1))


def _moved(rig: Rig, shifts: Float[Array, "handles 3"]) -> Float[Array, "vertices 3"]:
    return rig.vertices + jnp.einsum("vn,vnk->vk", rig.shares, shifts[rig.handles])


def _group_normals(rig: Rig, corners: Float[Array, "faces 3 3"]) -> Float[Array, "faces 3 3"]:
    """Returns unit normals at corners, area-weighted over the smoothing group of the corner."""
    a, b, c = jnp.moveaxis(corners, 1, 0)
    area = jnp.cross(b - a, c - a)
    flat = rig.groups.reshape(-1)
    sums = jax.ops.segment_sum(jnp.repeat(area, 3, axis=0), flat, num_segments=flat.shape[0])
    return jax.vmap(numerics.normalize)(sums)[rig.groups]


def _spread(vertices: Vertices, count: int) -> Int[np.ndarray, " handles"]:
    """Returns vertices by farthest point sampling."""
    if len(vertices) <= count:
        return np.arange(len(vertices))
    chosen = [int(np.argmax(np.linalg.norm(vertices - vertices.mean(axis=0), axis=-1)))]
    away = np.full(len(vertices), np.inf)
    while len(chosen) < count:
        away = np.minimum(away, np.linalg.norm(vertices - vertices[chosen[-1]], axis=-1))
        chosen.append(int(np.argmax(away)))
    return np.asarray(chosen)


def _hang(
    vertices: Vertices, handles: Float[np.ndarray, "handles 3"]
) -> tuple[Int[np.ndarray, "vertices nearest"], Float[np.ndarray, "vertices nearest"]]:
    """Returns the handles of each vertex, and their weights."""
    if len(handles) == len(vertices):
        return np.arange(len(vertices))[:, None], np.ones((len(vertices), 1))
    count = min(_NEAREST, len(handles))
    away, nearest = KDTree(handles).query(vertices, k=[*range(1, count + 1)])
    # The width of the kernel is the distance of the furthest handle, so that handles fade out
    # smoothly.
    reach = away[:, -1:]
    shares = np.maximum(1.0 - (away / reach) ** 2, 0.0) ** 2
    return nearest, shares / shares.sum(axis=1, keepdims=True)


@dataclasses.dataclass(frozen=True)
class LightRefinement:
    """Settings of the refinement.

    Attributes:
      steps: number of steps of the descent.
      rays: number of pixels per step.
      handles: largest number of handles on the surface.
      stride: largest move of a coordinate of a handle per step, world units. It is as small as the
        errors that masks leave: ten times this stride made the bundled ball worse.
      index_stride: largest change of the index per step.
      evenness: weight of the prior, per squared world unit.
      seed: seed of the pixels of each step.
    """

    steps: int = 100
    rays: int = 3072
    handles: int = HANDLES
    stride: float = 5e-5
    index_stride: float = 2e-4
    evenness: float = 30.0
    seed: int = 0


class Refined(NamedTuple):
    """Result of the refinement.

    Attributes:
      mesh: refined mesh.
      index: refined index of refraction.
      errors: mean error of the pixels at each step, sRGB.
      furthest: largest shift of a handle, world units.
    """

    mesh: Mesh
    index: float  # type: ignore[assignment]  # hides tuple.index
    errors: tuple[float, ...]
    furthest: float


class _Unknowns(NamedTuple):
    """Unknowns of the descent, in strides."""

    shifts: Float[Array, "handles 3"]
    index: Float[Array, ""]  # type: ignore[assignment]  # hides tuple.index


class _State(NamedTuple):
    """State of the descent."""

    unknowns: _Unknowns
    moments: optax.OptState


def refine_by_light(
    mesh: Mesh,
    index: float,
    interfaces: Interfaces,
    evidence: Evidence,
    *,
    config: ModelConfig,
    settings: LightRefinement,
    progress: Callable[[int, float], None] | None = None,
) -> Refined:
    """Refines the shape and the index of the only object of a scene.

    The caller must decide with other pixels whether the result is better.

    Args:
      mesh: mesh of the object.
      index: initial index of refraction.
      interfaces: interfaces of the scene, which has one part.
      evidence: pixels well inside the masks, and the field of the background.
      config: configuration of the field's model.
      settings: settings of the refinement.
      progress: called with the number of steps done and the error of the last one.
    """
    rig = build(mesh, handles=settings.handles)
    device = jax.device_put((rig, interfaces))
    state = _start(rig.neighbours.shape[0], settings)
    generator = np.random.default_rng(settings.seed)
    count = evidence.rgb.shape[0]
    found = []
    for step in range(settings.steps):
        chosen = generator.choice(count, min(settings.rays, count), replace=False).astype(np.int32)
        state, error = _step(
            state, chosen, evidence, *device, np.float32(index), config=config, settings=settings
        )
        found.append(float(error))
        if progress is not None:
            progress(step + 1, found[-1])
    shifts = settings.stride * np.asarray(state.unknowns.shifts, np.float64)
    furthest = float(np.linalg.norm(shifts, axis=-1).max())
    moved = moved_mesh(mesh, rig, shifts)
    better = index + settings.index_stride * float(state.unknowns.index)
    return Refined(moved, better, tuple(found), furthest)


def _start(handles: int, settings: LightRefinement) -> _State:
    unknowns = _Unknowns(jnp.zeros((handles, 3)), jnp.zeros(()))
    return _State(unknowns, _optimizer(settings).init(unknowns))


def _optimizer(settings: LightRefinement) -> optax.GradientTransformation:
    """Returns Adam in units of strides, which decay to a tenth over the steps."""
    rate = optax.exponential_decay(1.0, settings.steps, 0.1)
    return optax.adam(rate, b2=0.99)


@functools.partial(jax.jit, static_argnames=("config", "settings"))
def _step(
    state: _State,
    chosen: Int[Array, " rays"],
    evidence: Evidence,
    rig: Rig,
    interfaces: Interfaces,
    index: Float[Array, ""],
    *,
    config: ModelConfig,
    settings: LightRefinement,
) -> tuple[_State, Float[Array, ""]]:
    """Takes one step; also returns the mean error before it."""
    some = evidence._replace(
        rays=jax.tree.map(lambda x: x[chosen], evidence.rays), rgb=evidence.rgb[chosen]
    )

    def objective(unknowns: _Unknowns) -> tuple[Float[Array, ""], Float[Array, ""]]:
        shifts = settings.stride * unknowns.shifts
        moved = Scene(move(rig, shifts), interfaces)
        scene = with_index(moved, index + settings.index_stride * unknowns.index)
        error = jnp.mean(refractive_index.errors(some, scene, config=config))
        prior = settings.evenness * unevenness(rig, shifts)
        return error + prior, error

    gradient, error = jax.grad(objective, has_aux=True)(state.unknowns)
    updates, moments = _optimizer(settings).update(gradient, state.moments, state.unknowns)
    return _State(optax.apply_updates(state.unknowns, updates), moments), error
