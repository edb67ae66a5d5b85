"""How light divides at an interface, under a budget. One ray.

Source: paper (arXiv 2505.05848), section 4.2, Fresnel blend; the conserving cut is ours.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax.optics.budgets import Budget


class Shares(NamedTuple):
    """Shares of the light that arrives, which sum to 1. A share of 0 is a branch not followed."""

    reflected: Float[Array, ""]
    transmitted: Float[Array, ""]


def shares(
    budget: Budget,
    *,
    reflectance: Float[Array, ""],
    total: Bool[Array, ""],
    first: Bool[Array, ""],
    strength: Float[Array, ""],
) -> Shares:
    """Divides light between its two branches.

    Where a reflection is not followed, transmitted light takes all of it. Where the weaker branch
    falls below the cut, the stronger one takes all: the cut blurs nothing and darkens nothing, it
    only moves a little light. Shares are constant where a branch is cut and follow `reflectance`
    elsewhere, so their gradient is Fresnel's or 0.

    Args:
      budget: which light to follow.
      reflectance: Fresnel's `R`.
      total: whether reflection is total.
      first: whether this is the first surface of a path.
      strength: throughput that arrives, times the interface's tint; the largest of its RGB.
    """
    if budget.reflections == "all":
        partial = reflectance
    elif budget.reflections == "first":
        partial = jnp.where(first, reflectance, 0.0)
    else:
        partial = jnp.zeros_like(reflectance)
    reflected = jnp.where(total, jnp.ones_like(partial), partial)
    weaker = jnp.minimum(reflected, 1.0 - reflected)
    winner = jnp.where(reflected > 0.5, jnp.ones_like(reflected), jnp.zeros_like(reflected))
    reflected = jnp.where(weaker * strength < budget.cut, winner, reflected)
    return Shares(reflected, 1.0 - reflected)
