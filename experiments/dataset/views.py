"""Lists the missing views of scenes and their render jobs (NumPy only)."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from experiments.dataset import cameras, frame_files, scene_setup
from experiments.dataset.cameras import Split
from experiments.dataset.parts import Object, ObjectPart
from experiments.dataset.render_settings import RenderSettings
from experiments.dataset.seeds import seed_of
from experiments.dataset.workers import Job, Task
from refref_jax.data.scene_names import SceneName

# Number of seeds that Blender accepts.
_SEEDS = 1 << 31

_DETAIL = 1.0

# Light of an emitting part where it faces downwards, as a share of that where it faces upwards.
_DARKEST = 0.4


class View(NamedTuple):
    """One view to render.

    Attributes:
      scene: scene of the view.
      split: split of the view.
      number: number of the view in its split.
    """

    scene: SceneName
    split: Split
    number: int

    @property
    def name(self) -> str:
        """Name of the view in messages."""
        return f"{self.scene} {self.split} {self.number}"


def all_views(chosen: Sequence[SceneName], settings: RenderSettings) -> list[View]:
    """Returns all views of some scenes."""
    return [
        View(scene, split, number)
        for scene in chosen
        for split in cameras.SPLITS
        for number in settings.numbers(split)
    ]


def is_done(out: Path, view: View, settings: RenderSettings) -> bool:
    """Returns whether a view is rendered."""
    linear = settings.keeps_linear(view.split)
    return frame_files.is_done(out / str(view.scene), view.split, view.number, linear=linear)


def seed(view: View) -> int:
    """Returns Blender's seed for a view."""
    return seed_of(str(view.scene), view.split, f"r_{view.number:03d}") % _SEEDS


def tasks(
    out: Path,
    views: Sequence[View],
    settings: RenderSettings,
    *,
    objects: Mapping[str, Object],
    scratch: Path,
) -> Iterator[Task]:
    """Yields render jobs; the folder of a scene is created with its first view.

    Args:
      out: folder of the scenes.
      views: views to render; those of one scene follow each other.
      settings: settings of the rendering.
      objects: objects by name.
      scratch: existing folder for temporary files.
    """

    # Consecutive scenes share their object.
    @lru_cache(maxsize=1)
    def make(name: str) -> Sequence[ObjectPart]:
        made = objects[name].make(_DETAIL)
        return made if settings.opaque == "lit" else [emitting(part) for part in made]

    for view in views:
        scene, folder = view.scene, out / str(view.scene)
        parts = partial(make, scene.object)
        scene_setup.make(folder, scene, settings, parts=parts, scratch=scratch)
        poses = cameras.split_poses(str(scene), view.split, getattr(settings.views, view.split))
        job = Job(
            scene=str(folder.absolute()),
            pose=poses[view.number].tolist(),
            angle_x=cameras.ANGLE_X,
            samples=getattr(settings.spp, view.split),
            seed=seed(view),
        )
        yield Task(view.name, job, partial(_finish, folder, view, settings))


def emitting(part: ObjectPart) -> ObjectPart:
    """Returns a part that emits its albedo as light, brighter where it faces upwards.

    A tracer can render this light, while that of a part that is lit by the scene is unknown to it.
    Parts without an albedo are returned as they are.
    """
    if part.albedo is None:
        return part
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    upwards = 0.5 + 0.5 * np.asarray(mesh.vertex_normals)[:, 2:]
    light = np.array(part.albedo) * (_DARKEST + (1.0 - _DARKEST) * upwards)
    return part._replace(albedo=None, colours=frame_files.to_srgb(light))


def _finish(
    folder: Path, view: View, settings: RenderSettings, colours: Sequence[Path], geometry: Path
) -> None:
    rendering = frame_files.read_rendering(colours, geometry)
    linear = settings.keeps_linear(view.split)
    frame_files.write(folder, view.split, view.number, rendering, linear=linear)
