"""What stands in the 3D scene of the page: bodies, test cameras, and a pixel's light paths.

Functions here are given a `viser` scene and never import that package.
"""

from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8

from experiments.viewer import viewpoints
from refref_jax.geometry.bvh import LEAF_SIZE
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.render.pixel_paths import Pieces

_COLOURS = matplotlib.colormaps["plasma"]

# Throughput at the ends of the scale of colours, which is logarithmic.
_WEAKEST, _STRONGEST = 1e-3, 1.0

THICKNESSES = (1.0, 2.0, 3.5, 5.5)
"""Of lines, pixels, from weak to strong light: each stands for one share of the scale."""

_BODY_COLOURS = ((110, 190, 235), (240, 170, 90), (140, 210, 130), (220, 130, 190))
_OPACITY = 0.15


class Scenery:
    """The nodes of one page's scene."""

    def __init__(self, scene: Any, surfaces: Surfaces, views: Cameras | None) -> None:
        """Adds bodies and cameras, hidden.

        Args:
          scene: of the page.
          surfaces: the bodies; they may have no triangle.
          views: the test cameras.
        """
        self._scene = scene
        self._bodies = [
            scene.add_mesh_simple(
                f"/bodies/{part}",
                triangles.reshape(-1, 3),
                np.arange(3 * len(triangles)).reshape(-1, 3),
                color=_BODY_COLOURS[part % len(_BODY_COLOURS)],
                opacity=_OPACITY,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
                visible=False,
            )
            for part, triangles in triangles_by_part(surfaces).items()
        ]
        self._cameras = [] if views is None else self._add_cameras(views)
        self._paths: list[Any] = []

    def show_bodies(self, shown: bool) -> None:
        """Shows or hides the bodies."""
        for node in self._bodies:
            node.visible = shown

    def show_cameras(self, shown: bool) -> None:
        """Shows or hides the test cameras."""
        for node in self._cameras:
            node.visible = shown

    def show_paths(self, pieces: Pieces) -> None:
        """Draws a pixel's light paths in place of the last ones; strong light is thick."""
        self.remove_paths()
        strengths = np.minimum(
            (strength(pieces.shares) * len(THICKNESSES)).astype(int), len(THICKNESSES) - 1
        )
        for rank, thickness in enumerate(THICKNESSES):
            which = strengths == rank
            if which.any():
                colours = colour(pieces.shares[which])
                node = self._scene.add_line_segments(
                    f"/paths/{rank}",
                    pieces.ends[which],
                    np.repeat(colours[:, None], 2, axis=1),
                    thickness=thickness,
                    thickness_units="screen",
                )
                self._paths.append(node)

    def remove_paths(self) -> None:
        """Removes the light paths."""
        for node in self._paths:
            node.remove()
        self._paths = []

    def _add_cameras(self, views: Cameras) -> list[Any]:
        nodes = []
        aspect = views.width / views.height
        for i, pose in enumerate(views.poses):
            wxyz, position = viewpoints.to_browser(pose)
            fov = viewpoints.containing_fov(views, aspect)
            options = {"scale": 0.2, "color": (60, 60, 60), "visible": False}
            node = self._scene.add_camera_frustum(
                f"/cameras/{i}", fov, aspect, wxyz=wxyz, position=position, **options
            )
            nodes.append(node)
        return nodes


def triangles_by_part(surfaces: Surfaces) -> dict[int, Float[np.ndarray, "faces 3 3"]]:
    """Returns the triangles of each part that has any, without the slots that pad their tree."""
    corners = np.asarray(surfaces.bvh.triangles)[:-LEAF_SIZE]
    parts = np.asarray(surfaces.parts)[:-LEAF_SIZE]
    return {int(part): corners[parts == part] for part in np.unique(parts)}


def strength(shares: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns where on the logarithmic scale from 0.1 % to 100 % shares of light lie, in [0, 1]."""
    held = np.clip(shares, _WEAKEST, _STRONGEST)
    return np.log(held / _WEAKEST) / np.log(_STRONGEST / _WEAKEST)


def colour(shares: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of lines: dark blue for 0.1 % of a pixel's light, yellow for all."""
    return np.round(255.0 * _COLOURS(strength(shares))[:, :3]).astype(np.uint8)
