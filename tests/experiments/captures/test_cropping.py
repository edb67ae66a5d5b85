import numpy as np
import pytest

from experiments.captures.cropping import centred_windows


@pytest.mark.parametrize(
    ("centres", "size", "starts", "kept", "shift"),
    [
        ([6.0], 12, [0], 12, 0.0),  # centred: all of it
        ([6.2], 12, [0], 12, 0.2),  # a fifth of a pixel costs nothing
        ([6.4], 12, [1], 11, 0.1),  # a column from the left, and half a pixel is gained
        ([5.0], 12, [0], 10, 0.0),
        ([8.5], 12, [5], 7, 0.0),
        ([5.0, 7.0], 12, [0, 2], 10, 0.0),  # of one size, at different places
        ([6.0, 6.5], 12, [0, 0], 12, 0.5),
    ],
)
def test_by_hand(centres, size, starts, kept, shift):
    windows = centred_windows(np.array(centres), size)
    assert (windows.starts.tolist(), windows.size) == (starts, kept)
    assert windows.shift == pytest.approx(shift)


def test_no_window_leaves_its_image_or_is_off_by_more_than_half_a_pixel():
    rng = np.random.default_rng(0)
    for _ in range(200):
        size = int(rng.integers(8, 60))
        centres = size * rng.uniform(0.3, 0.7, rng.integers(1, 5))
        windows = centred_windows(centres, size)
        assert windows.starts.min() >= 0 and windows.starts.max() + windows.size <= size
        middles = windows.starts + 0.5 * windows.size
        assert np.abs(middles - centres).max() == pytest.approx(windows.shift)
        assert windows.shift <= 0.5
        # Nothing larger by two would have done: the nearest principal point bounds it.
        nearest = np.minimum(centres, size - centres).min()
        assert windows.size + 2 > 2.0 * nearest - 1.0


def test_one_image_is_never_off_by_more_than_a_quarter():
    for centre in np.linspace(4.0, 8.0, 41):
        assert centred_windows(np.array([centre]), 12).shift <= 0.25 + 1e-12
