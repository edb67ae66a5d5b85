"""Lens models against COLMAP's equations, which are written here once more."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import root

from experiments.captures import colmap, lenses
from experiments.captures.lenses import BORDER, FOLD, LIMIT, Distortion, Intrinsics, Lens

_SIZE = (640, 480)
_CASES = {
    "SIMPLE_PINHOLE": (500.0, 310.0, 250.0),
    "PINHOLE": (500.0, 520.0, 310.0, 250.0),
    "SIMPLE_RADIAL": (500.0, 310.0, 250.0, -0.13),
    "RADIAL": (500.0, 310.0, 250.0, -0.13, 0.04),
    "OPENCV": (500.0, 520.0, 310.0, 250.0, -0.13, 0.04, 0.003, -0.002),
    "OPENCV_FISHEYE": (400.0, 410.0, 310.0, 250.0, 0.02, -0.01, 0.004, -0.002),
    "FULL_OPENCV": (500.0, 520.0, 310.0, 250.0, 0.3, 0.1, 1e-3, 2e-3, 0.02, 0.4, 0.05, 0.01),
    "SIMPLE_RADIAL_FISHEYE": (400.0, 310.0, 250.0, 0.03),
    "RADIAL_FISHEYE": (400.0, 310.0, 250.0, 0.03, -0.01),
}


def _project(model, parameters, u, v):
    """COLMAP's `ImgFromCam`, of models.h, one point in double precision."""
    if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"):
        fx, fy, cx, cy, *extra = parameters
    else:
        fx, cx, cy, *extra = parameters
        fy = fx
    u2, uv, v2 = u * u, u * v, v * v
    r2 = u2 + v2
    r = math.sqrt(r2)
    du = dv = 0.0
    if model == "SIMPLE_RADIAL":
        du, dv = u * extra[0] * r2, v * extra[0] * r2
    elif model == "RADIAL":
        radial = extra[0] * r2 + extra[1] * r2 * r2
        du, dv = u * radial, v * radial
    elif model == "OPENCV":
        k1, k2, p1, p2 = extra
        radial = k1 * r2 + k2 * r2 * r2
        du = u * radial + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u2)
        dv = v * radial + 2.0 * p2 * uv + p1 * (r2 + 2.0 * v2)
    elif model == "FULL_OPENCV":
        k1, k2, p1, p2, k3, k4, k5, k6 = extra
        r4, r6 = r2 * r2, r2 * r2 * r2
        radial = (1.0 + k1 * r2 + k2 * r4 + k3 * r6) / (1.0 + k4 * r2 + k5 * r4 + k6 * r6)
        du = u * radial + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u2) - u
        dv = v * radial + 2.0 * p2 * uv + p1 * (r2 + 2.0 * v2) - v
    elif model.endswith("FISHEYE") and r > 1e-15:
        theta = math.atan2(r, 1.0)
        powers = sum(k * theta ** (2 * (i + 1)) for i, k in enumerate(extra))
        bent = theta * (1.0 + powers)
        du, dv = u * bent / r - u, v * bent / r - v
    return fx * (u + du) + cx, fy * (v + dv) + cy


def _lens(model):
    return colmap.lens_of(model, _SIZE, list(_CASES[model]), Path("cameras.txt"))


@pytest.mark.parametrize("model", _CASES)
def test_pixels_are_those_of_colmaps_equations(model):
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    points[0] = 0.0
    found = lenses.to_pixels(_lens(model), points)
    expected = [_project(model, _CASES[model], *map(float, point)) for point in points]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", _CASES)
def test_the_direction_that_a_pixel_shows_is_shown_there(model):
    lens = _lens(model)
    for pixel in np.random.default_rng(1).uniform((40, 40), (600, 440), (20, 2)):

        def off(point, pixel=pixel):
            return np.array(_project(model, _CASES[model], *point)) - pixel

        towards = root(off, (pixel - (310.0, 250.0)) / 500.0, tol=1e-13).x
        np.testing.assert_allclose(lenses.to_pixels(lens, towards), pixel, atol=1e-8)


def test_a_fisheye_is_regular_on_its_axis():
    lens = _lens("OPENCV_FISHEYE")
    radii = np.array([0.0, 1e-300, 1e-160, 1e-12, 1e-9, 1e-8])
    points = np.stack([radii, np.zeros_like(radii)], axis=-1)
    moved = lenses.distort(lens.distortion, points)
    np.testing.assert_allclose(moved, points, rtol=1e-15, atol=0.0)
    np.testing.assert_allclose(
        lenses.slopes(lens, points), [np.diag([400.0, 410.0])] * 6, rtol=1e-6
    )


def test_slopes_of_one_radial_coefficient_by_hand():
    k, lens = -0.13, _lens("SIMPLE_RADIAL")
    u, v = 0.4, -0.3
    across = 2 * k * u * v
    expected = 500.0 * np.array(
        [[1 + k * 0.25 + 2 * k * u * u, across], [across, 1 + k * 0.25 + 2 * k * v * v]]
    )
    np.testing.assert_allclose(lenses.slopes(lens, np.array([u, v])), expected, atol=1e-6)


def _radial(k1, *, focal=500.0, size=_SIZE):
    middle = (0.5 * size[0], 0.5 * size[1])
    return Lens(Intrinsics(focal, focal, *middle, *size), Distortion(radial=(k1,)))


def test_a_pinholes_field_of_view_is_its_own():
    found = lenses.extent(_radial(0.0), np.zeros(2), np.array([0.64, 0.48]), most=2.0)
    assert found.end == BORDER and found.factor == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize("k1", [-0.2, 0.3])
def test_the_widest_rectangle_within_a_radial_lens_by_hand(k1):
    # The middle of the long side leaves the image first (barrel), or the corner (cushion).
    found = lenses.extent(_radial(k1), np.zeros(2), np.array([0.64, 0.48]), most=2.0)
    reach = 0.64 * found.factor
    squared = reach**2 if k1 < 0.0 else reach**2 + (0.48 * found.factor) ** 2
    sides = {0: reach, 1: 0.48 * found.factor}
    worst = max(
        sides[axis] * (1.0 + k1 * (sides[axis] ** 2 if k1 < 0.0 else squared)) / (0.64, 0.48)[axis]
        for axis in (0, 1)
    )
    assert found.end == BORDER and worst == pytest.approx(1.0, abs=1e-7)


def test_a_lens_that_folds_inside_its_image_is_found():
    # r (1 + k r^2) turns around at r = 1 / sqrt(-3 k) = 0.6086, inside of 0.8.
    found = lenses.extent(_radial(-0.9), np.zeros(2), np.array([0.8, 0.6]), most=2.0)
    assert found.end == FOLD
    assert found.factor == pytest.approx(1.0 / math.sqrt(2.7), abs=1e-6)
    # In an image that ends before, the same lens is used.
    near = _radial(-0.9, size=(300, 200))
    assert lenses.extent(near, np.zeros(2), np.array([0.3, 0.2]), most=2.0).end == BORDER


def test_a_pole_of_the_rational_model_is_a_fold():
    known = Intrinsics(500.0, 500.0, 3200.0, 2400.0, 6400, 4800)
    lens = Lens(known, Distortion(radial=(0.0, 0.0, 0.0, -1.2)))
    found = lenses.extent(lens, np.zeros(2), np.array([0.8, 0.6]), most=1.7)
    assert found.end in (FOLD, BORDER) and found.factor < 1.0 / math.sqrt(1.2)


def test_a_wide_fisheye_is_cut_at_the_widest_pinhole():
    known = Intrinsics(200.0, 200.0, 500.0, 500.0, 1000, 1000)
    found = lenses.extent(Lens(known, Distortion(True)), np.zeros(2), np.ones(2), most=1.7)
    assert found == (1.7, LIMIT)


def test_a_distortion_is_described_by_what_it_has():
    assert Distortion().describe() == "none" and Distortion().is_none
    fish = Distortion(True, (0.0, -0.25))
    assert fish.describe() == "fisheye, k2 = -0.25" and not fish.is_none
    assert not Distortion(tangential=(0.0, 1e-4)).is_none
