"""FLIP is the number that its authors' program gives."""

import sys

import numpy as np
import pytest

from refref_jax import metrics
from refref_jax.data import image_files

flip_evaluator = pytest.importorskip("flip_evaluator")


def _images(shape=(24, 31, 3)):
    rendered, target = np.random.default_rng(0).uniform(size=(2, *shape))
    # As smooth as pictures are, and of 8 bits.
    return np.round(255.0 * (0.3 * rendered + 0.7 * target)) / 255.0, np.round(255 * target) / 255.0


def test_it_is_what_the_program_says_of_the_same_files(tmp_path):
    rendered, target = _images()
    image_files.write_rgb(tmp_path / "rendered.png", rendered)
    image_files.write_rgb(tmp_path / "target.png", target)
    names = (str(tmp_path / "target.png"), str(tmp_path / "rendered.png"))
    _, expected, settings = flip_evaluator.evaluate(*names, "LDR")
    assert settings["ppd"] == pytest.approx(0.7 * 3840 / 0.7 * np.pi / 180, rel=1e-5)
    assert 0.05 < expected < 1.0
    assert metrics.flip(rendered, target) == pytest.approx(expected, abs=1e-6)


def test_precision_and_layout_of_the_arrays_do_not_matter():
    rendered, target = _images()
    expected = metrics.flip(rendered, target)
    single = (np.asfortranarray(image.astype(np.float32)) for image in (rendered, target))
    assert metrics.flip(*single) == pytest.approx(expected, abs=1e-6)


def test_equal_images_do_not_differ_and_unlike_ones_do():
    rendered, target = _images()
    assert metrics.flip(target, target) == 0.0
    black, white = np.zeros_like(target), np.ones_like(target)
    assert metrics.flip(rendered, target) < metrics.flip(black, white) <= 1.0


def test_a_single_pixel_has_a_value():
    assert 0.0 < metrics.flip(np.zeros((1, 1, 3)), np.ones((1, 1, 3))) <= 1.0


def test_without_the_program_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(ValueError, match=r"pip install -e '.\[flip\]'"):
        metrics.flip(*_images())
