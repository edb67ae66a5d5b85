"""Traces single light paths, and the main branches of a ray, with gradients.

A path is a scan over the steps of `path_step`, for one ray along one branch of its tree. The search
for the triangles that are hit has no gradients, but each hit point is recomputed from the corners
of its triangle. Positions, directions, arc lengths and throughput of a path therefore have
gradients with respect to indices of refraction, tints, absorption, corners, normals and the ray. On
a level set, stretches of the ray take the place of triangles (`surfaces.meet`), and the gradients
are those with respect to its parameters.

Gradients are those of a fixed path: the same triangles in the same order, and the same branches.
They do not account for paths that move to another triangle or fall below the throughput threshold.
Towards the critical angle, the gradients of refraction and reflectance are unbounded; at it and
beyond, the derivatives of the refracted ray are 0 (see `fresnel.transmission`), while those of the
totally reflected ray are exact.

The *main branches* carry most of the light of a ray: the main path, which is refracted wherever it
can be, and the paths that are reflected once, at one of the first surfaces, and then refracted like
the main path. In clear glass, all other paths together carry 1 % of the light. If a branch is below
the throughput threshold, its sibling on these paths takes its share. A reflection may not exist,
because the main path has already left the objects, or because the reflection is total and therefore
part of the main path; its path is then empty.

Source: paper (arXiv 2505.05848), section 4.2; its two paths are the first two main branches.
Symbols as in `light_paths`.
"""

import functools
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from refref_jax.choices import Footprint
from refref_jax.geometry.bvh import NO_PRIMITIVE
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import LevelSet, closest
from refref_jax.optics import light_paths, media, path_step
from refref_jax.optics.light_paths import LightPaths, PathStatus, Stop
from refref_jax.optics.media import Scene, in_one_precision
from refref_jax.optics.path_settings import PathSettings
from refref_jax.optics.path_step import RayState

_Record = TypeVar("_Record")


class _Segment(NamedTuple):
    """One segment of the path.

    Attributes:
      state: state of the ray on the segment.
      medium: medium of the segment, known from the surface at its end, or else at its start.
      used: whether the path has this segment.
      primitive: triangle at its end, `NO_PRIMITIVE` if there is none.
      aside: state of the ray that is partially reflected at its end, and whether there is one;
        `None` if it is not needed.
    """

    state: RayState
    medium: Int[Array, ""]
    used: Bool[Array, ""]
    primitive: Int[Array, ""]
    aside: tuple[RayState, Bool[Array, ""]] | None = None


class _Choice(NamedTuple):
    """What is known in advance about one bend.

    Attributes:
      reflect: whether the reflected branch is followed.
      primitive: triangle at the bend; `None` if it has to be searched.
    """

    reflect: Bool[Array, ""]
    primitive: Int[Array, ""] | None


class _Walk(NamedTuple):
    """State of the scan.

    Attributes:
      state: state of the ray.
      medium: medium of the ray after its last surface.
      traced: whether the ray is to be cast; false for the paper's first reflection, and if max
        bends is 0.
      status: `EMPTY` while the path continues.
      stop: place where the path ends on an opaque surface; `None` without such surfaces.
    """

    state: RayState
    medium: Int[Array, ""]
    traced: Bool[Array, ""]
    status: Int[Array, ""]
    stop: Stop | None


def follow_branch(
    scene: Scene,
    ray: Rays,
    reflects: Bool[Array, " bends"],
    *,
    settings: PathSettings,
    interior_list: Int[Array, " slots"] | None = None,
    footprint: Footprint = "cone",
    primitives: Int[Array, " casts"] | None = None,
) -> LightPaths:
    """Traces one ray along one branch.

    Args:
      scene: the scene.
      ray: one camera ray.
      reflects: choice of branch at each bend: true for the reflected one. Total internal
        reflections are always followed. All false is the main path.
      settings: path settings; `settings.max_bends` must be the length of `reflects`.
      interior_list: interior list of the camera, where rays carry one (see `media`).
      footprint: `differential` carries derivatives across the pixel.
      primitives: triangle at each bend and one more, as `find_primitives` returns them; searched by
        default. With them, the scene's BVH may be that of another shape.

    Returns:
      One path. Its throughput is 0 if the path settings do not follow the branch, because its
      throughput moves to the sibling.

    Raises:
      ValueError: if the length of `reflects` is not the max bends, or the scene has dispersion.

    Example:
      The transmittance of a glass surface, and its derivative with respect to the index `n`:
      `4 n / (n + 1)^2` and `4 (1 - n) / (n + 1)^3`.

      >>> import jax, numpy as np, trimesh
      >>> import refref_jax
      >>> glass = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> ray = refref_jax.Rays(np.array([-2.0, 0.1, 0.2]), np.array([1.0, 0.0, 0.0]), 1e-3)
      >>> settings = refref_jax.PathSettings(max_bends=1, reflections="all")
      >>> def transmitted(index):
      ...     scene, straight_on = refref_jax.with_index(glass, index), jax.numpy.zeros(1, bool)
      ...     path = refref_jax.follow_branch(scene, ray, straight_on, settings=settings)
      ...     return path.throughput[0]
      >>> share, slope = jax.jit(jax.value_and_grad(transmitted))(1.5)
      >>> print(f"{share:.4f} {slope:.4f}")
      0.9600 -0.1280
    """
    end, segments, ray = _scan(scene, ray, reflects, settings, interior_list, footprint, primitives)
    return _record(settings, ray, end, segments)


def find_primitives(
    scene: Scene, ray: Rays, reflects: Bool[Array, " bends"], *, settings: PathSettings
) -> Int[Array, " casts"]:
    """Returns the triangles that one branch of a ray meets, without gradients.

    Args:
      scene: the scene.
      ray: one camera ray, outside all objects.
      reflects: choice of branch at each bend, as in `follow_branch`.
      settings: path settings.

    Returns:
      Triangle at each bend, and at the end of the last segment; `NO_PRIMITIVE` where the path has
      ended.
    """
    _, segments, _ = _scan(scene, ray, reflects, settings, None, "cone", None)
    return jnp.where(segments.used, segments.primitive, NO_PRIMITIVE)


def _scan(
    scene: Scene,
    ray: Rays,
    reflects: Bool[Array, " bends"],
    settings: PathSettings,
    interior_list: Int[Array, " slots"] | None,
    footprint: Footprint,
    primitives: Int[Array, " casts"] | None,
    aside: bool = False,
) -> tuple[_Walk, _Segment, Rays]:
    """Returns the end and the segments of one branch, and the ray in the scene's precision."""
    if reflects.shape[0] != settings.max_bends:
        raise ValueError(
            f"reflects has {reflects.shape[0]} choices for {settings.max_bends} bends. Give one "
            "choice for each of the max bends."
        )
    if media.has_dispersion(scene.interfaces):
        raise ValueError(
            "The scene has dispersion, but a single path has one colour. Take one with of_channel."
        )
    reflects = jnp.asarray(reflects)
    scene, ray = in_one_precision(scene, ray)
    if interior_list is None:
        interior_list = media.empty_interior_list(scene.interfaces)
    start = _Walk(
        path_step.begin(ray, interior_list, light_paths.begin_differential(ray, footprint)),
        jnp.int32(media.AMBIENT),
        jnp.asarray(settings.max_bends > 0),
        jnp.int32(PathStatus.EMPTY),
        _no_stop(scene, ray),
    )
    # One step more than max bends: the last one only checks whether the path escapes.
    choices = _Choice(jnp.append(reflects, False), primitives)
    advance = functools.partial(_advance, scene, settings, aside=aside)
    end, segments = jax.lax.scan(advance, start, choices)
    return end, segments, ray


def _advance(
    scene: Scene, settings: PathSettings, walk: _Walk, choice: _Choice, *, aside: bool = False
) -> tuple[_Walk, _Segment]:
    """Casts the ray, then ends the path or follows one of the two branches."""
    state, alive = walk.state, walk.status == PathStatus.EMPTY
    reflect, primitive_id = choice
    if primitive_id is None:
        limit = jnp.where(alive & walk.traced, jnp.inf, -1.0).astype(state.tau.dtype)
        primitive_id = closest(
            scene.surfaces, state.origin, state.direction, limit, state.exclude_primitive
        )
    hit = primitive_id != NO_PRIMITIVE
    arrival = path_step.arrive(scene, state, primitive_id)
    ended = jnp.where(
        walk.traced, path_step.end_status(settings, state, arrival, hit), PathStatus.NOT_TRACED
    )
    status = jnp.where(alive, ended, walk.status).astype(jnp.int32)
    met, sides = arrival.interaction, arrival.interaction.sides
    mirrored = reflect | met.total
    branches = path_step.branch(settings, state, arrival, primitive_id)
    bent = _Walk(
        state=_either(mirrored, branches.reflected, branches.transmitted),
        medium=jnp.where(mirrored, sides.medium_near, sides.medium_far),
        traced=~(reflect & ~met.total & (settings.reflections == "first")),
        status=status,
        stop=walk.stop,
    )
    ended_state, stop = path_step.stop(state, arrival, status)
    ended_walk = walk._replace(status=status)
    if walk.stop is not None:
        ended_walk = _either(
            alive, walk._replace(state=ended_state, status=status, stop=stop), walk
        )
    medium = jnp.where(hit, sides.medium_near, walk.medium)
    segment = _Segment(state, medium, alive, primitive_id)
    going_on = status == PathStatus.EMPTY
    if aside:
        segment = segment._replace(aside=(branches.reflected, going_on & ~mirrored))
    return _either(going_on, bent, ended_walk), segment


def _no_stop(scene: Scene, ray: Rays) -> Stop | None:
    if not media.has_opaque(scene.interfaces):
        return None
    known = media.meshes_of(scene).radiance.shape[0] > 0
    infinite = jnp.full_like(ray.radii, jnp.inf)
    return Stop(infinite, jnp.zeros_like(ray.origins) if known else None)


def _either(which: Bool[Array, ""], first: _Record, second: _Record) -> _Record:
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), first, second)


def _record(settings: PathSettings, ray: Rays, end: _Walk, segments: _Segment) -> LightPaths:
    used = segments.used
    tau = jnp.where(used, segments.state.tau, jnp.inf)
    none = jnp.zeros_like(tau, shape=(0,))
    return LightPaths(
        points=segments.state.point,
        directions=segments.state.direction,
        tau=tau,
        ends=jnp.append(tau[1:], jnp.inf),
        differentials=segments.state.differential,
        media=jnp.where(used, segments.medium, media.AMBIENT),
        rays=jnp.zeros_like(end.status),
        throughput=path_step.contribution(settings, end.state.throughput, end.status),
        radii=ray.radii,
        num_bends=end.state.num_bends,
        statuses=end.status,
        hit_counts=none,
        path_lengths=none,
        stop=end.stop,
    )


def follow_main_branches(
    scene: Scene,
    ray: Rays,
    *,
    settings: PathSettings,
    reflections: int,
    footprint: Footprint = "cone",
) -> LightPaths:
    """Traces one ray along its main path, and along the paths that are reflected once.

    Args:
      scene: the scene.
      ray: one camera ray.
      settings: path settings.
      reflections: number of first surfaces at which a reflection is followed.
      footprint: `differential` carries derivatives across the pixel.

    Returns:
      `1 + reflections` paths, the main path first; paths that do not exist are `EMPTY`. Their ray
      index is 0.

    Raises:
      ValueError: if there are more reflections than bends.

    Example:
      A glass cube in front of a red wall, and the derivative of its colour with respect to the
      index. The higher the index, the more of the black behind the camera is reflected.

      >>> import jax, numpy as np, trimesh
      >>> import refref_jax
      >>> from refref_jax.render import shade
      >>> glass = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> ray = refref_jax.Rays(np.array([-2.0, 0.1, 0.2]), np.array([1.0, 0.0, 0.0]), 1e-3)
      >>> red = jax.numpy.array([1.0, 0.0, 0.0])
      >>> wall = lambda origin, direction: jax.numpy.where(direction[0] > 0.0, red, 0.0)
      >>> def colour(index):
      ...     paths = refref_jax.follow_main_branches(
      ...         refref_jax.with_index(glass, index),
      ...         ray,
      ...         settings=refref_jax.PathSettings(max_bends=2, reflections="all"),
      ...         reflections=1,
      ...     )
      ...     return shade(paths, wall, rays=1)[0]
      >>> value, slope = jax.jit(lambda n: jax.jvp(colour, (n,), (1.0,)))(1.5)
      >>> print(f"{value[0]:.4f} {slope[0]:.4f}")  # (4 n / (n + 1)^2)^2, and its derivative
      0.9216 -0.2458
    """
    if not 0 <= reflections <= settings.max_bends:
        raise ValueError(
            f"reflections is {reflections}, outside 0 to {settings.max_bends}, the max bends. "
            "Choose a number in that range."
        )
    first = jnp.arange(reflections, dtype=jnp.int32)
    once = first[:, None] == jnp.arange(settings.max_bends, dtype=jnp.int32)[None]
    choices = jnp.concatenate([jnp.zeros_like(once, shape=(1, settings.max_bends)), once])
    if isinstance(scene.surfaces, LevelSet) and settings.reflections == "first":
        return _main_and_first(scene, ray, choices[0], settings, reflections, footprint)
    follow = functools.partial(follow_branch, scene, ray, settings=settings, footprint=footprint)
    paths = jax.vmap(follow)(choices)
    # If the main path stays in its medium at a bend, reflection is total there.
    total = paths.media[0, 1:] == paths.media[0, :-1]
    if media.has_kinds(scene.interfaces):  # a thin sheet lets light through on the same side
        total &= jnp.any(paths.directions[0, 1:] != paths.directions[0, :-1], axis=-1)
    real = jnp.append(True, (paths.num_bends[1:] > first) & ~total[:reflections])
    return paths._replace(
        statuses=jnp.where(real, paths.statuses, PathStatus.EMPTY),
        throughput=jnp.where(real[:, None], paths.throughput, 0.0),
    )


def _main_and_first(
    scene: Scene,
    ray: Rays,
    ahead: Bool[Array, " bends"],
    settings: PathSettings,
    reflections: int,
    footprint: Footprint,
) -> LightPaths:
    """Returns the main path, and its reflection at the first surface, with one search for each hit.

    The reflected ray is not cast. A search along a level set takes many values, and every copy of
    them in a program takes long to compile.
    """
    end, segments, ray = _scan(scene, ray, ahead, settings, None, footprint, None, aside=True)
    main = _record(settings, ray, end, segments)
    assert segments.aside is not None
    aside, exists = jax.tree.map(lambda x: x[0], segments.aside)
    second = jnp.arange(main.tau.size, dtype=jnp.int32) == 1

    def placed(values: Array, new: Array) -> Array:
        return jnp.where(second.reshape(-1, *[1] * new.ndim), new[None], values)

    past = jnp.full_like(main.tau, jnp.inf)
    reflected = main._replace(
        points=placed(main.points, aside.point),
        directions=placed(main.directions, aside.direction),
        tau=placed(past.at[0].set(0.0), aside.tau),
        ends=past.at[0].set(aside.tau),
        media=jnp.where(second, main.media[0], main.media),
        differentials=jax.tree.map(placed, main.differentials, aside.differential),
        throughput=jnp.where(exists, aside.throughput, 0.0),
        num_bends=jnp.where(exists, aside.num_bends, 0),
        statuses=jnp.where(exists, PathStatus.NOT_TRACED, PathStatus.EMPTY).astype(jnp.int32),
    )
    both = [main, *[reflected] * reflections]
    return jax.tree.map(lambda *each: jnp.stack(each), *both)
