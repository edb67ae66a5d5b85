"""What a run of training is to be: from what is asked and the scene's needs to a resolved plan."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.runs import choices, mesh_report, model_options
from experiments.runs.choices import Choices, Wishes
from experiments.runs.model_options import ModelOptions
from refref_jax.data import background, containment, local_layout, meshes, needs
from refref_jax.data.batches import check_batch
from refref_jax.data.geometry import build_geometry
from refref_jax.data.meshes import MeshPart
from refref_jax.fields import registry
from refref_jax.geometry.cameras import Cameras
from refref_jax.optics.media import EMPTY_SLOT
from refref_jax.optics.scene import Scene
from refref_jax.render.config import ModelConfig
from refref_jax.render.saved import SavedModel
from refref_jax.sampling.domains import Space
from refref_jax.training import presets
from refref_jax.training.config import DistortionOver, SceneConfig, TrainingConfig
from refref_jax.training.presets import PRESETS, bounds


class Request(NamedTuple):
    """What is asked of a run; `None` leaves a choice to the scene or the preset.

    Attributes:
      scene: folder of the scene.
      preset: name of a preset.
      wishes: what is to be modelled of the light.
      options: what replaces parts of the preset's model.
      rule: what lies outside a mesh.
      indices: indices of refraction by material or mesh, over those of the scene.
      space: whether there are walls.
      radius: of the walls' cube or sphere, or of the uncontracted ball, world units.
      steps: training steps.
      batch: rays a step.
      seed: of everything random.
      distortion_over: which samples the distortion loss counts, see `LossConfig`.
      parts: the objects, where they are not to be read from the scene's meshes.
      field: kind of the fields, see `fields.registry`.
    """

    scene: Path
    preset: str
    wishes: Wishes = Wishes()
    options: ModelOptions = ModelOptions()
    rule: str = "nested"
    indices: Mapping[str, float] = {}
    space: Space | None = None
    radius: float | None = None
    steps: int | None = None
    batch: int | None = None
    seed: int = 0
    distortion_over: DistortionOver = "outside"
    parts: Sequence[MeshPart] | None = None
    field: str = registry.USUAL


class Plan(NamedTuple):
    """A run before it begins."""

    config: TrainingConfig
    model: SavedModel
    geometry: Scene


def make_plan(request: Request) -> Plan:
    """Reads and checks the scene, resolves all choices, and prints what it comes to.

    Raises:
      ValueError: if the scene is broken, or what is asked can not be had.
    """
    scene, rule = request.scene, request.rule
    local_layout.check_scene(scene)
    cameras = local_layout.read_frames(scene, "train").cameras
    parts = request.parts
    if parts is None:
        parts = meshes.read_meshes(scene, indices=request.indices)
    tree = containment.find_containment(parts)
    mesh_report.report_meshes(parts, tree, rule=rule)
    if rule == "priority":
        _refuse_cameras_inside(parts, cameras)
    space = request.space or background.space(scene)
    found = needs.find_needs(parts, tree, cameras, rule=rule, space=space)
    chosen = choices.choose(found, request.wishes)
    model = SavedModel(_model(request, cameras, space, chosen), chosen.budget)
    config = _training(request, cameras, chosen, model.config)
    print(
        "\n".join([needs.describe(found), *choices.report(config, model, chosen), *chosen.warnings])
    )
    coloured = parts if chosen.tints == "given" else meshes.without_colour(parts)
    return Plan(config, model, build_geometry(coloured, tree.parents, rule=rule))


def _training(
    request: Request, cameras: Cameras, chosen: Choices, model: ModelConfig
) -> TrainingConfig:
    preset = PRESETS[request.preset]
    batch = request.batch or preset.batch
    check_batch(cameras, batch)
    indices = tuple(sorted(request.indices.items()))
    return TrainingConfig(
        scene=SceneConfig(str(request.scene), request.rule, indices),
        paths=chosen.paths,
        loss=dataclasses.replace(presets.loss(model), distortion_over=request.distortion_over),
        schedule=preset.schedule.over(request.steps or preset.schedule.steps),
        batch=batch,
        pool=preset.pool,
        pixels="all",
        seed=request.seed,
    )


def _model(request: Request, cameras: Cameras, space: Space, chosen: Choices) -> ModelConfig:
    told = background.half_extent(request.scene) if space != "unbounded" else None
    extent = bounds(cameras, space=space, radius=request.radius or told)
    model = PRESETS[request.preset].model(extent, chosen.interior, field=request.field)
    model = dataclasses.replace(model, learned_tints=chosen.learned_tints)
    return model_options.override(model, request.options, preset=request.preset)


def _refuse_cameras_inside(parts: Sequence[MeshPart], cameras: Cameras) -> None:
    """Refuses cameras whose rays would have to know at once what they are in."""
    if np.any(containment.parts_around(parts, cameras.poses[:, :, 3]) != EMPTY_SLOT):
        raise ValueError(
            "A camera stands inside a mesh, which training can not follow under --rule=priority. "
            "Use --rule=nested, or move the camera."
        )
