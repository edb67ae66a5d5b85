"""Options of commands that follow light with a budget of the user's choice."""

from absl import flags

from experiments.cli import command_line
from refref_jax.optics import budgets
from refref_jax.optics.budgets import Budget

CUT = flags.DEFINE_float(
    "cut", None, "Smallest throughput worth following, in [0, 1); that of --paths if not given."
)
BENDS = flags.DEFINE_integer(
    "bends", None, "Most refractions and reflections of a path; that of --paths if not given."
)
command_line.check(CUT, lambda cut: budgets.budget_of("tree", cut=cut))
command_line.check(BENDS, lambda bends: budgets.budget_of("tree", bends=bends))


def chosen(paths: str) -> Budget:
    """Returns the budget of a name, with the cut and the bends that were asked for."""
    return budgets.budget_of(paths, cut=CUT.value, bends=BENDS.value)
