"""What is looked at: a trained model, what its scene tells of it, and how finely it is drawn."""

import dataclasses
import functools
import math
from pathlib import Path

import jax
import numpy as np

from experiments.viewer import layers, viewpoints
from refref_jax.data import local_layout, meshes
from refref_jax.data.local_layout import Frames
from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras
from refref_jax.render import Model

CUTS = (0.1, 0.05, 0.02, 0.01, 0.005)
"""Cuts that are offered beside a model's own."""

BENDS = (2, 4, 6, 10, 24, 32)
"""Bends that are offered beside a model's own."""

# Where there are no test views: as the data set's cameras stand.
_DISTANCE, _ELEVATION, _FOV = 4.0, math.radians(20.0), math.radians(50.0)


@dataclasses.dataclass(frozen=True)
class Subject:
    """What is looked at.

    Attributes:
      name: of the run.
      model: the scene.
      rule: what lies outside each part, a name in `interface_rules.RULES`.
      frames: the scene's test views, if it is there.
      parts: name of each part.
      heights: of the pictures before they are cropped, pixels, from small to large.
      chunk: paths rendered at once.
    """

    name: str
    model: Model
    rule: str
    frames: Frames | None
    parts: tuple[str, ...]
    heights: tuple[int, ...]
    chunk: int

    @functools.cached_property
    def layers(self) -> tuple[str, ...]:
        """What can be shown."""
        return layers.offered(self.model, truth=self.frames is not None)

    @property
    def views(self) -> Cameras | None:
        """The test cameras."""
        return None if self.frames is None else self.frames.cameras


@dataclasses.dataclass(frozen=True)
class Choice:
    """What a user has chosen on the panel.

    Attributes:
      layer: what is shown.
      indices: of refraction, of each part.
      cut: smallest throughput that is followed.
      bends: most bends of a path.
    """

    layer: str
    indices: tuple[float, ...]
    cut: float
    bends: int


def first_choice(subject: Subject) -> Choice:
    """Returns what is shown before anything is chosen: the model as it was trained."""
    indices = tuple(float(x) for x in np.asarray(subject.model.geometry.interfaces.index_inside))
    budget = subject.model.budget
    return Choice(layers.RGB, indices, budget.cut, budget.bends)


def chosen_model(subject: Subject, choice: Choice) -> Model:
    """Returns the model with what was chosen; with the first choice, as it was trained."""
    model = subject.model
    if model.budget.bends == 0:
        return model
    interfaces = model.geometry.interfaces
    if choice.indices != first_choice(subject).indices:
        # On the device, as those of the model are: what is compiled serves both.
        interfaces = jax.device_put(layers.with_indices(interfaces, choice.indices, subject.rule))
    budget = model.budget
    if (choice.cut, choice.bends) != (budget.cut, budget.bends):
        budget = dataclasses.replace(budget, cut=choice.cut, bends=choice.bends)
    return model._replace(geometry=model.geometry._replace(interfaces=interfaces), budget=budget)


def part_names(scene: Path | None, count: int) -> tuple[str, ...]:
    """Returns the names of a model's parts: those of the scene's meshes, if there are as many."""
    stems = tuple(path.stem for path in meshes.mesh_files(scene)) if scene else ()
    return stems if len(stems) == count else tuple(f"part {i + 1}" for i in range(count))


def read_test_views(scene: Path) -> Frames:
    """Reads the test views of a scene."""
    return local_layout.read_frames(scene, "test")


def first_viewpoint(subject: Subject, aspect: float = viewpoints.ASPECT) -> viewpoints.Viewpoint:
    """Returns where a new page looks from: the first test view, or somewhere beside the origin."""
    if subject.views is not None:
        fov = viewpoints.containing_fov(subject.views, aspect)
        return viewpoints.Viewpoint(subject.views.poses[0], fov, aspect)
    pose = cameras.orbit(1, distance=_DISTANCE, elevation=_ELEVATION, size=1, angle_x=1.0).poses[0]
    return viewpoints.Viewpoint(pose, _FOV, aspect)
