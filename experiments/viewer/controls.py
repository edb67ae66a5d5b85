"""The page around the image: its panel of controls and its 3D scene.

The scene holds the objects, the test cameras and the light paths of a pixel. Functions take a
`viser` page's `gui` or `scene` and never import that package.
"""

from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8

from experiments.viewer import cameras, session
from experiments.viewer.session import Choice, Subject
from refref_jax.geometry.bvh import LEAF_SIZE
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.surfaces import LevelSet, Surfaces
from refref_jax.render.pixel_paths import Pieces

_LOWEST, _HIGHEST, _STEP = 1.0, 2.5, 0.001

_HINT = (
    "Click a pixel to draw its light paths. Yellow and thick is much light, blue and thin little."
)

_COLOURS = matplotlib.colormaps["plasma"]

# Throughput at the ends of the scale of colours, which is logarithmic.
_WEAKEST, _STRONGEST = 1e-3, 1.0

THICKNESSES = (1.0, 2.0, 3.5, 5.5)
"""Line widths, pixels, from weak to strong light; each stands for one part of the scale."""

_BODY_COLOURS = ((110, 190, 235), (240, 170, 90), (140, 210, 130), (220, 130, 190))
_OPACITY = 0.15


class Panel:
    """The controls of one page, and their values."""

    def __init__(
        self,
        gui: Any,
        subject: Subject,
        *,
        changed: Callable[[], None],
        show_objects: Callable[[bool], None],
        show_cameras: Callable[[bool], None],
        remove_paths: Callable[[], None],
    ) -> None:
        """Adds the controls.

        Args:
          gui: GUI of the page.
          subject: displayed run.
          changed: callback after every choice that changes the image.
          show_objects: function that shows or hides the objects.
          show_cameras: function that shows or hides the test cameras.
          remove_paths: function that removes the light paths.
        """
        first = session.first_choice(subject)
        self._own = first.indices
        self._layer = gui.add_dropdown("layer", subject.layers, initial_value=first.layer)
        self._status = gui.add_markdown("")
        self._sliders, self._min_throughput, self._max_bends = [], None, None
        if first.max_bends:
            self._add_light(gui, subject, first)
        controls = [self._layer, self._min_throughput, self._max_bends, *self._sliders]
        for control in filter(None, controls):
            control.on_update(lambda _: changed())
        self._objects = gui.add_checkbox("objects", False, visible=bool(first.max_bends))
        self._objects.on_update(lambda _: show_objects(self._objects.value))
        box = gui.add_checkbox("test cameras", False, visible=subject.views is not None)
        box.on_update(lambda _: show_cameras(box.value))
        with gui.add_folder("light paths", visible=subject.has_paths):
            self._paths = gui.add_markdown(_HINT)
            self._remove = gui.add_button("remove", visible=False)

        @self._remove.on_click
        def _(_: Any) -> None:
            remove_paths()
            self._paths.content = _HINT
            self._remove.visible = False

    def choice(self) -> Choice:
        """Returns the chosen settings."""
        # A slider rounds to its step: unmoved ones keep the trained value.
        moved = [slider.value for slider in self._sliders]
        indices = [
            own if abs(own - new) <= _STEP else new
            for own, new in zip(self._own, moved or self._own, strict=True)
        ]
        return Choice(
            self._layer.value,
            tuple(indices),
            float(self._min_throughput.value) if self._min_throughput else 0.0,
            int(self._max_bends.value) if self._max_bends else 0,
        )

    def say(self, text: str) -> None:
        """Writes a line below the layer."""
        self._status.content = text

    def show_table(self, table: str) -> None:
        """Shows a table of light paths, and the objects that they pass through."""
        self._paths.content = f"{table}\n\n{_HINT}"
        self._remove.visible = True
        self._objects.value = True

    def _add_light(self, gui: Any, subject: Subject, first: Choice) -> None:
        with gui.add_folder("light"):
            for name, index in zip(subject.parts, first.indices, strict=True):
                lowest, highest = min(_LOWEST, index), max(_HIGHEST, index)
                self._sliders.append(
                    gui.add_slider(
                        f"index of {name}",
                        round(lowest, 3),
                        round(highest, 3),
                        _STEP,
                        round(index, 3),
                        hint="index of refraction",
                    )
                )
            hint = "A new value is compiled once, which takes a while."
            for name, offered, own in (
                ("min_throughput", session.THRESHOLDS, first.min_throughput),
                ("max_bends", session.BENDS, first.max_bends),
            ):
                values = [f"{x:g}" for x in np.unique([*offered, own])]
                control = gui.add_dropdown(name, values, initial_value=f"{own:g}", hint=hint)
                setattr(self, f"_{name}", control)


class Scenery:
    """The nodes of one page's scene."""

    def __init__(self, scene: Any, surfaces: Surfaces | LevelSet, views: Cameras | None) -> None:
        """Adds objects and cameras, hidden.

        Args:
          scene: 3D scene of the page.
          surfaces: the objects' surfaces; they may have no triangle, and a level set has none.
          views: the test cameras.
        """
        self._scene = scene
        self._objects = [
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

    def show_objects(self, shown: bool) -> None:
        """Shows or hides the objects."""
        for node in self._objects:
            node.visible = shown

    def show_cameras(self, shown: bool) -> None:
        """Shows or hides the test cameras."""
        for node in self._cameras:
            node.visible = shown

    def show_paths(self, pieces: Pieces) -> None:
        """Draws a pixel's light paths in place of the previous ones; strong light is thick."""
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
            wxyz, position = cameras.to_browser(pose)
            fov = cameras.containing_fov(views, aspect)
            options = {"scale": 0.2, "color": (60, 60, 60), "visible": False}
            node = self._scene.add_camera_frustum(
                f"/cameras/{i}", fov, aspect, wxyz=wxyz, position=position, **options
            )
            nodes.append(node)
        return nodes


def triangles_by_part(surfaces: Surfaces | LevelSet) -> dict[int, Float[np.ndarray, "faces 3 3"]]:
    """Returns the triangles of each part that has any, without the padding of their tree."""
    if isinstance(surfaces, LevelSet):
        return {}
    corners = np.asarray(surfaces.bvh.triangles)[:-LEAF_SIZE]
    parts = np.asarray(surfaces.parts)[:-LEAF_SIZE]
    return {int(part): corners[parts == part] for part in np.unique(parts)}


def strength(shares: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the positions of shares of light on the log scale from 0.1 % to 100 %, in [0, 1]."""
    held = np.clip(shares, _WEAKEST, _STRONGEST)
    return np.log(held / _WEAKEST) / np.log(_STRONGEST / _WEAKEST)


def colour(shares: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of lines: dark blue for 0.1 % of a pixel's light, yellow for 100 %."""
    return np.round(255.0 * _COLOURS(strength(shares))[:, :3]).astype(np.uint8)
