"""The files of one rendered view (NumPy only).

Files are written under a temporary name in the same folder, and renamed when complete. So a view is
done when all of its files exist.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import numpy as np
import OpenEXR
from jaxtyping import Bool, Float, UInt8

from experiments.dataset.cameras import Split
from refref_jax import atomic_files
from refref_jax.data import image_files

# The published depth maps: white is 1 world unit, black 11.5 or more.
_NEAREST_DEPTH, _DEPTH_RANGE = 1.0, 10.5

# Boundary of the linear and the curved part of sRGB's transfer function, linear value.
_KNEE = 0.0031308

_LAYER = "ViewLayer."


class FrameFiles(NamedTuple):
    """Paths of a view's files.

    Attributes:
      image: 8-bit sRGB image.
      mask: mask, 255 inside the object.
      depth_8_bit: inverted planar depth, see `to_published_depth`.
      depth: float planar depth.
      normal: float normals in world space.
      linear: linear RGB in half precision, for some splits.
    """

    image: Path
    mask: Path
    depth_8_bit: Path
    depth: Path
    normal: Path
    linear: Path


class Rendering(NamedTuple):
    """One view as rendered by Blender. All arrays but the colours are sampled at pixel centres.

    Attributes:
      linear: linear RGB, the mean over each pixel's square.
      depth: planar depth of the first surface, object or background, world units; 1e10 without a
        hit.
      normal: shading normal in world space where the object is the first surface, towards the
        camera; else 0.
      mask: whether the object is the first surface.
    """

    linear: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]


def relative(split: Split, number: int) -> FrameFiles:
    """Returns the files of a view, relative to the scene's folder."""
    place = Path(split) / f"r_{number:03d}.png"
    return FrameFiles(
        image=place,
        mask="mask" / place,
        depth_8_bit="depth" / place,
        depth="depth" / place.with_suffix(".exr"),
        normal="normal" / place.with_suffix(".exr"),
        linear=place.with_suffix(".exr"),
    )


def is_done(scene: Path, split: Split, number: int, *, linear: bool) -> bool:
    """Returns whether a view is rendered.

    Args:
      scene: folder of the scene.
      split: split of the view.
      number: number of the view in its split.
      linear: whether the linear image is required, too.
    """
    wanted = relative(split, number) if linear else relative(split, number)[:-1]
    return all((scene / path).is_file() for path in wanted)


def write(scene: Path, split: Split, number: int, rendering: Rendering, *, linear: bool) -> None:
    """Writes the files of a view; for the arguments see `is_done`."""
    named = relative(split, number)
    write_file(scene / named.image, _png(to_srgb(rendering.linear)))
    write_file(scene / named.mask, _png(np.where(rendering.mask, 255, 0).astype(np.uint8)))
    write_file(scene / named.depth_8_bit, _png(to_published_depth(rendering.depth)))
    write_file(scene / named.depth, _exr("Z", rendering.depth))
    write_file(scene / named.normal, _exr("RGB", rendering.normal))
    if linear:
        # Half precision ends at 65504.
        half = np.minimum(rendering.linear, np.finfo(np.float16).max).astype(np.float16)
        write_file(scene / named.linear, _exr("RGB", half))


def remove_unfinished(scene: Path) -> None:
    """Removes incomplete files of an interrupted command."""
    for path in scene.rglob(f"*{atomic_files.UNFINISHED}"):
        path.unlink()


def read_rendering(colours: Sequence[Path], geometry: Path) -> Rendering:
    """Reads the files of a view written by `blender_worker`.

    Args:
      colours: one image, or three of which each has the right light in its own channel.
      geometry: depth, normals and object indices.

    Raises:
      ValueError: if a file is missing or broken, or a colour is not finite.
    """
    images = [_read_layers(path)["Combined"] for path in colours]
    linear = np.stack([images[channel % len(images)][..., channel] for channel in range(3)], -1)
    if not np.all(np.isfinite(linear)):
        raise ValueError(
            f"{colours[0]} has colours that are not finite. Check the scene in Blender."
        )
    layers = _read_layers(geometry)
    mask = layers["Object Index.X"] > 0.0
    normal = np.stack([layers[f"Normal.{axis}"] for axis in "XYZ"], axis=-1)
    return Rendering(linear, layers["Depth.Z"], np.where(mask[..., None], normal, 0.0), mask)


def to_srgb(linear: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Encodes linear light by the sRGB transfer function, clipped, as 8 bits.

    Blender's view transform Standard gives the same values, up to rounding.

    Source: IEC 61966-2-1.
    """
    light = np.clip(linear, 0.0, 1.0).astype(np.float64)
    curved = 1.055 * np.maximum(light, _KNEE) ** (1.0 / 2.4) - 0.055
    return image_files.to_bytes(np.where(light > _KNEE, curved, 12.92 * light))


def to_published_depth(depth: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Encodes planar depth, world units, in 8 bits: 255 at 1, 0 at 11.5 and beyond."""
    return image_files.to_bytes(1.0 - (depth.astype(np.float64) - _NEAREST_DEPTH) / _DEPTH_RANGE)


def _read_layers(path: Path) -> dict[str, np.ndarray]:
    """Returns the channels of all parts of an EXR."""
    try:
        with OpenEXR.File(str(path)) as file:
            return {
                name.removeprefix(_LAYER): channel.pixels.astype(np.float32)
                for part in file.parts
                for name, channel in part.channels.items()
            }
    except Exception as error:  # OpenEXR raises what its C++ core does
        raise ValueError(
            f"{path} cannot be read ({error}). Check that the disk is not full; the same command "
            "resumes where this one stopped."
        ) from error


def _png(pixels: UInt8[np.ndarray, "h w *channels"]) -> Callable[[Path], None]:
    return lambda path: iio.imwrite(path, pixels, plugin="pillow", extension=".png")


def _exr(name: str, pixels: np.ndarray) -> Callable[[Path], None]:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write_to(path: Path) -> None:
        with OpenEXR.File(header, {name: np.ascontiguousarray(pixels)}) as file:
            file.write(str(path))

    return write_to


def write_file(path: Path, write_to: Callable[[Path], None]) -> None:
    """Writes a file atomically, also on a power failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_files.written_file(path, survives="machine") as draft:
        write_to(draft)
