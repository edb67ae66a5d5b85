"""The state of a page: the displayed run, its settings, and the next image to draw.

The second part is a state machine without clock, threads or images. Everything that alters the
view, a moving camera or a slider, is a *change*. Images are drawn in *stages*, small to large.
During changes, only the first stage is drawn, repeatedly; `STILL` seconds after the last one the
larger stages follow, one after the other.

A change makes larger stages stale, and their drawing should stop. The first stage is never stale:
it is always completed and shown, since a camera in constant motion would otherwise show nothing.
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.viewer import cameras, layers
from refref_jax.data import meshes, scene_folder
from refref_jax.data.scene_folder import Frames
from refref_jax.geometry.cameras import Cameras, orbit
from refref_jax.render import Model

THRESHOLDS = (0.1, 0.05, 0.02, 0.01, 0.005)
"""Throughput thresholds offered in addition to a model's own."""

BENDS = (2, 4, 6, 10, 24, 32)
"""Max bends offered in addition to a model's own."""

# Without test views: a pose like those of the data set's cameras.
_DISTANCE, _ELEVATION, _FOV = 4.0, math.radians(20.0), math.radians(50.0)

STILL = 0.25
"""Seconds without a change after which an image is refined."""


@dataclasses.dataclass(frozen=True)
class Subject:
    """Displayed run.

    Attributes:
      name: name of the run.
      model: trained model of the scene.
      rule: outside medium of each part, a name in `interface_rules.RULES`.
      frames: test views of the scene, if it exists.
      parts: name of each part.
      heights: heights of the images before cropping, pixels, ascending.
      chunk: number of paths rendered at once.
    """

    name: str
    model: Model
    rule: str
    frames: Frames | None
    parts: tuple[str, ...]
    heights: tuple[int, ...]
    chunk: int | None

    @functools.cached_property
    def layers(self) -> tuple[str, ...]:
        """The available layers."""
        return layers.offered(self.model, truth=self.frames is not None)

    @property
    def has_paths(self) -> bool:
        """Whether pixels have light paths; Gaussian splats have none."""
        return self.model.config.splats is None

    @property
    def views(self) -> Cameras | None:
        """The test cameras."""
        return None if self.frames is None else self.frames.cameras


@dataclasses.dataclass(frozen=True)
class Choice:
    """Settings that a user has chosen on the panel.

    Attributes:
      layer: displayed layer.
      indices: index of refraction of each part.
      min_throughput: throughput threshold.
      max_bends: largest number of bends of a path.
    """

    layer: str
    indices: tuple[float, ...]
    min_throughput: float
    max_bends: int


class State(NamedTuple):
    """State between two events.

    Attributes:
      stages: number of sizes.
      change: number of the last change, counted from 1; 0 before any.
      changed_at: time of the last change, seconds of a steady clock.
      drawn: number of drawn stages of the last change.
    """

    stages: int
    change: int = 0
    changed_at: float = 0.0
    drawn: int = 0


class Job(NamedTuple):
    """An image to draw.

    Attributes:
      change: number of a change; the image shows the state after it, or after a later one.
      stage: size of the image.
    """

    change: int
    stage: int


def first_choice(subject: Subject) -> Choice:
    """Returns the initial settings: those of the trained model."""
    indices = tuple(float(x) for x in np.asarray(subject.model.scene.interfaces.index_inside))
    settings = subject.model.settings
    return Choice(layers.RGB, indices, settings.min_throughput, settings.max_bends)


def chosen_model(subject: Subject, choice: Choice) -> Model:
    """Returns the model with the chosen settings; the initial ones leave it as it was trained."""
    model = subject.model
    if model.settings.max_bends == 0:
        return model
    interfaces = model.scene.interfaces
    if choice.indices != first_choice(subject).indices:
        # On the device, as those of the model are, so that both share one compiled program.
        interfaces = jax.device_put(layers.with_indices(interfaces, choice.indices, subject.rule))
    settings = model.settings
    if (choice.min_throughput, choice.max_bends) != (settings.min_throughput, settings.max_bends):
        settings = dataclasses.replace(
            settings, min_throughput=choice.min_throughput, max_bends=choice.max_bends
        )
    return model._replace(scene=model.scene._replace(interfaces=interfaces), settings=settings)


def part_names(scene: Path | None, count: int) -> tuple[str, ...]:
    """Returns the names of a model's parts: those of the scene's meshes, if the counts match."""
    stems = tuple(path.stem for path in meshes.mesh_files(scene)) if scene else ()
    return stems if len(stems) == count else tuple(f"part {i + 1}" for i in range(count))


def read_test_views(scene: Path) -> Frames:
    """Reads the test views of a scene."""
    return scene_folder.read_frames(scene, "test")


def first_viewpoint(subject: Subject, aspect: float = cameras.ASPECT) -> cameras.Viewpoint:
    """Returns a new page's camera: the first test view, or one that looks at the scene's centre."""
    if subject.views is not None:
        fov = cameras.containing_fov(subject.views, aspect)
        return cameras.Viewpoint(subject.views.poses[0], fov, aspect)
    around = orbit(
        1,
        distance=_DISTANCE,
        elevation=_ELEVATION,
        size=1,
        angle_x=1.0,
        centre=subject.model.config.centre,
    )
    return cameras.Viewpoint(around.poses[0], _FOV, aspect)


def changed(state: State, now: float) -> State:
    """Returns the state after a change at the given time."""
    return state._replace(change=state.change + 1, changed_at=now, drawn=0)


def next_job(state: State, now: float) -> Job | None:
    """Returns the job to draw at the given time, or `None` if there is nothing to draw yet."""
    pause = wait(state, now)
    return Job(state.change, state.drawn) if pause == 0.0 else None


def wait(state: State, now: float) -> float | None:
    """Returns the seconds until there is something to draw; `None` to wait for a change."""
    if state.change == 0 or state.drawn >= state.stages:
        return None
    if state.drawn == 0:
        return 0.0
    return max(0.0, state.changed_at + STILL - now)


def is_stale(state: State, job: Job) -> bool:
    """Returns whether a job should be cancelled."""
    return job.stage > 0 and job.change != state.change


def finished(state: State, job: Job) -> State:
    """Returns the state after a job; outdated jobs leave the state unchanged."""
    if job.change != state.change:
        return state
    return state._replace(drawn=job.stage + 1)
