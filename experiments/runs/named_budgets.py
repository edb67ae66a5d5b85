"""Budgets of light by name, as commands take them."""

import dataclasses
import math

from refref_jax.optics.budgets import BUDGETS, Budget

# Room is not given for smaller cuts, which would take any amount of memory.
_SMALLEST_CUT_WITH_ROOM = 5e-4


def make_budget(paths: str, *, cut: float | None = None, bends: int | None = None) -> Budget:
    """Returns a budget by name, with another cut or number of bends, and room for what that takes.

    Args:
      paths: a name in `BUDGETS`.
      cut: smallest throughput worth following; the budget's own if `None`.
      bends: most bends; the budget's own if `None`.

    Raises:
      ValueError: if light is straight and has a cut or bends nevertheless.
    """
    budget = BUDGETS[paths]
    if budget.bends == 0 and (cut is not None or bends is not None):
        raise ValueError(
            f"--paths={paths} has no --cut and no --bends. Leave them out, or use --paths=tree."
        )
    return vary(budget, cut=cut, bends=bends)


def vary(budget: Budget, *, cut: float | None = None, bends: int | None = None) -> Budget:
    """Returns a budget with another cut or number of bends, and room for what that takes.

    Below the budget's own cut room grows as the inverse square root of the cut, and that of
    segments with the bends beyond its own: a flask of three media needs both. What finds no room
    nevertheless is told as lost.

    Args:
      budget: one that bends light.
      cut: smallest throughput worth following; the budget's own if `None`.
      bends: most bends; the budget's own if `None`.
    """
    given = {"cut": cut, "bends": bends}
    changed = dataclasses.replace(budget, **{k: v for k, v in given.items() if v is not None})
    if changed.bends > budget.bends:
        longer = changed.bends / budget.bends * budget.segments_per_ray
        changed = dataclasses.replace(changed, segments_per_ray=longer)
    if not changed.cut < budget.cut:
        return changed
    growth = math.sqrt(budget.cut / max(changed.cut, _SMALLEST_CUT_WITH_ROOM))
    rooms = ("live_per_ray", "segments_per_ray", "paths_per_ray")
    return dataclasses.replace(changed, **{room: growth * getattr(changed, room) for room in rooms})
