"""Several rays in a pixel: what is averaged, and how."""

import numpy as np
import pytest

from refref_jax import choices
from refref_jax.geometry import cameras
from refref_jax.optics.path_settings import STRAIGHT
from refref_jax.render import Model, Rendering, images, render_camera, render_image
from tests.factories import scenes
from tests.factories.small_model import CAMERAS, MODEL, initial

_CHUNK = 512


@pytest.fixture(scope="module")
def model():
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    return Model(MODEL, STRAIGHT, scene, initial(MODEL))


@pytest.mark.parametrize(("rays", "side"), [(1, 1), (4, 2), (9, 3), (16, 4), (49, 7)])
def test_rays_make_a_square_grid(rays, side):
    assert choices.side_of(rays) == side


@pytest.mark.parametrize(
    ("rays", "nearest"), [(-4, "Give 1."), (0, "Give 1."), (2, "1 or 4"), (8, "4 or 9")]
)
def test_rays_that_do_not_are_told_the_nearest_squares(rays, nearest):
    with pytest.raises(ValueError, match=nearest):
        choices.side_of(rays)


def _fine(linear, distance):
    linear, distance = (np.asarray(x, np.float32) for x in (linear, distance))
    rgb = np.repeat(linear[..., None], 3, axis=-1)
    black = np.zeros_like(rgb)
    return Rendering(black, distance, distance, np.ones_like(distance), rgb, black)


def test_half_a_pixel_of_white_is_more_than_half_of_its_code():
    seen = images.average(_fine([[1.0, 0.0], [1.0, 0.0]], np.ones((2, 2))), 2)
    # Half of the light is 0.735 in sRGB; the mean of the codes would be 0.5.
    np.testing.assert_allclose(seen.rgb, np.full((1, 1, 3), 0.7354), atol=1e-4)
    np.testing.assert_allclose(seen.linear, np.full((1, 1, 3), 0.5), atol=1e-4)


def test_light_is_clipped_after_it_is_averaged():
    seen = images.average(_fine([[3.0, 0.0], [0.0, 0.0]], np.ones((2, 2))), 2)
    np.testing.assert_allclose(seen.rgb, np.full((1, 1, 3), 0.8808), atol=1e-4)


@pytest.mark.parametrize(
    ("distance", "expected"),
    [
        ([[2.0, 7.0], [2.0, 7.0]], 2.0),  # not the 4.5 at which nothing is
        ([[np.inf, np.inf], [np.inf, 3.0]], np.inf),
        ([[1.0, 2.0, 3.0], [9.0, 8.0, 7.0], [4.0, 5.0, 6.0]], 5.0),
    ],
)
def test_a_distance_is_one_that_a_ray_saw(distance, expected):
    seen = images.average(_fine(np.ones_like(distance), distance), len(distance))
    np.testing.assert_array_equal(seen.distance, [[expected]])


def test_each_block_of_small_pixels_makes_its_own_pixel():
    fine = np.arange(24.0).reshape(4, 6)
    seen = images.average(_fine(fine / 24.0, fine), 2)
    np.testing.assert_array_equal(seen.distance, [[1.0, 3.0, 5.0], [13.0, 15.0, 17.0]])
    np.testing.assert_allclose(seen.mean_distance, [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]])


@pytest.mark.slow
def test_one_ray_a_pixel_is_the_picture_itself(model):
    seen = render_camera(model, CAMERAS, 0, chunk=_CHUNK)
    for ours, expected in zip(
        seen, render_image(model, cameras.image_rays(CAMERAS, 0), chunk=_CHUNK), strict=True
    ):
        np.testing.assert_allclose(ours, expected, atol=1e-5)


@pytest.mark.slow
def test_bands_of_rows_make_the_same_picture(model):
    # 16 x 16 pixels of 4 rays: bands of 3 rows of pixels, of which the last holds one.
    banded = render_camera(model, CAMERAS, 0, rays_per_pixel=4, chunk=_CHUNK, band=200)
    fine = render_image(model, cameras.image_rays(cameras.supersample(CAMERAS, 2), 0))
    assert banded.rgb.shape == (16, 16, 3) and banded.distance.shape == (16, 16)
    for ours, expected in zip(banded, images.average(fine, 2), strict=True):
        np.testing.assert_allclose(ours, expected, atol=2e-5)
