"""The options of training, and the run that they ask for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import (
    budget_options,
    choosable,
    command_line,
    options,
    scene_option,
    scenes,
    space_options,
)
from experiments.cli.late_imports import late
from experiments.runs import model_options
from refref_jax.optics.budgets import BUDGETS

if TYPE_CHECKING:
    from experiments.runs import choices, planning
    from refref_jax.data.meshes import MeshPart
else:
    choices = late("experiments.runs.choices")
    planning = late("experiments.runs.planning")

SCENE = flags.DEFINE_string("scene", None, f"The scene to train on: {options.SCENE_FORMS}.")
_PRESET = options.preset("Size of the model and its training.")
_FIELD = flags.DEFINE_enum(
    "field",
    choosable.FIELDS[0],
    choosable.FIELDS,
    "Kind of the fields that are learned: Zip-NeRF's, or without its anti-aliasing Nerfacto's.",
)
PATHS = flags.DEFINE_enum(
    "paths",
    None,
    list(BUDGETS),
    "Light paths: 'straight' ignores the objects; 'paper' bends up to 10 times and reflects at "
    "the first surface, with its ablations without that and without total reflection; 'tree' "
    "follows every branch that carries light. By default 'tree' if there are meshes, else "
    "'straight'.",
)
flags.adopt_module_key_flags(budget_options)
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
_DISTORTION = flags.DEFINE_enum(
    "distortion",
    "outside",
    ["outside", "everywhere"],
    "Samples that the distortion loss draws together: those outside the objects (the paper's "
    "correction), or all, as before it.",
)
flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(space_options)
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.", 1)
_BATCH = flags.DEFINE_integer("batch", None, "Rays a step; the preset's if not given.", 1)
SEED = options.seed()


def _parse_samples(words: list[str] | None) -> tuple[int, ...] | None:
    return None if words is None else model_options.parse_samples(words)


command_line.check(_SAMPLES, _parse_samples)
command_line.check(_MULTISAMPLES, model_options.check_multisamples)
command_line.check(_ENTRIES, model_options.check_entries)

SETTLED = (
    _PRESET,
    _FIELD,
    PATHS,
    budget_options.CUT,
    budget_options.BENDS,
    _REENTRY,
    _INTERIOR,
    _TINTS,
    _FOOTPRINT,
    _SAMPLES,
    _MULTISAMPLES,
    _ENTRIES,
    _FINEST,
    _PRECISION,
    _DISTORTION,
    scenes.RULE,
    scenes.IOR,
    space_options.BACKGROUND,
    space_options.RADIUS,
    _STEPS,
    _BATCH,
    SEED,
)
"""Options that a run is begun with, and can not change when it is resumed."""


def opened_scene() -> Path:
    """Returns the folder of the scene that the options name.

    Raises:
      ValueError: if they name none, or it is broken.
    """
    if SCENE.value is None:
        raise ValueError("No scene is given. Add --scene=FOLDER.")
    return scene_option.opened(SCENE.value).resolve()


def plan_from_flags(*, body: MeshPart | None = None) -> planning.Plan:
    """Plans the run that the options ask for, and prints what it comes to.

    Args:
      body: the reconstructed object; if `None`, the scene's own meshes are.
    """
    request = planning.Request(
        scene=opened_scene(),
        preset=_PRESET.value,
        field=_FIELD.value,
        wishes=_wishes(),
        options=_options(),
        rule=scenes.RULE.value,
        indices=scenes.given_indices() if body is None else {body.name: body.index},
        space=space_options.chosen_space(),
        radius=space_options.RADIUS.value,
        steps=_STEPS.value,
        batch=_BATCH.value,
        seed=SEED.value,
        distortion_over=_DISTORTION.value,
        parts=None if body is None else [body],
    )
    return planning.make_plan(request)


def check_options(*, resume: bool) -> None:
    """Refuses what can be told of the options alone, before anything is imported.

    Args:
      resume: whether a run may be gone on with, which knows its scene.

    Raises:
      ValueError: if one makes no sense, or there is no scene.
    """
    if PATHS.value is not None:
        budget_options.chosen(PATHS.value)
    scene_option.check(SCENE.value)
    if SCENE.value is None and not resume:
        raise ValueError("No scene is given. Add --scene=FOLDER, or --resume to go on with a run.")


def _wishes() -> choices.Wishes:
    asked = {"reentry": _REENTRY.value, "interior": _INTERIOR.value, "tints": _TINTS.value}
    decided = {name: None if value == "auto" else value for name, value in asked.items()}
    followed = {"cut": budget_options.CUT.value, "bends": budget_options.BENDS.value}
    return choices.Wishes(paths=PATHS.value, **followed, **decided)


def _options() -> model_options.ModelOptions:
    return model_options.ModelOptions(
        samples=_parse_samples(_SAMPLES.value),
        multisamples=_MULTISAMPLES.value,
        entries=_ENTRIES.value,
        finest=_FINEST.value,
        precision=_PRECISION.value,
        footprint=_FOOTPRINT.value,
    )
