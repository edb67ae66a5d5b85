"""Daylight and landscapes: the model's values, blue above, brightest at the sun, exposed."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.dataset import sky
from experiments.dataset.landscapes import ENVIRONMENTS, make_environment
from experiments.dataset.textures.sphere_fields import directions
from refref_jax.render.backgrounds import Environment, LinearTexture, environment_radiance

_ROWS = 96
_WEATHER = sky.Weather(math.radians(40.0), math.radians(45.0), 3.0, 0.4, 5)


@pytest.fixture(scope="module")
def environments():
    return {name: make_environment(name, _ROWS) for name in ENVIRONMENTS}


def _luminance(picture):
    return picture @ np.array(sky.LUMINANCE)


def _towards(azimuth, elevation):
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    around = math.cos(elevation)
    return np.array(
        [[[around * math.cos(azimuth), around * math.sin(azimuth), math.sin(elevation)]]],
        np.float32,
    )


def _chromaticity(rgb):
    xyz = np.linalg.inv(
        [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    ) @ np.ravel(rgb)
    return xyz[:2] / xyz.sum()


def test_the_zenith_has_the_models_chromaticity():
    # Of turbidity 3 and a sun 45 degrees high, by the polynomials of the paper.
    zenith = sky.clear_sky(_towards(0.0, 90.0), _WEATHER)
    np.testing.assert_allclose(_chromaticity(zenith), [0.24568, 0.25148], atol=2e-4)


def test_the_horizon_has_the_models_luminance():
    bright = [
        _luminance(sky.clear_sky(_towards(azimuth, elevation), _WEATHER)).item()
        for azimuth, elevation in ((220.0, 15.0), (0.0, 90.0))
    ]
    # Perez's function away from the sun over that at the zenith, for turbidity 3:
    # (1 + a e^(b / cos)) (1 + c e^(d gamma) + e cos^2 gamma).
    assert bright[0] / bright[1] == pytest.approx(0.98261, rel=2e-3)


def test_a_clear_sky_has_the_median_luminance_it_is_exposed_for():
    points = directions(128)[:64]
    bright = _luminance(sky.clear_sky(points, _WEATHER)).ravel()
    weight = np.sqrt(1.0 - points[..., 2].ravel() ** 2)
    darker = weight[bright < 0.33].sum() / weight.sum()
    assert darker == pytest.approx(0.5, abs=0.02)


def test_the_sky_is_brightest_at_the_sun():
    points = directions(180)
    picture = sky.sky_of(points, _WEATHER)
    brightest = np.unravel_index(np.argmax(_luminance(picture)), picture.shape[:2])
    cosine = points[brightest] @ sky.sun_direction(_WEATHER)
    assert math.degrees(math.acos(min(cosine, 1.0))) < 2.0
    assert picture.max() == pytest.approx(sky.SUN_RADIANCE, rel=0.05)


def test_the_library_sees_the_sun_where_it_stands():
    environment = Environment(LinearTexture(jnp.asarray(sky.sky_of(directions(180), _WEATHER))))
    towards, origin = jnp.asarray(sky.sun_direction(_WEATHER)), jnp.zeros(3)
    assert np.all(environment_radiance(environment, origin, towards) > 0.7 * sky.SUN_RADIANCE)
    mirrored = towards * jnp.array([1.0, -1.0, 1.0])
    assert np.all(environment_radiance(environment, origin, mirrored) < 2.0)


def test_environments_are_bounded_exposed_and_without_seam(environments):
    assert len(environments) >= 3
    for name, picture in environments.items():
        assert picture.shape == (_ROWS, 2 * _ROWS, 3) and picture.dtype == np.float32, name
        assert np.all(np.isfinite(picture)) and np.all(picture >= 0.0), name
        assert picture.max() <= sky.SUN_RADIANCE, name
        upper, ground = _luminance(picture[: _ROWS // 2]), _luminance(picture[-32:-8])
        assert np.mean((upper > 0.1) & (upper < 1.0)) > 0.8, name
        assert ground.std() > 0.2 * ground.mean(), name
        top = np.median(picture[: _ROWS // 8], axis=(0, 1))
        assert top[2] > 1.3 * top[0], name  # blue
        steps = np.abs(np.roll(picture, -1, axis=1) - picture).mean((0, 2))
        assert steps[-1] < 1.5 * np.quantile(steps[:-1], 0.9), name


def test_wrong_input_is_told():
    with pytest.raises(ValueError, match=r"no environment 'moon'\. Choose from meadow"):
        make_environment("moon", 64)
    with pytest.raises(ValueError, match=r"is too small\. Request 16"):
        make_environment("lake", 8)
    for changes in ({"elevation": -0.1}, {"turbidity": 1.0}):
        with pytest.raises(ValueError, match="no sky for a sun at"):
            sky.clear_sky(directions(16), _WEATHER._replace(**changes))
