"""Resampling into one pinhole, with patterns that are known in closed form."""

import math

import numpy as np
import pytest
from scipy.optimize import fsolve

from experiments.captures import lenses, photographs, resampling
from experiments.captures.lenses import Distortion, Intrinsics, Lens
from experiments.captures.resampling import Frame, Pinhole
from refref_jax.data import SceneError

_NONE = Distortion()
_BARREL = Distortion(radial=(-0.25, 0.05), tangential=(2e-3, -1e-3))
_CUSHION = Distortion(radial=(0.2,))
_FISHEYE = Distortion(True, (0.05, -0.02, 0.003))


def _frame(distortion=_NONE, *, size=(120, 90), focal=(110.0, 110.0), centre=None, turned=False):
    centre = (0.5 * size[0], 0.5 * size[1]) if centre is None else centre
    return Frame("photo.png", Lens(Intrinsics(*focal, *centre, *size), distortion), turned)


def _pattern(points, *, period=0.12):
    """Linear light of three gratings on the plane at distance 1, in [0, 1]."""
    angles = np.array([0.3, 1.4, 2.5])
    along = points[..., :1] * np.cos(angles) + points[..., 1:] * np.sin(angles)
    return 0.5 + 0.45 * np.cos(2.0 * np.pi * along / period)


def _photograph(frame, **options):
    """What the lens shows of the pattern: the direction of each pixel by a solver."""
    known = frame.lens.intrinsics
    columns, rows = np.meshgrid(np.arange(known.width) + 0.5, np.arange(known.height) + 0.5)
    pixels = np.stack([columns, rows], axis=-1)
    start = (pixels - known[2:4]) / known[:2]
    if frame.lens.distortion.is_none:
        return _pattern(start, **options).astype(np.float32)

    def off(flat):
        return (lenses.to_pixels(frame.lens, flat.reshape(-1, 2)) - target).ravel()

    found = np.empty_like(start)
    for row in range(known.height):
        for column in range(known.width):
            target = pixels[row, column]
            guess = start[row, column] if column == 0 else found[row, column - 1] + 1 / known[0]
            found[row, column] = fsolve(off, guess, xtol=1e-10)
    return _pattern(found, **options).astype(np.float32)


def _expected(pinhole, **options):
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    middle = 0.5 * np.array([pinhole.width, pinhole.height])
    return _pattern((np.stack([columns, rows], axis=-1) - middle) / pinhole.focal, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "distortion",
    [_BARREL, _CUSHION, _FISHEYE],
    ids=["barrel", "cushion", "fisheye"],
)
def test_a_known_pattern_comes_back_without_its_distortion(distortion):
    frame = _frame(distortion, size=(60, 44), focal=(55.0, 56.0), centre=(30.4, 21.7))
    shared = resampling.share([frame])
    assert not shared.exact and shared.kept[0] > 0.75
    found = resampling.resample(_photograph(frame, period=0.2), frame, shared.pinhole)
    error = found - _expected(shared.pinhole, period=0.2)
    # Periods of 11 pixels; errors are largest at the border, where pixels continue.
    assert np.abs(error).max() < 0.03 and np.sqrt(np.mean(error**2)) < 0.004


def test_where_nothing_is_to_be_done_pixels_are_kept():
    frames = [_frame(), _frame()]
    shared = resampling.share(frames)
    assert shared.exact and shared.pinhole == Pinhole(120, 90, 110.0) and shared.narrowest
    # Resampling would change nothing either.
    photograph = _photograph(frames[0])
    found = resampling.resample(photograph, frames[0], shared.pinhole)
    np.testing.assert_allclose(found, photograph, atol=1e-6)
    assert not resampling.share([_frame(), _frame(centre=(60.02, 45.0))]).exact
    assert resampling.share([_frame(), _frame(centre=(60.005, 45.0))]).exact


def test_a_principal_point_off_the_middle_is_moved_there():
    frame = _frame(centre=(53.0, 45.5))
    shared = resampling.share([frame])
    assert shared.pinhole == Pinhole(106, 89, 110.0)
    found = resampling.resample(_photograph(frame), frame, shared.pinhole)
    np.testing.assert_allclose(found, _expected(shared.pinhole), atol=0.002)
    assert shared.kept[0] == pytest.approx(106 * 89 / (120 * 90))


def test_sizes_focal_lengths_and_formats_at_once():
    frames = [
        _frame(),
        _frame(size=(240, 180), focal=(220.0, 220.0)),
        _frame(size=(120, 90), focal=(100.0, 104.0)),
        _frame(size=(90, 120), turned=True),
    ]
    assert resampling.turns([frame.lens for frame in frames]) == [False, False, False, True]
    shared = resampling.share(frames)
    assert shared.pinhole == Pinhole(120, 90, 110.0)  # the first has the narrowest field of view
    for frame in frames[:3]:
        found = resampling.resample(_photograph(frame, period=0.15), frame, shared.pinhole)
        expected = _expected(shared.pinhole, period=0.15)
        # An image that is finer is averaged over each pixel, which takes 3 % of the contrast.
        assert np.abs(found - expected)[2:-2, 2:-2].max() < 0.03
    turned = resampling.resample(_photograph(frames[3]), frames[3], shared.pinhole)
    np.testing.assert_allclose(turned, np.rot90(_photograph(frames[3]), -1), atol=1e-5)


def test_a_turned_camera_sees_the_same_directions():
    frame = _frame(_BARREL, size=(90, 120), turned=True)
    pinhole = resampling.share([frame]).pinhole
    x, y = 0.21, -0.13  # y up
    ahead = np.array([x, y, -1.0])
    pixel = np.array([x, -y]) * pinhole.focal + 0.5 * np.array([pinhole.width, pinhole.height])
    there = resampling.TURN @ ahead  # in the frame of the photograph's camera
    seen = lenses.to_pixels(frame.lens, np.array([there[0], -there[1]]) / -there[2])
    rows, columns = np.meshgrid(np.arange(120.0), np.arange(90.0), indexing="ij")
    ramps = np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(np.float32)
    found = resampling.resample(ramps, frame, pinhole)
    at = resampling.interpolate(found, pixel[None, None])
    np.testing.assert_allclose(at[0, 0], seen, atol=0.01)


def test_what_is_finer_is_averaged_in_linear_light():
    board = np.indices((180, 240)).sum(axis=0) % 2
    fine = np.repeat(board[..., None].astype(np.float32), 3, axis=-1)
    frame = _frame(size=(240, 180), focal=(220.0, 220.0))
    shared = resampling.share([frame], width=60)
    assert shared.pinhole == pytest.approx((60, 45, 55.0), rel=1e-9)
    assert resampling.points_per_side(frame, shared.pinhole) == 4
    found = resampling.resample(fine, frame, shared.pinhole)
    np.testing.assert_allclose(found, 0.5, atol=1e-5)
    assert set(np.unique(photographs.to_srgb(found))) == {188}


def test_the_cubic_is_exact_for_quadratics():
    rows, columns = np.meshgrid(np.arange(12.0), np.arange(15.0), indexing="ij")

    def value(x, y):
        return 0.3 + 0.1 * x - 0.02 * y * y + 0.01 * x * y + 0.005 * x * x

    image = value(columns + 0.5, rows + 0.5)[..., None].astype(np.float32)
    places = np.random.default_rng(0).uniform((2, 2), (12, 9), (5, 7, 2))
    found = resampling.interpolate(image, places)[..., 0]
    np.testing.assert_allclose(found, value(places[..., 0], places[..., 1]), atol=1e-5)


def test_how_sharp_an_interpolated_image_stays():
    """The contrast of gratings half a pixel off, against Keys' closed form."""
    for period in (4, 8, 16):
        x = np.arange(64) + 0.5
        line = np.cos(2.0 * np.pi * x / period)
        image = np.broadcast_to(line, (8, 64))[..., None].astype(np.float32)
        at = np.stack(np.meshgrid(np.arange(8, 56) + 1.0, np.full(1, 4.0)), axis=-1)
        found = resampling.interpolate(image, at)[0, :, 0]
        w = math.pi / period
        gain = (9.0 * math.cos(w) - math.cos(3.0 * w)) / 8.0
        expected = gain * np.cos(2.0 * np.pi * at[0, :, 0] / period)
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert gain > {4: 0.88, 8: 0.99, 16: 0.999}[period]


def test_masks_are_resampled_like_images():
    frame = _frame(_BARREL)
    shared = resampling.share([frame])
    rows, columns = np.indices((90, 120)) + 0.5
    disc = (columns - 60.0) ** 2 + (rows - 45.0) ** 2 < 20.0**2
    found = resampling.resample_mask(disc, frame, shared.pinhole)
    rows = np.arange(shared.pinhole.height)
    places = resampling._places(frame, shared.pinhole, rows, np.full(2, 0.5))
    distance = np.linalg.norm(places - (60.0, 45.0), axis=-1)
    assert np.all(found[distance < 19.2]) and not np.any(found[distance > 20.8])
    assert found.sum() == pytest.approx(np.sum(distance < 20.0), rel=0.02)
    small = resampling.share([frame], width=30)
    coarse = resampling.resample_mask(disc, frame, small.pinhole)
    assert coarse.mean() == pytest.approx(found.mean(), rel=0.05)


def test_lenses_that_fold_inside_their_image_are_refused():
    with pytest.raises(SceneError, match=r"photo\.png folds at most 3\d degrees.*k1 = -0\.9\."):
        resampling.share([_frame(Distortion(radial=(-0.9,)), focal=(60.0, 60.0))])


def test_photographs_of_which_little_is_left_are_refused():
    narrow = _frame(focal=(440.0, 440.0))._replace(name="zoomed.png")
    with pytest.raises(SceneError, match=r"shows 6% of photo\.png, since zoomed\.png sees little"):
        resampling.share([_frame(), narrow, _frame()])


@pytest.mark.slow
def test_every_pixel_is_inside_of_every_photograph():
    rng = np.random.default_rng(0)
    for _ in range(12):
        radial = tuple(rng.uniform(-0.2, 0.2, 2))
        frames = [
            _frame(
                Distortion(bool(number % 2), radial),
                focal=tuple(rng.uniform(90, 140, 2)),
                centre=tuple(rng.uniform((55, 40), (65, 50))),
            )
            for number in range(3)
        ]
        pinhole = resampling.share(frames).pinhole
        corners = np.array([(0.0, 0.0), (1.0, 1.0)])
        for frame in frames:
            for corner in corners:
                places = resampling._places(frame, pinhole, np.arange(pinhole.height), corner)
                assert places.min() > -0.01
                assert np.all(places < np.array([120.01, 90.01]))


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_extremes_stay_what_they_are(value):
    frame = _frame(_FISHEYE)
    pinhole = resampling.share([frame]).pinhole
    photograph = np.full((90, 120, 3), value, np.float32)
    found = resampling.resample(photograph, frame, pinhole)
    np.testing.assert_allclose(found, value, atol=1e-6)
