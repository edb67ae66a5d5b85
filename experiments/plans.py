"""What a run of training is to be: from options and the scene's needs to a resolved plan."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from absl import flags

from experiments import choices, model_options, scenes
from experiments.choices import Choices, Wishes
from experiments.model_options import ModelOptions
from experiments.presets import PRESETS, bounds
from refref_jax.data import background, containment, local_layout, meshes, needs
from refref_jax.data.batches import check_batch
from refref_jax.data.cameras import Cameras
from refref_jax.data.geometry import build_geometry
from refref_jax.optics.budgets import BUDGETS
from refref_jax.optics.media import EMPTY_SLOT
from refref_jax.optics.wavefront import Geometry
from refref_jax.render.config import ModelConfig
from refref_jax.render.saved import SavedModel
from refref_jax.sampling.domains import Space
from refref_jax.training.config import SceneConfig, TrainingConfig

SCENE = flags.DEFINE_string("scene", None, "Folder of the scene to train on.")
_PRESET = flags.DEFINE_enum("preset", "tiny", list(PRESETS), "Size of the model and its training.")
_PATHS = flags.DEFINE_enum(
    "paths",
    None,
    list(BUDGETS),
    "Light paths: 'straight' ignores the objects; 'paper' bends up to 10 times and reflects at "
    "the first surface; 'tree' follows every branch that carries light. By default 'tree' if there "
    "are meshes, else 'straight'.",
)
_CUT = flags.DEFINE_float(
    "cut", None, "Smallest throughput worth following, in [0, 1); that of --paths if not given."
)
_BENDS = flags.DEFINE_integer(
    "bends", None, "Most refractions and reflections of a path; that of --paths if not given."
)
_REENTRY = flags.DEFINE_enum(
    "reentry",
    "auto",
    ["auto", "possible", "impossible"],
    "Whether light that has left the objects may meet them again; by default found out.",
)
_INTERIOR = flags.DEFINE_enum(
    "interior",
    "auto",
    ["auto", "field", "clear", "absorbing"],
    "Inside the objects: a learned 'field' (the paper), nothing ('clear'), or interfaces and media "
    "that take light ('absorbing'). By default 'clear' if scene.json tells that all is, else "
    "'absorbing'.",
)
_TINTS = flags.DEFINE_enum(
    "tints",
    "auto",
    ["auto", "given", "learned"],
    "Colours of interfaces and media of an absorbing interior: those of scene.json, or learned; by "
    "default given if scene.json tells them.",
)
_FOOTPRINT = flags.DEFINE_enum(
    "footprint",
    None,
    ["cone", "differential"],
    "Footprint of a pixel: widened by arc length, or followed through the bends. The preset's if "
    "not given.",
)
_SAMPLES = flags.DEFINE_list(
    "samples",
    None,
    "Samples along a path in each proposal round, then in the final one, as 32,20. The preset's if "
    "not given.",
)
_MULTISAMPLES = flags.DEFINE_integer(
    "multisamples",
    None,
    "Points that stand for a sample's cone, 1 or 6; the preset's if not given.",
)
_ENTRIES = flags.DEFINE_integer(
    "entries",
    None,
    "Most entries of a level of the radiance field's hash grid, as their base-2 logarithm; the "
    "preset's if not given.",
)
_FINEST = flags.DEFINE_integer(
    "finest", None, "Cells a side of that grid's finest level; the preset's if not given."
)
_PRECISION = flags.DEFINE_enum(
    "precision",
    None,
    ["float32", "bfloat16"],
    "Arithmetic of the fields; the preset's if not given.",
)
flags.adopt_module_key_flags(scenes)
_BACKGROUND = flags.DEFINE_enum(
    "background",
    "auto",
    ["auto", "bounded", "unbounded"],
    "Whether there are walls, or an environment infinitely far away.",
)
_RADIUS = flags.DEFINE_float(
    "radius",
    None,
    "Half edge of the cube on whose faces a bounded scene's background stands (by default that of "
    "scene.json, else 7.3), or radius of an unbounded scene's uncontracted ball, in world units.",
    lower_bound=1e-6,
)
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.", 1)
_BATCH = flags.DEFINE_integer("batch", None, "Rays a step; the preset's if not given.", 1)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of everything random.", 0, 2**32 - 1)

SETTLED = (
    _PRESET,
    _PATHS,
    _CUT,
    _BENDS,
    _REENTRY,
    _INTERIOR,
    _TINTS,
    _FOOTPRINT,
    _SAMPLES,
    _MULTISAMPLES,
    _ENTRIES,
    _FINEST,
    _PRECISION,
    scenes.RULE,
    scenes.IOR,
    _BACKGROUND,
    _RADIUS,
    _STEPS,
    _BATCH,
    _SEED,
)
"""Options that a run is begun with, and can not change when it is resumed."""


class Plan(NamedTuple):
    """A run before it begins."""

    config: TrainingConfig
    model: SavedModel
    geometry: Geometry


def plan_from_flags() -> Plan:
    """Reads and checks the scene, resolves all options, and prints what it comes to."""
    if SCENE.value is None:
        raise ValueError("No scene is given. Add --scene=FOLDER.")
    scene = Path(SCENE.value).resolve()
    local_layout.check_scene(scene)
    frames = local_layout.read_frames(scene, "train")
    parts = meshes.read_meshes(scene, indices=scenes.given_indices())
    tree = containment.find_containment(parts)
    scenes.report_meshes(parts, tree, rule=scenes.RULE.value)
    if scenes.RULE.value == "priority":
        _refuse_cameras_inside(parts, frames.cameras)
    space = background.space(scene) if _BACKGROUND.value == "auto" else _BACKGROUND.value
    found = needs.find_needs(parts, tree, frames.cameras, rule=scenes.RULE.value, space=space)
    chosen = choices.choose(found, _wishes())
    config = _training(scene, frames.cameras, chosen)
    model = SavedModel(_model(scene, frames.cameras, space, chosen), chosen.budget)
    print(
        "\n".join([needs.describe(found), *choices.report(config, model, chosen), *chosen.warnings])
    )
    coloured = parts if chosen.tints == "given" else meshes.without_colour(parts)
    return Plan(config, model, build_geometry(coloured, tree.parents, rule=scenes.RULE.value))


def _wishes() -> Wishes:
    asked = {"reentry": _REENTRY.value, "interior": _INTERIOR.value, "tints": _TINTS.value}
    decided = {name: None if value == "auto" else value for name, value in asked.items()}
    return Wishes(paths=_PATHS.value, cut=_CUT.value, bends=_BENDS.value, **decided)


def _training(scene: Path, cameras: Cameras, chosen: Choices) -> TrainingConfig:
    preset = PRESETS[_PRESET.value]
    batch = _BATCH.value or preset.batch
    check_batch(cameras, batch)
    indices = tuple(sorted(scenes.given_indices().items()))
    return TrainingConfig(
        scene=SceneConfig(str(scene), scenes.RULE.value, indices),
        paths=chosen.paths,
        loss=preset.loss,
        schedule=preset.schedule.over(_STEPS.value or preset.schedule.steps),
        batch=batch,
        pool=preset.pool,
        seed=_SEED.value,
    )


def _model(scene: Path, cameras: Cameras, space: Space, chosen: Choices) -> ModelConfig:
    radius = _RADIUS.value or (background.half_extent(scene) if space == "bounded" else None)
    extent = bounds(cameras, space=space, radius=radius)
    model = PRESETS[_PRESET.value].model(extent, chosen.interior)
    model = dataclasses.replace(model, learned_tints=chosen.learned_tints)
    options = ModelOptions(
        samples=None if _SAMPLES.value is None else model_options.parse_samples(_SAMPLES.value),
        multisamples=_MULTISAMPLES.value,
        entries=_ENTRIES.value,
        finest=_FINEST.value,
        precision=_PRECISION.value,
        footprint=_FOOTPRINT.value,
    )
    return model_options.override(model, options, preset=_PRESET.value)


def _refuse_cameras_inside(parts: list[meshes.MeshPart], cameras: Cameras) -> None:
    """Refuses cameras whose rays would have to know at once what they are in."""
    if np.any(containment.parts_around(parts, cameras.poses[:, :, 3]) != EMPTY_SLOT):
        raise ValueError(
            "A camera stands inside a mesh, which training can not follow under --rule=priority. "
            "Use --rule=nested, or move the camera."
        )
