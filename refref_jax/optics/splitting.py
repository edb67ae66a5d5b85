"""Divides the throughput of one ray between reflection and transmission at an interface.

Source: paper (arXiv 2505.05848), section 4.2, Fresnel blend; the energy-conserving throughput
threshold is ours.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax.optics.budgets import Budget


class Shares(NamedTuple):
    """Shares of the incident throughput, which sum to 1. Branches of share 0 are not followed."""

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
    """Divides throughput between the two branches.

    If a reflection is not followed, the transmitted branch takes its share. If the weaker branch
    falls below the throughput threshold, the stronger one takes all, so the threshold neither
    darkens the image nor adds noise. Shares are constant if a branch is below the threshold and
    follow `reflectance` elsewhere, so their gradient is that of Fresnel's equations or 0.

    Args:
      budget: path settings.
      reflectance: Fresnel's `R`.
      total: whether reflection is total.
      first: whether this is the first surface of a path.
      strength: incident throughput times the interface's tint, the largest of its RGB.
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
