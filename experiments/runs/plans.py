"""The options of training, and the run that they ask for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.runs import model_options, refraction_indices
from refref_jax.optics.budgets import BUDGETS

if TYPE_CHECKING:
    from refref_jax.data.meshes import MeshPart

with epy.lazy_imports():
    from experiments.runs import choices, planning

SCENE = cli_flags.scene("The scene to train on", required=False)
_PRESET = cli_flags.preset("Size of the model and its training.")
_FIELD = flags.DEFINE_enum(
    "field",
    cli_flags.FIELDS[0],
    cli_flags.FIELDS,
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
BUDGET = cli_flags.budget()
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
_RULE = cli_flags.rule()
IOR = cli_flags.ior()
SPACE = cli_flags.space()
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.", 1)
_BATCH = flags.DEFINE_integer("batch", None, "Rays a step; the preset's if not given.", 1)
SEED = cli_flags.seed()


def _parse_samples(words: list[str] | None) -> tuple[int, ...] | None:
    return None if words is None else model_options.parse_samples(words)


app.check(_SAMPLES, _parse_samples)
app.check(_MULTISAMPLES, model_options.check_multisamples)
app.check(_ENTRIES, model_options.check_entries)

SETTLED = (
    _PRESET,
    _FIELD,
    PATHS,
    *BUDGET,
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
    _RULE,
    IOR,
    *SPACE,
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
    return cli_scenes.opened(SCENE.value).resolve()


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
        rule=_RULE.value,
        indices=refraction_indices.parse_named(IOR.value)
        if body is None
        else {body.name: body.index},
        space=SPACE.chosen(),
        radius=SPACE.radius.value,
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
        BUDGET.chosen(PATHS.value)
    cli_scenes.check(SCENE.value)
    if SCENE.value is None and not resume:
        raise ValueError("No scene is given. Add --scene=FOLDER, or --resume to go on with a run.")


def _wishes() -> choices.Wishes:
    asked = {"reentry": _REENTRY.value, "interior": _INTERIOR.value, "tints": _TINTS.value}
    decided = {name: None if value == "auto" else value for name, value in asked.items()}
    followed = {"cut": BUDGET.cut.value, "bends": BUDGET.bends.value}
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


def _indices(body: MeshPart | None) -> dict[str, float]:
    given = refraction_indices.parse_named
    return given(IOR.value) if body is None else {body.name: body.index}
