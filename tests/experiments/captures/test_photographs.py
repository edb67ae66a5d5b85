"""Photographs of 8 and 16 bits and EXR, as linear light."""

import numpy as np
import pytest

from experiments.captures import photographs
from refref_jax.data import SceneError, image_files
from tests.factories.png_files import write_sixteen_bits


@pytest.mark.parametrize("shape", [(7, 9), (7, 9, 3), (7, 9, 4)])
def test_all_sixteen_bits_are_read(tmp_path, shape):
    pixels = np.random.default_rng(0).integers(0, 1 << 16, shape).astype(np.uint16)
    path = write_sixteen_bits(tmp_path / "deep.png", pixels)
    assert not photographs.is_plain(path)
    np.testing.assert_array_equal(photographs.read_sixteen_bits(path), pixels)


def test_sixteen_bits_are_linear_light_to_sixteen_bits(tmp_path):
    ramp = np.arange(0, 1 << 16, 257, dtype=np.uint16)[None, :, None].repeat(3, axis=-1)
    linear = photographs.read_linear(write_sixteen_bits(tmp_path / "deep.png", ramp + 100))
    encoded = (ramp[0, :, 0] + 100).clip(0, 65535) / 65535.0
    # IEC 61966-2-1, in double precision.
    low, high = encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4
    expected = np.where(encoded > 0.04045, high, low)
    np.testing.assert_allclose(linear[0, :-1, 1], expected[:-1], rtol=1e-5)


def test_opacity_of_sixteen_bits_is_composited_over_white(tmp_path):
    pixels = np.full((2, 2, 4), (65535, 0, 32768, 16384), np.uint16)
    linear = photographs.read_linear(write_sixteen_bits(tmp_path / "deep.png", pixels))
    plain = np.full((2, 2, 4), (255, 0, 128, 64), np.uint8)
    image_files.write_png(tmp_path / "plain.png", plain)
    np.testing.assert_allclose(linear, photographs.read_linear(tmp_path / "plain.png"), atol=0.01)


def test_eight_bits_come_back_as_they_were(tmp_path):
    pixels = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=-1)
    image_files.write_png(tmp_path / "plain.png", pixels)
    assert photographs.is_plain(tmp_path / "plain.png")
    linear = photographs.read_linear(tmp_path / "plain.png")
    np.testing.assert_array_equal(photographs.to_srgb(linear), pixels)


def test_exr_is_linear_and_clipped_at_white(tmp_path):
    pixels = np.array([[[0.0, 0.5, 1.0], [2.0, -0.5, 0.18]]], np.float32)
    image_files.write_exr(tmp_path / "light.exr", pixels)
    linear = photographs.read_linear(tmp_path / "light.exr")
    np.testing.assert_array_equal(linear, pixels)
    assert photographs.to_srgb(linear).tolist() == [[[0, 188, 255], [255, 0, 118]]]
    image_files.write_exr(tmp_path / "grey.exr", pixels[..., 1])
    assert photographs.read_linear(tmp_path / "grey.exr").shape == (1, 2, 3)


def test_files_that_cannot_be_read_are_named(tmp_path):
    path = write_sixteen_bits(tmp_path / "deep.png", np.zeros((20, 20, 3), np.uint16))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SceneError, match=r"deep\.png cannot be read.*copy it again"):
        photographs.read_linear(path)
    write_sixteen_bits(tmp_path / "opaque.png", np.zeros((4, 4, 2), np.uint16))
    with pytest.raises(SceneError, match=r"opaque\.png has 16 bits and opacity, but no colour"):
        photographs.read_linear(tmp_path / "opaque.png")
    image_files.write_exr(tmp_path / "light.exr", np.full((2, 2, 3), np.nan, np.float32))
    with pytest.raises(SceneError, match=r"light\.exr has values that are not finite"):
        photographs.read_linear(tmp_path / "light.exr")
