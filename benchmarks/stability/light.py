"""What must hold for the light on all paths of a ray, at extremes; see `cases`.

Clear glass loses nothing: the weights of a ray's paths and its loss sum to 1.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import balls_and_rays
from benchmarks.oracles.reference_surfaces import unit
from benchmarks.stability import paths
from benchmarks.stability.cases import RAYS, inner_rays, sphere
from benchmarks.stability.laws import Found
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import PAPER, TREE, PathSettings

_CUBE = 2.0, 2.0, 2.0


def edge_on(density: int) -> Found:
    """Light of rays that run in faces and along edges of a box, and start on them."""
    box = paths.slab(_CUBE)
    random = np.random.default_rng(0)
    origins = random.choice([-1.0, 1.0], (RAYS, 3))
    inner = random.uniform(-1.5, 1.5, (RAYS, 3))
    free = random.integers(0, 3, RAYS)[:, None] == np.arange(3)
    origins = np.where(free, inner, origins)
    axes = np.eye(3)[random.integers(0, 3, RAYS)] * random.choice([-1.0, 1.0], (RAYS, 1))
    diagonals = random.choice([-1.0, 0.0, 1.0], (RAYS, 3)) + 1e-3 * axes
    worst = 0.0
    for directions in (axes, diagonals, axes + 1e-6 * random.normal(size=axes.shape)):
        for back in (0.0, 3.0):
            rays = balls_and_rays.rays(origins - back * unit(directions), directions)
            worst = max(worst, _unbalance(paths.build(box), rays, TREE))
    del density
    return Found(worst, 6 * RAYS)


def on_surfaces(density: int) -> Found:
    """Light of rays that start on a ball's vertices and triangles, inwards and outwards."""
    body = sphere()
    corners = body.vertices[body.faces]
    worst, random = 0.0, np.random.default_rng(density)
    for origins in (body.vertices, corners.mean(axis=1), corners[:, :2].mean(axis=1)):
        origins = origins[random.integers(0, len(origins), RAYS)]
        directions = unit(random.normal(size=origins.shape))
        rays = balls_and_rays.rays(origins, directions)
        scene = paths.build(body)
        worst = max(worst, _unbalance(scene, rays, TREE))
        bends = paths.main_ends(scene, rays).num_bends
        # Rounding decides whether a start is inside; if it is, steep light leaves at once.
        outwards = np.sum(origins * directions, axis=-1) > 0.8
        assert np.all(bends[outwards] <= 1)
    return Found(worst, 3 * RAYS)


def _unbalance(scene, rays, settings) -> float:
    """Returns how far weights and losses are from summing to 1."""
    traced = paths.trace(scene, rays, settings=settings)
    assert np.all(traced.ends.num_bends <= settings.max_bends)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(traced.ends))
    return float(np.abs(paths.energy(traced, len(rays.radii)) - 1.0).max())


def white_furnace(density: int) -> Found:
    """Sums of weights and losses in clear glass, with ample room and with too little."""
    scene, rays = paths.build(paths.torus()), inner_rays(1.4)
    all_settings = [
        PathSettings(
            24, "all", min_throughput=0.0, live_per_ray=1.0, segments_per_ray=4.0, paths_per_ray=1.0
        ),
        TREE,
        PathSettings(24, "all", min_throughput=0.002, live_per_ray=1.0),
        PathSettings(24, "all", min_throughput=0.002, segments_per_ray=1.0),
        PathSettings(24, "all", min_throughput=0.002, paths_per_ray=1.0),
        PathSettings(
            8,
            "all",
            min_throughput=0.0,
            live_per_ray=64.0,
            segments_per_ray=600.0,
            paths_per_ray=300.0,
        ),
        PathSettings(24, "all", min_throughput=0.001),
        PAPER,
    ][: 2 * density]
    worst = max(_unbalance(scene, rays, settings) for settings in all_settings)
    return Found(worst, len(all_settings) * RAYS)


def nested_and_overlapping(density: int) -> Found:
    """Sums of weights and losses in bodies within and across one another, under each rule."""
    within, across = [0.0, 0.0, 0.0], [1.0, 0.3, 0.0]
    bodies = [
        (
            balls_and_rays.ball(1.0),
            balls_and_rays.ball(0.6, index=index, centre=centre, name="inner_water"),
        )
        for index, centre in ((1.333, within), (2.5, across), (0.4, across))
    ]
    worst = 0.0
    for pair in bodies:
        for rule in ("nested", "facing", "priority"):
            built = assemble_scene(pair, [NO_PARENT, 0], rule=rule)
            scene = jax.tree.map(jnp.asarray, built)
            worst = max(worst, _unbalance(scene, inner_rays(0.9), TREE))
    del density
    return Found(worst, 9 * RAYS)


def broken_meshes(density: int) -> Found:
    """Sums of weights and losses with degenerate, duplicate and missing triangles."""
    body = sphere()
    faces = body.faces
    points, lines = np.stack([faces[:, 0]] * 3, axis=-1), faces[:, [0, 1, 1]]
    meshes = [
        np.concatenate([faces, points[:100], lines[:100]]),
        np.concatenate([faces, faces[::7]]),
        faces[::3],
        np.concatenate([faces[:2560], faces[2560:, ::-1]]),
    ]
    del density
    worst = max(
        _unbalance(paths.build(body._replace(faces=mesh)), inner_rays(), TREE) for mesh in meshes
    )
    return Found(worst, len(meshes) * RAYS)


def index_matched(density: int) -> Found:
    """Distance of lines behind bodies of index 1 from the straight ones."""
    del density
    worst, rays = 0.0, inner_rays(0.9)
    for body in (sphere(index=1.0), paths.torus(index=1.0), paths.slab(_CUBE, index=1.0)):
        traced = paths.trace(paths.build(body), rays, settings=TREE)
        ends = traced.ends
        there = ends.statuses != PathStatus.EMPTY
        assert np.sum(there) == RAYS and np.all(ends.throughput[there] == 1.0)
        start, along = (np.asarray(x, float)[ends.rays] for x in (rays.origins, rays.directions))
        turned = np.linalg.norm(ends.directions - along, axis=-1)
        apart = np.linalg.norm(np.cross(ends.origins - start, along), axis=-1)
        worst = max(worst, float(turned[there].max()), float(apart[there].max()))
    return Found(worst, 3 * RAYS)


def reversibility(density: int) -> Found:
    """Directions after a path was traced back from where it escaped."""
    worst, cases = 0.0, 0
    for body, radius in ((sphere(), 0.5), (paths.slab(_CUBE), 0.5)):
        for seed in range(density):
            rays = paths.rays_at(paths.random_points(RAYS, radius=radius, seed=seed))
            scene = paths.build(body)
            ends = paths.main_ends(scene, rays)
            escaped = ends.statuses == PathStatus.ESCAPED
            back = rays._replace(
                origins=jnp.asarray(ends.origins + 4.0 * ends.directions),
                directions=jnp.asarray(-ends.directions),
            )
            home = paths.main_ends(scene, back)
            same = escaped & (home.num_bends == ends.num_bends)
            assert same[escaped].mean() > 0.99
            turned = home.directions + np.asarray(rays.directions)
            worst = max(worst, float(np.linalg.norm(turned, axis=-1)[same].max()))
            cases += int(same.sum())
    return Found(worst, cases)


def whispering_gallery(density: int) -> Found:
    """Light of rays caught in a ball by total reflection, which must end at their max bends."""
    sine = np.linspace(0.75, 0.999, RAYS)
    origins = np.stack([0.0 * sine, 0.0 * sine + 0.001, sine], axis=-1)
    rays = balls_and_rays.rays(origins, [1.0, 0.0, 0.0])
    worst, scene = 0.0, paths.build(sphere())
    for bends in (24, 100)[: 1 + (density > 1)]:
        traced = paths.trace(scene, rays, settings=PathSettings(bends, "all", min_throughput=0.02))
        there = traced.ends.statuses != PathStatus.EMPTY
        assert np.all(traced.ends.statuses[there] == PathStatus.OUT_OF_BENDS)
        assert np.all(traced.ends.num_bends[there] == bends)
        worst = max(worst, float(np.abs(paths.energy(traced, RAYS) - 1.0).max()))
    return Found(worst, RAYS)
