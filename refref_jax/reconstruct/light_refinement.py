"""Refines a mesh by the light refracted through it.

A mesh that moves with a few handles, differentiably.

Handles are vertices spread evenly over the surface. A vertex moves by the mean shift of the handles
next to it, the nearer the more; where there are no more vertices than handles,
each is its own. Shading normals turn as those of the faces around do, so that without a shift they
are what they were, however these were made.

Hosts build (`build`), devices move (`move`).

The tree of the surfaces stays that of the mesh at rest: which triangle a ray meets is found there,
and where it meets it on the moved one. That holds for shifts well below an edge's length.

A body made better by the light that went through it.

Masks know where a body's outlines are; what is seen through it knows its normals, which bend light
by as much as they turn. So, with the field of the background held fixed, the handles of the surface
(see `deformation`) and its index of refraction descend together on the error of the pixels, against
a prior that neighbouring handles move alike.

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
"""Enough for errors of a twentieth of a body's size; what is finer is noise of the masks."""

# Handles that a vertex hangs on.
_NEAREST = 6


class Rig(NamedTuple):
    """What moves a mesh.

    Attributes:
      surfaces: at rest.
      vertices: at rest, world units.
      faces: of the mesh.
      groups: number of the smooth group that each corner of a face belongs to.
      slots: the face of each slot of the surfaces.
      handles: those that a vertex hangs on.
      shares: their weights, which sum to 1.
      neighbours: handles next to each handle.
    """

    surfaces: Surfaces
    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    groups: Int[Array, "faces 3"]
    slots: Int[Array, " slots"]
    handles: Int[Array, "vertices nearest"]
    shares: Float[Array, "vertices nearest"]
    neighbours: Int[Array, "handles around"]


def build(mesh: Mesh, *, handles: int = HANDLES) -> Rig:
    """Puts handles on a mesh; the arrays are the host's.

    Args:
      mesh: at rest.
      handles: how many at most; 4 or more.

    Raises:
      ReconstructionError: if there are fewer.
    """
    if handles < 4:
        raise ReconstructionError(f"{handles} handles hold no body. Give 4 or more.")
    bvh, slots = bvh_build.build(mesh.vertices[mesh.faces].astype(np.float32))
    surfaces = Surfaces(
        bvh,
        host_array(mesh.normals[slots].astype(np.float32)),
        host_array(np.zeros(len(slots), np.int32)),
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
        host_array(slots),
        host_array(hung.astype(np.int32)),
        host_array(shares.astype(np.float32)),
        around.astype(np.int32),
    )


def move(rig: Rig, shifts: Float[Array, "handles 3"]) -> Surfaces:
    """Returns the surfaces with their handles shifted, in world units."""
    corners = _moved(rig, shifts)[rig.faces]
    still = rig.vertices[rig.faces]
    turned = _group_normals(rig, corners) - _group_normals(rig, still)
    normals = jax.vmap(jax.vmap(numerics.normalize))(rig.surfaces.normals + turned[rig.slots])
    bvh = rig.surfaces.bvh._replace(triangles=corners[rig.slots])
    return rig.surfaces._replace(bvh=bvh, normals=normals)


def moved_mesh(mesh: Mesh, rig: Rig, shifts: Float[np.ndarray, "handles 3"]) -> Mesh:
    """Returns a mesh with its handles shifted, for good: its surfaces can be built anew."""
    moved = np.einsum("vn,vnk->vk", rig.shares, shifts[rig.handles])
    device = jax.device_put((rig, shifts.astype(np.float32)))
    normals = np.zeros(mesh.normals.shape)
    # Slots at the end are padding, which repeats a face.
    normals[rig.slots] = np.asarray(move(*device).normals, np.float64)
    return Mesh(mesh.vertices + moved, mesh.faces, normals)


def unevenness(rig: Rig, shifts: Float[Array, "handles 3"]) -> Float[Array, ""]:
    """Returns the mean squared difference of a handle's shift to the mean of those around it."""
    if rig.neighbours.shape[1] == 0:
        return jnp.zeros((), shifts.dtype)
    around = jnp.mean(shifts[rig.neighbours], axis=1)
    return jnp.mean(jnp.sum(jnp.square(shifts - around), axis=-1))


def _moved(rig: Rig, shifts: Float[Array, "handles 3"]) -> Float[Array, "vertices 3"]:
    return rig.vertices + jnp.einsum("vn,vnk->vk", rig.shares, shifts[rig.handles])


def _group_normals(rig: Rig, corners: Float[Array, "faces 3 3"]) -> Float[Array, "faces 3 3"]:
    """Returns unit normals at corners: of the smooth group there, weighted by area."""
    a, b, c = jnp.moveaxis(corners, 1, 0)
    area = jnp.cross(b - a, c - a)
    flat = rig.groups.reshape(-1)
    sums = jax.ops.segment_sum(jnp.repeat(area, 3, axis=0), flat, num_segments=flat.shape[0])
    return jax.vmap(numerics.normalize)(sums)[rig.groups]


def _spread(vertices: Vertices, count: int) -> Int[np.ndarray, " handles"]:
    """Returns vertices far from one another, each the furthest from those before it."""
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
    """Returns the handles of each vertex, and their shares."""
    if len(handles) == len(vertices):
        return np.arange(len(vertices))[:, None], np.ones((len(vertices), 1))
    count = min(_NEAREST, len(handles))
    away, nearest = KDTree(handles).query(vertices, k=[*range(1, count + 1)])
    # The width is that of the furthest: a handle loses a vertex smoothly to another one.
    reach = away[:, -1:]
    shares = np.maximum(1.0 - (away / reach) ** 2, 0.0) ** 2
    return nearest, shares / shares.sum(axis=1, keepdims=True)


@dataclasses.dataclass(frozen=True)
class LightRefinement:
    """How a body is refined.

    Attributes:
      steps: of the descent.
      rays: pixels of a step.
      handles: of the surface, at most.
      stride: the most that a coordinate of a handle moves in a step, world units. What masks leave
        to find is as small: ten times this stride made the bundled ball worse.
      index_stride: the most that the index does.
      evenness: weight of the prior, per squared world unit.
      seed: of the pixels of each step.
    """

    steps: int = 100
    rays: int = 3072
    handles: int = HANDLES
    stride: float = 5e-5
    index_stride: float = 2e-4
    evenness: float = 30.0
    seed: int = 0


class Refined(NamedTuple):
    """What light says of a body.

    Attributes:
      mesh: moved.
      index: of refraction.
      errors: mean error of the pixels at each step, sRGB.
      furthest: that a handle was shifted, world units.
    """

    mesh: Mesh
    index: float  # type: ignore[assignment]  # hides tuple.index
    errors: tuple[float, ...]
    furthest: float


class _Unknowns(NamedTuple):
    """What is looked for, in strides."""

    shifts: Float[Array, "handles 3"]
    index: Float[Array, ""]  # type: ignore[assignment]  # hides tuple.index


class _State(NamedTuple):
    """Of the descent."""

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
    """Descends on the shape and the index of the only body of a scene.

    Whether the result is better is for pixels to tell that were not descended on.

    Args:
      mesh: of the body.
      index: of refraction, where to begin.
      interfaces: of the scene, which has one part.
      evidence: pixels well inside of the masks, and the field of what is behind.
      config: of the field's model.
      settings: how.
      progress: told the steps done and the error of the last one.
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
    """Returns Adam by strides, which shrink to a tenth over the steps."""
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
    """Takes one step; returns the mean error before it as well."""
    some = evidence._replace(
        rays=jax.tree.map(lambda x: x[chosen], evidence.rays), rgb=evidence.rgb[chosen]
    )

    def objective(unknowns: _Unknowns) -> tuple[Float[Array, ""], Float[Array, ""]]:
        shifts = settings.stride * unknowns.shifts
        moved = Scene(move(rig, shifts), interfaces)
        geometry = with_index(moved, index + settings.index_stride * unknowns.index)
        error = jnp.mean(refractive_index.errors(some, geometry, config=config))
        prior = settings.evenness * unevenness(rig, shifts)
        return error + prior, error

    gradient, error = jax.grad(objective, has_aux=True)(state.unknowns)
    updates, moments = _optimizer(settings).update(gradient, state.moments, state.unknowns)
    return _State(optax.apply_updates(state.unknowns, updates), moments), error
