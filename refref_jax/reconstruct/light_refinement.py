"""A body made better by the light that went through it.

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

from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.media import Interfaces
from refref_jax.optics.scene import Scene, with_index
from refref_jax.reconstruct import deformation, photometry
from refref_jax.reconstruct.deformation import Rig
from refref_jax.reconstruct.photometry import Evidence
from refref_jax.render.config import ModelConfig


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
    handles: int = deformation.HANDLES
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
    index: float
    errors: tuple[float, ...]
    furthest: float


class _Unknowns(NamedTuple):
    """What is looked for, in strides."""

    shifts: Float[Array, "handles 3"]
    index: Float[Array, ""]


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
    rig = deformation.build(mesh, handles=settings.handles)
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
    moved = deformation.moved_mesh(mesh, rig, shifts)
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
        moved = Scene(deformation.move(rig, shifts), interfaces)
        geometry = with_index(moved, index + settings.index_stride * unknowns.index)
        error = jnp.mean(photometry.errors(some, geometry, config=config))
        prior = settings.evenness * deformation.unevenness(rig, shifts)
        return error + prior, error

    gradient, error = jax.grad(objective, has_aux=True)(state.unknowns)
    updates, moments = _optimizer(settings).update(gradient, state.moments, state.unknowns)
    return _State(optax.apply_updates(state.unknowns, updates), moments), error
