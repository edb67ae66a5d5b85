"""Settings of the rendering (NumPy only)."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from refref_jax.choices import SPLITS, Split, TwoSidedRule

LinearImages = Literal["all", "test", "none"]
"""Splits that also keep their images as linear EXRs."""

OpaqueLight = Literal["lit", "emitting"]
"""Whether opaque parts reflect the light of the scene, or emit known light."""

GENERATOR = 2
"""Version of the generator, incremented when scenes with the same settings would change."""

Device = Literal["CPU", "GPU"]
"""Devices of Cycles."""

LEAST_TEXTURE = 16
"""Smallest useful number of rows of a texture."""

BLENDER = "5.0.1"
"""Required version of Blender; pixels may differ between versions."""

BOUNCES = 64
"""Limit of bounces of every kind in Cycles."""

_RENDER: dict[str, Any] = {
    "bounces": BOUNCES,
    "pixel_filter": "box, 1 pixel wide",
    "view_transform": "Standard: the sRGB transfer function, clipped",
    "adaptive_sampling": False,
    "denoising": False,
    "clamping": False,
    "filter_glossy": 0.0,
    "caustics": True,
    "seed": "first 8 bytes of SHA-256 of 'SCENE\\0SPLIT\\0NAME\\0', big-endian, modulo 2^31",
    "depth_mask_normal": "of the first surface on the ray through a pixel's middle",
}


class PerSplit(NamedTuple):
    """A number for each split."""

    train: int
    val: int
    test: int


@dataclass(frozen=True)
class RenderSettings:
    """Settings that decide a scene's files, in addition to its name.

    Attributes:
      size: width and height of images in pixels.
      spp: samples per pixel.
      views: number of poses of each split.
      rule: outside medium of each part.
      texture_size: rows of each image of the background.
      linear: splits that keep linear EXRs.
      preview: whether only `preview_view` is rendered.
      device: device of Cycles; the noise of images depends on it.
      source: digest of the user's meshes, if the object is made of them.
      opaque: light of opaque parts: that of the scene, or known light that they emit.
    """

    size: int
    spp: PerSplit
    views: PerSplit
    rule: TwoSidedRule = "nested"
    texture_size: int = 1024
    linear: LinearImages = "test"
    preview: bool = False
    device: Device = "CPU"
    source: str = ""
    opaque: OpaqueLight = "lit"

    def __post_init__(self) -> None:
        """Rejects invalid settings.

        Raises:
          ValueError: if a number is too small, or all splits are empty.
        """
        for name, number in [("size", self.size), *zip(_SPP, self.spp, strict=True)]:
            if number < 1:
                raise ValueError(f"The {name} is {number}. Give 1 or more.")
        if self.texture_size < LEAST_TEXTURE:
            raise ValueError(
                f"The texture_size is {self.texture_size}. Give {LEAST_TEXTURE} or more."
            )
        if min(self.views) < 0 or not any(self.views):
            raise ValueError(
                f"The views of train, val and test are {', '.join(map(str, self.views))}. Give "
                "non-negative numbers, and at least one view."
            )
        if self.preview and not self.views.test:
            raise ValueError("A preview shows a test view, but there is none. Give --test_views.")

    def numbers(self, split: Split) -> tuple[int, ...]:
        """Returns the numbers of the rendered views of a split."""
        if self.preview:
            return (preview_view(self.views.test),) if split == "test" else ()
        return tuple(range(getattr(self.views, split)))

    def keeps_linear(self, split: Split) -> bool:
        """Returns whether a split keeps its images as linear EXRs."""
        return self.linear in ("all", split)

    def record(self) -> dict[str, Any]:
        """Returns the record of the settings for `scene.json`."""
        render = {"generator": GENERATOR, **_RENDER, "linear_images": self.linear}
        if self.device != "CPU":
            render["device"] = self.device
        if self.opaque != "lit":
            render["opaque"] = self.opaque
        if self.source:
            render["meshes_sha256"] = self.source
        return {
            "renderer": f"Blender Cycles {BLENDER}",
            "size": self.size,
            "spp": self.spp._asdict(),
            "views": {split: list(self.numbers(split)) for split in SPLITS}
            if self.preview
            else self.views._asdict(),
            "rule": self.rule,
            "texture_size": self.texture_size,
            "render": render,
        }


_SPP = ("spp of train", "spp of val", "spp of test")


def preview_view(count: int) -> int:
    """Returns the number of the preview's test view, which looks down slightly."""
    return (count - 1) * 6 // 10
