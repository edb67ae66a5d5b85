"""Draws the pixels of each training step (NumPy only).

Pixels are assigned to batches once, at random; every epoch uses all batches, in a new random order.
Results computed for a batch, such as its light paths, are therefore valid in every epoch. The batch
of a step depends on the seed and the step alone, so a resumed run has the same pixels as an
uninterrupted one. Within an epoch no pixel is repeated, except for those that fill up the last
batch.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, UInt8

from refref_jax.geometry.cameras import Cameras, pixel_rays
from refref_jax.geometry.rays import Rays


class PixelBatch(NamedTuple):
    """Rays and true colours of pixels.

    Attributes:
      rays: camera rays.
      rgb: colours, 8-bit sRGB.
      views: index of the image of each pixel.
    """

    rays: Rays
    rgb: UInt8[np.ndarray, "*shape 3"]
    views: Int[np.ndarray, "*shape"]


def check_batch(cameras: Cameras, batch: int) -> None:
    """Checks that the images of cameras have enough pixels for a batch.

    Raises:
      ValueError: if they have fewer.
    """
    pixels = len(cameras.poses) * cameras.height * cameras.width
    if batch > pixels:
        raise ValueError(
            f"A batch of {batch} pixels is larger than all images together, with {pixels}. "
            "Use a smaller batch."
        )


class PixelSampler:
    """Draws batches of pixels from a set of images.

    Attributes:
      batches: number of batches per epoch.
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
        """Assigns pixels to batches.

        Args:
          images: images in 8-bit sRGB.
          cameras: cameras of the images.
          seed: seed of the order of pixels.
          batch: number of pixels per step.
          kept: mask of the pixels to draw from; all pixels if `None`.

        Raises:
          ValueError: if the images do not fit the cameras, or have fewer pixels than a batch.
        """
        expected = (len(cameras.poses), cameras.height, cameras.width, 3)
        if images.shape != expected:
            raise ValueError(
                f"The images are {images.shape}, but the cameras require {expected}. Give one "
                "image per camera, of the camera's size."
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
        self._kept = None if kept is None else places
        self._order = self._generator(0).permutation(places).astype(np.uint32)

    def numbers(self, first: int, steps: int) -> Int[np.ndarray, " steps"]:
        """Returns the batch numbers of steps `first .. first + steps - 1`."""
        epoch, place = np.divmod(np.arange(first, first + steps), self.batches)
        found = np.empty(steps, np.int32)
        for each in np.unique(epoch):
            # Number 0 is used to assign pixels to batches.
            order = self._generator(int(each) + 1).permutation(self.batches)
            found[epoch == each] = order[place[epoch == each]]
        return found

    def draw(self, numbers: Int[np.ndarray, " n"]) -> PixelBatch:
        """Returns batches by their numbers, as `[n, batch]`."""
        place = np.int64(self._batch) * numbers[:, None] + np.arange(self._batch)
        return self.look_up(self._order[place % len(self._order)].astype(np.int64))

    def survey(self, count: int) -> PixelBatch:
        """Returns `count` of the pixels to draw from, at random, always the same ones."""
        drawn = np.random.default_rng(0).integers(len(self._order), size=count)
        return self.look_up(drawn if self._kept is None else self._kept[drawn])

    def look_up(self, index: Int[np.ndarray, "*shape"]) -> PixelBatch:
        """Returns pixels by their index in the flattened images."""
        frame, row, column = np.unravel_index(
            index, (len(self._cameras.poses), self._cameras.height, self._cameras.width)
        )
        rays = pixel_rays(self._cameras, frame, row, column)
        return PixelBatch(rays, self._pixels[index], np.asarray(frame, np.int32))

    def _generator(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.Philox(key=[self._seed, number]))
