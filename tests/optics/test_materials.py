"""Paths at opaque parts, conductors, thin sheets, rough surfaces and with dispersion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import refref_jax
from refref_jax.choices import Material
from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.scene_analysis import analyse
from refref_jax.optics import fresnel
from refref_jax.optics.light_paths import PathStatus, ends_of, exists
from refref_jax.optics.media import empty_interior_list, interior_length, of_channel
from refref_jax.optics.path_settings import PATH_PRESETS, TREE
from refref_jax.optics.path_tracing import survey, trace, trace_ends
from refref_jax.render import shade
from tests.factories import scenes
from tests.factories.small_model import CAMERAS

pytestmark = pytest.mark.longest

_OPAQUE = Material("opaque", radiance=(0.8, 0.2, 0.1))
_GOLD = ((0.18, 0.42, 1.37), (3.42, 2.35, 1.77))
_BALL = scenes.ball(1.0, subdivisions=3)


def _inner(material, radius=0.5, index=1.0):
    part = scenes.ball(radius, subdivisions=2, name="inner")
    colour = material.radiance
    light = None if colour is None else np.broadcast_to(colour, (len(part.faces), 3, 3))
    return part._replace(index=index, material=material, radiance=light)


def _sheet(index=1.5, at=0.0, material=None):
    square = np.array([[at, -1.0, -1.0], [at, 1.0, -1.0], [at, 1.0, 1.0], [at, -1.0, 1.0]])
    mesh = refref_jax.make_part(
        (square, np.array([[0, 1, 2], [0, 2, 3]])), index=index, name="sheet", shading="flat"
    )
    return mesh._replace(material=material or Material("thin_sheet"))


def _rays(*heights, towards=(1.0, 0.0, 0.0)):
    origins = jnp.array([[-3.0, height, 0.01] for height in heights], jnp.float32)
    directions = jnp.broadcast_to(jnp.array(towards, jnp.float32), origins.shape)
    return refref_jax.Rays(origins, directions, jnp.full(len(heights), 1e-3))


_trace = jax.jit(trace, static_argnames="settings")
_branch = jax.jit(functools.partial(refref_jax.follow_branch, settings=TREE))


def _paths(scene, rays, settings=TREE):
    return _trace(scene, rays, settings=settings).paths


def _moved(part, *offset):
    return part._replace(vertices=part.vertices + np.array(offset))


def _main(paths, ray=0):
    """Returns the heaviest path of a ray."""
    mine = np.flatnonzero((np.asarray(paths.rays) == ray) & np.asarray(exists(paths)))
    heaviest = mine[np.argmax(np.max(np.asarray(paths.throughput), axis=1)[mine])]
    return jax.tree.map(lambda x: np.asarray(x)[heaviest], paths)


_KINDS = [_OPAQUE, Material("conductor", complex_index=_GOLD), Material("thin_sheet")]


def _with_every_kind(material, glass=_BALL, rule="nested"):
    """Returns a part inside glass, and the other kinds far away: one program for all of them."""
    others = [_moved(_inner(each), 0.0, 20.0 * (k + 1), 0.0) for k, each in enumerate(_KINDS)]
    others = [part for part in others if part.material.kind != material.kind]
    return scenes.build(glass, _inner(material, index=1.33), *others, rule=rule)


@pytest.mark.parametrize(
    "rule", ["nested", "facing", pytest.param("priority", marks=pytest.mark.slow)]
)
def test_light_ends_on_an_opaque_part_inside_glass(rule):
    path = _main(_paths(_with_every_kind(_OPAQUE, rule=rule), _rays(0.02)))
    assert path.statuses == PathStatus.OPAQUE and path.num_bends == 1
    np.testing.assert_allclose(path.stop.tau, 2.5, atol=5e-3)
    np.testing.assert_allclose(path.stop.radiance, _OPAQUE.radiance, rtol=1e-6)
    np.testing.assert_allclose(path.throughput, 0.96, atol=1e-3)
    assert path.media[:2].tolist() == [0, 1] and np.isinf(path.ends[1])


def test_the_medium_in_front_of_an_opaque_part_absorbs():
    glass = _BALL._replace(absorption=(0.5, 1.0, 2.0))
    path = _main(_paths(_with_every_kind(_OPAQUE, glass), _rays(0.02)))
    expected = 0.96 * np.exp(-np.array([0.5, 1.0, 2.0]) * 0.5)
    np.testing.assert_allclose(path.throughput, expected, rtol=6e-3)


@pytest.mark.slow
def test_opaque_parts_may_be_half_in_a_liquid():
    reed = _moved(_inner(_OPAQUE, radius=0.3), 0.0, 1.0, 0.0)  # at the wall
    scene = scenes.build(_BALL._replace(index=1.001), reed)
    outside, inside = (_main(_paths(scene, _rays(height))) for height in (1.15, 0.75))
    assert outside.statuses == inside.statuses == PathStatus.OPAQUE
    assert (outside.num_bends, inside.num_bends) == (0, 1)
    assert outside.media[0] == 0 and inside.media[1] == 1


@pytest.mark.slow
def test_unknown_radiance_is_left_to_the_field_and_refused_elsewhere():
    scene = _with_every_kind(Material("opaque"))
    ends = ends_of(_paths(scene, _rays(0.02)))
    assert ends.stop.radiance is None and np.isfinite(ends.stop.tau[0])
    with pytest.raises(ValueError, match="radiance is unknown"):
        shade(ends, lambda origin, direction: direction, rays=1)


@pytest.mark.slow
def test_the_colour_of_an_opaque_part_is_interpolated_between_corners():
    part = _sheet(material=Material("opaque", radiance="vertex_colours"))
    corners = np.repeat(part.vertices[part.faces][..., 1:2] * 0.5 + 0.5, 3, axis=2)
    scene = scenes.build(part._replace(radiance=corners))
    heights = np.linspace(-0.9, 0.9, 7)

    @jax.jit
    def see(scene, rays):
        ends = trace_ends(scene, rays, settings=TREE).ends
        return shade(ends, lambda origin, direction: 0.0 * direction, rays=7)

    seen = see(scene, _rays(*heights))
    np.testing.assert_allclose(seen[:, 0], heights * 0.5 + 0.5, atol=1e-5)


def _sheets(material, glass):
    """Returns a sheet with glass, and one of the other kind far away: one program for both."""
    kinds = Material("thin_sheet"), Material("conductor", complex_index=_GOLD)
    (other,) = (each for each in kinds if each.kind != material.kind)
    return scenes.build(glass, _sheet(material=material), _moved(_sheet(material=other), 0, 40, 0))


@pytest.mark.parametrize("around", [1.0, 1.5])
def test_a_conductor_reflects_by_its_index_relative_to_the_medium(around):
    metal = Material("conductor", complex_index=_GOLD)
    glass = scenes.box((3.0, 3.0, 3.0), index=around)
    glass = _moved(glass, 0.0, 20.0, 0.0) if around == 1.0 else glass
    path = _main(_paths(_sheets(metal, glass), _rays(0.2)))
    eta, k = (np.array(value) / around for value in _GOLD)
    expected = ((eta - 1.0) ** 2 + k**2) / ((eta + 1.0) ** 2 + k**2)
    entered = 1.0 if around == 1.0 else (4.0 * around / (1.0 + around) ** 2) ** 2
    np.testing.assert_allclose(path.throughput, entered * expected, rtol=1e-4)
    np.testing.assert_allclose(path.directions[path.num_bends], [-1.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_thin_sheet_reflects_twice_from_either_side_and_does_not_bend_light(sign):
    away = _moved(scenes.box((3.0, 3.0, 3.0)), 0.0, 20.0, 0.0)
    scene = _sheets(Material("thin_sheet"), away)
    towards = np.array([0.8, 0.6, 0.0])
    rays = scenes.rays([-sign * towards * 2.0], sign * towards)
    paths = _paths(scene, rays)
    path = _main(paths)
    once = float(jax.jit(fresnel.reflectance)(*np.float32([0.8, 1.0, 1.5])))
    np.testing.assert_allclose(path.throughput, 1.0 - 2.0 * once / (1.0 + once), rtol=1e-5)
    np.testing.assert_array_equal(path.directions[1], path.directions[0])
    assert path.media[:2].tolist() == [0, 0]
    np.testing.assert_allclose(np.sum(np.asarray(paths.throughput)[:, 0]), 1.0, rtol=1e-5)


@pytest.mark.slow
def test_two_sheets_equal_the_slab_that_they_stand_for():
    # A slab of glass far thinner than a pixel: all its reflections, summed.
    slab, sheet = scenes.box((1e-3, 4.0, 4.0)), _moved(_sheet(), 0.0, 20.0, 0.0)
    towards = np.array([np.cos(0.7), np.sin(0.7), 0.0])
    rays = scenes.rays(np.array([[0.0, 0.0, 0.0], [0.0, 20.0, 0.0]]) - towards, towards)
    every = refref_jax.PathSettings(max_bends=12, reflections="all", min_throughput=1e-6)
    paths = _paths(scenes.build(slab, sheet), rays, settings=every)
    real = np.asarray(exists(paths))
    paths = jax.tree.map(np.asarray, paths)
    last = np.sum(np.isfinite(paths.tau), axis=1) - 1
    back = (paths.directions[np.arange(last.size), last, 0] < 0.0) & real
    shares = [np.sum(paths.throughput[back & (paths.rays == ray), 0]) for ray in (0, 1)]
    assert np.count_nonzero(back & (paths.rays == 0)) > np.count_nonzero(back & (paths.rays == 1))
    np.testing.assert_allclose(shares[0], shares[1], rtol=1e-4)


@pytest.mark.slow
def test_dispersion_is_three_scenes_of_one_colour_each():
    indices = (1.4, 1.5, 1.7)
    glass = _BALL._replace(material=Material(dispersion=indices))
    rays = _rays(*np.linspace(-0.9, 0.9, 9))

    @jax.jit
    def colour(paths):
        return shade(ends_of(paths), lambda origin, direction: 0.5 + 0.5 * direction, rays=9)

    found = colour(_paths(scenes.build(glass), rays))
    for channel, index in enumerate(indices):
        alone = colour(_paths(scenes.build(_BALL._replace(index=index)), rays))
        np.testing.assert_allclose(found[:, channel], alone[:, channel], atol=2e-6)


@pytest.mark.slow
def test_dispersed_paths_belong_to_their_rays_and_share_their_light():
    glass = _BALL._replace(material=Material(dispersion=(1.4, 1.5, 1.6)))
    rays = _rays(0.1, 0.5, 2.0, *np.linspace(-0.9, 0.8, 6))
    traced = _trace(scenes.build(glass), rays, settings=TREE)
    sums = np.array(traced.dropped)
    np.add.at(sums, np.asarray(traced.paths.rays), traced.paths.throughput)
    np.testing.assert_allclose(sums, 1.0, rtol=1e-5)
    real = np.asarray(traced.paths.throughput)[np.asarray(exists(traced.paths))]
    assert np.all(np.sum(real > 0.0, axis=1) == 1)


@pytest.mark.slow
def test_one_colour_of_a_dispersive_scene_has_gradients_and_all_three_are_refused():
    scene = scenes.build(_BALL._replace(material=Material(dispersion=(1.4, 1.5, 1.6))))
    ray = jax.tree.map(lambda x: x[0], _rays(0.3))
    with pytest.raises(ValueError, match="dispersion"):
        refref_jax.follow_branch(scene, ray, jnp.zeros(24, bool), settings=TREE)
    with pytest.raises(ValueError, match="dispersion"):
        refref_jax.with_index(scene, 1.5)
    red, plain = of_channel(scene, 0), scenes.build(_BALL._replace(index=1.4))
    one, other = (_branch(each, ray, np.zeros(24, bool)) for each in (red, plain))
    np.testing.assert_allclose(one.points, other.points, atol=1e-6)


@pytest.mark.slow
def test_dispersion_reaches_the_medium_inside_another_one():
    water = scenes.ball(0.5, subdivisions=2, name="water")._replace(index=1.33)
    glass = _BALL._replace(material=Material(dispersion=(1.4, 1.5, 1.6)))
    pairs = scenes.build(glass, water).interfaces.index_by_channel
    np.testing.assert_allclose(pairs[:, 0], [[1.4, 1.33], [1.5, 1.33], [1.6, 1.33]], rtol=1e-6)
    np.testing.assert_allclose(pairs[:, 1], [[1.0, 1.4], [1.0, 1.5], [1.0, 1.6]], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_a_rough_surface_adds_no_light_and_scatters_around_the_mirror(roughness):
    scene = scenes.build(
        scenes.box((1.0, 9.0, 9.0))._replace(material=Material(roughness=roughness))
    )
    heights = np.random.default_rng(0).uniform(-1.0, 1.0, 4000)
    one = refref_jax.PathSettings(max_bends=1, reflections="all")
    paths = _paths(scene, _rays(*heights), settings=one)
    sums = np.zeros(4000, np.float32)
    np.add.at(sums, np.asarray(paths.rays), np.asarray(paths.throughput)[:, 0])
    assert np.all(sums <= 1.0 + 1e-5) and np.mean(sums) > (0.99 if roughness < 0.2 else 0.8)
    sideways = np.asarray(paths.directions)[:, 1, 1:][np.asarray(exists(paths))]
    spread = np.sqrt(np.mean(np.sum(sideways**2, axis=1)))
    assert abs(np.mean(sideways)) < 0.05 and 0.1 < spread / roughness**2 < 6.0


@pytest.mark.parametrize(
    "number", [pytest.param(number, marks=pytest.mark.slow) for number in (4, 64)]
)
def test_the_footprint_behind_a_rough_surface_reaches_the_next_facet(number):
    rough = Material("conductor", roughness=0.3, complex_index=_GOLD)
    rays = _rays(0.0)._replace(strata=jnp.array([[0, 0, number]], jnp.int32))
    one = refref_jax.PathSettings(max_bends=1, reflections="all")

    @jax.jit
    def reflected(scene, rays):
        return trace_ends(scene, rays, settings=one, footprint="differential").ends

    def edges(material, rays):
        ends = reflected(scenes.build(_sheet()._replace(material=material)), rays)
        return np.linalg.norm(ends.differentials.directions[0], axis=-1)

    # A mirror turns a reflected ray by twice its own angle, here across and along its tilt.
    alpha = 0.3**2
    expected = 2.0 * np.sqrt(np.pi / 3.0) * alpha / np.sqrt(number)
    np.testing.assert_allclose(edges(rough, rays), expected, rtol=0.2)
    for material, some in [
        (Material("conductor", complex_index=_GOLD), rays),
        (rough, rays._replace(strata=None)),
        (rough, rays._replace(strata=jnp.array([[0, 0, 1]], jnp.int32))),
    ]:
        np.testing.assert_allclose(edges(material, some), 1e-3, rtol=0.2)


def _of_a_pixel(*heights):
    """Returns rays that share the strata of one pixel."""
    count = len(heights)
    strata = np.stack([np.full(count, 7), np.arange(count), np.full(count, count)], axis=-1)
    return _rays(*heights)._replace(strata=jnp.asarray(strata, jnp.int32))


def _assert_same_paths(one, other):
    ones, others = np.asarray(exists(one)), np.asarray(exists(other))
    np.testing.assert_array_equal(ones.sum(), others.sum())
    for field in ("points", "throughput", "num_bends", "rays"):
        first, second = np.asarray(getattr(one, field))[ones], np.asarray(getattr(other, field))
        np.testing.assert_allclose(first, second[others], atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_each_channel_of_a_rough_prism_meets_the_facets_of_its_stratum(channel):
    indices = (1.4, 1.5, 1.6)
    both = scenes.build(_BALL._replace(material=Material(dispersion=indices, roughness=0.2)))
    one = scenes.build(_BALL._replace(index=indices[channel], material=Material(roughness=0.2)))
    rays = _of_a_pixel(-0.3, -0.1, 0.2, 0.4)
    _assert_same_paths(_paths(of_channel(both, channel), rays), _paths(one, rays))


@pytest.mark.slow
def test_interior_lists_leave_the_facets_of_a_stratum_as_they_are():
    rough = Material(roughness=0.2)
    outer = _BALL._replace(material=rough)
    inner = _inner(rough, index=1.33)._replace(priority=1)
    rays = _of_a_pixel(-0.3, -0.1, 0.2, 0.4)
    listed, nested = (scenes.build(outer, inner, rule=rule) for rule in ("priority", "nested"))
    _assert_same_paths(_paths(listed, rays), _paths(nested, rays))


@pytest.mark.slow
def test_entry_and_exit_of_a_rough_body_widen_the_footprint_independently():
    heights, rough = np.linspace(-1.0, 1.0, 200), Material(roughness=0.1)
    pixel = np.stack([np.arange(200), np.zeros(200), np.full(200, 64)], axis=-1)
    rays = _rays(*heights)._replace(strata=jnp.asarray(pixel, jnp.int32))
    rays = rays._replace(radii=jnp.full(200, 1e-6))
    two = refref_jax.PathSettings(max_bends=2, reflections="none")
    slab = scenes.build(scenes.box((1.0, 9.0, 9.0))._replace(material=rough))
    through = jax.jit(functools.partial(trace_ends, settings=two, footprint="differential"))
    ends = through(slab, rays).ends
    axes = np.linalg.norm(ends.differentials.directions, axis=-1)[np.asarray(exists(ends))]
    # One surface of index 1.5 turns light by half of its tilt.
    alone = 0.5 * np.sqrt(np.pi / 3.0) * 0.1**2 / 8.0
    np.testing.assert_allclose(np.median(axes), np.sqrt(2.0) * alone, rtol=0.2)


@pytest.mark.parametrize("material", _KINDS, ids=lambda material: material.kind)
def test_both_tracers_agree_on_every_kind(material):
    scene = _with_every_kind(material)
    ray = jax.tree.map(lambda x: x[0], _rays(0.12))
    path = _branch(scene, ray, np.zeros(24, bool))
    paths = _paths(scene, _rays(0.12))
    match = np.argmin(
        np.abs(np.asarray(paths.throughput) - np.asarray(path.throughput)).sum(axis=1)
    )
    assert paths.statuses[match] == path.statuses and paths.num_bends[match] == path.num_bends
    used = int(path.num_bends) + 1
    np.testing.assert_allclose(paths.points[match, :used], path.points[:used], atol=1e-4)
    if material.kind == "opaque":
        np.testing.assert_allclose(paths.stop.tau[match], path.stop.tau, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["nested", "facing"])
def test_metal_in_a_liquid_keeps_light_in_the_liquid(rule):
    metal = _inner(Material("conductor", complex_index=_GOLD), radius=0.2)
    water = scenes.ball(0.6, subdivisions=2, name="water")._replace(index=1.33)
    path = _main(_paths(scenes.build(_BALL, water, metal, rule=rule), _rays(0.01)))
    assert path.media[: path.num_bends + 1].tolist() == [0, 1, 2, 2, 1, 0]


@pytest.mark.slow
def test_gradients_of_the_complex_index_and_roughness_are_finite():
    scene = scenes.build(
        _BALL._replace(material=Material(roughness=0.3)),
        _inner(Material("conductor", complex_index=_GOLD)),
    )
    ray = jax.tree.map(lambda x: x[0], _rays(0.1))

    @jax.jit
    @jax.grad
    def slopes_of_light(some):
        changed = scene._replace(interfaces=scene.interfaces._replace(**some))
        path = refref_jax.follow_branch(changed, ray, jnp.zeros(24, bool), settings=TREE)
        return jnp.sum(path.throughput)

    names = ("complex_index", "alpha", "index_inside")
    slopes = slopes_of_light({name: getattr(scene.interfaces, name) for name in names})
    assert all(np.all(np.isfinite(slope)) for slope in slopes.values())
    assert np.any(slopes["complex_index"][1] != 0.0)


def test_meshes_of_surfaces_without_inside_may_be_open():
    icosphere = trimesh.creation.icosphere(subdivisions=1)
    half = (icosphere.vertices, icosphere.faces[icosphere.triangles_center[:, 2] > 0])
    for material in (Material("opaque"), Material("thin_sheet")):
        part = refref_jax.make_part(half, index=1.5, name="cap", material=material)
        assert refref_jax.assemble([part]).interfaces.kinds.size == 1


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["nested", "facing", "priority"])
def test_dispersed_rays_may_start_inside_parts(rule):
    glass = _BALL._replace(material=Material(dispersion=(1.4, 1.5, 1.6)))
    scene = scenes.build(glass, rule=rule)
    lists = jnp.broadcast_to(
        empty_interior_list(scene.interfaces), (2, interior_length(scene.interfaces))
    )
    rays = _rays(0.1, 0.2)
    given = _trace(scene, rays, settings=TREE, interior_list=lists).paths
    np.testing.assert_array_equal(given.throughput, _paths(scene, rays).throughput)


@pytest.mark.slow
def test_the_share_of_rays_that_hit_counts_rays_not_colours():
    glass = _BALL._replace(material=Material(dispersion=(1.4, 1.5, 1.6)))
    rays = _rays(0.1, 2.0, 3.0, 4.0)
    surveyed = jax.jit(functools.partial(survey, settings=TREE))
    assert float(surveyed(scenes.build(glass), rays).hit_fraction) == 0.25
    assert float(surveyed(scenes.build(_BALL), rays).hit_fraction) == 0.25


@pytest.mark.slow
def test_a_mirror_is_followed_where_total_internal_reflections_are_not():
    metal = _sheet(material=Material("conductor", complex_index=_GOLD))
    path = _main(_paths(scenes.build(metal), _rays(0.2), settings=PATH_PRESETS["paper_no_tir"]))
    assert path.num_bends == 1 and path.statuses == PathStatus.ESCAPED


@pytest.mark.slow
def test_light_inside_a_closed_sheet_meets_its_far_wall():
    bubble = _BALL._replace(material=Material("thin_sheet"), colour_known=True)
    tree = find_containment([bubble])
    found = analyse([bubble], tree, CAMERAS, rule="nested", space="bounded")
    assert found.reentry == "possible"
    assert _main(_paths(scenes.build(bubble), _rays(0.1))).num_bends == 2


@pytest.mark.parametrize(
    "material",
    [
        Material("glass"),
        Material("conductor"),
        Material("conductor", complex_index=5.0),
        Material("conductor", complex_index=(1e10, 1.0)),
        Material(roughness=2.0),
        Material(roughness=float("nan")),
        Material(dispersion=(1.5, 1.5)),
        Material("opaque", radiance=(1.0, float("inf"), 1.0)),
        Material("opaque", radiance="vertex_colours"),
        Material("opaque", roughness=0.1),
    ],
    ids=str,
)
def test_a_wrong_material_is_refused_in_one_line(material):
    with pytest.raises(refref_jax.SceneError) as error:
        refref_jax.make_part(trimesh.creation.box(), index=1.5, material=material)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


def test_numbers_and_arrays_of_materials_are_taken_as_in_a_file():
    numbers = Material("conductor", complex_index=(0.2, np.array([3.0, 3.1, 3.2])))
    part = refref_jax.make_part(trimesh.creation.box(), index=1.0, material=numbers)
    assert part.material.complex_index == ((0.2, 0.2, 0.2), (3.0, 3.1, 3.2))
    equal = Material(dispersion=(1.5, 1.5, 1.5))
    part = refref_jax.make_part(trimesh.creation.box(), index=1.5, material=equal)
    assert part.material == Material()
