"""Writes PNGs of 16 bits per colour, which Pillow cannot."""

import struct
import zlib
from pathlib import Path

import numpy as np

from tests.factories.small_scenes import png_chunk

_KINDS = {1: 0, 2: 4, 3: 2, 4: 6}


def write_sixteen_bits(path: Path, pixels: np.ndarray) -> Path:
    """Writes `[h, w]` or `[h, w, channels]`; rows take turns with three of PNG's filters."""
    height, width = pixels.shape[:2]
    channels = 1 if pixels.ndim == 2 else pixels.shape[-1]
    rows = pixels.astype(">u2").reshape(height, -1).view(np.uint8)
    left = np.pad(rows, ((0, 0), (2 * channels, 0)))[:, : rows.shape[1]]
    above = np.pad(rows, ((1, 0), (0, 0)))[:-1]
    filtered = [rows, rows - left, rows - above]
    content = b"".join(bytes([i % 3]) + filtered[i % 3][i].tobytes() for i in range(height))
    header = struct.pack(">IIBBBBB", width, height, 16, _KINDS[channels], 0, 0, 0)
    chunks = {b"IHDR": header, b"IDAT": zlib.compress(content), b"IEND": b""}
    body = b"".join(png_chunk(name, data) for name, data in chunks.items())
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    return path
