"""Small scenes with known answers, and rays to send into them."""

import functools

import jax
import numpy as np
import trimesh

from benchmarks.balls_and_rays import ball as ball
from benchmarks.balls_and_rays import rays as rays
from benchmarks.balls_and_rays import trace_ends as trace_ends
from refref_jax.data import meshes
from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.geometry import bvh_build
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.geometry.triangle_meshes import volume


def box(extents=(1.0, 1.0, 1.0), *, index=1.5, name="box_glass"):
    mesh = trimesh.creation.box(extents=extents)
    return MeshPart(name, np.asarray(mesh.vertices), np.asarray(mesh.faces), index, "auto")


def right_prism(index=1.5):
    """A prism along y with a right angle at the origin; its legs lie in x = 0 and z = 0."""
    base = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    mesh = trimesh.convex.convex_hull(np.array([[x, y, z] for x, z in base for y in (-1.0, 1.0)]))
    return MeshPart("prism_glass", np.asarray(mesh.vertices), np.asarray(mesh.faces), index, "flat")


def build(*parts, rule="nested"):
    tree = find_containment(parts)
    built = assemble_scene(parts, tree.parents, rule=rule, overlaps=tree.overlaps)
    return jax.device_put(built)


def with_spare_rows(scene):
    """Fills the tables of meshes up to few sizes, so that scenes can share a program.

    Nothing is ever found in the rows that are added.
    """
    bvh, *by_triangle = scene.surfaces
    spare = bvh_build.spare_rows(len(bvh.triangles))
    filled = [np.concatenate([x, np.repeat(x[-1:], spare, axis=0)]) for x in by_triangle]
    surfaces = Surfaces(bvh_build.filled_up(bvh), *filled)
    return jax.device_put(scene._replace(surfaces=surfaces))


@functools.cache
def read_geometry(scene):
    """Returns what the meshes of a scene's folder make, under the rule `nested`."""
    return build(*meshes.read_meshes(scene))


def volume_of(mesh):
    """Returns the volume inside a mesh or a part, negative if its faces point inwards."""
    return volume(mesh.vertices, mesh.faces)
