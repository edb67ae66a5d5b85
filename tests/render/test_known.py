import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

import refref_jax
from benchmarks.oracles import colours
from refref_jax.data.mesh_queries import parts_around
from refref_jax.geometry import cameras
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.path_settings import PAPER, STRAIGHT, TREE
from refref_jax.render import (
    background_rendering,
    images,
    radiance_of,
    render_known,
    render_known_camera,
)
from refref_jax.render.backgrounds import (
    CubeBackground,
    Environment,
    LinearTexture,
    SphereBackground,
)
from tests.factories import scenes

pytestmark = pytest.mark.longest

_BALL = scenes.ball(1.3, subdivisions=2)


def _environment(seed=0):
    return _environment_of(np.random.default_rng(seed).uniform(size=(8, 16, 3)))


def _environment_of(texels):
    return radiance_of(Environment(LinearTexture(jnp.asarray(texels, jnp.float32))))


# As an environment it needs no compiling of its own.
_WHITE = _environment_of(np.ones((8, 16, 3)))


@pytest.fixture(scope="module")
def scene():
    return scenes.build(_BALL)


@pytest.fixture(scope="module")
def whole(scene, rays):
    return render_known(scene, _environment(), rays, settings=TREE, tile=256)


def test_straight_rays_see_the_background_itself(scene, rays):
    radiance = _environment()
    seen = render_known(scene, radiance, rays, settings=STRAIGHT, tile=100)
    flat = (jnp.asarray(x.reshape(-1, 3)) for x in rays[:2])
    expected = jax.jit(jax.vmap(radiance))(*flat).reshape(seen.linear.shape)
    np.testing.assert_allclose(seen.linear, expected, rtol=1e-5)
    assert seen.casts == 0 and np.all(seen.paths == 1) and np.all(seen.dropped == 0.0)


def test_an_image_has_the_shape_of_its_rays(whole):
    assert whole.rgb.shape == whole.linear.shape == whole.dropped.shape == (16, 16, 3)
    assert whole.paths.shape == (16, 16)
    srgb = np.clip(colours.linear_to_srgb(whole.linear), 0.0, 1.0)
    np.testing.assert_allclose(whole.rgb, srgb, atol=1e-6)
    # The corners miss the ball; its middle is seen along several paths.
    assert whole.paths[0, 0] == 1 and whole.paths[8, 8] > 1


@pytest.mark.parametrize(
    "settings",
    [STRAIGHT, PAPER, TREE],
    ids=["straight", "paper", "tree"],
)
@pytest.mark.slow
def test_the_size_of_a_tile_does_not_matter(scene, rays, settings):
    one = render_known(scene, _environment(), rays, settings=settings, tile=256)
    pieces = render_known(scene, _environment(), rays, settings=settings, tile=100)
    np.testing.assert_allclose(pieces.linear, one.linear, atol=1e-5)
    np.testing.assert_array_equal(pieces.paths, one.paths)
    assert pieces.casts == one.casts


@pytest.mark.parametrize(
    "settings", [pytest.param(PAPER, marks=pytest.mark.slow), TREE], ids=["paper", "tree"]
)
def test_clear_glass_before_white_is_white(scene, rays, settings):
    seen = render_known(scene, _WHITE, rays, settings=settings, tile=256)
    np.testing.assert_allclose(seen.linear + seen.dropped, 1.0, atol=1e-5)


@pytest.mark.slow
def test_lost_light_is_told(scene, rays):
    tight = dataclasses.replace(TREE, min_throughput=0.0, max_bends=6, paths_per_ray=1.0)
    seen = render_known(scene, _WHITE, rays, settings=tight, tile=256)
    assert np.max(seen.dropped) > 0.0
    np.testing.assert_allclose(seen.linear + seen.dropped, 1.0, atol=1e-5)


def test_a_function_of_the_user_s_sees_origins_and_directions(scene, rays):
    seen = render_known(scene, lambda o, d: o / 10.0 + d + 2.0, rays, settings=STRAIGHT, tile=256)
    np.testing.assert_allclose(seen.linear, rays.origins / 10.0 + rays.directions + 2.0, rtol=1e-6)


@pytest.mark.slow
def test_each_ray_behind_a_rough_surface_sees_its_share_of_the_background():
    window = scenes.build(
        scenes.box((9.0, 9.0, 0.5))._replace(material=refref_jax.Material(roughness=0.5))
    )
    pixels, side = 50, 16
    rays = Rays(
        np.tile(np.float32([0.1, 0.2, 3.0]), (pixels * side, 1)),
        np.tile(np.float32([0.0, 0.0, -1.0]), (pixels * side, 1)),
        np.full(pixels * side, 1e-4, np.float32),
    )
    pixel, ray = (x.ravel() for x in np.indices((pixels, side), np.int32))

    def waves(frequency, origin, direction):
        return 1.0 + jnp.cos(frequency * direction)

    def noise(number, frequency):
        strata = np.stack([pixel, ray, np.full_like(pixel, number)], axis=-1)
        sky = jax.tree_util.Partial(waves, jnp.float32(frequency))
        seen = render_known(window, sky, rays._replace(strata=strata), settings=TREE, tile=1024)
        each = seen.linear.reshape(pixels, side, 3).mean(axis=1)[:, :2]
        return each.mean(), each.std()

    # As one of very many rays, each is alone.
    (_, noisy), (_, smooth) = noise(2**30, 60.0), noise(side, 60.0)
    assert smooth < 0.9 * noisy
    # A lobe of twice the width would darken broad waves by a tenth.
    (alone, spread), (shared, _) = noise(2**30, 4.0), noise(side, 4.0)
    assert spread < 0.1 and abs(shared - alone) < 0.03


def test_backgrounds_are_arguments_of_one_program(scene, rays):
    first = render_known(scene, _environment(1), rays, settings=TREE, tile=256)
    compiled = background_rendering._render_tile._cache_size()
    second = render_known(scene, _environment(2), rays, settings=TREE, tile=256)
    assert background_rendering._render_tile._cache_size() == compiled
    assert np.max(np.abs(first.linear - second.linear)) > 0.1


def test_no_rays_give_an_empty_rendering(scene):
    none = Rays(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    seen = render_known(scene, _WHITE, none, settings=TREE)
    assert seen.linear.shape == (0, 3) and seen.paths.shape == (0,) and seen.casts == 0


def test_a_tile_without_rays_is_refused(scene, rays):
    with pytest.raises(ValueError, match="Give 1 or more"):
        render_known(scene, _WHITE, rays, settings=TREE, tile=0)


@pytest.mark.slow
def test_a_camera_inside_a_body_is_told_by_the_rule_of_priorities():
    scene = scenes.build(_BALL, rule="priority")
    rays = scenes.rays([[0.0, 0.0, 0.0]] * 3, np.eye(3))
    inside = parts_around([_BALL], np.asarray(rays.origins))
    settings = dataclasses.replace(TREE, reflections="none")
    # Seen from its centre a ball bends nothing, so directions stay as they are.
    seen = render_known(
        scene, lambda o, d: d + 1.0 + 0.0 * o, rays, settings=settings, interior_list=inside, tile=4
    )
    np.testing.assert_allclose(seen.linear, 1.0 + np.eye(3), atol=0.05)
    assert seen.casts == 6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cube", "sphere"])
def test_a_scene_that_is_moved_as_a_whole_gives_the_same_image(rays, kind):
    texels = np.random.default_rng(1).uniform(size=(6, 4, 4, 3)).astype(np.float32)
    axes = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    texture = LinearTexture(jnp.asarray(texels if kind == "cube" else texels[0]))
    if kind == "cube":
        # The walls' axes need not be right-handed.
        turned = (axes, np.roll(axes, 1, axis=1), np.roll(axes, 2, axis=1))
        background = CubeBackground(texture, *map(jnp.asarray, turned), jnp.float32(7.0))
    else:
        background = SphereBackground(texture, jnp.float32(7.0))
    centre = np.array([2.0, -1.0, 0.5], np.float32)
    images = []
    for shift in (np.zeros(3, np.float32), centre):
        part = _BALL._replace(vertices=_BALL.vertices + shift)
        seen = render_known(
            scenes.build(part),
            radiance_of(background._replace(centre=jnp.asarray(shift))),
            rays._replace(origins=rays.origins + shift),
            settings=PAPER,
            tile=256,
        )
        images.append(seen.linear)
    np.testing.assert_allclose(images[1], images[0], atol=1e-5)
    still = render_known(
        scenes.build(_BALL), radiance_of(background), rays, settings=PAPER, tile=256
    )
    np.testing.assert_allclose(images[0], still.linear, atol=1e-6)


_CAMERA = cameras.orbit(2, distance=4.0, elevation=0.3, size=12, angle_x=0.9)


# Four rays in each pixel: one program for all images.
_TILE = 576


def _rays(side, view=0):
    """Returns the rays of an image: one in each square, row and column of a pixel."""
    fine = cameras.supersample(_CAMERA, side)
    row, column = np.indices((fine.height, fine.width))
    column_of, row_of = (_STEPS.get(side, 1) * (x % side) % side for x in (column, row))
    up, right = (column_of + 0.5) / side - 0.5, (row_of + 0.5) / side - 0.5
    return cameras.pixel_rays(fine, np.full(row.shape, view), row - up, column + right)


# Step of the offsets of the rays of a pixel, by the square root of their number.
_STEPS = {2: 1, 3: 1, 4: 1, 5: 2, 6: 1, 8: 3, 10: 3, 12: 5}


def _uniform(scene, radiance, side, view=0):
    seen = render_known(scene, radiance, _rays(side, view), settings=TREE, tile=_TILE)
    return cameras.box_filter(seen.linear, side), seen.casts


def _image(scene, radiance, *, view=0, **options):
    return render_known_camera(scene, radiance, _CAMERA, view, settings=TREE, tile=_TILE, **options)


@pytest.mark.slow
@pytest.mark.parametrize("view", [0, 1])
def test_a_pixel_is_the_mean_of_its_rays(scene, view):
    seen = _image(scene, _environment(), view=view)
    expected, casts = _uniform(scene, _environment(), 2, view)
    np.testing.assert_allclose(seen.linear, expected, atol=1e-5)
    srgb = np.clip(colours.linear_to_srgb(seen.linear), 0.0, 1.0)
    np.testing.assert_allclose(seen.rgb, srgb, atol=1e-6)
    assert seen.casts == casts and np.all(seen.rays == 4) and np.all(seen.dropped == 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("side", [2, 4, 8])
def test_an_edge_along_the_pixels_is_resolved_by_as_many_steps_as_there_are_rays(side):
    ahead = cameras.Cameras(np.eye(4, dtype=np.float32)[None, :3], 1, 1, 1.0)
    empty = refref_jax.assemble([])
    shares = np.linspace(-0.4, 0.4, 23)

    def half(edge, axis, origin, direction):
        return jnp.full(3, jnp.where(direction[axis] > edge * -direction[2], 1.0, 0.0))

    for axis in (0, 1):
        for share in shares:
            sky = jax.tree_util.Partial(half, jnp.float32(share), jnp.int32(axis))
            seen = render_known_camera(
                empty, sky, ahead, 0, settings=STRAIGHT, rays_per_pixel=side**2, tile=1024
            )
            assert abs(seen.linear[0, 0, 0] - (0.5 - share)) <= 0.5 / side**2 + 1e-6


def _stripes(origin, direction):
    return jnp.where(jnp.sin(4.0 * direction[2]) > 0.0, 0.9, 0.1) + 0.0 * origin


def _by_pixel(values, side):
    return values.reshape(12, side, 12, side, *values.shape[2:]).swapaxes(1, 2)


def _with_more_background(scene, radiance, few, many):
    """Returns refined pixels, and which of them show the background past the objects.

    Of many rays those that meet an object have the mean colour of the few that do in their pixel
    and of every second one of themselves, as on a checkerboard. Elsewhere the first four rays keep
    the weight of their number to the power of 1.5.
    """
    met, hits = (
        _by_pixel(
            np.isfinite(images.find_first_surface(scene.surfaces, _rays(side)).distances), side
        )
        for side in (few, many)
    )
    traced = render_known(scene, radiance, _rays(few), settings=TREE, tile=_TILE).linear
    straight = render_known(scene, radiance, _rays(many), settings=STRAIGHT, tile=_TILE).linear
    fine = render_known(scene, radiance, _rays(many), settings=TREE, tile=_TILE).linear
    traced, colours, fine = _by_pixel(traced, few), _by_pixel(straight, many), _by_pixel(fine, many)
    black = np.indices((many, many)).sum(axis=0) % 2 == 0
    for pixel in zip(*np.nonzero(met.any(axis=(2, 3))), strict=True):
        bent = traced[pixel][met[pixel]], fine[pixel][hits[pixel] & black]
        colours[pixel][hits[pixel]] = np.concatenate(bent).mean(axis=0)
    beside = ~met.all(axis=(2, 3))
    ratio = (few * few / 4) ** 1.5
    both = (_uniform(scene, radiance, 2)[0] + ratio * traced.mean(axis=(2, 3))) / (1.0 + ratio)
    return np.where(beside[..., None], colours.mean(axis=(2, 3)), both), beside


@pytest.mark.slow
def test_pixels_whose_rays_differ_from_neighbours_get_more_rays(scene):
    seen = _image(scene, _stripes, refined_rays_per_pixel=25, tolerance=0.2)
    first = render_known(scene, _stripes, _rays(2), settings=TREE, tile=_TILE).rgb
    high, low = (f(first, (3, 3, 1), mode="nearest") for f in (maximum_filter, minimum_filter))
    contrast = _by_pixel(high - low, 2).max(axis=(2, 3, 4))
    refined, beside = _with_more_background(scene, _stripes, 5, 10)
    expected = np.where(contrast > 0.2, np.where(beside, 100, 29), 4)
    clear = np.abs(contrast - 0.2) > 1e-5  # of rounding
    np.testing.assert_array_equal(seen.rays[clear], expected[clear])
    assert set(np.unique(seen.rays)) == {4, 29, 100}
    few = _uniform(scene, _stripes, 2)[0]
    linear = np.where(seen.rays[..., None] == 4, few, refined)
    np.testing.assert_allclose(seen.linear, linear, atol=1e-5)


@pytest.mark.slow
def test_refined_pixels_are_nearer_to_the_truth_than_more_rays_everywhere(scene):
    truth, _ = _uniform(scene, _stripes, 24)
    seen = _image(scene, _stripes, refined_rays_per_pixel=36, tolerance=0.2)
    met = np.isfinite(images.find_first_surface(scene.surfaces, _rays(6)).distances)
    inside = met.reshape(12, 6, 12, 6).all(axis=(1, 3))
    assert np.mean(seen.rays[inside]) < 25.0
    error, uniform = (
        np.sqrt(np.mean((x - truth) ** 2)) for x in (seen.linear, _uniform(scene, _stripes, 6)[0])
    )
    assert error < uniform


@pytest.mark.slow
def test_white_is_not_refined_and_zero_tolerance_refines_what_differs(scene):
    assert np.all(_image(scene, _WHITE, refined_rays_per_pixel=9).rays == 4)
    seen = _image(scene, _environment(), refined_rays_per_pixel=9, tolerance=0.0)
    expected, beside = _with_more_background(scene, _environment(), 3, 6)
    np.testing.assert_array_equal(seen.rays, np.where(beside, 36, 13))
    np.testing.assert_allclose(seen.linear, expected, atol=1e-5)


@pytest.mark.slow
def test_pixels_beside_the_objects_have_four_first_rays_where_others_are_refined(scene):
    assert np.all(_image(scene, _WHITE, rays_per_pixel=1).rays == 1)
    seen = _image(scene, _environment(), rays_per_pixel=1, refined_rays_per_pixel=4, tolerance=9.0)
    met = np.isfinite(images.find_first_surface(scene.surfaces, _rays(1)).distances)
    assert np.any(met) and not np.all(met)
    np.testing.assert_array_equal(seen.rays, np.where(met, 1, 4))
    one, four = (_uniform(scene, _environment(), side)[0] for side in (1, 2))
    np.testing.assert_allclose(seen.linear, np.where(met[..., None], one, four), atol=1e-5)


@pytest.mark.slow
def test_casts_of_a_refined_background_are_counted_once(scene):
    options = {"rays_per_pixel": 4, "refined_rays_per_pixel": 4, "tolerance": 0.0}
    seen = _image(scene, _environment(), **options)
    few, many = _rays(2), _rays(4)
    met, hits = (
        np.isfinite(images.find_first_surface(scene.surfaces, rays).distances)
        for rays in (few, many)
    )
    edges = _by_pixel(met, 2).any(axis=(2, 3)) & ~_by_pixel(met, 2).all(axis=(2, 3))
    edges = np.repeat(np.repeat(edges, 4, axis=0), 4, axis=1)
    bent = edges & hits & (np.indices(hits.shape).sum(axis=0) % 2 == 0)
    first, again = (
        render_known(scene, _environment(), rays, settings=TREE, tile=_TILE).casts
        for rays in (few, jax.tree.map(lambda x: x[bent], many))
    )
    assert seen.casts == first + edges.sum() + again - bent.sum()


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, 2, 3])
def test_the_background_alone_is_measured_by_more_rays(scene, side):
    count, tolerance = side * side, 0.1
    seen = _image(
        scene,
        _environment(),
        rays_per_pixel=count,
        refined_rays_per_pixel=count,
        tolerance=tolerance,
    )
    few = max(side, 2)  # pixels beside the objects have four first rays
    expected, beside = _with_more_background(scene, _environment(), few, 2 * few)
    uniform, _ = _uniform(scene, _environment(), side)
    finer = seen.rays == 4 * few * few
    inside = _by_pixel(
        np.isfinite(images.find_first_surface(scene.surfaces, _rays(side)).distances), side
    ).all(axis=(2, 3))
    assert np.any(finer & beside) and not np.any(finer & inside)
    np.testing.assert_allclose(seen.linear[finer], expected[finer], atol=1e-5)
    np.testing.assert_allclose(seen.linear[inside], uniform[inside], atol=1e-5)
    assert np.all(seen.rays[inside] == count)


@pytest.mark.slow
def test_the_weight_of_first_rays_is_that_of_their_number():
    empty = refref_jax.assemble([])
    ahead = cameras.Cameras(np.eye(4, dtype=np.float32)[None, :3], 8, 8, 8.0)

    def see(**options):
        return render_known_camera(empty, half, ahead, 0, settings=TREE, tile=_TILE, **options)

    def half(origin, direction):
        return jnp.where(direction[0] > 0.05, 0.9, 0.1) + 0.0 * origin

    seen = see(rays_per_pixel=1, refined_rays_per_pixel=144)
    four, many = (see(rays_per_pixel=count).linear for count in (4, 144))
    refined = seen.rays == 148
    assert np.any(refined) and np.all(seen.rays[~refined] == 4)
    ratio = (144 / 4) ** 1.5
    expected = np.where(refined[..., None], (four + ratio * many) / (1.0 + ratio), four)
    np.testing.assert_allclose(seen.linear, expected, atol=1e-5)


def _infinite_beyond(edge, origin, direction):
    return jnp.where(direction[0] > edge, jnp.inf, 0.5) + 0.0 * origin


def _sun(edge):
    """Returns infinite light from all directions beyond an edge along x."""
    return jax.tree_util.Partial(_infinite_beyond, jnp.float32(edge))


@pytest.mark.slow
def test_infinite_light_is_infinite_in_refined_pixels(scene):
    seen = _image(scene, _sun(0.0), refined_rays_per_pixel=9)
    assert np.any(np.isinf(seen.linear)) and not np.any(np.isnan(seen.linear))


def test_straight_rays_are_refined_as_their_background(scene):
    options = {"settings": STRAIGHT, "refined_rays_per_pixel": 100, "tolerance": 0.0}
    seen = render_known_camera(scene, _environment(), _CAMERA, 0, tile=_TILE, **options)
    fine = render_known(scene, _environment(), _rays(12), settings=STRAIGHT, tile=_TILE)
    assert np.all(seen.rays == 144) and seen.casts == 0
    np.testing.assert_allclose(seen.linear, cameras.box_filter(fine.linear, 12), atol=1e-5)


@pytest.mark.slow
def test_a_tile_whose_paths_do_not_fit_is_rendered_in_halves(scene, rays):
    scarce = dataclasses.replace(TREE, live_per_ray=1.0, segments_per_ray=6.0, paths_per_ray=2.0)
    met = np.isfinite(images.find_first_surface(scene.surfaces, rays).distances)
    hits = jax.tree.map(lambda x: np.resize(x[met], (1024, *x.shape[rays.radii.ndim :])), rays)
    once = path_tracing.trace_ends(scene, hits, settings=scarce)
    assert np.sum(once.dropped) > 0.0
    seen = render_known(scene, _environment(), hits, settings=scarce, tile=1024)
    assert np.sum(seen.dropped) == 0.0
    roomy = render_known(scene, _environment(), hits, settings=TREE, tile=256)
    np.testing.assert_allclose(seen.linear, roomy.linear, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rays_per_pixel": 5}, "square grid"),
        ({"refined_rays_per_pixel": 5}, "square grid"),
        ({"rays_per_pixel": 9, "refined_rays_per_pixel": 4}, "refined_rays_per_pixel is 4"),
        ({"refined_rays_per_pixel": 9, "tolerance": -0.1}, "tolerance is -0.1"),
        ({"refined_rays_per_pixel": 9, "tolerance": float("nan")}, "tolerance is nan"),
    ],
)
def test_impossible_numbers_of_rays_are_refused(scene, options, message):
    with pytest.raises(ValueError, match=message):
        _image(scene, _WHITE, **options)


@pytest.mark.slow
def test_a_camera_inside_an_object_has_its_interior_list():
    scene = scenes.build(_BALL, rule="priority")
    here = _CAMERA._replace(poses=_CAMERA.poses * np.float32([1.0, 1.0, 1.0, 0.0]))
    inside = parts_around([_BALL], np.zeros((1, 3)))[0]
    settings = dataclasses.replace(TREE, reflections="none")
    seen = render_known_camera(
        scene, lambda o, d: d + 2.0, here, 0, settings=settings, interior_list=inside
    )
    expected = cameras.box_filter(cameras.image_rays(cameras.supersample(here, 2), 0).directions, 2)
    np.testing.assert_allclose(seen.linear, expected + 2.0, atol=0.05)


@pytest.mark.slow
def test_light_that_a_refined_pixel_loses_is_told(scene):
    short = dataclasses.replace(TREE, max_bends=2, truncated_paths="black")
    seen = render_known_camera(
        scene, _WHITE, _CAMERA, 0, settings=short, refined_rays_per_pixel=9, tolerance=0.0
    )
    assert np.max(seen.dropped) > 0.0 and np.any(seen.rays == 36)
    np.testing.assert_allclose(seen.linear + seen.dropped, 1.0, atol=1e-5)


@pytest.mark.slow
def test_a_background_of_infinite_radiance_gives_no_nan(scene):
    seen = _image(scene, _sun(-1.1), refined_rays_per_pixel=9, tolerance=0.0)
    assert not np.any(np.isnan(seen.rgb))


@pytest.mark.slow
def test_few_rays_at_once_make_the_same_image(scene, monkeypatch):
    whole = _image(scene, _environment(), refined_rays_per_pixel=9)
    monkeypatch.setattr(images, "RAYS_OF_A_BAND", 500)
    bands = _image(scene, _environment(), refined_rays_per_pixel=9)
    assert np.any(whole.rays > 4)
    np.testing.assert_array_equal(bands.rays, whole.rays)
    np.testing.assert_allclose(bands.linear, whole.linear, atol=1e-6)
    assert bands.casts == whole.casts
