"""Residuals of images that are known functions of the pixel, displaced by known amounts."""

import numpy as np
import pytest
import scipy.ndimage

from experiments.runs import residuals
from experiments.runs.residuals import Motion, Residuals

_SIZE = 96
_ALL = np.ones((_SIZE, _SIZE), bool)


def _picture(row, column):
    """Returns a smooth image in [0, 1], whose slopes point in all directions."""
    waves = [(0.31, 0.12, 0.3), (-0.17, 0.37, 1.1), (0.23, -0.29, 2.0)]
    return np.stack(
        [0.5 + 0.3 * np.sin(a * column + b * row + c) * np.cos(0.2 * row) for a, b, c in waves], -1
    )


def _displaced(*, right=0.0, down=0.0, growth=0.0):
    """Returns a picture, and the same one displaced and magnified about the middle."""
    row, column = np.indices((_SIZE, _SIZE)).astype(np.float64)
    middle = 0.5 * (_SIZE - 1)
    # What is at a pixel of the displaced picture was elsewhere before.
    back = [middle + (x - middle) * (1.0 - growth) for x in (row, column)]
    return _picture(row, column), _picture(back[0] - down, back[1] - right)


@pytest.mark.parametrize(("right", "down"), [(0.3, -0.2), (-0.05, 0.0), (0.0, 0.6)])
def test_a_shift_is_found_to_first_order(right, down):
    found = residuals.motion(*_displaced(right=right, down=down), _ALL)
    np.testing.assert_allclose(found.shift, [right, down], rtol=0.06, atol=0.01)
    assert abs(found.growth * found.reach) < 0.02
    assert found.length == pytest.approx(np.hypot(right, down), rel=0.06, abs=0.01)


@pytest.mark.parametrize("growth", [0.01, -0.004])
def test_growth_is_found_and_is_no_shift(growth):
    found = residuals.motion(*_displaced(growth=growth), _ALL)
    assert found.growth == pytest.approx(growth, rel=0.08)
    assert found.length < 0.02


def test_equal_images_are_not_displaced():
    rendered, _ = _displaced()
    found = residuals.motion(rendered, rendered, _ALL)
    assert found.length == found.growth == found.deviation == 0.0


def test_the_deviation_is_that_of_noise():
    rendered, target = _displaced(right=0.2)
    draw, shifts, deviations = np.random.default_rng(3), [], []
    for _ in range(60):
        noisy = target + draw.normal(scale=0.05, size=target.shape)
        found = residuals.motion(rendered, noisy, _ALL)
        shifts.append(found.shift)
        deviations.append(found.deviation)
    true = np.sqrt(np.sum(np.var(shifts, axis=0)))
    # Blurred noise is not independent: the deviation is too small, by a factor that a blur of one
    # pixel bounds, and which the factor of certainty covers.
    assert 0.2 * true < np.median(deviations) < 1.2 * true
    assert np.linalg.norm(np.mean(shifts, axis=0) - [0.2, 0.0]) < 0.02


def _few(row, column):
    few = np.zeros((_SIZE, _SIZE), bool)
    few[:10, :10] = True
    return _picture(row, column), few


@pytest.mark.parametrize(
    "image",
    [
        lambda row, column: (np.full((*row.shape, 3), 0.5), _ALL),
        lambda row, column: (np.tile(0.5 + 0.4 * np.sin(0.3 * column)[..., None], 3), _ALL),
        _few,
    ],
    ids=["plain", "stripes", "few pixels"],
)
def test_what_says_nothing_is_unknown(image):
    rendered, among = image(*np.indices((_SIZE, _SIZE)).astype(np.float64))
    assert residuals.motion(rendered, rendered, among) is None


def test_a_motion_explains_displaced_images_and_not_other_faults():
    rendered, target = _displaced(right=0.3)
    assert residuals.motion(rendered, target, _ALL).explained > 0.99
    fault = 0.2 * np.random.default_rng(0).normal(size=target.shape)
    noisy = residuals.motion(rendered, target + scipy.ndimage.gaussian_filter(fault, 1.0), _ALL)
    assert 0.0 <= noisy.explained < 0.9
    assert residuals.motion(rendered, rendered, _ALL).explained == 0.0
    assert not residuals.warnings([Residuals(noisy._replace(explained=0.04), None, None, None)])
    assert residuals.warnings([Residuals(noisy._replace(explained=0.06), None, None, None)])


def test_inside_and_beside_are_apart():
    rendered, shifted = _displaced(right=0.4)
    mask = np.zeros((_SIZE, _SIZE), bool)
    mask[24:72, 24:72] = True
    target = np.where(mask[..., None], shifted, rendered)
    found = residuals.of_view(rendered, target, mask)
    assert found.beside.length < 0.01
    np.testing.assert_allclose(found.inside.shift, [0.4, 0.0], atol=0.02)
    assert residuals.of_view(rendered, target, None) == Residuals(None, None, None, None)


def test_exposure_and_white_balance_are_no_displacement():
    rendered, target = _displaced(right=0.3)
    found = residuals.motion(rendered, target * [0.8, 0.9, 1.1], _ALL)
    np.testing.assert_allclose(found.shift, [0.3, 0.0], atol=0.03)
    assert abs(found.growth * found.reach) < 0.03


def _motion(*, right=0.0, growth=0.0, deviation=0.001):
    return Motion(np.array([right, 0.0]), growth, deviation, 50.0)


def _views(beside, inside, *, rim=0.03, interior=0.02):
    return [Residuals(beside, inside, rim, interior)] * 3


@pytest.mark.parametrize(
    ("views", "words"),
    [
        (_views(_motion(), _motion()), None),
        ([], None),
        (_views(None, None, rim=None, interior=None), None),
        (_views(_motion(right=-0.3), _motion(right=2.0)), ["shifted by 0.30", "cameras"]),
        (_views(_motion(right=0.3, deviation=0.1), _motion()), None),
        (_views(_motion(growth=-0.01), _motion(growth=0.1)), ["smaller", "0.50", "background"]),
        (_views(_motion(right=0.06, growth=-0.01), _motion()), ["smaller", "background"]),
        (_views(_motion(), _motion(growth=0.01)), ["larger", "0.50", "index of refraction"]),
        (_views(_motion(), _motion(right=0.4)), ["shifted by 0.40", "experiments.align"]),
        (_views(_motion(), _motion(), rim=0.15), ["outline", "0.15", "masks"]),
        (_views(_motion(), _motion(), rim=0.15, interior=0.14), None),
    ],
)
def test_warnings_name_the_cause(views, words):
    found = residuals.warnings(views)
    assert bool(found) == (words is not None)
    for word in words or ():
        assert word in " ".join(found)


def test_an_object_that_is_too_large_and_moved_leads_to_both_warnings():
    found = residuals.warnings(_views(_motion(), _motion(right=0.3, growth=-0.01)))
    assert len(found) == 2 and "size of the object" in found[0] and "place" in found[1]
