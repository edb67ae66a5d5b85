"""Surfaces that are learned: where they are and begin, and their paths and losses in a step.

A field with a surface has it in a ball between the cameras (`place`). If it bends light
(`fields.tnsr`), paths cannot be traced in advance, since the surface changes with every step: each
step turns its straight paths into bent ones (`bent`), with gradients. Samples of these paths are
outside the surface, so that the losses of the surface are those of the points where light meets it
(`sums_of_hits`). In the first part of the training, the surface stops straight rays, as in NeuS.

Instead of from a ball, a surface may begin from meshes (`fit`): with those of the scene, the
training shows what is lost by learning the surface; with those of a reconstruction, it is refined.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from refref_jax import numerics
from refref_jax.choices import Position
from refref_jax.data.meshes import MeshPart
from refref_jax.fields.base import RadianceConfig, SurfaceSums
from refref_jax.fields.neus import SurfaceConfig
from refref_jax.fields.tnsr import INDICES, TnsrConfig
from refref_jax.geometry.bvh import LEAF_SIZE
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import LevelSet, Surfaces, slope
from refref_jax.geometry.triangle_meshes import unit_vectors
from refref_jax.numerics import host_array
from refref_jax.optics import light_paths, media, path_tracing
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import PathSettings, make_path_settings
from refref_jax.render.model import ModelConfig, Params, ball_of, opaque_model, surface_scene
from refref_jax.render.pixels import Light
from refref_jax.render.volume_rendering import Jitter
from refref_jax.training import objective
from refref_jax.training.config import SURFACE_ONLY, FieldConfig, TrainConfig, require
from refref_jax.training.objective import Totals

KIND = "tnsr"
"""Field kind whose surface bends light."""

BENDS = 2
"""Its default of max bends: into a body, and out of it."""

# Radius of the ball of a surface, in distances of the nearest camera: 2.2 world units in the data
# set, whose objects end at 2.1. In a larger ball, each camera could see a part of it by itself.
_BALL = 0.55

# Mean squared sine of the angles to a common axis below which optical axes are parallel.
_PARALLEL = 1e-3

# Number of points on meshes, of those to which far distances are measured, and of samples near the
# meshes; there are as many anywhere.
_DENSE, _FEW, _SAMPLES = 100_000, 4_000, 40_000

# Steps of the fit to meshes, samples of a step, and first and last share of the learning rate.
_STEPS, _BATCH, _RATE, _LAST = 600, 2048, 1e-2, 1e-2

_EPSILON = 1e-15

# Factor on the learning rate of a surface that bends light. Published are 2e-4 for surface and
# colour, and 1e-2 for proposals, which is the peak of all others here.
_SLOWER = 0.02


def place(model: ModelConfig, cameras: Cameras) -> ModelConfig:
    """Returns a model whose surface, if its field has one, lies in a ball between the cameras.

    The ball is around the point that the cameras look at, and ends before the nearest of them; an
    object behind a camera has no surface.

    Args:
      model: model of a preset.
      cameras: cameras of the training images.

    Raises:
      ValueError: if space is contracted, or the cameras do not look at one place.
    """
    field = model.field
    if not isinstance(field, SurfaceConfig):
        return model
    if model.space == "unbounded":
        raise ValueError(
            f"field={field.kind} has a surface in a ball of the world, but the space of this scene "
            "is contracted (background=unbounded or contraction=always). Use field=zipnerf, or "
            "state the cube or sphere around the scene."
        )
    positions, axes = cameras.poses[:, :, 3], -cameras.poses[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    spread, towards = across.mean(0), np.einsum("nij,nj->i", across, positions) / len(axes)
    focus = np.linalg.lstsq(spread, towards)[0]
    depths = np.sum((focus - positions) * axes, axis=-1)
    nearest = float(np.min(np.linalg.norm(positions - focus, axis=-1)))
    beyond = float(np.max(np.abs(focus - model.centre)))
    radius = min(_BALL * nearest, model.radius - beyond)
    parallel = np.linalg.eigvalsh(spread)[0] < _PARALLEL
    if parallel or radius <= 0.0 or not np.all(depths > 0.0):
        raise ValueError(
            f"field={field.kind} needs cameras around an object, but these do not all look at one "
            "place in the scene. Use field=zipnerf."
        )
    edge = 2.0 * model.radius
    x, y, z = (float(place) for place in 0.5 + (focus - model.centre) / edge)
    field = dataclasses.replace(field, ball_centre=(x, y, z), ball_radius=radius / edge)
    return dataclasses.replace(model, field=field)


def with_options(field: RadianceConfig, asked: FieldConfig) -> RadianceConfig:
    """Returns the shape of a field with the options of a surface that bends light.

    Args:
      field: shape of a preset.
      asked: options; `None` keeps the value of the preset.

    Raises:
      ValueError: if there is an option, but the field has no such surface.
    """
    given = {name: getattr(asked, name) for name in SURFACE_ONLY}
    given = {name: value for name, value in given.items() if value is not None}
    if isinstance(field, TnsrConfig):
        return dataclasses.replace(
            field,
            index=require(asked.surface_index),
            index_from=require(asked.surface_index_from),
            straight=require(asked.straight_share),
        )
    if given:
        raise ValueError(
            f"Without effect on field kind {field.kind}, whose light is not bent by a learned "
            f"surface: {', '.join(given)}. Leave it out, or use field=tnsr."
        )
    return field


def check(config: TrainConfig, parts: int) -> None:
    """Refuses options that contradict a surface that bends light.

    Args:
      config: configuration with its paths.
      parts: number of meshes in the scene.

    Raises:
      ValueError: if light is not bent, the body is not clear, or meshes are missing.
    """
    model, paths = config.model, config.paths
    wrong = [f"paths={paths.name}"] if not paths.max_bends else []
    if model.interior not in (None, "clear"):
        wrong.append(f"interior={model.interior}")
    if model.tints not in (None, "none"):
        wrong.append(f"tints={model.tints}")
    if wrong:
        raise ValueError(
            f"{' and '.join(wrong)} cannot be combined with field={KIND}, whose surface bends "
            "light into a clear body. Leave it out, or use another field."
        )
    if model.surface_start == "meshes" and not parts:
        raise ValueError(
            "surface_start=meshes, but there are no meshes. Add .ply files of the objects to the "
            "scene's folder meshes, or use surface_start=ball."
        )


def usual(
    asked: FieldConfig, parts: Sequence[MeshPart], ambient: float
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields values of the options of a surface that bends light, with the reason for them.

    Args:
      asked: options, of which `surface_start` may be given.
      parts: meshes of the scene.
      ambient: index of refraction of the medium around them.
    """
    start = asked.surface_start or "ball"
    yield "by default", {"surface_start": start, "surface_index_from": "given"}
    yield f"surface_start={start}", {"straight_share": 0.5 if start == "ball" else 0.0}
    least, most = INDICES
    bends = [part for part in parts if part.material.kind == "dielectric"]
    clear = [part for part in bends if least <= part.index / ambient <= most]
    if not clear:
        yield "glass, as there is no mesh of glass or a liquid", {"surface_index": 1.5}
        return
    largest = max(clear, key=lambda part: float(np.prod(np.ptp(part.vertices, axis=0))))
    yield "the scene's largest mesh", {"surface_index": float(largest.index / ambient)}


def slowed(rate: optax.Schedule, model: ModelConfig, steps: int) -> optax.Schedule:
    """Returns the learning rate of a surface, which is lower once it bends light.

    Before the colours behind it are known, a surface that learns as fast as they do is inflated to
    its ball; once they are, its normals become noise.

    Args:
      rate: learning rate of the other parameters.
      model: configuration of the model.
      steps: number of steps of the training.
    """
    assert isinstance(model.field, TnsrConfig)
    turn = model.field.straight * steps
    return lambda step: rate(step) * jnp.where(step < turn, 1.0, _SLOWER)


def settings_of(config: TrainConfig) -> PathSettings:
    """Returns the settings of the paths through a surface that bends light."""
    paths = config.paths
    return make_path_settings(
        require(paths.name), min_throughput=paths.min_throughput, max_bends=paths.max_bends
    )


def total(
    key: Array,
    params: Params,
    model: ModelConfig,
    straight: LightPaths,
    jitter: Jitter,
    *,
    gather: Callable[..., Light],
    progress: Float[Array, ""] | None,
    config: TrainConfig,
) -> Totals:
    """Returns the sums over the paths of a batch; see `objective.total`.

    Args:
      key: random key of the step.
      params: parameters of the model.
      model: configuration of the model, whose surface bends light after a first share of the steps.
      straight: straight paths of the batch.
      jitter: jitter of all paths through the surface.
      gather: function of parameters, model, paths and jitter that returns their light.
      progress: progress of the training, 0 to 1.
      config: configuration of the run.
    """
    settings, losses = settings_of(config), config.losses

    def bend(params: Params) -> Totals:
        paths = bent(params, model, straight, settings=settings)
        sums = sums_of_hits(key, params, model, paths)
        light = gather(params, model, paths, jitter)
        return objective.total(
            light._replace(paths=light.paths._replace(surface=sums)), paths, losses
        )

    def stop(params: Params) -> Totals:
        opaque = opaque_model(model)
        every = jax.tree.map(lambda x: x[:: x.shape[0] // straight.radii.shape[0]], jitter)
        return objective.total(gather(params, opaque, straight, every), straight, losses)

    share = require(config.model.straight_share)
    assert progress is not None
    if share == 0.0:
        return bend(params)
    return jax.lax.cond(progress < share, stop, bend, params)


def bent(
    params: Params, model: ModelConfig, straight: LightPaths, *, settings: PathSettings
) -> LightPaths:
    """Returns the paths of rays through the surface of a field, with gradients.

    Args:
      params: parameters of the model.
      model: configuration of the model, whose field has a surface that bends light.
      straight: straight paths.
      settings: path settings.
    """
    rays = Rays(straight.points[:, 0], straight.directions[:, 0], straight.radii)
    scene, branches = surface_scene(params, model), path_tracing.branches_of(settings)
    paths = path_tracing.trace_level_set(
        scene, rays, settings=settings, footprint=model.footprint
    ).paths
    index, empty, share = (
        jnp.repeat(x, branches, axis=0)
        for x in (straight.rays, ~light_paths.exists(straight), straight.throughput)
    )
    return paths._replace(
        rays=index,
        throughput=paths.throughput * share,
        statuses=jnp.where(empty, PathStatus.EMPTY, paths.statuses),
    )


def sums_of_hits(key: Array, params: Params, model: ModelConfig, paths: LightPaths) -> SurfaceSums:
    """Returns sums over the points where paths meet a surface that bends light, for each path.

    In place of a curvature there is the change of the normal over a random distance, of up to a
    cell of the finest grid along each axis: the smoothness of TNSR.

    Args:
      key: random key.
      params: parameters of the model.
      model: configuration of the model.
      paths: paths from `bent`.
    """
    surface = surface_scene(params, model).surfaces
    assert isinstance(surface, LevelSet) and isinstance(model.field, SurfaceConfig)
    points = jax.lax.stop_gradient(paths.points[:, 1:])
    met = jnp.isfinite(paths.tau[:, 1:]) & light_paths.exists(paths)[:, None]
    cell = 2.0 * ball_of(model).radius / model.field.grid.max_res
    beside = points + cell * jax.random.uniform(key, points.shape, minval=-1.0)
    pairs = jnp.stack([points, beside]).reshape(-1, 3)
    slopes = jax.vmap(functools.partial(slope, surface))(pairs)
    here, there = slopes.reshape(2, *points.shape)
    stretch = jnp.square(numerics.length(here) - 1.0)
    turn = jnp.sum(jnp.abs(numerics.normalize(here) - numerics.normalize(there)), axis=-1)
    values = stretch, turn, jnp.ones_like(stretch)
    eikonal, curvature, samples = (jnp.sum(jnp.where(met, x, 0.0), axis=-1) for x in values)
    return SurfaceSums(eikonal, curvature, samples, jnp.any(met, axis=-1).astype(stretch.dtype))


class SurfaceSamples(NamedTuple):
    """Points around meshes, and points on them, from which a signed value is learned.

    Attributes:
      points: points in and around the ball of the surface, world units.
      distances: signed distances of these points to the meshes, negative inside.
      on_surface: points on the meshes.
      normals: outward unit shading normals there.
    """

    points: Float[Array, "samples 3"]
    distances: Float[Array, " samples"]
    on_surface: Float[Array, "samples 3"]
    normals: Float[Array, "samples 3"]


def sample_meshes(
    surfaces: Surfaces,
    outermost: Bool[np.ndarray, " parts"],
    *,
    seed: int,
    centre: Position,
    radius: float,
) -> SurfaceSamples:
    """Samples the outermost parts of a scene (NumPy).

    Half of the points are near the surface. Their distance is that to the plane through the nearest
    of many points on the meshes; that of the others is the distance to the nearest of few.

    Args:
      surfaces: triangles of the scene, as NumPy arrays.
      outermost: whether a part is in no other.
      seed: seed of the random points.
      centre: centre of the ball of the surface, world units.
      radius: radius of the ball.

    Raises:
      ValueError: if there are no meshes, or they do not lie in the ball.
    """
    real = slice(None, -LEAF_SIZE)  # the last slots fill up the last leaf
    kept = outermost[surfaces.parts[real]]
    corners, normals = surfaces.bvh.triangles[real][kept], surfaces.normals[real][kept]
    reach = np.max(np.linalg.norm(corners - np.array(centre), axis=-1), initial=0.0)
    if not 0.0 < reach < radius:
        raise ValueError(
            f"surface_start=meshes, but the meshes reach {reach:.3g} world units from the middle "
            f"of the cameras' view, where a surface may have more than 0 and less than "
            f"{radius:.3g}. Use surface_start=ball."
        )
    rng = np.random.default_rng(seed)
    edges = corners[:, 1:] - corners[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1)
    chosen = rng.choice(len(corners), _DENSE, p=areas / areas.sum())
    shares = rng.dirichlet(np.ones(3), _DENSE)[:, :, None]
    points = np.sum(shares * corners[chosen], axis=1)
    up = unit_vectors(np.sum(shares * normals[chosen], axis=1))
    near = points[:_SAMPLES] + 0.05 * radius * rng.normal(size=(_SAMPLES, 3))
    away = rng.normal(size=(_SAMPLES, 3))
    away *= rng.uniform(0.0, 1.0, (_SAMPLES, 1)) / np.linalg.norm(away, axis=-1, keepdims=True)
    away = np.array(centre) + radius * away
    # Near the middle of a ball all points are the nearest ones: few of them are searched.
    _, nearest = cKDTree(points).query(near)
    close = np.sum((near - points[nearest]) * up[nearest], axis=-1)
    distance, nearest = cKDTree(points[:_FEW]).query(away)
    far = np.copysign(distance, np.sum((away - points[nearest]) * up[nearest], axis=-1))
    asked, signed = np.concatenate([near, away]), np.concatenate([close, far])
    order = rng.permutation(2 * _SAMPLES)
    held = asked[order], signed[order], points[-2 * _SAMPLES :], up[-2 * _SAMPLES :]
    return SurfaceSamples(*(host_array(x.astype(np.float32)) for x in held))


def distance_to_meshes(surface: LevelSet, samples: SurfaceSamples) -> Float[Array, ""]:
    """Returns the loss of a signed value: of values, in radii, and of slopes at the meshes."""
    both = jnp.concatenate([samples.points, samples.on_surface])
    away, on = jnp.split(surface.values(both) / surface.radius, 2)
    error = away - samples.distances / surface.radius
    turned = jax.vmap(functools.partial(slope, surface))(samples.on_surface) - samples.normals
    return (
        jnp.mean(jnp.abs(error)) + 10.0 * jnp.mean(jnp.abs(on)) + 0.1 * jnp.mean(jnp.square(turned))
    )


def fit(params: Params, model: ModelConfig, scene: Scene, *, seed: int) -> Params:
    """Returns parameters whose surface is that of the outermost meshes of a scene.

    Args:
      params: initial parameters.
      model: configuration of the model.
      scene: scene of the meshes.
      seed: seed of the samples.

    Raises:
      ValueError: if the meshes do not lie in the ball of the surface.
    """
    ball, surfaces = ball_of(model), jax.device_get(media.meshes_of(scene))
    outside = jax.device_get(scene.interfaces.medium_outside)
    samples = sample_meshes(surfaces, outside == media.AMBIENT, seed=seed, **ball._asdict())
    rate = optax.exponential_decay(_RATE, _STEPS, _LAST)
    adam = optax.adam(rate, b2=0.99, eps=_EPSILON)

    def placed(surface: Any) -> Params:
        return params._replace(field=params.field._replace(surface=surface))

    def loss(surface: Any, some: SurfaceSamples) -> Float[Array, ""]:
        learned = surface_scene(placed(surface), model).surfaces
        assert isinstance(learned, LevelSet)
        return distance_to_meshes(learned, some)

    def step(i: Int[Array, ""], carry: Any) -> Any:
        surface, moments = carry
        first = (i * _BATCH) % (samples.distances.size - _BATCH)
        some = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, _BATCH), samples)
        updates, moments = adam.update(jax.grad(loss)(surface, some), moments, surface)
        return optax.apply_updates(surface, updates), moments

    surface = params.field.surface
    surface, _ = jax.lax.fori_loop(0, _STEPS, step, (surface, adam.init(surface)))
    return placed(surface)
