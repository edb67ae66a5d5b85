import itertools

import numpy as np
import pytest

from refref_jax.data.batches import PixelSampler
from refref_jax.geometry.cameras import orbit, pixel_rays

_FRAMES, _HEIGHT, _WIDTH, _BATCH = 3, 4, 5, 8

# 60 pixels make 7 whole batches of 8; four pixels that come twice fill up the eighth.
_PIXELS = _FRAMES * _HEIGHT * _WIDTH
_STEPS = -(-_PIXELS // _BATCH)


def _cameras():
    cameras = orbit(_FRAMES, distance=4.0, elevation=0.3, size=_WIDTH, angle_x=1.0)
    return cameras._replace(height=_HEIGHT)


def _sampler(seed=1, batch=_BATCH):
    """A sampler of images whose red is the number of the pixel."""
    number = np.arange(_PIXELS, dtype=np.uint8)
    images = np.stack([number, 255 - number, number // 2], axis=-1)
    images = images.reshape(_FRAMES, _HEIGHT, _WIDTH, 3)
    return PixelSampler(images, _cameras(), seed=seed, batch=batch)


def _draw(sampler, first, steps):
    return sampler.draw(sampler.numbers(first, steps))


def _numbers(batch):
    return batch.rgb[..., 0].astype(np.int64)


def _assert_same(one, other):
    for left, right in zip((*one.rays, one.rgb), (*other.rays, other.rgb), strict=True):
        np.testing.assert_array_equal(left, right)


def test_earlier_draws_do_not_matter():
    sampler = _sampler()
    later = _draw(sampler, 4 * _STEPS, 3)
    earlier = _draw(sampler, 0, 3)
    _assert_same(earlier, _draw(_sampler(), 0, 3))
    _assert_same(later, _draw(sampler, 4 * _STEPS, 3))


def test_a_draw_may_cross_the_end_of_an_epoch():
    sampler = _sampler()
    across = _draw(sampler, _STEPS - 2, 4)
    assert across.rgb.shape == (4, _BATCH, 3)
    for position, step in enumerate(range(_STEPS - 2, _STEPS + 2)):
        np.testing.assert_array_equal(across.rgb[position], _draw(_sampler(), step, 1).rgb[0])


@pytest.mark.parametrize("epoch", [0, 1, 1000])
def test_an_epoch_shows_every_pixel_and_few_of_them_twice(epoch):
    numbers = _numbers(_draw(_sampler(), epoch * _STEPS, _STEPS))
    counts = np.bincount(numbers.ravel(), minlength=_PIXELS)
    assert counts.min() == 1 and counts.max() == 2
    assert np.sum(counts == 2) == _STEPS * _BATCH - _PIXELS == 4


def test_epochs_see_the_same_batches_in_orders_of_their_own():
    sampler = _sampler()
    epochs = [_numbers(_draw(sampler, epoch * _STEPS, _STEPS)) for epoch in range(6)]
    for one, other in itertools.pairwise(epochs):
        assert np.any(one != other)
        assert set(map(tuple, one)) == set(map(tuple, other))


def test_seeds_differ():
    assert np.any(_draw(_sampler(seed=1), 0, 1).rgb != _draw(_sampler(seed=2), 0, 1).rgb)


def test_a_seed_s_second_epoch_is_not_the_next_seed_s_first():
    second = _draw(_sampler(seed=1), _STEPS, _STEPS)
    assert np.any(second.rgb != _draw(_sampler(seed=2), 0, _STEPS).rgb)


def test_rays_and_colours_belong_to_one_pixel():
    drawn = _draw(_sampler(), 3, 20)
    number = _numbers(drawn)
    frame, row, column = number // 20, number // 5 % 4, number % 5
    expected = pixel_rays(_cameras(), frame, row, column)
    assert drawn.rays.origins.shape == (20, _BATCH, 3)
    for left, right in zip(drawn.rays, expected, strict=True):
        np.testing.assert_array_equal(left, right)
    np.testing.assert_array_equal(drawn.rgb[..., 1], 255 - number)


def test_a_batch_may_be_all_pixels():
    sampler = _sampler(batch=_PIXELS)
    assert sampler.batches == 1
    numbers = _numbers(_draw(sampler, 0, 2))
    np.testing.assert_array_equal(np.sort(numbers, axis=1), np.tile(np.arange(_PIXELS), (2, 1)))


def test_a_batch_larger_than_the_data():
    with pytest.raises(ValueError, match=r"batch of 61 .* 60\. Use a smaller batch\."):
        _sampler(batch=_PIXELS + 1)


def test_a_survey_is_always_the_same():
    sampler = _sampler()
    survey = sampler.survey(200)
    _draw(sampler, 7, 2)
    assert survey.rgb.shape == (200, 3)
    _assert_same(survey, sampler.survey(200))
    _assert_same(survey, _sampler(seed=9, batch=2).survey(200))
    assert len(np.unique(_numbers(survey))) > _PIXELS // 2


def test_only_kept_pixels_are_drawn():
    kept = np.zeros((_FRAMES, _HEIGHT, _WIDTH), bool)
    kept[1:, 1:3] = True
    plain = _sampler()
    images = plain.look_up(np.arange(_PIXELS)).rgb.reshape(_FRAMES, _HEIGHT, _WIDTH, 3)
    sampler = PixelSampler(images, _cameras(), seed=1, batch=_BATCH, kept=kept)
    assert sampler.batches == 3
    seen = _numbers(_draw(sampler, 0, sampler.batches))
    np.testing.assert_array_equal(np.unique(seen), np.flatnonzero(kept))
    surveyed = np.unique(_numbers(sampler.survey(200)))
    np.testing.assert_array_equal(surveyed, np.flatnonzero(kept))


def test_too_few_kept_pixels_are_refused():
    kept = np.zeros((_FRAMES, _HEIGHT, _WIDTH), bool)
    kept[0, 0] = True
    images = np.zeros((_FRAMES, _HEIGHT, _WIDTH, 3), np.uint8)
    with pytest.raises(ValueError, match="Only 5 pixels are left"):
        PixelSampler(images, _cameras(), seed=1, batch=_BATCH, kept=kept)
