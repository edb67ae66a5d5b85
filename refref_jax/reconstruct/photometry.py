"""Compares photographs with the light of a known backdrop, refracted by an object of unknown shape.

`predict` renders pixels along the whole path tree. `sensitivities` differentiates them: the main
path of a pixel (refracted wherever it can be) carries the share `T` of its light and ends at a
place `(u, v)` of the backdrop. With the three *coordinates* `(u, v, T)`,

    d colour / d unknowns = (d colour / d coordinates) (d coordinates / d unknowns).

The first factor is small: differences of the radiance over the pixel's own footprint, and, for `T`,
the difference between the main path and the pixel's other light, which takes its share. The second
is exact, and dense only in the corners and normals of the few triangles that the path meets.
Nothing is ever differentiated through the whole mesh. The sequence of triangles is held fixed, as
in `differentiable_paths`: a caller traces again for every linearisation.

This is one of the modules that call `jax.jit`.

Source: ours. Igehy, Tracing Ray Differentials (1999), for the footprints.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.compilation import at_once, jit_quickly, threads, traced_once
from refref_jax.geometry import bvh_build
from refref_jax.geometry.bvh import NO_PRIMITIVE
from refref_jax.geometry.bvh_build import Division
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.differentiable_paths import find_primitives, follow_branch
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.media import AMBIENT, INDEX_OF_AIR, Interfaces, Scene, meshes_of
from refref_jax.optics.path_settings import TREE, PathSettings
from refref_jax.render import backdrop, images, pixels
from refref_jax.render.backdrop import Lookups, Mips
from refref_jax.sampling.scene_bounds import Domain

MAIN = PathSettings(max_bends=8, reflections="all", min_throughput=TREE.min_throughput)
"""The main path: 8 bends are enough for 99 % of the pixels of a torus or of a filled flask."""

# Number of rays traced at once by all threads (the same for any number of rays: one compilation),
# and largest number of taps along each axis of a footprint.
_TILE = 8192
_TAPS = 3

# Half the width of the difference that gives the slope of the radiance, in cells of the resolution
# read: the slope over the cells that the pixel averages, not that of one bilinear patch.
_HALF_WIDTH = 0.5

# Light beside the main path that is below this share has no colour of its own.
_LITTLE = 0.01

# Scenes have this many interfaces on the device, or else a multiple of the second number: those
# without faces let them share a program.
_FEW_PARTS, _MORE_PARTS = 4, 16

_Tree = TypeVar("_Tree")


class Backdrop(NamedTuple):
    """A known backdrop.

    Attributes:
      domain: its kind, size and place.
      mips: its radiance at all resolutions, fine to coarse (`backdrop.mipmap`).
      coverage: number of pixels that see each vertex, at the same resolutions, in three channels.
    """

    domain: Domain
    mips: Mips
    coverage: Mips

    @property
    def resolution(self) -> int:
        """Number of cells per side of a face."""
        return self.mips[0].shape[1] - 1


class Photographs(NamedTuple):
    """Pixels of photographs that see the object.

    Attributes:
      rays: rays of the pixels.
      rgb: sRGB of the pixels, in `[0, 1]`.
      views: view of each pixel.
    """

    rays: Rays
    rgb: Float[np.ndarray, "rays 3"]
    views: Int[np.ndarray, " rays"]

    def chosen(self, some: Int[np.ndarray, " some"]) -> "Photographs":
        """Returns some of the pixels."""
        return jax.tree.map(lambda x: numerics.host_array(np.asarray(x)[some]), self)

    def drawn(self, generator: np.random.Generator, count: int) -> "Photographs":
        """Returns pixels that are drawn without repetition, all if there are no more."""
        every = len(self.views)
        return self.chosen(generator.choice(every, min(count, every), replace=False))


class TracedObject(NamedTuple):
    """A scene on the device, and the faces that its primitives are.

    Attributes:
      scene: the scene; its parts are nested dielectrics, of which some have no faces.
      faces: face of each primitive, counted over all parts.
      division: division of the faces among the nodes of the tree.
      parts: number of the parts.
    """

    scene: Scene
    faces: Int[np.ndarray, " primitives"]
    division: Division
    parts: int

    def with_interfaces(self, interfaces: Interfaces) -> "TracedObject":
        """Returns the same surfaces between other media."""
        scene = self.scene._replace(interfaces=jax.device_put(_filled_up(interfaces)))
        return self._replace(scene=scene)


class Prediction(NamedTuple):
    """Predicted pixels, as NumPy arrays once a caller has them.

    Attributes:
      linear: linear RGB.
      dropped: share of the light that was not followed.
    """

    linear: Float[Any, "rays 3"]
    dropped: Float[Any, " rays"]


class Sensitivities(NamedTuple):
    """Derivatives of pixels, as factors; see the module.

    Attributes:
      primitives: triangle at each bend of the main path, `NO_PRIMITIVE` where it has none.
      by_corners: derivatives of the coordinates by the corners of these triangles, per world unit.
      by_normals: derivatives of the coordinates by their normals.
      by_indices: derivatives of the coordinates by the index of refraction of each part.
      slopes: derivatives of the pixel's linear RGB by the coordinates.
      light: linear RGB that the main path contributes.
      crossings: number of times that the main path meets each part.
      lengths: length of the main path in the medium of each part, world units.
      coverage: number of pixels that see the backdrop where the path ends.
      usable: whether the path leaves the object within the number of bends.
    """

    primitives: Int[Any, "rays bends"]
    by_corners: Float[Any, "rays 3 bends 3 3"]
    by_normals: Float[Any, "rays 3 bends 3 3"]
    by_indices: Float[Any, "rays 3 parts"]
    slopes: Float[Any, "rays 3 3"]
    light: Float[Any, "rays 3"]
    crossings: Int[Any, "rays parts"]
    lengths: Float[Any, "rays parts"]
    coverage: Float[Any, " rays"]
    usable: Bool[Any, " rays"]


class InnerSegments(NamedTuple):
    """Segments of main paths, in order.

    Attributes:
      starts: first points, world units.
      ends: last points, world units.
      inside: whether a segment lies in the object; the other fields have no meaning elsewhere.
    """

    starts: Float[Any, "rays segments 3"]
    ends: Float[Any, "rays segments 3"]
    inside: Bool[Any, "rays segments"]


def assemble(
    corners: Float[np.ndarray, "faces 3 3"],
    normals: Float[np.ndarray, "faces 3 3"],
    parts: Int[np.ndarray, " faces"],
    interfaces: Interfaces,
    *,
    like: TracedObject | None = None,
) -> TracedObject:
    """Returns a scene of triangles, on the device.

    Args:
      corners: corners of all faces, world units.
      normals: outward unit shading normals at these corners.
      parts: part of each face.
      interfaces: interfaces of the parts, under the rule `nested`.
      like: scene of the same faces, elsewhere by little, whose tree is divided alike.
    """
    triangles = corners.astype(np.float32)
    division = bvh_build.divide(triangles) if like is None else like.division
    bvh, order = bvh_build.build(triangles, division=division)
    order = np.append(order, np.repeat(order[-1:], bvh_build.spare_rows(len(order))))
    packed = Surfaces(
        bvh_build.filled_up(bvh),
        numerics.host_array(normals[order].astype(np.float32)),
        numerics.host_array(parts[order].astype(np.int32)),
        numerics.host_array(np.zeros((0, 3, 3), np.float32)),
    )
    scene = jax.device_put(Scene(packed, _filled_up(interfaces)))
    return TracedObject(scene, order, division, len(interfaces.index_inside))


def _filled_up(interfaces: Interfaces) -> Interfaces:
    """Returns interfaces with some that no face has, which repeat the last one."""
    count = len(interfaces.index_inside)
    some = _FEW_PARTS if count <= _FEW_PARTS else math.ceil(count / _MORE_PARTS) * _MORE_PARTS

    def with_more(name: str, axis: int) -> Any:
        known = np.asarray(getattr(interfaces, name))
        last = np.repeat(np.take(known, [-1], axis=axis), some - count, axis=axis)
        return numerics.host_array(np.concatenate([known, last], axis=axis))

    by_part = "index_inside", "index_outside", "medium_outside", "tint", "absorption"
    filled = {name: with_more(name, 0) for name in by_part}
    return interfaces._replace(**filled, index_by_channel=with_more("index_by_channel", 2))


def blurred(surface: Backdrop, halvings: int) -> Backdrop:
    """Returns a backdrop that is blurred by about `0.58 * 2**halvings` of its cells.

    Args:
      surface: the backdrop.
      halvings: number of times that the resolution is halved before it is interpolated again.
    """
    if not halvings:
        return surface
    mips = surface.mips
    halvings = min(halvings, len(mips) - 1)
    levels = [jnp.zeros_like(mip) for mip in mips]
    levels[halvings] = mips[halvings]
    pyramid = tuple(reversed(levels))
    return surface._replace(mips=_mipmap(pyramid, space=surface.domain.space))


_mipmap = jit_quickly(backdrop.mipmap, static_argnames="space")


def predict(traced: TracedObject, surface: Backdrop, rays: Rays) -> Prediction:
    """Renders pixels along the whole path tree, with one ray and its footprint each."""

    def render(part: Rays) -> Prediction:
        return _predict(
            traced.scene,
            surface.mips,
            part,
            domain=surface.domain,
            resolution=surface.resolution,
        )

    return _in_tiles(render, rays)


def inner_segments(traced: TracedObject, rays: Rays) -> InnerSegments:
    """Returns the segments of the main paths inside the object, as a list for each ray.

    Segments in parts of the object's parts, such as bubbles, count as inside. Paths that do not
    leave the object within the number of bends have none.

    Args:
      traced: the object.
      rays: rays of pixels.
    """
    return _in_tiles(lambda part: _inner_segments(traced.scene, part), rays)


@jit_quickly
def _inner_segments(scene: Scene, rays: Rays) -> InnerSegments:
    ahead = jnp.zeros(MAIN.max_bends, bool)
    paths = jax.vmap(lambda ray: follow_branch(scene, ray, ahead, settings=MAIN))(rays)
    bounded = jnp.isfinite(paths.tau[:, 1:]) & (paths.media[:, :-1] != AMBIENT)
    inside = bounded & (paths.statuses == PathStatus.ESCAPED)[:, None]
    return InnerSegments(paths.points[:, :-1], paths.points[:, 1:], inside)


def sensitivities(
    traced: TracedObject, surface: Backdrop, rays: Rays, predicted: Prediction
) -> Sensitivities:
    """Differentiates pixels by the corners, normals and indices that their main paths meet."""

    def differentiate(part: Rays) -> tuple[Sensitivities, Array, Array]:
        return _differentiate(
            traced.scene,
            surface.mips,
            surface.coverage,
            part,
            domain=surface.domain,
            resolution=surface.resolution,
        )

    found, radiance, share = _in_tiles(differentiate, rays)
    share = share[:, None]
    light = share * radiance
    others = (predicted.linear - light) / np.maximum(1.0 - share, _LITTLE)
    by_share = np.where(1.0 - share > _LITTLE, radiance - others, 0.0)
    slopes = np.concatenate([found.slopes, by_share[:, None]], axis=1)
    return found._replace(
        slopes=slopes,
        light=light,
        by_indices=found.by_indices[..., : traced.parts],
        crossings=found.crossings[:, : traced.parts],
        lengths=found.lengths[:, : traced.parts],
    )


def residuals(
    predicted: Float[np.ndarray, "*predictions rays 3"], rgb: Float[np.ndarray, "rays 3"]
) -> Float[np.ndarray, "*predictions rays 3"]:
    """Returns the errors of predicted pixels in sRGB, for each of several predictions."""
    return encode(predicted) - rgb


def encode(linear: Float[np.ndarray, "*rays 3"]) -> Float[np.ndarray, "*rays 3"]:
    """Returns linear RGB as sRGB in `[0, 1]`."""
    return np.asarray(_encode(linear), np.float64)


def _encode(linear: Float[ArrayLike, "*rays 3"]) -> Float[Array, "*rays 3"]:
    return jnp.clip(pixels.linear_to_srgb(jnp.asarray(linear)), 0.0, 1.0)


def _in_tiles(render: Callable[[Rays], _Tree], rays: Rays) -> _Tree:
    """Returns the results for all rays, as NumPy arrays."""
    count, tile = rays.radii.shape[0], _TILE // threads()

    def see(start: int) -> _Tree:
        part, _ = images.crop(rays, None, start, tile)
        kept = min(tile, count - start)
        return jax.tree.map(lambda x: np.asarray(x)[:kept], render(part))

    return images.join(at_once(see, range(0, count, tile)))


@traced_once
@functools.partial(jit_quickly, static_argnames=("domain", "resolution"))
def _predict(
    scene: Scene, mips: Mips, rays: Rays, *, domain: Domain, resolution: int
) -> Prediction:
    count = rays.radii.shape[0]
    traced = path_tracing.trace_ends(scene, rays, settings=TREE, footprint="differential")
    ends = traced.ends
    throughput = jnp.where(light_paths.exists(ends)[:, None], ends.throughput, 0.0)
    ends = ends._replace(throughput=throughput)
    lookups = backdrop.locate(domain, ends, ends.rays, resolution=resolution, most_taps=_TAPS)
    linear = backdrop.colours(mips, lookups, pixels=count)
    return Prediction(linear, jnp.max(traced.dropped, axis=-1))


@traced_once
@functools.partial(jit_quickly, static_argnames=("domain", "resolution"))
def _differentiate(
    scene: Scene, mips: Mips, coverage: Mips, rays: Rays, *, domain: Domain, resolution: int
) -> tuple[Sensitivities, Array, Array]:
    """Returns the sensitivities, and the radiance and the share of the main path."""
    ahead = jnp.zeros(MAIN.max_bends, bool)
    primitives = jax.vmap(lambda ray: find_primitives(scene, ray, ahead, settings=MAIN))(rays)
    replay = functools.partial(_replay, scene, domain)
    meshes = meshes_of(scene)
    triangles = meshes.bvh.triangles[primitives]
    normals, parts = meshes.normals[primitives], meshes.parts[primitives]
    indices = scene.interfaces.index_inside
    absorptions = scene.interfaces.absorption
    by = jax.jacrev(replay, argnums=(0, 1, 2, 3), has_aux=True)
    found_by, ends = jax.vmap(by, in_axes=(0, 0, None, None, 0, 0, 0))(
        triangles, normals, indices, absorptions, parts, primitives, rays
    )
    by_corners, by_normals, by_indices, by_absorptions = found_by
    share = jnp.mean(ends.throughput, axis=-1)
    # The share falls by its own size for each unit of length and of absorption.
    lengths = -jnp.sum(by_absorptions[:, 2], axis=-1) / jnp.maximum(share, _LITTLE)[:, None]
    count = rays.radii.shape[0]
    numbers = jnp.arange(count, dtype=jnp.int32)
    lookups = backdrop.locate(domain, ends, numbers, resolution=resolution, most_taps=_TAPS)
    slopes = _slopes(mips, lookups) * ends.throughput[:, None]
    radiance = backdrop.radiance(mips, lookups)
    met = primitives[:, :-1] != NO_PRIMITIVE
    kinds = jnp.arange(indices.shape[0], dtype=jnp.int32)[None, None]
    crossings = jnp.sum((parts[:, :-1, None] == kinds) & met[..., None], axis=1, dtype=jnp.int32)
    cut = lambda x: x[:, :, :-1]  # noqa: E731 - the last cast meets nothing
    found = Sensitivities(
        primitives=primitives[:, :-1],
        by_corners=cut(by_corners),
        by_normals=cut(by_normals),
        by_indices=by_indices,
        slopes=slopes,
        light=radiance,
        crossings=crossings,
        lengths=lengths,
        coverage=backdrop.radiance(coverage, lookups)[:, 0],
        usable=ends.statuses == PathStatus.ESCAPED,
    )
    return found, radiance, share


def _replay(
    scene: Scene,
    domain: Domain,
    corners: Float[Array, "casts 3 3"],
    normals: Float[Array, "casts 3 3"],
    indices: Float[Array, " parts"],
    absorptions: Float[Array, "parts 3"],
    parts: Int[Array, " casts"],
    primitives: Int[Array, " casts"],
    ray: Rays,
) -> tuple[Float[Array, "3"], light_paths.PathEnds]:
    """Returns the coordinates of the main path of one ray, through the triangles given."""
    meshes = meshes_of(scene)
    bvh = meshes.bvh._replace(triangles=corners)
    surfaces = meshes._replace(bvh=bvh, normals=normals, parts=parts)
    interfaces = with_indices(scene.interfaces, indices)._replace(absorption=absorptions)
    local = Scene(surfaces, interfaces)
    casts = jnp.arange(primitives.shape[0], dtype=jnp.int32)
    path = follow_branch(
        local,
        ray,
        jnp.zeros(MAIN.max_bends, bool),
        settings=MAIN,
        footprint="differential",
        primitives=jnp.where(primitives == NO_PRIMITIVE, NO_PRIMITIVE, casts),
    )
    one = jax.tree.map(lambda x: x[None], path)
    ends = jax.tree.map(lambda x: x[0], light_paths.ends_of(one))
    towards = jax.lax.stop_gradient(backdrop.to_surface(domain, ends.origins, ends.directions))
    axis = jnp.argmax(jnp.abs(towards)).astype(jnp.int32)
    place = backdrop.place_on_face(domain, axis, ends.origins, ends.directions)
    share = jnp.mean(ends.throughput, keepdims=True)
    return jnp.append(place, share), jax.lax.stop_gradient(ends)


def with_indices(interfaces: Interfaces, indices: Float[Array, " parts"]) -> Interfaces:
    """Returns the interfaces of nested dielectrics with other indices, in air."""
    around = indices[jnp.maximum(interfaces.medium_outside - 1, 0)]
    outside = jnp.where(interfaces.medium_outside == AMBIENT, INDEX_OF_AIR, around)
    return interfaces._replace(index_inside=indices, index_outside=outside.astype(indices.dtype))


def _slopes(mips: Mips, lookups: Lookups) -> Float[Array, "rays 2 3"]:
    """Returns the derivatives of the radiance by the place on the face."""
    sides = lookups.sides.astype(lookups.starts.dtype)

    def along(axis: int) -> Float[Array, "rays 3"]:
        shift = _HALF_WIDTH * jnp.eye(2, dtype=lookups.starts.dtype)[axis][None]
        there, here = (
            backdrop.radiance(mips, lookups._replace(starts=lookups.starts + sign * shift))
            for sign in (1.0, -1.0)
        )
        # A face is two units and as many cells wide as it has sides.
        return (there - here) * (0.5 * sides / (2.0 * _HALF_WIDTH))[:, None]

    return jnp.stack([along(0), along(1)], axis=1)


def make_backdrop(
    domain: Domain,
    pyramid: backdrop.Pyramid,
    coverage: Float[ArrayLike, "6 side side"],
) -> Backdrop:
    """Returns a solved backdrop, to be looked up.

    Args:
      domain: its kind, size and place.
      pyramid: its radiance, which must not depend on the direction.
      coverage: number of pixels that see each vertex.
    """
    seen = [jnp.zeros_like(level) for level in pyramid]
    seen[-1] = jnp.repeat(jnp.asarray(coverage, jnp.float32)[..., None], 3, axis=-1)
    mips, covered = (_mipmap(each, space=domain.space) for each in (pyramid, tuple(seen)))
    return Backdrop(domain, mips, covered)
