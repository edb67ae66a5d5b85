"""Whole paths through bodies that overlap, are tinted and absorb, or hold the camera."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.data.mesh_queries import find_containment, parts_around
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.geometry.rays import Rays
from refref_jax.optics import media, path_tracing
from refref_jax.optics.differentiable_paths import follow_branch
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.media import AMBIENT, EMPTY_SLOT
from refref_jax.optics.path_settings import TREE, PathSettings
from tests.factories import scenes, solids
from tests.oracles import reference
from tests.oracles.reference import Sphere

# Planar bodies are exact: what is left is float32 rounding near coordinates of 4.
_PLANAR_TOLERANCE = 5e-6

# Rays restart off a surface by a share of its coordinates, which reach 20 here; four surfaces.
_SLAB_TOLERANCE = 2e-4

# An icosphere of 20,480 faces with interpolated normals against the true sphere.
_SPHERE_TOLERANCE = 4e-3

_REFRACTED = PathSettings(max_bends=16, reflections="none")

_RAYS = 64


@functools.partial(jax.jit, static_argnames=("settings", "capacity"))
def _trace_jitted(scene, rays, interior_list, *, settings, capacity):
    return path_tracing.trace(
        scene, rays, settings=settings, capacity=capacity, interior_list=interior_list
    )


def _trace(scene, rays, *, interior_list=None, settings=_REFRACTED):
    if interior_list is None:
        nowhere = media.empty_interior_list(scene.interfaces)
        interior_list = jnp.broadcast_to(nowhere, (len(rays.radii), nowhere.shape[0]))
    capacity = 8 * len(rays.radii)
    traced = _trace_jitted(scene, rays, interior_list, settings=settings, capacity=capacity)
    return jax.tree.map(np.asarray, traced)


def _paths(scene, rays, **options):
    """Returns the paths there are."""
    paths = _trace(scene, rays, **options).paths
    return jax.tree.map(lambda x: x[paths.statuses != PathStatus.EMPTY], paths)


def _ranked(part, priority, **values):
    return part._replace(priority=priority, **values)


def _bundle(count, seed=0, differential=0.5):
    """Rays from all around towards the neighbourhood of the origin."""
    generator = np.random.default_rng(seed)
    origins = generator.normal(size=(count, 3))
    origins *= 4.0 / np.linalg.norm(origins, axis=-1, keepdims=True)
    return origins, generator.uniform(-differential, differential, (count, 3)) - origins


def _last(paths):
    """Returns start and direction of the last segment of every path."""
    path = np.arange(len(paths.num_bends))
    return paths.points[path, paths.num_bends], paths.directions[path, paths.num_bends]


# Bodies inside one another: both rules say the same.


def _balls(priorities=(1, 2), **outer):
    """Glass around water; always as many triangles, so that tracing compiles once a rule."""
    glass = scenes.ball(1.0, subdivisions=5, name="outer_glass")
    water = scenes.ball(0.6, index=1.333, subdivisions=5, name="inner_water")
    return _ranked(glass, priorities[0], **outer), _ranked(water, priorities[1])


@pytest.mark.slow
def test_a_contained_body_of_higher_priority_is_the_nested_model():
    parts = _balls(tint=(0.9, 0.8, 0.7), absorption=(0.1, 0.2, 0.4))
    rays = scenes.rays(*_bundle(_RAYS))
    nested = _paths(scenes.build(*parts, rule="nested"), rays)
    ranked = _paths(scenes.build(*parts, rule="priority"), rays)
    assert set(np.unique(nested.media)) == {AMBIENT, 1, 2}
    for name in ("rays", "num_bends", "statuses", "media"):
        np.testing.assert_array_equal(getattr(ranked, name), getattr(nested, name))
    for name in ("points", "directions", "tau", "throughput"):
        np.testing.assert_allclose(getattr(ranked, name), getattr(nested, name), atol=1e-5)


@pytest.mark.slow
def test_a_contained_body_of_lower_priority_is_invisible():
    scene = scenes.build(*_balls((2, 1)), rule="priority")
    origins, directions = _bundle(_RAYS)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    paths = _paths(scene, scenes.rays(origins, directions))
    outranked = 0
    for i, end, onward in zip(paths.rays, *_last(paths), strict=True):
        bends = reference.trace_concentric_spheres(
            [Sphere(1.0, 1.5, 1.0)], origins[i], directions[i], 10
        )
        np.testing.assert_allclose(end, bends[-1].point, atol=_SPHERE_TOLERANCE)
        np.testing.assert_allclose(onward, bends[-1].direction, atol=_SPHERE_TOLERANCE)
        outranked += paths.num_bends[i] == len(bends) + 2
    assert outranked > _RAYS // 4


# Bodies that overlap: the highest priority fills the overlap.


def _slab(name, bottom, top, index):
    slab = scenes.box((40.0, 40.0, top - bottom), index=index, name=name)
    return slab._replace(vertices=slab.vertices + np.array([0.0, 0.0, 0.5 * (bottom + top)]))


def _slabs(*priorities, **colours):
    """Glass over z in [-1, 0], and water over [-0.1, 1]."""
    parts = [_slab("wall_glass", -1.0, 0.0, 1.5), _slab("drink_water", -0.1, 1.0, 1.333)]
    for number, priority in enumerate(priorities):
        added = {name: value[number] for name, value in colours.items()}
        parts[number] = _ranked(parts[number], priority, **added)
    return scenes.build(*parts, rule="priority")


@pytest.mark.parametrize("degrees", [0.0, 20.0, 50.0, 75.0])
@pytest.mark.parametrize(("priorities", "boundary"), [((3, 1), 0.0), ((1, 2), -0.1)])
@pytest.mark.parametrize("upwards", [True, False])
def test_one_surface_is_left_between_slabs_that_overlap(degrees, priorities, boundary, upwards):
    theta = np.radians(degrees)
    up = 1.0 if upwards else -1.0
    direction = np.array([np.sin(theta), 0.0, up * np.cos(theta)])
    rays = scenes.rays([0.0, 0.0, -2.0 * up], direction)
    paths = _paths(_slabs(*priorities), rays)
    assert paths.num_bends.tolist() == [4] and paths.statuses.tolist() == [PathStatus.ESCAPED]
    end, onward = _last(paths)
    in_glass, in_water = (np.tan(np.arcsin(np.sin(theta) / n)) for n in (1.5, 1.333))
    sideways = np.tan(theta) + in_glass * (1.0 + boundary) + in_water * (1.0 - boundary)
    # The near side of the slabs is one unit away.
    np.testing.assert_allclose(end[0], [sideways, 0.0, up], atol=_SLAB_TOLERANCE)
    np.testing.assert_allclose(onward[0], direction, atol=_PLANAR_TOLERANCE)
    media = [AMBIENT, 1, 1, 2, AMBIENT] if boundary == 0.0 else [AMBIENT, 1, 2, 2, AMBIENT]
    assert paths.media[0, :5].tolist() == (media if upwards else media[::-1])


def test_only_real_surfaces_tint_and_only_the_medium_that_is_there_absorbs():
    tint = [(0.9, 0.8, 1.0), (0.5, 0.6, 0.7)]
    absorption = [(0.0, 0.3, 1.0), (2.0, 0.1, 0.0)]
    scene = _slabs(3, 1, tint=tint, absorption=absorption)
    theta = np.radians(40.0)
    paths = _paths(scene, scenes.rays([0.0, 0.0, -2.0], [np.sin(theta), 0.0, np.cos(theta)]))
    glass, water = (1.0 / np.cos(np.arcsin(np.sin(theta) / n)) for n in (1.5, 1.333))
    surfaces = np.square(tint[0]) * tint[1]
    left = np.exp(-glass * np.array(absorption[0]) - water * np.array(absorption[1]))
    np.testing.assert_allclose(paths.throughput[0], surfaces * left, rtol=1e-5)


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.slow
def test_water_that_overlaps_the_wall_of_a_hollow_ball(swapped):
    """The wall keeps its shape: as water within a hole of glass."""
    outer, hole = scenes.ball(1.0, subdivisions=5), scenes.ball(0.6, subdivisions=5)
    wall = outer._replace(
        vertices=np.concatenate([outer.vertices, hole.vertices]),
        faces=np.concatenate([outer.faces, hole.faces[:, ::-1] + len(outer.vertices)]),
        priority=2,
    )
    water = _ranked(scenes.ball(0.75, index=1.333, subdivisions=4, name="drink_water"), 1)
    parts = (water, wall) if swapped else (wall, water)
    scene = scenes.build(*parts, rule="priority")
    origins = np.array([[-4.0, y, 0.1] for y in (0.1, 0.3, 0.5)])
    direction = np.array([1.0, 0.0, 0.0])
    paths = _paths(scene, scenes.rays(origins, direction))
    spheres = [Sphere(1.0, 1.5, 1.0), Sphere(0.6, 1.333, 1.5)]
    ends, onward = _last(paths)
    for i, origin in enumerate(origins):
        bends = reference.trace_concentric_spheres(spheres, origin, direction, 10)
        assert paths.num_bends[i] == len(bends) + 2
        np.testing.assert_allclose(ends[i], bends[-1].point, atol=_SPHERE_TOLERANCE)
        np.testing.assert_allclose(onward[i], bends[-1].direction, atol=_SPHERE_TOLERANCE)


# Any bodies, against a search for the medium at every point.


_CENTRES = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, -0.1], [-0.3, 0.5, 0.3]])
_RADII = np.array([1.0, 0.8, 0.7])
_INDICES = np.array([1.5, 1.333, 1.2])


def _index_at(point, priorities):
    """Returns the index of the highest ball around a point."""
    around = np.linalg.norm(point - _CENTRES, axis=-1) < _RADII
    if not around.any():
        return 1.0
    return _INDICES[np.argmax(np.where(around, priorities, -1))]


def _trace_balls(priorities, point, direction):
    """Follows a ray through overlapping balls without a list; returns the last segment.

    `None` where it comes too close to a tangent, to the critical angle or to where two spheres
    cut each other for an icosphere to agree with a sphere.
    """
    for _ in range(16):
        offset = point - _CENTRES
        b, c = offset @ direction, np.sum(offset**2, axis=-1) - _RADII**2
        root = np.sqrt(np.maximum(b * b - c, 0.0))
        distances = np.stack([-b - root, -b + root])
        distances[:, b * b <= c] = np.inf
        distances[distances < 1e-6] = np.inf
        if np.min(np.abs(b * b - c)) < 0.02:
            return None
        if not np.isfinite(distances).any():
            return point, direction
        ball = int(np.argmin(distances) % len(_RADII))
        point = point + distances.min() * direction
        normal = (point - _CENTRES[ball]) / _RADII[ball]
        apart = np.abs(np.linalg.norm(point - _CENTRES, axis=-1) - _RADII)
        if np.any(np.delete(apart, ball) < 0.02):
            return None
        normal = -np.sign(normal @ direction) * normal
        near, far = (_index_at(point + side * 1e-6 * normal, priorities) for side in (1, -1))
        sine = near / far * np.sqrt(1.0 - (normal @ direction) ** 2)
        if abs(sine - 1.0) < 0.05:
            return None
        refracted = reference.refract_by_angles(direction, normal, near, far)
        mirrored = direction - 2.0 * (direction @ normal) * normal
        direction = mirrored if refracted is None else refracted
    return None


@pytest.mark.parametrize("priorities", [(3, 2, 1), (1, 2, 3), (2, 3, 1)])
@pytest.mark.slow
def test_three_balls_that_overlap(priorities):
    balls = [
        _ranked(
            scenes.ball(radius, index=index, centre=centre, subdivisions=5, name=f"ball{i}"),
            priorities[i],
        )
        for i, (radius, index, centre) in enumerate(zip(_RADII, _INDICES, _CENTRES, strict=True))
    ]
    origins, directions = _bundle(60, seed=1)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    paths = _paths(scenes.build(*balls, rule="priority"), scenes.rays(origins, directions))
    ends, onward = _last(paths)
    compared = 0
    for i in np.flatnonzero(paths.statuses == PathStatus.ESCAPED):
        expected = _trace_balls(priorities, origins[i], directions[i])
        if expected is not None:
            np.testing.assert_allclose(ends[i], expected[0], atol=0.02)
            np.testing.assert_allclose(onward[i], expected[1], atol=0.02)
            compared += 1
    assert compared > 15


# Light is neither made nor lost.


@pytest.mark.parametrize("priorities", [(3, 1), (1, 2)])
@pytest.mark.slow
def test_the_light_of_a_ray_is_shared_among_its_paths(priorities):
    glass = _ranked(scenes.box((1.0, 1.2, 0.8), index=1.5), priorities[0])
    water = _ranked(scenes.ball(0.6, index=1.333, centre=(0.4, 0.0, 0.2)), priorities[1])
    traced = _trace(
        scenes.build(glass, water, rule="priority"), scenes.rays(*_bundle(200)), settings=TREE
    )
    sums = np.zeros((200, 3))
    np.add.at(sums, traced.paths.rays, traced.paths.throughput)
    np.testing.assert_allclose(sums + traced.dropped, 1.0, atol=1e-5)


# A camera inside.


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["nested", "priority"])
@pytest.mark.parametrize(
    ("start", "slots"),
    [
        ((0.1, 0.2, -0.1), {0, 1}),
        ((0.1, -0.8, 0.1), {0}),
        ((2.0, 0, 0), set()),
    ],
)
def test_a_camera_inside_of_balls(rule, start, slots):
    parts = _balls()
    directions = np.random.default_rng(2).normal(size=(_RAYS, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = np.broadcast_to(np.array(start, np.float64), directions.shape)
    around = parts_around(parts, origins)
    assert set(around[0]) - {EMPTY_SLOT} == slots
    inside = jnp.asarray(around) if rule == "priority" else None
    scene = scenes.build(*parts, rule=rule)
    paths = _paths(scene, scenes.rays(origins, directions), interior_list=inside)
    spheres = [Sphere(1.0, 1.5, 1.0), Sphere(0.6, 1.333, 1.5)]
    compared = 0
    for i, end, onward in zip(paths.rays, *_last(paths), strict=True):
        bends = reference.trace_concentric_spheres(spheres, origins[i], directions[i], 10)
        if bends and len(bends) < 8 and paths.num_bends[i] == len(bends):
            np.testing.assert_allclose(end, bends[-1].point, atol=0.02)
            np.testing.assert_allclose(onward, bends[-1].direction, atol=0.02)
            compared += 1
    assert compared > (20 if slots else 0)


@pytest.mark.parametrize("degrees", [0.0, 30.0])
def test_a_camera_in_a_drink_sees_its_wall(degrees):
    """The drink has the lower priority and overlaps the wall."""
    glass, water = _slab("wall_glass", -1.0, 0.0, 1.5), _slab("drink_water", -0.1, 2.9, 1.333)
    parts = [_ranked(glass, 3), _ranked(water, 1)]
    origin = np.array([[0.0, 0.0, 1.0]])
    inside = jnp.asarray(parts_around(parts, origin))
    sine = np.sin(np.radians(degrees))
    rays = scenes.rays(origin, [sine, 0.0, -np.sqrt(1.0 - sine**2)])
    paths = _paths(scenes.build(*parts, rule="priority"), rays, interior_list=inside)
    assert paths.media[0, :4].tolist() == [2, 1, 1, AMBIENT]
    np.testing.assert_allclose(_last(paths)[1][0, 0], 1.333 * sine, atol=_PLANAR_TOLERANCE)


# The rule `facing`: faces bend light, the interior list says in which medium it is.


def _overlapping_cup():
    """A hollow ball of glass, and a ball of water that reaches into its wall."""
    cup = solids.shell("cup_glass", outer=1.0, inner=0.7)
    return [cup, solids.ball("drink_water", radius=0.8, index=1.333)]


@pytest.mark.slow
def test_facing_media_of_an_overlapping_cup():
    paths = _paths(
        scenes.build(*_overlapping_cup(), rule="facing"),
        scenes.rays([[-3.0, 0.01, 0.02]], [[1.0, 0.0, 0.0]]),
    )
    glass, water = 1, 2
    seen = paths.media[0, : paths.num_bends[0] + 1].tolist()
    assert [seen[i] for i in (0, 1, 3, 5, 6)] == [AMBIENT, glass, water, glass, AMBIENT]
    assert seen[2] in (glass, water) and seen[4] in (glass, water) and len(seen) == 7


@pytest.mark.slow
def test_facing_media_are_those_around_each_segment():
    parts = _overlapping_cup()
    paths = _paths(scenes.build(*parts, rule="facing"), scenes.rays(*_bundle(_RAYS)))
    compared = 0
    for path in range(len(paths.rays)):
        ends = paths.points[path, : paths.num_bends[path] + 1]
        middles = 0.5 * (ends[1:] + ends[:-1])
        long = np.linalg.norm(ends[1:] - ends[:-1], axis=-1) > 1e-2
        media_of = paths.media[path, : len(middles)]
        for medium, around in zip(media_of[long], parts_around(parts, middles)[long], strict=True):
            held = set(around[around != EMPTY_SLOT] + 1)
            assert (medium in held) if held else medium == AMBIENT
            compared += len(held) == 2
    assert compared > _RAYS // 4


@pytest.mark.slow
def test_facing_bends_light_by_faces_whatever_the_media():
    parts = _overlapping_cup()
    tracked = scenes.build(*parts, rule="facing")
    tree = find_containment(parts)
    untracked = assemble_scene(parts, tree.parents, rule="facing")
    rays = scenes.rays(*_bundle(_RAYS))
    found, expected = _paths(tracked, rays), _paths(untracked, rays)
    assert media.interior_length(untracked.interfaces) == 0
    assert media.interior_length(tracked.interfaces) == media.SLOTS
    for name in ("points", "directions", "tau", "throughput", "num_bends", "statuses"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert np.any(found.media != expected.media)


@pytest.mark.slow
def test_facing_with_overlaps_has_the_same_media_in_the_differentiable_tracer():
    scene = scenes.build(*_overlapping_cup(), rule="facing")
    ray = Rays(jnp.array([-3.0, 0.1, 0.2]), jnp.array([1.0, 0.0, 0.0]), jnp.float32(1e-3))
    straight_on = jnp.zeros(_REFRACTED.max_bends, bool)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def last_direction(indices):
        changed = scene._replace(interfaces=scene.interfaces._replace(index_inside=indices))
        path = follow_branch(changed, ray, straight_on, settings=_REFRACTED)
        return path.directions[path.num_bends, 1], path

    indices = scene.interfaces.index_inside
    (_, single), slopes = last_direction(indices)
    paths = _paths(scene, scenes.rays([[-3.0, 0.1, 0.2]], [[1.0, 0.0, 0.0]]))
    segments = int(single.num_bends) + 1
    assert segments > 5
    np.testing.assert_array_equal(single.media[:segments], paths.media[0, :segments])
    np.testing.assert_allclose(single.tau[:segments], paths.tau[0, :segments], rtol=1e-5)

    assert np.all(np.isfinite(slopes)) and np.all(np.asarray(slopes) != 0.0)
    for part, step in enumerate(1e-3 * np.eye(2, dtype=np.float32)):
        there, here = (last_direction(indices + change)[0] for change in (step, -step))
        assert there[1].num_bends == here[1].num_bends == single.num_bends
        change = there[0] - here[0]
        assert slopes[part] == pytest.approx(float(change) / 2e-3, rel=0.02, abs=1e-3)
