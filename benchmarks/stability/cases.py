"""The extremes that the geometry of paths is tried at; each function returns the worst error.

`density` says how finely: 1 in tests. What must hold at every point of a lattice is asserted here.
"""

import jax
import numpy as np
import trimesh

from benchmarks import balls_and_rays
from benchmarks.oracles.reference_surfaces import unit
from benchmarks.stability import laws, paths
from benchmarks.stability.laws import Found

RAYS = 512
"""Rays of a case."""


def sphere(subdivisions=4, **options):
    return paths.part_from(trimesh.creation.icosphere(subdivisions=subdivisions), **options)


def inner_rays(radius=0.5):
    return paths.rays_at(paths.random_points(RAYS, radius=radius))


def _moved(rays, *, scale=1.0, offset=0.0):
    origins = scale * np.asarray(rays.origins, float) + offset
    return balls_and_rays.rays(origins, np.asarray(rays.directions, float))


def _worst(differences, error) -> Found:
    """Returns the worst of an error; every path must have as many bends as the reference's."""
    assert all(d.same.all() for d in differences)
    return Found(
        max(float(error(d)[d.escaped].max(initial=0.0)) for d in differences),
        sum(len(d.same) for d in differences),
    )


def slabs(density: int, tracer=paths.trace, *, from_grazing=1e-3, from_critical=3e-6) -> Found:
    """Last directions behind slabs of all ratios, at angles down to 1e-6 rad from grazing.

    Within the two angles given (in radians) from grazing and from the critical angle a path need
    not have as many bends as in the reference: what enters at grazing incidence meets the other
    face at the critical angle, and rounding decides whether it leaves.
    """
    found = []
    for ratio in laws.ratios(density):
        theta = np.resize(laws.angles(density, 1.0 / ratio), RAYS)
        turn = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, RAYS)
        across = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1)
        directions = np.sin(theta)[:, None] * across - np.cos(theta)[:, None] * [0.0, 0.0, 1.0]
        rays = balls_and_rays.rays(np.array([0.013, 0.017, 0.25]) - 3.0 * directions, directions)
        compared = paths.compare([paths.slab(index=float(ratio))], rays, tracer=tracer)
        clear = 0.5 * np.pi - theta > from_grazing
        clear &= np.abs(theta - np.arcsin(min(1.0, ratio))) > from_critical
        found.append(jax.tree.map(lambda x, clear=clear: x[clear], compared))
    return _worst(found, lambda d: d.direction)


def balls(density: int, tracer=paths.trace) -> Found:
    """Last directions behind a ball, off its rim."""
    rays = [inner_rays(), paths.rays_at(paths.random_points(RAYS, radius=0.5, seed=density))]
    return _worst(
        [paths.compare([sphere()], r, tracer=tracer) for r in rays], lambda d: d.direction
    )


def scales(density: int) -> Found:
    """Positions behind balls of radius 1e-3 to 1e3, relative to the radius."""
    found = []
    for scale in np.logspace(-3, 3, 6 * density + 1):
        body = sphere()
        rays = _moved(inner_rays(), scale=scale)
        compared = paths.compare([body._replace(vertices=scale * body.vertices)], rays)
        found.append(compared._replace(position=compared.position / scale))
    return _worst(found, lambda d: np.maximum(d.position, d.direction))


def powers_of_two(density: int) -> Found:
    """Paths at scales of powers of two, where not a bit may change."""
    body, rays = sphere(), inner_rays()
    plain = paths.main_ends(paths.build(body), rays)
    worst = 0.0
    exponents = np.linspace(-10, 10, 2 * density + 1).astype(int)
    for scale in np.exp2(exponents):
        moved = rays._replace(origins=rays.origins * np.float32(scale))
        scene = paths.build(body._replace(vertices=scale * body.vertices))
        other = paths.main_ends(scene, moved)
        assert np.array_equal(other.num_bends, plain.num_bends)
        apart = np.abs(other.origins / scale - plain.origins)
        turned = np.abs(other.directions - plain.directions)
        worst = max(worst, float(apart.max()), float(turned.max()))
    return Found(worst, len(exponents) * RAYS)


def offsets(density: int) -> Found:
    """Directions behind a ball of radius 1 up to 1e4 from the origin, by the distance."""
    found = []
    for size in np.logspace(0, 4, 4 * density + 1):
        offset = size * np.array([1.0, -1.0, 0.5])
        body = sphere()
        rays = _moved(inner_rays(), offset=offset)
        compared = paths.compare([body._replace(vertices=body.vertices + offset)], rays)
        found.append(compared._replace(direction=compared.direction / size))
    return _worst(found, lambda d: d.direction)


def needles(density: int) -> Found:
    """Share of rays that slip between triangles of aspect 1e6, 1e5 and 1e4."""
    slipped, cases = 0, 0
    for width in np.logspace(-6, -4, 2 * density + 1):
        random = np.random.default_rng(0)
        x = random.uniform(-6.0, 6.0, RAYS) * 2.0 * width
        points = np.stack([x, random.uniform(-0.5, 0.5, RAYS), np.full(RAYS, 0.25)], axis=-1)
        above = random.normal(size=points.shape)
        above[:, 2] = 0.3 + np.abs(above[:, 2])
        rays = balls_and_rays.rays(points + 3.0 * unit(above), -above)
        compared = paths.compare([paths.needles(2.0 * width)], rays)
        slipped += int(np.sum(~compared.same))
        cases += RAYS
    return Found(slipped / cases, cases)


def sizes(density: int) -> Found:
    """Last directions behind spheres of 80 triangles and more."""
    steps = (1, 3, 5)[:density] if density < 3 else (1, 2, 3, 4, 5, 6, 7)
    found = [paths.compare([sphere(step)], inner_rays()) for step in steps]
    return _worst(found, lambda d: d.direction)


def a_million_triangles(density: int) -> Found:
    """Last directions behind a sphere of 1,310,720 triangles."""
    del density
    return _worst([paths.compare([sphere(8)], inner_rays())], lambda d: d.direction)


def vertices_and_edges(density: int) -> Found:
    """Share of rays, aimed at vertices and at middles of edges, that slip through."""
    body = sphere()
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    middles = mesh.vertices[mesh.edges_unique].mean(axis=1)
    slipped, cases = 0, 0
    for seed in range(density):
        for targets in (mesh.vertices, middles):
            random = np.random.default_rng(seed)
            aims = targets[random.integers(0, len(targets), RAYS)]
            origins = 4.0 * unit(unit(aims) + 0.3 * unit(random.normal(size=aims.shape)))
            rays = balls_and_rays.rays(origins, aims - origins)
            ends = paths.main_ends(paths.build(body), rays)
            slipped += int(np.sum(ends.num_bends != 2))
            cases += RAYS
    return Found(slipped / cases, cases)


def in_double(density: int) -> Found:
    """Last directions behind a ball in double precision, of corners in single precision."""
    return balls(density, paths.trace_in_double)


def slabs_in_double(density: int) -> Found:
    """Last directions behind slabs in double precision."""
    return slabs(density, paths.trace_in_double, from_grazing=0.0, from_critical=0.0)


def no_nan_in_any_operation(density: int) -> Found:
    """Runs the meeting of ray and interface operation by operation under the check for NaN."""
    cases = laws.rounded(laws.lattice(density), np.float32)
    some = np.random.default_rng(0).choice(len(cases.near), 100 * density, replace=False)
    picked = type(cases)(*(x[some] for x in cases))
    with jax.debug_nans(True), jax.disable_jit():
        law = laws.ours(picked)
    return Found(float(np.sum(~np.isfinite(law.reflectance.astype(float)))), len(some))
