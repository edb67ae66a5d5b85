"""Which pixels a training step sees (NumPy only).

Pixels are dealt to batches once, at random; every epoch sees all batches, in an order of its own.
So what is made of a batch, its light paths, serves for every epoch. Which batch a step sees depends
on the seed and on the step alone, so a run that is resumed sees the very pixels that it would have
seen. Within an epoch no pixel comes twice, but for those that fill up the last batch.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, UInt8

from refref_jax.geometry.cameras import Cameras, pixel_rays
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

    Attributes:
      batches: number of batches of an epoch.
    """

    def __init__(
        self,
        images: UInt8[np.ndarray, "frames h w 3"],
        cameras: Cameras,
        *,
        seed: int,
        batch: int,
        kept: Bool[np.ndarray, "frames h w"] | None = None,
    ) -> None:
        """Prepares to draw.

        Args:
          images: 8-bit sRGB.
          cameras: one an image.
          seed: of the order of pixels.
          batch: pixels a step.
          kept: the pixels to draw from; all of them if not given.

        Raises:
          ValueError: if the images do not fit the cameras, or have fewer pixels than a batch.
        """
        expected = (len(cameras.poses), cameras.height, cameras.width, 3)
        if images.shape != expected:
            raise ValueError(
                f"The images are {images.shape}, but the cameras ask for {expected}. Give one "
                "image a camera, in its size."
            )
        check_batch(cameras, batch)
        places = np.arange(images.size // 3) if kept is None else np.flatnonzero(kept)
        if len(places) < batch:
            raise ValueError(
                f"Only {len(places)} pixels are left to draw from, fewer than a batch of {batch}. "
                "Use a smaller batch, or check the masks."
            )
        self._pixels = images.reshape(-1, 3)
        self._cameras = cameras
        self._seed = seed
        self._batch = batch
        self.batches = -(-len(places) // batch)
        self._order = self._generator(0).permutation(places).astype(np.uint32)

    def numbers(self, first: int, steps: int) -> Int[np.ndarray, " steps"]:
        """Returns the batches that steps `first .. first + steps - 1` see."""
        epoch, place = np.divmod(np.arange(first, first + steps), self.batches)
        found = np.empty(steps, np.int32)
        for each in np.unique(epoch):
            # The number 0 is that of the deal.
            order = self._generator(int(each) + 1).permutation(self.batches)
            found[epoch == each] = order[place[epoch == each]]
        return found

    def draw(self, numbers: Int[np.ndarray, " n"]) -> PixelBatch:
        """Returns some batches, as `[n, batch]`."""
        place = np.int64(self._batch) * numbers[:, None] + np.arange(self._batch)
        return self.look_up(self._order[place % len(self._order)].astype(np.int64))

    def survey(self, count: int) -> PixelBatch:
        """Returns `count` pixels drawn at random, always the same ones."""
        return self.look_up(np.random.default_rng(0).integers(len(self._pixels), size=count))

    def look_up(self, index: Int[np.ndarray, "*shape"]) -> PixelBatch:
        """Returns pixels by their index in the flattened images."""
        frame, row, column = np.unravel_index(
            index, (len(self._cameras.poses), self._cameras.height, self._cameras.width)
        )
        return PixelBatch(pixel_rays(self._cameras, frame, row, column), self._pixels[index])

    def _generator(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.Philox(key=[self._seed, number]))
