"""Writes images as a video: always as GIF, and as mp4 if FFmpeg is installed."""

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from jaxtyping import UInt8

INSTALL = "pip install -e '.[video]'"
"""Command that installs FFmpeg."""

# Constant rate factor of H.264: lower is better; at 18 losses are hardly visible.
_QUALITY = "18"


def has_ffmpeg() -> bool:
    """Returns whether imageio finds an FFmpeg."""
    try:
        import imageio_ffmpeg
    except ImportError:
        return False
    try:
        return bool(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:  # neither the package nor the machine has an FFmpeg
        return False


def write(
    stem: Path, frames: Sequence[UInt8[np.ndarray, "h w 3"]], *, fps: float
) -> tuple[Path, ...]:
    """Writes a video, replacing existing files.

    Args:
      stem: stem of the file names; the suffixes are appended.
      frames: sRGB frames, all of one size.
      fps: frames per second.

    Returns:
      The files: the GIF, and the mp4 if FFmpeg is installed.
    """
    gif, mp4 = (stem.with_name(f"{stem.name}.{ending}") for ending in ("gif", "mp4"))
    iio.imwrite(gif, frames, plugin="pillow", extension=".gif", duration=1000.0 / fps, loop=0)
    if not has_ffmpeg():
        return (gif,)
    iio.imwrite(
        mp4,
        np.stack([_even(frame) for frame in frames]),
        plugin="FFMPEG",
        extension=".mp4",
        fps=fps,
        codec="libx264",
        macro_block_size=1,  # otherwise frames are resized to multiples of 16
        output_params=["-crf", _QUALITY],
    )
    return gif, mp4


def _even(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Repeats the last row and column of a frame of odd size: H.264 requires even sizes."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
