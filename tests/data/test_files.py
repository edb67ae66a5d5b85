import struct
import zlib

import imageio.v3 as iio
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from refref_jax.data import image_files
from tests.factories.small_scenes import png_chunk
from tests.laws.expectations import scene_error


def _save(path, pixels, mode=None):
    image = Image.fromarray(np.asarray(pixels, np.uint8))
    (image if mode is None else image.convert(mode)).save(path)
    return path


def _save_exr(path, channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def _noise(*shape):
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


@pytest.fixture
def png(tmp_path):
    return tmp_path / "view_07.png"


@pytest.fixture
def exr(tmp_path):
    return tmp_path / "depth_07.exr"


def test_colour_is_read_as_it_is(png):
    pixels = _noise(3, 5, 3)
    np.testing.assert_array_equal(image_files.read_rgb(_save(png, pixels)), pixels)


@pytest.mark.parametrize(
    ("rgba", "rgb"),
    [
        ((10, 20, 30, 255), (10, 20, 30)),
        ((10, 20, 30, 0), (255, 255, 255)),
        # 51 / 255 is a fifth: 0.2 v + 0.8 * 255, rounded.
        ((3, 100, 255, 51), (205, 224, 255)),
        # Black at 128 / 255 leaves 127 of white.
        ((0, 0, 0, 128), (127, 127, 127)),
    ],
)
def test_transparency_goes_over_white(png, rgba, rgb):
    np.testing.assert_array_equal(image_files.read_rgb(_save(png, [[rgba]])), [[rgb]])


def test_grey_becomes_colour(png):
    grey = _noise(4, 3)
    np.testing.assert_array_equal(
        image_files.read_rgb(_save(png, grey)), np.stack([grey] * 3, axis=-1)
    )


def test_grey_with_transparency_goes_over_white(png):
    _save(png, [[[100, 255], [100, 0], [0, 51]]])
    np.testing.assert_array_equal(image_files.read_rgb(png), [[[100] * 3, [255] * 3, [204] * 3]])


def test_one_bit_image_becomes_black_and_white(png):
    _save(png, [[0, 255]], mode="1")
    np.testing.assert_array_equal(image_files.read_rgb(png), [[[0] * 3, [255] * 3]])


def test_palette_is_resolved(png):
    image = Image.fromarray(np.array([[0, 1, 2]], np.uint8)).convert("P")
    image.putpalette([0, 0, 0, 10, 20, 30, 255, 0, 128])
    image.save(png)
    np.testing.assert_array_equal(
        image_files.read_rgb(png), [[[0, 0, 0], [10, 20, 30], [255, 0, 128]]]
    )


@pytest.mark.parametrize(
    ("pixels", "mask"),
    [
        ([[0, 1], [128, 255]], [[False, True], [True, True]]),
        ([[[0, 0, 0], [0, 0, 1]]], [[False, True]]),
        ([[[255, 0, 0], [0, 7, 0]]], [[True, True]]),
        # Opacity is no object, and no opacity hides none.
        ([[[0, 0, 0, 255], [0, 1, 0, 0]]], [[False, True]]),
        ([[[0, 255], [1, 0]]], [[False, True]]),
    ],
    ids=["grey", "colour", "primary-colours", "colour-and-alpha", "grey-and-alpha"],
)
def test_any_nonzero_value_of_a_mask_is_object(png, pixels, mask):
    np.testing.assert_array_equal(image_files.read_mask(_save(png, pixels)), mask)


def test_one_bit_mask(png):
    _save(png, [[0, 255], [255, 0]], mode="1")
    np.testing.assert_array_equal(image_files.read_mask(png), [[False, True], [True, False]])


@pytest.mark.parametrize(
    ("level", "depth"), [(255, 1.0), (0, 11.5), (51, 9.4), (204, 3.1), (102, 7.3)]
)
def test_eight_bit_depth_by_hand(png, level, depth):
    read = image_files.read_depth(_save(png, [[level]]))
    assert read.shape == (1, 1)
    assert read[0, 0] == pytest.approx(depth, rel=1e-6)


@pytest.mark.parametrize("pixels", [[[[51] * 3]], [[[51, 51, 51, 255]]], [[[51, 255]]]])
def test_eight_bit_depth_may_be_stored_in_colour(png, pixels):
    assert image_files.read_depth(_save(png, pixels))[0, 0] == pytest.approx(9.4, rel=1e-6)


def test_float_depth_survives_the_round_trip(exr):
    depth = np.array([[0.0, 1.5, np.inf], [np.float32(np.pi), 11.5, 9999.0]], np.float32)
    image_files.write_exr(exr, depth)
    np.testing.assert_array_equal(image_files.read_depth(exr), depth)
    np.testing.assert_array_equal(image_files.read_exr(exr), depth)


@pytest.mark.parametrize("miss", [1e4, 65504.0, 1e10, np.inf])
def test_a_float_depth_of_a_miss_becomes_infinite(exr, miss):
    image_files.write_exr(exr, np.array([[2.0, miss]], np.float32))
    np.testing.assert_array_equal(image_files.read_depth(exr), [[2.0, np.inf]])


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.uint32])
@pytest.mark.parametrize("name", ["Z", "V", "ViewLayer.Depth.Z"])
def test_the_only_channel_of_an_exr_may_have_any_name_and_type(exr, name, kind):
    _save_exr(exr, {name: np.array([[3, 4]], kind)})
    depth = image_files.read_depth(exr)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, [[3.0, 4.0]])


def test_all_levels_survive_the_round_trip(png):
    levels = np.stack([np.arange(256, dtype=np.uint8)] * 3, axis=-1)[None]
    image_files.write_rgb(png, levels / 255.0)
    np.testing.assert_array_equal(image_files.read_rgb(png), levels)


@pytest.mark.parametrize(
    ("value", "level"),
    [(-1.0, 0), (0.0, 0), (0.49 / 255, 0), (0.51 / 255, 1), (1.0, 255), (7.0, 255), (np.inf, 255)],
)
def test_to_bytes_rounds_and_clips(value, level):
    assert image_files.to_bytes(np.array([value])) == level


@pytest.mark.parametrize(
    "read", [image_files.read_rgb, image_files.read_mask, image_files.read_depth]
)
def test_sixteen_bits_are_refused(png, read):
    iio.imwrite(png, np.array([[0, 300], [65535, 1]], np.uint16), plugin="pillow")
    with scene_error(png.name, "more than 8 bits", "8-bit PNG"):
        read(png)


def test_sixteen_bits_of_colour_are_refused(png):
    # One pixel: no library here writes such a file, and Pillow reads it as 8 bits.
    colour = 2
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 16, colour, 0, 0, 0))
    pixel = png_chunk(b"IDAT", zlib.compress(b"\0" + struct.pack(">HHH", 1, 300, 65535)))
    png.write_bytes(b"\x89PNG\r\n\x1a\n" + header + pixel + png_chunk(b"IEND", b""))
    assert iio.imread(png, plugin="pillow").dtype == np.uint8
    with scene_error(png.name, "more than 8 bits", "8-bit PNG"):
        image_files.read_rgb(png)


@pytest.mark.parametrize(
    "read", [image_files.read_rgb, image_files.read_mask, image_files.read_depth]
)
@pytest.mark.parametrize("kept", [0.0, 0.002, 0.1, 0.5, 0.9])
def test_truncated_image(png, read, kept):
    content = _save(png, _noise(40, 40, 3)).read_bytes()
    png.write_bytes(content[: int(kept * len(content))])
    with scene_error(png.name, "truncated", "copy or render it again"):
        read(png)


@pytest.mark.parametrize(
    "read",
    [image_files.read_rgb, image_files.read_mask, image_files.read_depth, image_files.read_exr],
)
@pytest.mark.parametrize("name", ["absent.png", "absent.exr"])
def test_missing_file(tmp_path, read, name):
    with scene_error(name, "does not exist", "Check"):
        read(tmp_path / name)


def test_a_folder_is_no_file(tmp_path):
    folder = tmp_path / "view.png"
    folder.mkdir()
    with scene_error(folder.name, "does not exist"):
        image_files.read_rgb(folder)


@pytest.mark.parametrize("content", [b"", b"not an image at all", b"v/1\x01"])
def test_corrupt_exr(exr, content):
    exr.write_bytes(content)
    with scene_error(exr.name, "Export it again"):
        image_files.read_depth(exr)


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_truncated_exr(exr, kept):
    image_files.write_exr(exr, np.random.default_rng(0).uniform(size=(40, 40)))
    content = exr.read_bytes()
    exr.write_bytes(content[: int(kept * len(content))])
    with scene_error(exr.name, "Export it again"):
        image_files.read_depth(exr)


def test_exr_with_unrelated_channels(exr):
    plane = np.ones((2, 3), np.float32)
    _save_exr(exr, {"Y": plane, "Z": plane})
    with scene_error(exr.name, "'Y', 'Z'", "Export one channel"):
        image_files.read_exr(exr)


def test_exr_with_opacity_has_too_many_channels(exr):
    _save_exr(exr, {"RGBA": np.ones((2, 3, 4), np.float32)})
    with scene_error(exr.name, "A", "Export"):
        image_files.read_exr(exr)


@pytest.mark.parametrize("channels", ["RGB", "RGBA"])
def test_depth_map_has_one_channel(exr, channels):
    _save_exr(exr, {channels: np.ones((2, 3, len(channels)), np.float32)})
    with scene_error(exr.name, "Export"):
        image_files.read_depth(exr)
