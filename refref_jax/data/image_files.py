"""Reads and writes images, masks and depth maps (NumPy only).

The pixels at the outline of a mask show the object and the background; `well_inside` and
`well_outside` leave them out.

Every reader raises a `SceneError` that names the file and the remedy.
"""

import warnings
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import OpenEXR
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

from refref_jax.data import SceneError

Masks = Bool[np.ndarray, "frames h w"]

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

# The 8-bit depth maps of the data set: white is 1 world unit, black 11.5 or more.
_NEAREST_DEPTH = 1.0
_DEPTH_RANGE = 10.5

DEPTH_STEP = _DEPTH_RANGE / 255.0
"""Difference between two depths of an 8-bit depth map, world units."""

# Neighbours of a pixel, including diagonal ones, within its own image.
_AROUND = np.ones((1, 3, 3), bool)

# Formats that are read. Pillow knows others, for some of which it starts programs.
_FORMATS = ("PNG", "JPEG", "BMP", "WEBP")

# Most pixels of an image, and those that are composited at once.
_MOST_PIXELS, _BLOCK = 1 << 26, 1 << 22

# Renderers write 1e4 or more for rays that hit nothing.
_DEPTH_OF_A_MISS = 1e4


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Reads an 8-bit image as sRGB, composited over white; grey is repeated in three channels."""
    pixels = _read_png(path)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=-1)
    if pixels.shape[-1] == 3:
        return pixels
    blocks = range(0, len(pixels), max(1, _BLOCK // pixels.shape[1]))
    return np.concatenate([_over_white(pixels[i : i + blocks.step]) for i in blocks])


def _over_white(pixels: UInt8[np.ndarray, "h w channels"]) -> UInt8[np.ndarray, "h w 3"]:
    """Composites pixels with opacity over white, as the last of 2 or 4 channels."""
    if pixels.shape[-1] == 2:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, axis=-1), pixels[..., 1:]], -1)
    alpha = pixels[..., 3:] / 255.0
    return np.round(pixels[..., :3] * alpha + 255.0 * (1.0 - alpha)).astype(np.uint8)


def srgb_to_linear(encoded: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Returns sRGB values in `[0, 1]` as linear light; see `render.pixels` for values of fields."""
    curved = ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, curved)


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Reads a mask: all nonzero values are the object."""
    pixels = _read_png(path)
    if pixels.ndim == 3 and pixels.shape[-1] in (2, 4):
        pixels = pixels[..., :-1]
    return pixels != 0 if pixels.ndim == 2 else np.any(pixels != 0, axis=-1)


def read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    """Reads a map of planar depth in world units; misses of a float map are `inf`.

    Two formats: a float EXR with one channel, and an 8-bit image of inverted depth,
    `z = 1 + 10.5 (1 - v / 255)`, which saturates at 11.5.
    """
    if path.suffix == ".exr":
        depth = read_exr(path)
        if depth.ndim != 2:
            raise SceneError(
                f"{path} has {depth.shape[-1]} channels, but a depth map has one. Export the Z "
                "pass alone."
            )
        if np.any(np.isnan(depth)):
            raise SceneError(f"{path} has a depth that is not a number. Export it again.")
        return np.where(depth >= _DEPTH_OF_A_MISS, np.inf, depth).astype(np.float32)
    pixels = _read_png(path)
    grey = pixels if pixels.ndim == 2 else pixels[..., 0]
    return (_NEAREST_DEPTH + _DEPTH_RANGE * (1.0 - grey / 255.0)).astype(np.float32)


def is_measured(depth: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Returns whether depths of an 8-bit map are not saturated, at either end of its range."""
    middle, half = _NEAREST_DEPTH + 0.5 * _DEPTH_RANGE, 0.5 * (_DEPTH_RANGE - DEPTH_STEP)
    return np.abs(depth - middle) < half


def well_inside(masks: Masks, *, margin: int = 1) -> Masks:
    """Returns the pixels at least `margin` pixels inside a mask, and inside the image."""
    return binary_erosion(masks, _AROUND, iterations=margin) if margin else masks


def well_outside(masks: Masks, *, margin: int = 2) -> Masks:
    """Returns the pixels more than `margin` pixels away from a mask."""
    return ~(binary_dilation(masks, _AROUND, iterations=margin) if margin else masks)


def read_size(path: Path) -> tuple[int, int]:
    """Returns height and width of an image or EXR in pixels, without reading its pixels."""
    _require(path)
    if path.suffix != ".exr":
        return _read_header(path)
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
    except Exception as error:  # as in `read_exr`
        raise _unreadable_exr(path, error) from error
    width, height = (int(last) - int(first) + 1 for first, last in zip(low, high, strict=True))
    _refuse_large(path, height, width)
    return height, width


def _read_header(path: Path) -> tuple[int, int]:
    """Returns height and width of a single image in one of the formats that are read."""
    try:
        with warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning):
            image = Image.open(path, formats=_FORMATS)
        with image:
            (width, height), pictures = image.size, getattr(image, "n_frames", 1)
            mode = image.mode
            if image.format == "MPO":  # a photograph with a preview or a depth map behind it
                pictures = 1
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise SceneError(f"{path} has more than {_MOST_PIXELS} pixels. Scale it down.") from error
    except Exception as error:  # Pillow raises OSError, SyntaxError and its own
        raise _unreadable_image(path, error) from error
    _refuse_large(path, height, width)
    if pictures > 1 or mode == "CMYK":
        wrong = f"has {pictures} pictures" if pictures > 1 else "has the inks of a print (CMYK)"
        raise SceneError(f"{path} {wrong}. Export one picture as 8-bit RGB.")
    return height, width


def _refuse_large(path: Path, height: int, width: int) -> None:
    """Refuses images that would take a gigabyte when they are unpacked."""
    if not 0 < height * width <= _MOST_PIXELS:
        raise SceneError(
            f"{path} has {width} x {height} pixels, but from 1 to {_MOST_PIXELS} are read. Scale "
            "it down."
        )


def read_exr(path: Path) -> Float[np.ndarray, "h w *channels"]:
    """Reads the first part of an EXR: `[h, w]` for one channel, `[h, w, 3]` for RGB."""
    read_size(path)
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # OpenEXR raises the errors of its C++ core
        raise _unreadable_exr(path, error) from error
    if set(channels) == {"RGB"}:
        return channels["RGB"].astype(np.float32)
    if len(channels) == 1 and next(iter(channels.values())).ndim == 2:
        return next(iter(channels.values())).astype(np.float32)
    raise SceneError(
        f"{path} has the channels {sorted(channels)}. Export one channel, or R, G and B."
    )


def write_exr(path: Path, pixels: Float[np.ndarray, "h w *channels"]) -> None:
    """Writes a float EXR: one channel `Z` for `[h, w]`, `RGB` for `[h, w, 3]`."""
    name = "Z" if pixels.ndim == 2 else "RGB"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {name: np.ascontiguousarray(pixels, np.float32)}) as file:
        file.write(str(path))


def write_rgb(path: str | Path, pixels: Float[np.ndarray, "h w 3"]) -> None:
    """Writes an sRGB image in `[0, 1]` as 8-bit PNG; values outside are clipped."""
    write_png(path, to_bytes(pixels))


def write_mask(path: Path, mask: Bool[np.ndarray, "h w"]) -> None:
    """Writes a mask as 8-bit PNG: white for true, black for false."""
    write_png(path, np.where(mask, 255, 0).astype(np.uint8))


def write_png(path: str | Path, pixels: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Writes an 8-bit image as PNG."""
    iio.imwrite(path, pixels, plugin="pillow", extension=".png")


def to_bytes(pixels: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Quantises `[0, 1]` to 8 bits, rounding to the nearest."""
    return np.round(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)


def _read_png(path: Path) -> UInt8[np.ndarray, "h w *channels"]:
    _require(path)
    _read_header(path)
    try:
        pixels = iio.imread(path, plugin="pillow")
    except Exception as error:  # Pillow raises OSError, SyntaxError and its own
        raise _unreadable_image(path, error) from error
    if pixels.dtype == bool:
        pixels = pixels.astype(np.uint8) * 255
    if pixels.dtype != np.uint8 or _has_sixteen_bits(path):
        raise SceneError(
            f"{path} has more than 8 bits per channel. Convert it to an 8-bit PNG: only 8 bits are "
            "used."
        )
    return pixels


def _unreadable_image(path: Path, error: Exception) -> SceneError:
    return SceneError(
        f"{path} cannot be read as an image ({error}). It may be truncated: copy or render it "
        "again."
    )


def _unreadable_exr(path: Path, error: Exception) -> SceneError:
    return SceneError(f"{path} cannot be read as EXR ({error}). Export it again.")


def _has_sixteen_bits(path: Path) -> bool:
    """Returns whether a PNG has 16 bits per channel, which Pillow silently reduces to 8."""
    with path.open("rb") as file:
        header = file.read(25)
    return header.startswith(_PNG_SIGNATURE) and header[24] == 16


def _require(path: Path) -> None:
    if not path.is_file():
        raise SceneError(f"{path} does not exist. Check the scene folder, or copy it again.")
