"""What is modelled of the light in a scene: what it needs, unless an option says otherwise."""

import dataclasses
from typing import NamedTuple

from experiments.runs.model_options import grid_of, samples_of
from experiments.runs.named_budgets import make_budget
from refref_jax.data.needs import Needs
from refref_jax.optics.budgets import Budget, Reentry
from refref_jax.optics.part_choices import KnownTints, Tints
from refref_jax.render.config import Interior, ModelConfig
from refref_jax.render.saved import SavedModel
from refref_jax.training.config import TrainingConfig

_OF_BENT_LIGHT = ("interior", "reentry")

# A field is everywhere where light goes straight.
_ANYWAY = ("field", "possible")


class Wishes(NamedTuple):
    """What options ask for; `None` leaves the choice to the scene's needs.

    Attributes:
      paths: name of a budget of light paths.
      cut: smallest throughput worth following.
      bends: most bends of a path.
      reentry: whether a ray that has left the objects may meet them again.
      interior: what is modelled inside the objects.
      tints: where their colours come from.
    """

    paths: str | None = None
    cut: float | None = None
    bends: int | None = None
    reentry: Reentry | None = None
    interior: Interior | None = None
    tints: KnownTints | None = None


class Choices(NamedTuple):
    """What is modelled.

    Attributes:
      paths: name of the budget of light paths.
      budget: which light to follow.
      interior: what is modelled inside the objects.
      tints: where the colours of interfaces and media come from; `none` if light paths carry none.
      learned_tints: number of parts whose colours are learned.
      warnings: what is doubtful about the wishes.
    """

    paths: str
    budget: Budget
    interior: Interior
    tints: Tints
    learned_tints: int
    warnings: tuple[str, ...]


def choose(needs: Needs, wishes: Wishes) -> Choices:
    """Chooses what to model of a scene.

    Raises:
      ValueError: if the wishes contradict each other, or ask for what is not known.
    """
    if needs.parts == 0 and wishes.paths not in (None, "straight"):
        raise ValueError(
            f"There are no meshes, so there is nothing to bend light for --paths={wishes.paths}. "
            "Add .ply files of the objects to the scene's folder meshes, or use --paths=straight."
        )
    paths = wishes.paths or ("tree" if needs.parts else "straight")
    budget = make_budget(paths, cut=wishes.cut, bends=wishes.bends)
    if budget.bends:
        budget = dataclasses.replace(budget, reentry=wishes.reentry or needs.reentry)
    elif asked := [name for name in _OF_BENT_LIGHT if getattr(wishes, name) is not None]:
        _check_straight(paths, asked[0], getattr(wishes, asked[0]))
    interior = wishes.interior or _needed_interior(needs, wishes, budget)
    tints = _tints(needs, wishes, interior, budget)
    return Choices(
        paths=paths,
        budget=budget,
        interior=interior,
        tints=tints,
        learned_tints=needs.parts if tints == "learned" else 0,
        warnings=tuple(_doubts(needs, wishes)),
    )


def _check_straight(paths: str, name: str, value: str) -> None:
    """Refuses a wish about the inside of objects where light goes straight through them.

    Raises:
      ValueError: unless it asks for what there is anyway.
    """
    if value not in _ANYWAY:
        raise ValueError(
            f"--{name}={value} has no effect: light that goes straight (--paths={paths}) knows of "
            "no objects. Leave it out, or use --paths=tree with meshes."
        )


def report(config: TrainingConfig, model: SavedModel, chosen: Choices) -> list[str]:
    """Says what was resolved, a line for each choice with the options that change it."""
    budget, shape = model.budget, model.config
    tints = f", tints {chosen.tints}" if chosen.tints != "none" else ""
    lines = [
        (f"paths {chosen.paths}, cut {budget.cut:g}, {budget.bends} bends", "paths cut bends"),
        (f"re-entry {budget.reentry}", "reentry"),
        (f"interior {shape.interior}{tints}", "interior tints"),
        (f"{shape.space}, radius {shape.radius:g}", "background radius"),
        (
            f"samples {','.join(map(str, samples_of(shape)))} of {shape.multisamples} point"
            f"{'s' * (shape.multisamples > 1)}, {shape.footprint}",
            "samples multisamples footprint",
        ),
        _field_line(shape),
        (
            f"{config.schedule.steps} steps of {config.batch} rays, seed {config.seed}",
            "preset steps batch seed",
        ),
    ]
    if budget.bends == 0:
        del lines[1]
    options = ["  ".join(f"--{name}" for name in names.split()) for _, names in lines]
    return [f"  {text:<46}  {names}" for (text, _), names in zip(lines, options, strict=True)]


def _field_line(shape: ModelConfig) -> tuple[str, str]:
    """Returns what the fields are, and the options that change it."""
    field, grid = shape.field, grid_of(shape)
    if grid is None:
        return f"{field.kind}, {field.precision}", "field precision"
    table = f"grid 2^{grid.entries.bit_length() - 1}, finest {grid.finest}"
    return f"{field.kind}, {table}, {field.precision}", "field entries finest precision"


def _needed_interior(needs: Needs, wishes: Wishes, budget: Budget) -> Interior:
    if budget.bends == 0:
        return "field"  # Straight light ignores the objects, and so does what samples it.
    asked_to_learn = wishes.tints == "learned"
    return "clear" if needs.interior == "clear" and not asked_to_learn else "absorbing"


def _tints(needs: Needs, wishes: Wishes, interior: Interior, budget: Budget) -> Tints:
    if interior != "absorbing" or budget.bends == 0:
        given_as_clear = wishes.tints == "given" and needs.tints == "none" and interior == "clear"
        if wishes.tints is not None and not given_as_clear:
            raise ValueError(
                f"--tints={wishes.tints} has no effect with interior {interior} and at most "
                f"{budget.bends} bends. Leave it out, or use --interior=absorbing and bent paths."
            )
        return "none"
    if wishes.tints == "given" and needs.tints == "learned":
        raise ValueError(
            "--tints=given, but scene.json does not tell colour_per_interface or absorption of "
            "every part. Describe all of them there, or use --tints=learned."
        )
    return wishes.tints or ("learned" if needs.tints == "learned" else "given")


def _doubts(needs: Needs, wishes: Wishes) -> list[str]:
    doubts = []
    if wishes.interior == "clear" and needs.tints == "given":
        doubts.append(
            "warning: --interior=clear, but scene.json gives the objects colours, which will be "
            "missing. Use --interior=absorbing."
        )
    if wishes.reentry == "impossible" and needs.reentry == "possible":
        doubts.append(
            "warning: --reentry=impossible, but light that has left these objects may meet them "
            "again: it will be followed no further. Leave it out."
        )
    return doubts
