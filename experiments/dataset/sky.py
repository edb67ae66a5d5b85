"""Daylight: a clear sky, its sun, and clouds (NumPy only).

Source: Preetham, Shirley and Smits, A practical analytic model for daylight (SIGGRAPH 1999),
appendix A.2: Perez's distribution of luminance Y and chromaticity x, y over the dome, as a function
of the sun's position and the turbidity `T` of the air (2 clear, 6 hazy). `theta` is the angle from
the zenith, `gamma` the angle from the sun. Colours are linear RGB with the primaries of sRGB.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.dataset.textures.fields import Field, Picture, blend, smooth
from experiments.dataset.textures.sphere_fields import Directions, directions, fbm3

SUN_RADIANCE = 12.0
"""The largest radiance of any environment: the sun's centre.

The real sun is 1e5 times as bright as the sky, which would make the pixels of a glass object noisy.
"""

_SUN_WIDTH = math.radians(1.6)
_AUREOLE_WIDTH = math.radians(7.0)

_EXPOSED = 0.33  # median luminance of the upper half
_ROWS_OF_EXPOSURE = 64

# Perez's A to E, each a + b T.
_OF_LUMINANCE = (
    (-1.4630, 0.1787),
    (0.4275, -0.3554),
    (5.3251, -0.0227),
    (-2.5771, 0.1206),
    (0.3703, -0.0670),
)
_OF_X = (
    (-0.2592, -0.0193),
    (0.0008, -0.0665),
    (0.2125, -0.0004),
    (-0.8989, -0.0641),
    (0.0452, -0.0033),
)
_OF_Y = (
    (-0.2608, -0.0167),
    (0.0092, -0.0950),
    (0.2102, -0.0079),
    (-1.6537, -0.0441),
    (0.0529, -0.0109),
)

# Chromaticity of the zenith: rows T^2, T, 1; columns theta_sun^3, ^2, ^1, 1.
_ZENITH_X = (
    (0.00166, -0.00375, 0.00209, 0.0),
    (-0.02903, 0.06377, -0.03202, 0.00394),
    (0.11693, -0.21196, 0.06052, 0.25886),
)
_ZENITH_Y = (
    (0.00275, -0.00610, 0.00317, 0.0),
    (-0.04214, 0.08970, -0.04153, 0.00516),
    (0.15346, -0.26756, 0.06670, 0.26688),
)

# IEC 61966-2-1.
_RGB_OF_XYZ = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Luminance of linear R, G and B."""


class Weather(NamedTuple):
    """Parameters of a sky.

    Attributes:
      azimuth: azimuth of the sun, from +x towards +y, radians.
      elevation: elevation of the sun, radians, above 0.
      turbidity: turbidity of the air, 2 to 6.
      clouds: share of the sky covered by clouds, about 0 to 1.
      seed: seed of the clouds.
    """

    azimuth: float
    elevation: float
    turbidity: float
    clouds: float
    seed: int


def sun_direction(weather: Weather) -> Float[np.ndarray, "3"]:
    """Returns the unit vector towards the sun."""
    around = math.cos(weather.elevation)
    towards = (
        around * math.cos(weather.azimuth),
        around * math.sin(weather.azimuth),
        math.sin(weather.elevation),
    )
    return np.array(towards, np.float32)


def clear_sky(points: Directions, weather: Weather) -> Picture:
    """Returns the sky without sun and clouds, exposed so that its median luminance is 0.33.

    Below the horizon it continues with the colours at the horizon.

    Raises:
      ValueError: if the sun is not above the horizon, or the turbidity is not 2 to 10.
    """
    if not 0.0 < weather.elevation <= 0.5 * math.pi or not 2.0 <= weather.turbidity <= 10.0:
        raise ValueError(
            f"The model has no sky for a sun at {weather.elevation} rad and a turbidity of "
            f"{weather.turbidity}. Give an elevation above 0 and a turbidity of 2 to 10."
        )
    few = directions(_ROWS_OF_EXPOSURE)[: _ROWS_OF_EXPOSURE // 2]
    # Rows near the zenith have as many samples but cover less of the sky: weights are areas.
    weight = np.sqrt(1.0 - few[:, 0, 2] ** 2)
    bright = _preetham(few, weather) @ np.array(LUMINANCE, np.float32)
    median = _weighted_median(bright, np.broadcast_to(weight[:, None], bright.shape))
    return _preetham(points, weather) * np.float32(_EXPOSED / median)


def sky_of(points: Directions, weather: Weather) -> Picture:
    """Returns the sky with clouds and sun, at most `SUN_RADIANCE`."""
    sky = clear_sky(points, weather)
    density = _clouds(points, weather)
    # Clouds are darker where they are thicker towards the sun.
    to_sun = _clouds(points + 0.06 * sun_direction(weather), weather)
    cos_gamma = np.clip(points @ sun_direction(weather), -1.0, 1.0)
    silver = 0.9 + 0.9 * smooth(0.75, 1.0, cos_gamma)
    warm = math.exp(-4.0 * weather.elevation)
    lit = np.array([1.0, 0.97 - 0.22 * warm, 0.92 - 0.45 * warm], np.float32)
    shade = np.array([0.24, 0.28, 0.37], np.float32)
    turned_away = 0.30 + 1.6 * (to_sun - density) + 0.22 * density
    body = blend(lit * silver[..., None], shade, np.clip(turned_away, 0.0, 0.95))
    cover = smooth(0.0, 0.55, density) * smooth(0.0, 0.16, points[..., 2])
    sky = blend(sky, body, 0.92 * cover)
    return np.minimum(sky + _sun(cos_gamma, weather, cover), np.float32(SUN_RADIANCE))


def _sun(cos_gamma: Field, weather: Weather, cover: Field) -> Picture:
    """Returns the softened disc of the sun and its glow, dimmed by clouds."""
    gamma = np.arccos(cos_gamma)
    low = math.exp(-5.0 * weather.elevation)
    tone = np.array([1.0, 0.95 - 0.35 * low, 0.88 - 0.65 * low], np.float32)
    disc = SUN_RADIANCE * np.exp(-((gamma / _SUN_WIDTH) ** 4))
    aureole = 0.8 * np.exp(-gamma / _AUREOLE_WIDTH)
    return (disc + aureole * (1.0 - 0.5 * cover))[..., None] * tone


def _clouds(points: Directions, weather: Weather) -> Field:
    """Returns the density of clouds: cumulus on a layer seen from below."""
    up = np.maximum(points[..., 2:], 0.0) + np.float32(0.22)
    layer = np.concatenate([points[..., :2] / up, 0.15 / up], -1)
    heaps = fbm3(layer, 1.1, weather.seed, octaves=7, gain=0.56)
    return 0.55 * heaps + 1.3 * (weather.clouds - 0.5)


def _preetham(points: Directions, weather: Weather) -> Picture:
    """Returns linear RGB of the model; luminance in kcd/m2."""
    turbidity, theta_sun = weather.turbidity, 0.5 * math.pi - weather.elevation
    cos_theta = np.maximum(points[..., 2], np.float32(0.02))
    cos_gamma = np.clip(points @ sun_direction(weather), -1.0, 1.0)
    chi = (4.0 / 9.0 - turbidity / 120.0) * (math.pi - 2.0 * theta_sun)
    zenith = (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192
    powers_t = np.array([turbidity**2, turbidity, 1.0])
    powers_sun = np.array([theta_sun**3, theta_sun**2, theta_sun, 1.0])
    zeniths = (
        zenith,
        *(float(powers_t @ np.array(rows) @ powers_sun) for rows in (_ZENITH_X, _ZENITH_Y)),
    )
    luminance, x, y = (
        value
        * _perez(cos_theta, cos_gamma, rows, turbidity)
        / _perez(np.float32(1.0), np.float32(math.cos(theta_sun)), rows, turbidity)
        for value, rows in zip(zeniths, (_OF_LUMINANCE, _OF_X, _OF_Y), strict=True)
    )
    xyz = np.stack([x * luminance / y, luminance, (1.0 - x - y) * luminance / y], -1)
    # Colours outside the gamut of sRGB are clipped.
    return np.maximum(xyz @ np.array(_RGB_OF_XYZ, np.float32).T, 0.0).astype(np.float32)


def _perez(
    cos_theta: np.ndarray,
    cos_gamma: np.ndarray,
    rows: tuple[tuple[float, float], ...],
    turbidity: float,
) -> np.ndarray:
    a, b, c, d, e = (first + slope * turbidity for first, slope in rows)
    around = 1.0 + c * np.exp(d * np.arccos(cos_gamma)) + e * cos_gamma**2
    return (1.0 + a * np.exp(b / cos_theta)) * around


def _weighted_median(values: Field, weights: Field) -> float:
    order = np.argsort(values, axis=None)
    total = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(total, 0.5 * total[-1])])
