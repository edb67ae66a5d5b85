"""Which pixels a training step sees (NumPy only).

A batch depends on the seed and on the step alone, so a run that is resumed at a step sees the
very pixels that it would have seen. Within an epoch no pixel comes twice.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int, UInt8

from refref_jax.data.cameras import Cameras, pixel_rays
from refref_jax.geometry.rays import Rays


class PixelBatch(NamedTuple):
    """Rays and true colours of some pixels.

    Attributes:
      rays: camera rays.
      rgb: 8-bit sRGB.
    """

    rays: Rays
    rgb: UInt8[np.ndarray, "*shape 3"]


def check_batch(cameras: Cameras, batch: int) -> None:
    """Checks that the images of some cameras hold a batch.

    Raises:
      ValueError: if not.
    """
    pixels = len(cameras.poses) * cameras.height * cameras.width
    if batch > pixels:
        raise ValueError(
            f"A batch of {batch} pixels is larger than all images together, which have {pixels}. "
            "Use a smaller batch."
        )


class PixelSampler:
    """Draws batches of pixels from a set of images.

    Only the current epoch's permutation is kept; it is a function of the seed and the epoch.
    """

    def __init__(
        self,
        images: UInt8[np.ndarray, "frames h w 3"],
        cameras: Cameras,
        *,
        seed: int,
        batch: int,
    ) -> None:
        """Prepares to draw.

        Args:
          images: 8-bit sRGB.
          cameras: one an image.
          seed: of the order of pixels.
          batch: pixels a step.

        Raises:
          ValueError: if the images do not fit the cameras, or have fewer pixels than a batch.
        """
        expected = (len(cameras.poses), cameras.height, cameras.width, 3)
        if images.shape != expected:
            raise ValueError(
                f"The images are {images.shape}, but the cameras ask for {expected}. Give one "
                "image a camera, in its size."
            )
        self._pixels = images.reshape(-1, 3)
        self._cameras = cameras
        self._seed = seed
        self._batch = batch
        self._epoch, self._order = -1, np.empty(0, np.uint32)
        check_batch(cameras, batch)

    @property
    def _steps_per_epoch(self) -> int:
        return len(self._pixels) // self._batch

    def draw(self, first: int, steps: int) -> PixelBatch:
        """Returns the batches of steps `first .. first + steps - 1`, as `[steps, batch]`."""
        return self.look_up(np.stack([self._indices(first + i) for i in range(steps)]))

    def survey(self, count: int) -> PixelBatch:
        """Returns `count` pixels drawn at random, always the same ones."""
        return self.look_up(np.random.default_rng(0).integers(len(self._pixels), size=count))

    def look_up(self, index: Int[np.ndarray, "*shape"]) -> PixelBatch:
        """Returns pixels by their index in the flattened images."""
        frame, row, column = np.unravel_index(
            index, (len(self._cameras.poses), self._cameras.height, self._cameras.width)
        )
        return PixelBatch(pixel_rays(self._cameras, frame, row, column), self._pixels[index])

    def _indices(self, step: int) -> Int[np.ndarray, " batch"]:
        epoch, position = divmod(step, self._steps_per_epoch)
        if epoch != self._epoch:
            generator = np.random.Generator(np.random.Philox(key=[self._seed, epoch]))
            self._order = generator.permutation(len(self._pixels)).astype(np.uint32)
            self._epoch = epoch
        start = position * self._batch
        return self._order[start : start + self._batch].astype(np.int64)
