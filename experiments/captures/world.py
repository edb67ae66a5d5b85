"""Moves the world of a capture, so that the object lies at the origin in a known size (NumPy only).

A `Placement` is `x -> scale rotation (x - centre)`. Meshes say where the object is, or masks: it
lies in the cones of all of them. Otherwise it is taken to be where the optical axes meet.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from refref_jax.data import SceneError
from refref_jax.geometry.cameras import Cameras, project

USUAL_DISTANCE = 4.0
"""Distance of the data set's cameras from the origin, world units."""

OBJECT_RADIUS = 1.5
"""Radius of an object that is scaled, world units: R3F searches within 2.1 units of the origin."""

# Axes count as parallel if their intersection moves more than this per unit of their shift.
_WORST_CONDITION = 1e4

# Mean of the cameras' upward directions below which there is no common one.
_LEAST_UP = 0.2

# Cells along an edge of the searched cube, how often it shrinks, and views that are looked at.
_CELLS, _ROUNDS, _VIEWS = 40, 6, 100

# Share of the cells within the radius: few views leave long tips. All lie within 2 / 1.5 of it,
# so that none is outside of the cube that R3F searches.
_BULK, _LEAST_REACH = 0.95, 0.75

# Share of the pixels that masks of an object may mark; largest radius of its ball as a share of the
# distance of the nearest camera; least angle between optical axes, degrees. Seen from nearly one
# direction, the cones of all masks also meet in front of the cameras.
_MOST_MARKED, _LARGEST, _NARROWEST = 0.9, 0.6, 40.0

FEW_VIEWS = 10
"""Number of masks below which the ball around the object is a guess."""

# Share of the views of a point that must show it within their masks, and that must see it at all.
_AGREE, _SEE = 0.97, 0.5


class Placement(NamedTuple):
    """A change of the world frame: `x -> scale rotation (x - centre)`.

    Attributes:
      centre: position of the new origin, in old units.
      scale: new units per old unit.
      rotation: new axes in the old frame, as rows.
    """

    centre: Float[np.ndarray, "3"]
    scale: float
    rotation: Float[np.ndarray, "3 3"] = np.eye(3)

    def record(self) -> dict[str, Any]:
        """Returns the placement for a JSON file."""
        return {
            "formula": "x -> scale rotation (x - centre)",
            "centre": self.centre.tolist(),
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
        }


class Ball(NamedTuple):
    """A ball around the object.

    Attributes:
      centre: its centre.
      radius: its radius.
    """

    centre: Float[np.ndarray, "3"]
    radius: float


def move(
    points: Float[np.ndarray, "points 3"], placement: Placement
) -> Float[np.ndarray, "points 3"]:
    """Returns points in the changed frame."""
    return placement.scale * (points - placement.centre) @ placement.rotation.T


def place(
    poses: Float[np.ndarray, "cameras 3 4"], placement: Placement
) -> Float[np.ndarray, "cameras 3 4"]:
    """Returns camera-to-world matrices in the changed frame."""
    positions = move(poses[..., 3], placement)
    return np.concatenate([placement.rotation @ poses[..., :3], positions[..., None]], axis=-1)


def undo_motion(
    poses: Float[np.ndarray, "cameras 3 4"], motion: Float[np.ndarray, "3 4"], scale: float
) -> Float[np.ndarray, "cameras 3 4"]:
    """Returns poses as they were before `p -> scale motion(p)`.

    Args:
      poses: camera-to-world matrices.
      motion: rotation and translation, which were applied first.
      scale: scale of positions, which was applied second.
    """
    back = motion[:, :3].T
    positions = (poses[..., 3] / scale - motion[:, 3]) @ back.T
    return np.concatenate([back @ poses[..., :3], positions[..., None]], axis=-1)


def meeting_point(poses: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "3"]:
    """Returns the point that is nearest to all optical axes, by least squares.

    Raises:
      SceneError: if the axes are nearly parallel, so that they have no such point.
    """
    axes = poses[..., 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) > _WORST_CONDITION:
        raise SceneError(
            "All cameras look in the same direction, so the centre of the scene is unknown. Give "
            "centre, such as (0.5, 0, 1.2)."
        )
    return np.linalg.solve(total, np.einsum("nij,nj->i", across, poses[..., 3]))


def upright(poses: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "3 3"]:
    """Returns the smallest rotation that turns the cameras' mean upward direction to +z.

    It is the identity if they have no common one, as where a camera was turned in all directions.
    """
    mean = poses[..., 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < _LEAST_UP:
        return np.eye(3)
    up, ahead = mean / length, np.array([0.0, 0.0, 1.0])
    if up[2] < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.cross(up, ahead)
    cross = np.cross(np.eye(3), axis)  # of the axis with a vector, as a matrix
    return np.eye(3) + cross + cross @ cross / (1.0 + up[2])


def ball_of_points(points: Float[np.ndarray, "points 3"]) -> Ball:
    """Returns the ball around the middle of the bounding box of points."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return Ball(centre, float(np.linalg.norm(points - centre, axis=-1).max()))


def ball_of_masks(masks: Bool[np.ndarray, "views h w"], cameras: Cameras) -> Ball:
    """Returns a ball around the object, from the cones of its masks; its centre is their centroid.

    A cube around all cameras is divided into cells; those that lie within the masks of 97 % of the
    views that see them, and are seen by half of all, remain, and the cube shrinks around them.
    Masks may be coarse, since the ball is, too.

    Args:
      masks: masks of the object; those that are empty are left out.
      cameras: their cameras.

    Raises:
      SceneError: if no mask marks the object, their cones have nothing in common, or they leave its
        place unknown: masks that mark nearly everything, views from nearly one
        direction, or a ball that nearly holds a camera.
    """
    shown = np.flatnonzero(masks.any(axis=(1, 2)))
    if not len(shown):
        raise SceneError("No mask marks the object. Give the centre of the scene, or other masks.")
    if (share := float(masks[shown].mean())) > _MOST_MARKED:
        raise SceneError(
            f"The masks mark {100 * share:.0f} % of the pixels, too many for an object. Check that "
            "they are masks and what white means (--masks), or give --centre and --scale."
        )
    shown = shown[np.unique(np.linspace(0, len(shown) - 1, _VIEWS).astype(int))]
    axes = cameras.poses[shown, :, 2]
    widest = float(np.degrees(np.arccos(np.clip(np.min(axes @ axes.T), -1.0, 1.0))))
    if widest < _NARROWEST:
        raise SceneError(
            f"The {len(shown)} masks leave the object's place unknown, as all views look within "
            f"{widest:.0f} degrees of each other. Add views, or give --centre and --scale."
        )
    outside = [distance_transform_edt(~mask) for mask in masks[shown]]
    poses = cameras.poses[shown]
    ball = ball_of_points(poses[..., 3])
    low, high = ball.centre - 2.0 * ball.radius, ball.centre + 2.0 * ball.radius
    for _ in range(_ROUNDS):
        size = (high - low) / _CELLS
        cells = low + (np.indices((_CELLS,) * 3).reshape(3, -1).T + 0.5) * size
        radius = 0.5 * float(np.linalg.norm(size))
        kept = cells[_in_cones(cells, radius, outside, cameras._replace(poses=poses))]
        if not len(kept):
            raise SceneError(
                "The cones of the masks have no point in common. Check that masks and poses belong "
                "together, or give the centre of the scene."
            )
        low, high = kept.min(axis=0) - size, kept.max(axis=0) + size
    centre = kept.mean(axis=0)
    away = np.linalg.norm(kept - centre, axis=-1)
    radius = float(max(np.quantile(away, _BULK), _LEAST_REACH * away.max()))
    nearest = float(np.linalg.norm(poses[..., 3] - centre, axis=-1).min())
    if radius > _LARGEST * nearest:
        raise SceneError(
            f"The {len(shown)} masks leave the object's place unknown: it would have a radius of "
            f"{radius:.3g}, and a camera is {nearest:.3g} from its centre. Add views, or give "
            "--centre and --scale."
        )
    return Ball(centre, radius)


def sees(ball: Ball, cameras: Cameras) -> Bool[np.ndarray, " cameras"]:
    """Returns which cameras have the centre of a ball in their images."""
    return np.array([_seen(ball.centre[None], cameras, pose)[2][0] for pose in cameras.poses])


def _in_cones(
    cells: np.ndarray, radius: float, outside: Sequence[np.ndarray], cameras: Cameras
) -> np.ndarray:
    """Returns which cells touch the cones of enough masks; `outside` holds distances in pixels."""
    within, among = np.zeros(len(cells)), np.zeros(len(cells))
    for distance, pose in zip(outside, cameras.poses, strict=True):
        pixels, depth, seen = _seen(cells, cameras, pose)
        column, row = pixels[seen].astype(int).T
        reach = cameras.focal * radius / depth[seen] + 1.0
        among[seen] += 1.0
        within[seen] += distance[row, column] <= reach
    return (within >= _AGREE * among) & (among >= _SEE * len(outside))


def _seen(
    points: np.ndarray, cameras: Cameras, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns pixels, planar depths, and which of them are within the image."""
    pixels, depths = project(points, pose, cameras)
    size = np.array([cameras.width, cameras.height])
    inside = np.all((pixels >= 0.0) & (pixels < size), axis=-1)
    return pixels, depths, inside & (depths > 0.0)
