"""Conversion between browser and scene cameras, and cropping of images to any window.

A browser's camera has a vertical field of view and the aspect of its window; its axes are x right,
y down, z forward. Ours are those of `geometry.cameras`. Aspects are width over height.

Images always have the aspect 16:9, so that nothing is compiled for a window. The rule: *the image
covers the window, and the overhang is cropped*, equally on both sides. A wider window crops rows at
top and bottom, a narrower one columns at left and right. Test views are instead shown in full, with
grey bars at the sides.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays

ASPECT = 16 / 9
"""Aspect of all images before cropping."""

_GREY = 96

ROUNDING = 1e-3
"""Tolerance for the rounding of cameras by browsers; smaller than any manual movement."""

# Our axes are the browser's with y and z negated.
_TURN = np.diag([1.0, -1.0, -1.0])


class Viewpoint(NamedTuple):
    """A window's camera.

    Attributes:
      pose: camera to world, in the axes of `geometry.cameras`.
      fov: vertical field of view, radians.
      aspect: width of the window over its height.
    """

    pose: Float[np.ndarray, "3 4"]
    fov: float
    aspect: float


class Window(NamedTuple):
    """Some pixels of a camera's image: those where the given rows and columns cross.

    Attributes:
      camera: the camera, alone.
      rows: indices of the rows.
      columns: indices of the columns.
    """

    camera: Cameras
    rows: Int[np.ndarray, " h"]
    columns: Int[np.ndarray, " w"]

    @property
    def rays(self) -> Rays:
        """Rays through the centres of the pixels, `[h, w]`."""
        row, column = np.meshgrid(self.rows, self.columns, indexing="ij")
        return cameras.pixel_rays(self.camera, np.zeros_like(row), row, column)


def from_browser(
    wxyz: Float[np.ndarray, "4"], position: Float[np.ndarray, "3"], fov: float, aspect: float
) -> Viewpoint:
    """Returns the camera of a browser from its unit quaternion, scalar first."""
    rotation = Rotation.from_quat(wxyz, scalar_first=True).as_matrix() @ _TURN
    return Viewpoint(np.concatenate([rotation, position[:, None]], axis=1), fov, aspect)


def to_browser(pose: Float[np.ndarray, "3 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns a pose in the browser's form: unit quaternion, scalar first, and position."""
    rotation = Rotation.from_matrix(pose[:, :3] @ _TURN)
    return rotation.as_quat(scalar_first=True), pose[:, 3]


def width_of(height: int) -> int:
    """Returns the width of an uncropped image of that height."""
    return max(1, round(height * ASPECT))


def window(view: Viewpoint, height: int) -> Window:
    """Returns the pixels of an image after cropping to its window; see the rule of the module.

    Args:
      view: the window's camera.
      height: rows of the uncropped image.

    Returns:
      Pixels in `height` rows or `width_of(height)` columns, and the cropped number of the other.
      Their aspect equals the window's to within two pixels.
    """
    width, half = width_of(height), math.tan(0.5 * view.fov)
    focal = min(0.5 * height / half, 0.5 * width / (view.aspect * half))
    rows = _middle(height, 2.0 * focal * half)
    columns = _middle(width, 2.0 * focal * half * view.aspect)
    return Window(Cameras(view.pose[None], width, height, focal), rows, columns)


def nearest(
    pose: Float[np.ndarray, "3 4"], views: Cameras, *, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> int:
    """Returns the index of the camera that is closest to a pose.

    The difference is that of the positions, plus that of the viewing directions times the distance
    of the candidate from the centre of the scene: the displacement of an object there.
    """
    apart = np.linalg.norm(views.poses[:, :, 3] - pose[:, 3], axis=-1)
    turned = np.linalg.norm(views.poses[:, :, 2] - pose[:, 2], axis=-1)
    distances = np.linalg.norm(views.poses[:, :, 3] - centre, axis=-1)
    return int(np.argmin(apart + turned * distances))


def is_same(a: Viewpoint, b: Viewpoint, *, within: float = ROUNDING) -> bool:
    """Returns whether two cameras agree to within a tolerance in every number."""
    numbers = [np.append(view.pose, [view.fov, view.aspect]) for view in (a, b)]
    return bool(np.allclose(*numbers, rtol=0.0, atol=within))


def containing_fov(views: Cameras, aspect: float) -> float:
    """Returns the vertical field of view for a window to show a complete view of a scene, radians.

    Args:
      views: cameras; only their intrinsics are used.
      aspect: width of the window over its height.
    """
    tallest = max(float(views.height), views.width / aspect)
    return 2.0 * math.atan(0.5 * tallest / views.focal)


def letterbox(
    image: UInt8[np.ndarray, "h w 3"], aspect: float
) -> UInt8[np.ndarray, "height width 3"]:
    """Returns an image with equal grey bars on both sides that give it an aspect."""
    height, width, _ = image.shape
    across = max(0, round(0.5 * (height * aspect - width)))
    along = max(0, round(0.5 * (width / aspect - height)))
    return np.pad(image, ((along, along), (across, across), (0, 0)), constant_values=_GREY)


def _middle(whole: int, wanted: float) -> np.ndarray:
    """Returns the indices of about as many pixels as requested, in the middle of a row."""
    margin = min(max(0, round(0.5 * (whole - wanted))), (whole - 1) // 2)
    return np.arange(margin, whole - margin)
