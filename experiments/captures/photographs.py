"""Reads photographs of captures as linear light, without loss: 8 and 16 bits, and EXR (NumPy only).

Scenes hold 8-bit sRGB. A photograph that is resampled or has more than 8 bits is decoded to linear
light in single precision and quantised once, at the end, with an error of at most half a step.

Pillow reduces PNGs of 16 bits per colour to 8 silently, since it has no image of such pixels: its
decoder keeps one byte of two. Which one is decided by the name of the byte order, so that decoding
twice, once with the wrong order, yields both.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import Image

from refref_jax.data import SceneError, image_files

EXR = ".exr"

# Modes of Pillow for PNGs of 16 bits, and the decoders of the upper and of the lower bytes.
_BYTES = {"RGB;16B": ("RGB;16B", "RGB;16L"), "RGBA;16B": ("RGBA;16B", "RGBA;16L")}

_KNEE = 0.0031308


def to_srgb(linear: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Encodes linear light by the sRGB transfer function in 8 bits; values outside are clipped.

    Source: IEC 61966-2-1.
    """
    light = np.clip(linear, 0.0, 1.0)
    curved = 1.055 * np.maximum(light, _KNEE) ** (1.0 / 2.4) - 0.055
    return image_files.to_bytes(np.where(light > _KNEE, curved, 12.92 * light))


def is_plain(path: Path) -> bool:
    """Returns whether a photograph has 8 bits per colour, so that its pixels may be copied."""
    return path.suffix.lower() != EXR and not _has_sixteen_bits(path)


def read_linear(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Reads a photograph as linear light; grey is repeated, and opacity composited over white.

    Raises:
      SceneError: if it cannot be read, or has values that are not finite.
    """
    if path.suffix.lower() == EXR:
        pixels = image_files.read_exr(path)
        if not np.all(np.isfinite(pixels)):
            raise SceneError(f"{path} has values that are not finite. Export it again.")
        return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=-1)
    if _has_sixteen_bits(path):
        return _to_linear(_over_white(read_sixteen_bits(path)))
    table = image_files.srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    return table[image_files.read_rgb(path)]


def read_sixteen_bits(path: Path) -> UInt16[np.ndarray, "h w *channels"]:
    """Reads all bits of a PNG with 16 bits per colour: grey, RGB or RGBA.

    Raises:
      SceneError: if it cannot be read, or has other channels.
    """
    image_files.read_size(path)
    try:
        with Image.open(path, formats=("PNG",)) as image:
            mode = image.tile[0].args
            if mode == "I;16B":
                return np.asarray(image).astype(np.uint16)
        if mode in _BYTES:
            upper, lower = (_decoded(path, order) for order in _BYTES[mode])
            return upper.astype(np.uint16) << 8 | lower
    except Exception as error:  # Pillow raises OSError, SyntaxError and its own
        raise SceneError(
            f"{path} cannot be read as an image ({error}). It may be truncated: copy it again."
        ) from error
    raise SceneError(f"{path} has 16 bits and opacity, but no colour. Export it as RGB.")


def _decoded(path: Path, order: str) -> UInt8[np.ndarray, "h w channels"]:
    with Image.open(path, formats=("PNG",)) as image:
        image.tile = [tile._replace(args=order) for tile in image.tile]
        return np.asarray(image)


def _over_white(pixels: UInt16[np.ndarray, "h w *channels"]) -> Float[np.ndarray, "h w 3"]:
    """Returns sRGB in `[0, 1]`, composited like 8-bit images."""
    values = pixels.astype(np.float32) / 65535.0
    if values.ndim == 2:
        return np.repeat(values[..., None], 3, axis=-1)
    if values.shape[-1] == 3:
        return values
    return values[..., :3] * values[..., 3:] + (1.0 - values[..., 3:])


def _to_linear(encoded: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return image_files.srgb_to_linear(encoded).astype(np.float32)


def _has_sixteen_bits(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(25)
    return header.startswith(b"\x89PNG\r\n\x1a\n") and header[24] == 16
