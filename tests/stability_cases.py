"""The extremes that paths are tried at; each function returns the worst error that it finds.

`density` says how finely: 1 in tests. What must hold at every point of a lattice is asserted here.
"""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from refref_jax.data.geometry import build_geometry
from refref_jax.optics.budgets import PAPER, TREE, Budget
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.light_paths import PathStatus
from tests import scenes, stability_laws
from tests import stability_paths as paths
from tests.reference_surfaces import unit
from tests.stability_laws import Found

_RAYS = 512
_CUBE = 2.0, 2.0, 2.0


def sphere(subdivisions=4, **options):
    return paths.part_from(trimesh.creation.icosphere(subdivisions=subdivisions), **options)


def _inner_rays(radius=0.5):
    return paths.rays_at(paths.random_points(_RAYS, radius=radius))


def _moved(rays, *, scale=1.0, offset=0.0):
    origins = scale * np.asarray(rays.origins, float) + offset
    return scenes.rays(origins, np.asarray(rays.directions, float))


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
    for ratio in stability_laws.ratios(density):
        theta = np.resize(stability_laws.angles(density, 1.0 / ratio), _RAYS)
        turn = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, _RAYS)
        across = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1)
        directions = np.sin(theta)[:, None] * across - np.cos(theta)[:, None] * [0.0, 0.0, 1.0]
        rays = scenes.rays(np.array([0.013, 0.017, 0.25]) - 3.0 * directions, directions)
        compared = paths.compare([paths.slab(index=float(ratio))], rays, tracer=tracer)
        clear = 0.5 * np.pi - theta > from_grazing
        clear &= np.abs(theta - np.arcsin(min(1.0, ratio))) > from_critical
        found.append(jax.tree.map(lambda x, clear=clear: x[clear], compared))
    return _worst(found, lambda d: d.direction)


def balls(density: int, tracer=paths.trace) -> Found:
    """Last directions behind a ball, off its rim."""
    rays = [_inner_rays(), paths.rays_at(paths.random_points(_RAYS, radius=0.5, seed=density))]
    return _worst(
        [paths.compare([sphere()], r, tracer=tracer) for r in rays], lambda d: d.direction
    )


def scales(density: int) -> Found:
    """Positions behind balls of radius 1e-3 to 1e3, relative to the radius."""
    found = []
    for scale in np.logspace(-3, 3, 6 * density + 1):
        body = sphere()
        rays = _moved(_inner_rays(), scale=scale)
        compared = paths.compare([body._replace(vertices=scale * body.vertices)], rays)
        found.append(compared._replace(position=compared.position / scale))
    return _worst(found, lambda d: np.maximum(d.position, d.direction))


def powers_of_two(density: int) -> Found:
    """Paths at scales of powers of two, where not a bit may change."""
    body, rays = sphere(), _inner_rays()
    plain = paths.main_ends(paths.build(body), rays)
    worst = 0.0
    exponents = np.linspace(-10, 10, 2 * density + 1).astype(int)
    for scale in np.exp2(exponents):
        moved = rays._replace(origins=rays.origins * np.float32(scale))
        geometry = paths.build(body._replace(vertices=scale * body.vertices))
        other = paths.main_ends(geometry, moved)
        assert np.array_equal(other.bends, plain.bends)
        apart = np.abs(other.origins / scale - plain.origins)
        turned = np.abs(other.directions - plain.directions)
        worst = max(worst, float(apart.max()), float(turned.max()))
    return Found(worst, len(exponents) * _RAYS)


def offsets(density: int) -> Found:
    """Directions behind a ball of radius 1 up to 1e4 from the origin, by the distance."""
    found = []
    for size in np.logspace(0, 4, 4 * density + 1):
        offset = size * np.array([1.0, -1.0, 0.5])
        body = sphere()
        rays = _moved(_inner_rays(), offset=offset)
        compared = paths.compare([body._replace(vertices=body.vertices + offset)], rays)
        found.append(compared._replace(direction=compared.direction / size))
    return _worst(found, lambda d: d.direction)


def needles(density: int) -> Found:
    """Share of rays that slip between triangles of aspect 1e6, 1e5 and 1e4."""
    slipped, cases = 0, 0
    for width in np.logspace(-6, -4, 2 * density + 1):
        random = np.random.default_rng(0)
        x = random.uniform(-6.0, 6.0, _RAYS) * 2.0 * width
        points = np.stack([x, random.uniform(-0.5, 0.5, _RAYS), np.full(_RAYS, 0.25)], axis=-1)
        above = random.normal(size=points.shape)
        above[:, 2] = 0.3 + np.abs(above[:, 2])
        rays = scenes.rays(points + 3.0 * unit(above), -above)
        compared = paths.compare([paths.needles(2.0 * width)], rays)
        slipped += int(np.sum(~compared.same))
        cases += _RAYS
    return Found(slipped / cases, cases)


def sizes(density: int) -> Found:
    """Last directions behind spheres of 80 triangles and more."""
    steps = (1, 3, 5)[:density] if density < 3 else (1, 2, 3, 4, 5, 6, 7)
    found = [paths.compare([sphere(step)], _inner_rays()) for step in steps]
    return _worst(found, lambda d: d.direction)


def a_million_triangles(density: int) -> Found:
    """Last directions behind a sphere of 1,310,720 triangles."""
    del density
    return _worst([paths.compare([sphere(8)], _inner_rays())], lambda d: d.direction)


def vertices_and_edges(density: int) -> Found:
    """Share of rays, aimed at vertices and at middles of edges, that slip through."""
    body = sphere()
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    middles = mesh.vertices[mesh.edges_unique].mean(axis=1)
    slipped, cases = 0, 0
    for seed in range(density):
        for targets in (mesh.vertices, middles):
            random = np.random.default_rng(seed)
            aims = targets[random.integers(0, len(targets), _RAYS)]
            origins = 4.0 * unit(aims + 0.3 * random.normal(size=aims.shape))
            rays = scenes.rays(origins, aims - origins)
            ends = paths.main_ends(paths.build(body), rays)
            slipped += int(np.sum(ends.bends != 2))
            cases += _RAYS
    return Found(slipped / cases, cases)


def edge_on(density: int) -> Found:
    """Light of rays that run in faces and along edges of a box, and start on them."""
    box = paths.slab(_CUBE)
    random = np.random.default_rng(0)
    origins = random.choice([-1.0, 1.0], (_RAYS, 3))
    inner = random.uniform(-1.5, 1.5, (_RAYS, 3))
    free = random.integers(0, 3, _RAYS)[:, None] == np.arange(3)
    origins = np.where(free, inner, origins)
    axes = np.eye(3)[random.integers(0, 3, _RAYS)] * random.choice([-1.0, 1.0], (_RAYS, 1))
    diagonals = random.choice([-1.0, 0.0, 1.0], (_RAYS, 3)) + 1e-3 * axes
    worst = 0.0
    for directions in (axes, diagonals, axes + 1e-6 * random.normal(size=axes.shape)):
        for back in (0.0, 3.0):
            rays = scenes.rays(origins - back * unit(directions), directions)
            worst = max(worst, _unbalance(paths.build(box), rays, TREE))
    del density
    return Found(worst, 6 * _RAYS)


def on_surfaces(density: int) -> Found:
    """Light of rays that start on a ball's vertices and triangles, inwards and outwards."""
    body = sphere()
    corners = body.vertices[body.faces]
    worst, random = 0.0, np.random.default_rng(density)
    for origins in (body.vertices, corners.mean(axis=1), corners[:, :2].mean(axis=1)):
        origins = origins[random.integers(0, len(origins), _RAYS)]
        directions = unit(random.normal(size=origins.shape))
        rays = scenes.rays(origins, directions)
        geometry = paths.build(body)
        worst = max(worst, _unbalance(geometry, rays, TREE))
        bends = paths.main_ends(geometry, rays).bends
        # Rounding decides whether a start is inside; if it is, steep light leaves at once.
        outwards = np.sum(origins * directions, axis=-1) > 0.8
        assert np.all(bends[outwards] <= 1)
    return Found(worst, 3 * _RAYS)


def _unbalance(geometry, rays, budget) -> float:
    """Returns how far weights and losses are from summing to 1."""
    traced = paths.trace(geometry, rays, budget=budget)
    assert np.all(traced.ends.bends <= budget.bends)
    assert all(np.all(np.isfinite(x)) for x in traced.ends)
    return float(np.abs(paths.energy(traced, len(rays.radii)) - 1.0).max())


def white_furnace(density: int) -> Found:
    """Sums of weights and losses in clear glass, with ample room and with too little."""
    geometry, rays = paths.build(paths.torus()), _inner_rays(1.4)
    budgets = [
        Budget(24, "all", cut=0.0, live_per_ray=1.0, segments_per_ray=4.0, paths_per_ray=1.0),
        TREE,
        Budget(24, "all", cut=0.002, live_per_ray=1.0),
        Budget(24, "all", cut=0.002, segments_per_ray=1.0),
        Budget(24, "all", cut=0.002, paths_per_ray=1.0),
        Budget(8, "all", cut=0.0, live_per_ray=64.0, segments_per_ray=600.0, paths_per_ray=300.0),
        Budget(24, "all", cut=0.001),
        PAPER,
    ][: 2 * density]
    worst = max(_unbalance(geometry, rays, budget) for budget in budgets)
    return Found(worst, len(budgets) * _RAYS)


def nested_and_overlapping(density: int) -> Found:
    """Sums of weights and losses in bodies within and across one another, under each rule."""
    within, across = [0.0, 0.0, 0.0], [1.0, 0.3, 0.0]
    bodies = [
        (scenes.ball(1.0), scenes.ball(0.6, index=index, centre=centre, name="inner_water"))
        for index, centre in ((1.333, within), (2.5, across), (0.4, across))
    ]
    worst = 0.0
    for pair in bodies:
        for rule in ("nested", "facing", "priority"):
            built = build_geometry(pair, [NO_PARENT, 0], rule=rule)
            geometry = jax.tree.map(jnp.asarray, built)
            worst = max(worst, _unbalance(geometry, _inner_rays(0.9), TREE))
    del density
    return Found(worst, 9 * _RAYS)


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
        _unbalance(paths.build(body._replace(faces=mesh)), _inner_rays(), TREE) for mesh in meshes
    )
    return Found(worst, len(meshes) * _RAYS)


def index_matched(density: int) -> Found:
    """Distance of lines behind bodies of index 1 from the straight ones."""
    del density
    worst, rays = 0.0, _inner_rays(0.9)
    for body in (sphere(index=1.0), paths.torus(index=1.0), paths.slab(_CUBE, index=1.0)):
        traced = paths.trace(paths.build(body), rays, budget=TREE)
        ends = traced.ends
        there = ends.statuses != PathStatus.EMPTY
        assert np.sum(there) == _RAYS and np.all(ends.weights[there] == 1.0)
        start, along = (np.asarray(x, float)[ends.rays] for x in (rays.origins, rays.directions))
        turned = np.linalg.norm(ends.directions - along, axis=-1)
        apart = np.linalg.norm(np.cross(ends.origins - start, along), axis=-1)
        worst = max(worst, float(turned[there].max()), float(apart[there].max()))
    return Found(worst, 3 * _RAYS)


def reversibility(density: int) -> Found:
    """Directions after a path was traced back from where it escaped."""
    worst, cases = 0.0, 0
    for body, radius in ((sphere(), 0.5), (paths.slab(_CUBE), 0.5)):
        for seed in range(density):
            rays = paths.rays_at(paths.random_points(_RAYS, radius=radius, seed=seed))
            geometry = paths.build(body)
            ends = paths.main_ends(geometry, rays)
            escaped = ends.statuses == PathStatus.ESCAPED
            back = rays._replace(
                origins=jnp.asarray(ends.origins + 4.0 * ends.directions),
                directions=jnp.asarray(-ends.directions),
            )
            home = paths.main_ends(geometry, back)
            same = escaped & (home.bends == ends.bends)
            assert same[escaped].mean() > 0.99
            turned = home.directions + np.asarray(rays.directions)
            worst = max(worst, float(np.linalg.norm(turned, axis=-1)[same].max()))
            cases += int(same.sum())
    return Found(worst, cases)


def whispering_gallery(density: int) -> Found:
    """Light of rays caught in a ball by total reflection, which must end by their budget."""
    sine = np.linspace(0.75, 0.999, _RAYS)
    origins = np.stack([0.0 * sine, 0.0 * sine + 0.001, sine], axis=-1)
    rays = scenes.rays(origins, [1.0, 0.0, 0.0])
    worst, geometry = 0.0, paths.build(sphere())
    for bends in (24, 100)[: 1 + (density > 1)]:
        traced = paths.trace(geometry, rays, budget=Budget(bends, "all", cut=0.02))
        there = traced.ends.statuses != PathStatus.EMPTY
        assert np.all(traced.ends.statuses[there] == PathStatus.OUT_OF_BENDS)
        assert np.all(traced.ends.bends[there] == bends)
        worst = max(worst, float(np.abs(paths.energy(traced, _RAYS) - 1.0).max()))
    return Found(worst, _RAYS)


def in_double(density: int) -> Found:
    """Last directions behind a ball in double precision, of corners in single precision."""
    return balls(density, paths.trace_in_double)


def slabs_in_double(density: int) -> Found:
    """Last directions behind slabs in double precision."""
    return slabs(density, paths.trace_in_double, from_grazing=0.0, from_critical=0.0)


def no_nan_in_any_operation(density: int) -> Found:
    """Runs the meeting of ray and interface operation by operation under the check for NaN."""
    cases = stability_laws.rounded(stability_laws.lattice(density), np.float32)
    some = np.random.default_rng(0).choice(len(cases.near), 100 * density, replace=False)
    picked = type(cases)(*(x[some] for x in cases))
    with jax.debug_nans(True), jax.disable_jit():
        law = stability_laws.ours(picked)
    return Found(float(np.sum(~np.isfinite(law.reflectance.astype(float)))), len(some))
