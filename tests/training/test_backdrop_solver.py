"""The solver of backdrops: recovers known backgrounds, at the extremes, and through glass."""

import dataclasses
import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry import cameras
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import STRAIGHT, TREE
from refref_jax.render import backdrop, learned_media, pixels, render_known
from refref_jax.render.backgrounds import (
    Environment,
    LinearTexture,
    radiance_of,
)
from refref_jax.sampling.scene_bounds import Domain
from refref_jax.training import backdrop_equations, backdrop_solver
from refref_jax.training.backdrop_equations import Block
from tests.factories import scenes

pytestmark = pytest.mark.longest

_RESOLUTION = 16
_SKY = Domain(1.0, "unbounded")
_TREE = dataclasses.replace(TREE, max_bends=5)
_mipmap = jax.jit(backdrop.mipmap, static_argnames="space")


def _environment(brightness=1.0):
    """Returns a smooth environment: three directions with a colour each."""
    row, column = np.mgrid[:64, :128]
    elevation, azimuth = np.pi * (0.5 - (row + 0.5) / 64), 2 * np.pi * (0.5 - (column + 0.5) / 128)
    flat = np.cos(elevation)
    towards = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    texels = brightness * (0.3 + 0.25 * np.sin(2.0 * towards))
    return radiance_of(Environment(LinearTexture(jnp.asarray(texels, jnp.float32))))


def _views(count=6, size=24):
    """Returns cameras around the origin, half of them above it."""
    rings = [
        cameras.orbit(count // 2, distance=4.0, elevation=angle, size=size, angle_x=1.6)
        for angle in (0.9, -0.8)
    ]
    return rings[0]._replace(poses=np.concatenate([ring.poses for ring in rings]))


def _photographs(scene, radiance, views, settings):
    images = []
    for view in range(len(views.poses)):
        rays = cameras.image_rays(cameras.supersample(views, 3), view)
        linear = render_known(scene, radiance, rays, settings=settings).linear
        srgb = pixels.linear_to_srgb(jnp.asarray(cameras.box_filter(np.asarray(linear), 3)))
        images.append(np.round(255.0 * np.clip(srgb, 0.0, 1.0)).astype(np.uint8))
    return np.stack(images)


def _equations(scene, views, images, *, settings=STRAIGHT, domain=_SKY, **options):
    return backdrop_equations.read(
        scene,
        views,
        images,
        settings=settings,
        domain=domain,
        resolution=_RESOLUTION,
        **options,
    )


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_only_pixels_among_a_mask_have_equations(share):
    views, empty = _views(), scenes.build()
    images = np.random.default_rng(0).integers(256, size=(6, 24, 24, 3), dtype=np.uint8)
    among = np.random.default_rng(1).random((6, 24, 24)) < 0.6
    among[2] = False
    # An object in the middle of all views, in a colour that occurs nowhere else.
    among[:, 8:16, 8:16] = False
    images[images == 7] = 8
    images[:, 8:16, 8:16] = 7
    blocks = _equations(empty, views, images, among=among, share=share, draw=3)
    seen = np.concatenate([np.round(255.0 * block.srgb) for block in blocks])
    assert not np.any(seen == 7.0)
    names = np.concatenate([block.views for block in blocks])
    counts = among.sum(axis=(1, 2))
    if share == 1.0:
        np.testing.assert_array_equal(np.bincount(names, minlength=6), counts)
        np.testing.assert_array_equal(np.sort(seen, axis=0), np.sort(images[among], axis=0))
        whole = _equations(empty, views, images)
        assert sum(len(block.srgb) for block in whole) == among.size
    else:
        assert 0.4 * counts.sum() < len(names) < 0.6 * counts.sum() and 2 not in names
    for block in blocks:
        assert len(block.lookups.pixels) == len(block.srgb)
        assert np.all(np.asarray(block.lookups.pixels) < len(block.srgb))


def _solve(blocks, iterations=16, **options):
    *_, last = backdrop_solver.solve(
        blocks, space="unbounded", resolution=_RESOLUTION, iterations=iterations, **options
    )
    return last


@pytest.fixture(scope="module")
def ball() -> Scene:
    return scenes.build(scenes.ball(1.3, subdivisions=2))


@pytest.mark.slow
def test_an_environment_is_recovered_through_glass(ball):
    views, sky = _views(), _environment()
    blocks = _equations(ball, views, _photographs(ball, sky, views, _TREE), settings=_TREE)
    last = _solve(blocks)
    assert last.fitted > 40.0 and last.held_out > 38.0
    # Another view, rendered by the solved backdrop and by the known environment.
    other = cameras.orbit(1, distance=3.0, elevation=0.1, size=24, angle_x=1.2)
    image = _photographs(ball, sky, other, _TREE)
    (block,) = _equations(ball, other, image, settings=_TREE, side=2)
    mips = _mipmap(last.pyramid, space="unbounded")
    seen = pixels.linear_to_srgb(backdrop.colours(mips, block.lookups, pixels=24**2))
    assert np.sqrt(np.mean((seen - block.srgb) ** 2)) < 0.012


@pytest.mark.slow
def test_paused_solving_is_the_same_as_solving_without_a_pause(ball):
    views = _views(4, 16)
    blocks = _equations(ball, views, _photographs(ball, _environment(), views, STRAIGHT))
    whole = _solve(blocks, 3 * backdrop_solver.ROUND)
    first = _solve(blocks, backdrop_solver.ROUND)
    rest = _solve(blocks, 3 * backdrop_solver.ROUND, start=(first.step, first.pyramid))
    assert whole.step == rest.step
    for ours, theirs in zip(whole.pyramid, rest.pyramid, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_the_number_of_rays_in_a_tile_does_not_matter(ball, monkeypatch):
    views = _views(2, 16)
    images = _photographs(ball, _environment(), views, STRAIGHT)
    whole = _equations(ball, views, images, blocks=1)
    monkeypatch.setattr(backdrop_equations.images, "TILE", 128)
    tiled = _equations(ball, views, images, blocks=1)
    for ours, theirs in zip(jax.tree.leaves(whole), jax.tree.leaves(tiled), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def _one_pixel(srgb, *, throughput=1.0, kept=1.0):
    """Returns the equation of one pixel whose only path ends in the middle of a face."""
    lookups = backdrop.Lookups(
        pixels=jnp.zeros(1, jnp.int32),
        entries=jnp.zeros(1, jnp.int32),
        sides=jnp.full(1, _RESOLUTION, jnp.int32),
        taps=jnp.ones((1, 2), jnp.int32),
        starts=jnp.full((1, 2), 0.5 * _RESOLUTION),
        steps=jnp.zeros((1, 2, 2)),
        throughput=jnp.full((1, 3), throughput),
        directions=jnp.zeros((1, 0)),
    )
    colour = jnp.full((1, 3), srgb)
    nothing = jnp.zeros((1, 0))
    linear, view = pixels.srgb_to_linear(colour), jnp.zeros(1, jnp.int32)
    return Block(lookups, nothing, linear, colour, jnp.full(1, kept), view)


@pytest.mark.slow
def test_one_vertex_seen_by_one_pixel_continues_everywhere():
    last = _solve([_one_pixel(0.5)])
    expected = float(pixels.srgb_to_linear(jnp.float32(0.5)))
    for copy in _mipmap(last.pyramid, space="unbounded"):
        np.testing.assert_allclose(copy, expected, rtol=1e-3)


def test_the_coverage_is_the_sum_of_the_weights_of_fitted_pixels():
    blocks = [_one_pixel(0.5), _one_pixel(0.5, throughput=0.4), _one_pixel(0.5, kept=0.0)]
    seen = backdrop_solver.coverage(blocks, space="unbounded", resolution=_RESOLUTION)
    assert seen.shape == (6, _RESOLUTION + 1, _RESOLUTION + 1)
    np.testing.assert_allclose(jnp.sum(seen), 1.4, rtol=1e-6)
    np.testing.assert_allclose(seen[0, _RESOLUTION // 2, _RESOLUTION // 2], 1.4, rtol=1e-6)


@pytest.mark.slow
def test_saturated_pixels_bound_the_radiance_from_below():
    # The same vertex is white in one pixel, and far brighter behind a dark filter.
    white, dimmed = _one_pixel(1.0), _one_pixel(0.5, throughput=0.05)
    last = _solve([white, dimmed], iterations=32)
    expected = float(pixels.srgb_to_linear(jnp.float32(0.5))) / 0.05
    middle = _mipmap(last.pyramid, space="unbounded")[0][0, 8, 8]
    assert expected > 4.0
    np.testing.assert_allclose(middle, expected, rtol=0.05)


def test_pixels_that_are_held_out_have_no_weight():
    last = _solve([_one_pixel(0.5), _one_pixel(0.9, kept=0.0)])
    expected = float(pixels.srgb_to_linear(jnp.float32(0.5)))
    middle = _mipmap(last.pyramid, space="unbounded")[0][0, 8, 8]
    np.testing.assert_allclose(middle, expected, rtol=1e-3)


@pytest.mark.parametrize("throughput", [0.0, 1e-20, 1e-6])
def test_pixels_without_light_leave_the_radiance_finite(throughput):
    last = _solve([_one_pixel(0.5, throughput=throughput)])
    assert all(np.all(np.isfinite(level)) for level in last.pyramid)


@pytest.mark.slow
def test_tints_are_found_with_the_radiance():
    tint = (0.9, 0.7, 0.5)
    body = scenes.ball(1.3, subdivisions=2)
    tinted = scenes.build(body._replace(tint=tint))
    views, sky = _views(10, 32), _environment()
    images = _photographs(tinted, sky, views, _TREE)
    blocks = _equations(scenes.build(body), views, images, settings=_TREE, tally="parts")
    rounds = {"iterations": 4 * backdrop_solver.ROUND, "tint_decay": 1e-3}
    last = _solve(blocks, tints=learned_media.init(1), **rounds)
    assert last.fitted > 36.0
    # Light that crosses a ball meets it twice, and a chord is as long as 1.8 radii or more, so that
    # a tint and absorption look alike.
    total = np.array([2.0, 1.9 * 1.3]) @ np.asarray(learned_media.densities(last.tints))
    np.testing.assert_allclose(total, -2.0 * np.log(tint), atol=0.04, rtol=0.04)
    # A run that was paused after a round ends with the same bits.
    first = _solve(blocks, tints=learned_media.init(1), **rounds | {"iterations": 8})
    again = _solve(blocks, start=(first.step, first.pyramid), tints=first.tints, **rounds)
    for ours, theirs in zip(jax.tree.leaves(last[:3]), jax.tree.leaves(again[:3]), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_parts_that_no_pixel_sees_become_clear(ball):
    views = _views(2, 16)
    images = _photographs(ball, _environment(), views, STRAIGHT)
    blocks = _equations(ball, views, images, tally="none")
    empty = [b._replace(crossings=jnp.zeros((b.lookups.pixels.size, 2))) for b in blocks]
    last = _solve(empty, tints=learned_media.init(1), tint_decay=1e-3)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(last.tints))
    np.testing.assert_allclose(learned_media.tints(last.tints), 1.0, atol=1e-5)


@pytest.mark.slow
def test_gains_of_the_images_are_found_with_the_radiance(ball):
    # One ring of cameras: images of separate parts of the surface have no common scale.
    views = cameras.orbit(10, distance=4.0, elevation=0.2, size=32, angle_x=1.6)
    images = _photographs(ball, _environment(), views, _TREE)
    gains = np.exp(np.random.default_rng(0).normal(scale=0.2, size=(10, 1, 1, 3)))
    linear = np.asarray(pixels.srgb_to_linear(jnp.asarray(images, jnp.float32) / 255.0))
    taken = pixels.linear_to_srgb(jnp.asarray(gains * linear, jnp.float32))
    taken = np.round(255.0 * np.clip(taken, 0.0, 1.0)).astype(np.uint8)
    blocks = _equations(ball, views, taken, settings=_TREE)
    fixed = _solve(blocks, 4 * backdrop_solver.ROUND)
    rounds = {"iterations": 4 * backdrop_solver.ROUND, "gains": jnp.zeros((10, 3))}
    last = _solve(blocks, **rounds)
    assert last.held_out > fixed.held_out + 10.0
    expected = np.log(gains[:, 0, 0])
    expected -= expected.mean(axis=0)
    np.testing.assert_allclose(last.gains, expected, atol=0.01)
    np.testing.assert_allclose(jnp.mean(last.gains, axis=0), 0.0, atol=1e-6)
    # A run that was paused after a round ends with the same bits.
    first = _solve(blocks, **rounds | {"iterations": backdrop_solver.ROUND})
    again = _solve(blocks, start=(first.step, first.pyramid), **rounds | {"gains": first.gains})
    for ours, theirs in zip(jax.tree.leaves(last[:4]), jax.tree.leaves(again[:4]), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_equal_images_have_equal_gains(ball):
    views = _views()
    blocks = _equations(ball, views, _photographs(ball, _environment(), views, STRAIGHT))
    last = _solve(blocks, gains=jnp.zeros((len(views.poses), 3)))
    np.testing.assert_allclose(last.gains, 0.0, atol=0.01)


@pytest.mark.slow
def test_a_black_image_leaves_all_gains_finite():
    last = _solve([_one_pixel(0.0), _one_pixel(0.5)], gains=jnp.zeros((2, 3)))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(last[:4]))


@pytest.mark.slow
def test_rounds_with_other_pixels_come_close_to_all_pixels(ball):
    views, sky = _views(10, 32), _environment()
    images = _photographs(ball, sky, views, _TREE)

    def some(draw):
        return _equations(ball, views, images, settings=_TREE, share=0.3, draw=draw)

    held = np.mean([float(np.mean(1.0 - block.kept)) for block in some(0)])
    assert 0.01 < held < 0.03
    counts = [sum(len(block.srgb) for block in some(draw)) for draw in range(2)]
    assert counts[0] != counts[1] and np.allclose(counts, 0.3 * 10 * 32**2, rtol=0.1)
    rounds = {"iterations": 8 * backdrop_solver.ROUND, "uniform": backdrop.init(16, radiance=0.3)}
    blocks = _equations(ball, views, images, settings=_TREE)
    all_, few = _solve(blocks, **rounds), _solve(some(0), **rounds)
    streamed = _solve(some, **rounds)
    assert streamed.step == 8 * backdrop_solver.ROUND

    def held_out(solved):
        seen = backdrop_equations.System(blocks, "unbounded", _RESOLUTION, None, None).see(
            solved.pyramid
        )
        return backdrop_solver._measure(blocks, seen)[0]

    assert held_out(streamed) > held_out(all_) - 0.8 and held_out(streamed) > held_out(few)
    # A run that was paused after a round ends with the same bits.
    first = _solve(some, **rounds | {"iterations": 2 * backdrop_solver.ROUND})
    again = _solve(some, start=(first.step, first.pyramid), held=first.held, **rounds)
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(streamed), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_the_equations_of_a_round_are_freed_before_the_next_are_made():
    alive = []

    def draw(number):
        gc.collect()
        assert sum(each() is not None for each in alive) == 0
        block = _one_pixel(0.5)
        alive.append(weakref.ref(block.srgb))
        return [block]

    last = _solve(draw, uniform=backdrop.init(_RESOLUTION), iterations=3 * backdrop_solver.ROUND)
    assert last.step == 3 * backdrop_solver.ROUND and len(alive) == 3
    with pytest.raises(ValueError, match="need the radiance `uniform`"):
        _solve(draw)


@pytest.mark.slow
def test_radiance_that_is_linear_in_the_direction_is_recovered():
    # A grey cube that is brighter for light that travels up, seen from two rings of cameras.
    views, domain = _views(12, 32), Domain(6.0, "bounded")
    images = []
    for view in range(12):
        towards = cameras.image_rays(views, view).directions
        linear = np.broadcast_to(0.3 + 0.2 * np.asarray(towards)[..., 2:], (32, 32, 3))
        srgb = pixels.linear_to_srgb(jnp.asarray(linear, jnp.float32))
        images.append(np.round(255.0 * np.asarray(srgb)).astype(np.uint8))
    found = {}
    for axes in (0, 3):
        blocks = _equations(
            scenes.build(scenes.ball(0.01)), views, np.stack(images), domain=domain, axes=axes
        )
        *_, found[axes] = backdrop_solver.solve(
            blocks, space="bounded", resolution=_RESOLUTION, iterations=24
        )
    assert found[3].held_out > max(42.0, found[0].held_out + 8.0)
    assert found[3].pyramid[-1].shape[-1] == 12
