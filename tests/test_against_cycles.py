"""Light paths against Blender Cycles: the background is known, so nothing is learned."""

import functools

import imageio.v3 as iio
import jax
import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from benchmarks.oracles import colours
from benchmarks.oracles.backgrounds import CubeBackground
from refref_jax.data import scene_assembly, scene_folder
from refref_jax.geometry import cameras
from refref_jax.optics import path_tracing
from refref_jax.optics.path_settings import PAPER, STRAIGHT, TREE, PathSettings
from refref_jax.render import radiance_of, render_known
from tests.factories import scenes

pytestmark = pytest.mark.computing

# Rays a pixel along each axis: Cycles' pixels are box-filtered. What the paper's paths lack is more
# than what fewer rays alias.
_FINE, _COARSE = 6, 3


@functools.partial(jax.jit, static_argnames="settings")
def _trace(scene, rays, *, settings):
    return path_tracing.trace(scene, rays, settings=settings, capacity=rays.radii.shape[0]).paths


@functools.cache
def _render(scene, view, settings, *, oversampling=_FINE):
    """Renders a view of the test split; returns sRGB, and casts and paths a camera ray."""
    frames = scene_folder.read_frames(scene, "test")
    rays = cameras.image_rays(cameras.supersample(frames.cameras, oversampling), view)
    radiance = radiance_of(scene_assembly.read_background(scene))
    seen = render_known(scenes.read_geometry(scene), radiance, rays, settings=settings)
    linear = cameras.box_filter(seen.linear, oversampling)
    return (
        np.clip(colours.linear_to_srgb(linear), 0.0, 1.0),
        seen.casts / seen.paths.size,
        np.mean(seen.paths),
    )


def _psnr(image, target, mask):
    return -10.0 * np.log10(np.mean((image - target)[mask] ** 2))


@pytest.mark.parametrize(
    ("settings", "at_least", "at_most"),
    [
        pytest.param(STRAIGHT, 8.0, 13.0, marks=pytest.mark.slow),
        pytest.param(PathSettings(10, "none"), 22.0, 28.0, marks=pytest.mark.slow),
        pytest.param(PAPER, 27.0, 33.0, marks=pytest.mark.slow),
        (TREE, 41.5, 48.0),
    ],
    ids=["straight", "refraction", "paper", "tree"],
)
def test_the_glass_ball_is_as_good_as_its_path_model(ball_scene, settings, at_least, at_most):
    frames = scene_folder.read_frames(ball_scene, "test")
    masks = scene_folder.read_masks(frames)
    values = []
    for view in (0, 10):
        target = iio.imread(frames.images[view])[..., :3] / 255.0
        side = _FINE if settings == TREE else _COARSE
        image, *_ = _render(ball_scene, view, settings, oversampling=side)
        values.append(_psnr(image, target, masks[view]))
        # Outside lie only camera and walls, and the half-covered pixels of the rim.
        assert _psnr(image, target, ~masks[view]) > 36.0
    assert at_least <= np.mean(values) <= at_most


@pytest.mark.slow
def test_the_tree_costs_what_the_slow_one_does(ball_scene):
    counts = [_render(ball_scene, view, TREE)[1:] for view in (0, 10)]
    # `reference_tree`, in float64 on Embree, of rays through the middles of all pixels.
    np.testing.assert_allclose(np.mean(counts, axis=0), [2.4506, 1.5632], rtol=0.01)


@pytest.mark.parametrize(("view", "at_least"), [(0, 54.0), (10, 56.0)])
def test_the_walls_are_exact_to_8_bits(ball_scene, view, at_least):
    """Away from the ball, with rays enough for the walls' borders.

    Decoding texels before interpolating them would give 33.4 and 36.9 dB.
    """
    frames = scene_folder.read_frames(ball_scene, "test")
    target = iio.imread(frames.images[view])[..., :3] / 255.0
    image, *_ = _render(ball_scene, view, STRAIGHT, oversampling=8)
    away = ~binary_dilation(scene_folder.read_masks(frames)[view], iterations=2)
    assert _psnr(image, target, away) > at_least


@pytest.mark.slow
def test_the_first_surface_is_where_cycles_sees_it(ball_scene):
    frames = scene_folder.read_frames(ball_scene, "test")
    distances = scene_folder.read_distances(frames)[0]
    rays = cameras.image_rays(frames.cameras, 0)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    paths = jax.tree.map(np.asarray, _trace(scenes.read_geometry(ball_scene), flat, settings=PAPER))
    ours = paths.tau[: distances.size, 1].reshape(distances.shape)
    mask = scene_folder.read_masks(frames)[0]
    both = np.isfinite(ours) & mask
    # Both are of rays through the middles of pixels.
    assert np.sum(np.isfinite(ours) != mask) <= 1
    assert np.quantile(np.abs(ours - distances)[both], 0.999) < 1e-5


def test_the_walls_are_where_cycles_sees_them(ball_scene):
    frames = scene_folder.read_frames(ball_scene, "test")
    distances = scene_folder.read_distances(frames)[3].ravel()
    rays = cameras.image_rays(frames.cameras, 3)
    origins, directions = (np.asarray(x, float).reshape(-1, 3) for x in rays[:2])
    _, ours = CubeBackground(ball_scene).look(origins, directions)
    outside = ~scene_folder.read_masks(frames)[3].ravel()
    assert np.quantile(np.abs(ours - distances)[outside], 0.999) < 1e-4
