"""The controls of one page.

Functions here are given a `viser` page's controls and never import that package.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.viewer import subject as subjects
from experiments.viewer.subject import Choice, Subject

_LOWEST, _HIGHEST, _STEP = 1.0, 2.5, 0.001

_HINT = (
    "Click a pixel to draw its light paths. Yellow and thick is much light, blue and thin little."
)


class Panel:
    """The controls of one page, and what is chosen on them."""

    def __init__(
        self,
        gui: Any,
        subject: Subject,
        *,
        changed: Callable[[], None],
        show_bodies: Callable[[bool], None],
        show_cameras: Callable[[bool], None],
        remove_paths: Callable[[], None],
    ) -> None:
        """Adds the controls.

        Args:
          gui: of the page.
          subject: what is looked at.
          changed: called after every choice that changes the picture.
          show_bodies: shows or hides the bodies.
          show_cameras: shows or hides the test cameras.
          remove_paths: removes the light paths.
        """
        first = subjects.first_choice(subject)
        self._own = first.indices
        self._layer = gui.add_dropdown("layer", subject.layers, initial_value=first.layer)
        self._status = gui.add_markdown("")
        self._sliders, self._cut, self._bends = [], None, None
        if first.bends:
            self._add_light(gui, subject, first)
        controls = [self._layer, self._cut, self._bends, *self._sliders]
        for control in filter(None, controls):
            control.on_update(lambda _: changed())
        self._bodies = gui.add_checkbox("bodies", False, visible=bool(first.bends))
        self._bodies.on_update(lambda _: show_bodies(self._bodies.value))
        cameras = gui.add_checkbox("test cameras", False, visible=subject.views is not None)
        cameras.on_update(lambda _: show_cameras(cameras.value))
        with gui.add_folder("light paths"):
            self._paths = gui.add_markdown(_HINT)
            self._remove = gui.add_button("remove", visible=False)

        @self._remove.on_click
        def _(_: Any) -> None:
            remove_paths()
            self._paths.content = _HINT
            self._remove.visible = False

    def choice(self) -> Choice:
        """Returns what is chosen."""
        # A slider rounds to its step: what was not moved stays as it was trained.
        moved = [slider.value for slider in self._sliders]
        indices = [
            own if abs(own - new) <= _STEP else new
            for own, new in zip(self._own, moved or self._own, strict=True)
        ]
        return Choice(
            self._layer.value,
            tuple(indices),
            float(self._cut.value) if self._cut else 0.0,
            int(self._bends.value) if self._bends else 0,
        )

    def say(self, text: str) -> None:
        """Writes a line below the layer."""
        self._status.content = text

    def show_table(self, table: str) -> None:
        """Shows a table of light paths, and the bodies that they go through."""
        self._paths.content = f"{table}\n\n{_HINT}"
        self._remove.visible = True
        self._bodies.value = True

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
                ("cut", subjects.CUTS, first.cut),
                ("bends", subjects.BENDS, first.bends),
            ):
                values = [f"{x:g}" for x in np.unique([*offered, own])]
                control = gui.add_dropdown(name, values, initial_value=f"{own:g}", hint=hint)
                setattr(self, f"_{name}", control)
