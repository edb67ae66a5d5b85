"""How exactly whole paths are traced at the extremes of scenes, meshes and rays.

Every trace runs under JAX's check for NaN. The reference (`reference_tree`) gets the same rays and
corners, after they were rounded to single precision.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from benchmarks import balls_and_rays
from benchmarks.oracles import reference_surfaces, reference_tree
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.path_settings import PathSettings

MAIN = PathSettings(10, "none", live_per_ray=1.0, segments_per_ray=10.0, paths_per_ray=1.0)
"""One path a ray: refracted wherever it can be."""


class Difference(NamedTuple):
    """How far the library's main paths are from the reference's.

    Attributes:
      direction: error of the last direction, of rays whose paths have equally many bends.
      position: distance of the start of the last segment from the reference's last line.
      bends: number of bends, the library's.
      same: which rays have equally many bends in both.
      escaped: the reference's paths that escape.
    """

    direction: np.ndarray
    position: np.ndarray
    bends: np.ndarray
    same: np.ndarray
    escaped: np.ndarray


def slab(extents=(40.0, 40.0, 0.5), *, index=1.5):
    mesh = trimesh.creation.box(extents)
    return MeshPart("slab_glass", np.asarray(mesh.vertices), np.asarray(mesh.faces), index, "flat")


def torus(*, index=1.5, sections=48):
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=sections, minor_sections=sections // 2)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return MeshPart("torus_glass", vertices, faces, index, "smooth")


def needles(width=2e-6, count=16, *, index=1.5):
    """Returns a slab whose large faces hold needles of that width, one beside another, at x = 0."""
    x = np.concatenate([[-1.0], width * (np.arange(count) - count // 2), [1.0]])
    ring = [(a, b) for b in (-1.0, 1.0) for a in (x if b < 0 else x[::-1])]
    size, n = len(ring), len(x)
    vertices = np.array([(a, b, c) for c in (-0.25, 0.25) for a, b in ring])
    faces = []
    for i in range(size):
        j = (i + 1) % size
        faces += [(i, j, size + j), (i, size + j, size + i)]
    for i in range(n - 1):
        quad = i, i + 1, size - 2 - i, size - 1 - i
        top = [size + k for k in quad]
        faces += [(top[0], top[1], top[2]), (top[0], top[2], top[3])]
        faces += [(quad[0], quad[2], quad[1]), (quad[0], quad[3], quad[2])]
    return MeshPart("needles_glass", vertices, np.array(faces), index, "flat")


def part_from(mesh, *, index=1.5, shading="smooth"):
    return MeshPart("mesh_glass", np.asarray(mesh.vertices), np.asarray(mesh.faces), index, shading)


def build(*parts):
    """Returns the scene of parts that do not contain one another."""
    built = assemble_scene(parts, [NO_PARENT] * len(parts), rule="nested")
    return jax.tree.map(jnp.asarray, built)


def trace(scene, rays, *, settings):
    """Traces, and refuses any NaN on the way."""
    with jax.debug_nans(True):
        return jax.tree.map(np.asarray, balls_and_rays.trace_ends(scene, rays, settings=settings))


def trace_in_double(scene, rays, *, settings):
    """Traces in double precision what was built in single."""

    def widen(x):
        return jnp.asarray(x, jnp.float64) if x.dtype == np.float32 else jnp.asarray(x)

    scene, rays = (jax.tree.map(np.asarray, x) for x in (scene, rays))
    # What was of length 1 in single precision is not in double, and no index would matter more.
    rays = rays._replace(directions=reference_surfaces.unit(rays.directions.astype(float)))
    # Integers are 64 bits wide then, and meet those of the scene.
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        return trace(*(jax.tree.map(widen, x) for x in (scene, rays)), settings=settings)


def surfaces_of(parts):
    """Returns the reference's surfaces, of corners in single precision."""
    described = [
        reference_surfaces.Part(p.vertices, p.faces, p.shading == "smooth", p.index) for p in parts
    ]
    joined = reference_surfaces.join(described)

    def halved(x):
        return x.astype(np.float32).astype(float)

    return joined._replace(corners=halved(joined.corners), inside=halved(joined.inside))


def main_ends(scene, rays, *, tracer=trace):
    """Returns the end of the main path of every ray, in the order of the rays."""
    ends = tracer(scene, rays, settings=MAIN).ends
    order = np.argsort(ends.rays)
    assert np.array_equal(ends.rays[order], np.arange(len(order)))
    return jax.tree.map(lambda x: x[order], ends)


def compare(parts, rays, *, tracer=trace):
    """Traces the main paths of rays twice."""
    surfaces = surfaces_of(parts)
    few = len(surfaces.corners) <= 400
    cast = (reference_surfaces.BruteForce if few else reference_surfaces.Embree)(surfaces)
    origins, directions = (np.asarray(x, float) for x in (rays.origins, rays.directions))
    rule = reference_tree.Rule(MAIN.max_bends, "none")
    directions = reference_surfaces.unit(directions)
    true = reference_tree.trace(surfaces, cast, origins, directions, rule)
    true = true._replace(casts=np.zeros(len(true.rays)))
    true = reference_tree.Ends(*(x[np.argsort(true.rays)] for x in true))
    return difference(main_ends(build(*parts), rays, tracer=tracer), true)


def difference(found, true):
    """Compares last segments, one a ray and in the order of rays."""
    apart = found.origins - true.origins
    along = np.sum(apart * true.directions, axis=-1, keepdims=True)
    return Difference(
        direction=np.linalg.norm(found.directions - true.directions, axis=-1),
        position=np.linalg.norm(apart - along * true.directions, axis=-1),
        bends=found.num_bends,
        same=found.num_bends == true.num_bends,
        escaped=true.statuses == reference_tree.ESCAPED,
    )


def rays_at(points, *, distance=4.0, seed=0):
    """Returns rays from random places at that distance of the origin, aimed at points."""
    places = np.random.default_rng(seed).normal(size=np.shape(points))
    origins = distance * reference_surfaces.unit(places)
    return balls_and_rays.rays(origins, points - origins)


def random_points(count, *, radius=1.0, seed=1):
    """Returns points within a cube of that half edge."""
    return np.random.default_rng(seed).uniform(-radius, radius, (count, 3))


def energy(traced, count):
    """Returns weights and losses, summed for each ray."""
    sums = np.array(traced.dropped, float)
    np.add.at(sums, traced.ends.rays, traced.ends.throughput.astype(float))
    assert sums.shape == (count, 3)
    return sums
