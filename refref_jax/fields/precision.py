"""Arithmetic precision of fields: float32, or mixed precision with bfloat16.

With `bfloat16`, tables are read and matrices multiplied in bfloat16. Parameters, sums, gradients
and outputs stay in float32: bfloat16 has only 8 significant bits, so small gradients would be lost
in a sum of many.

Source: Micikevicius et al., Mixed Precision Training (2018), for the float32 master weights.
"""

import functools
from collections.abc import Callable
from typing import Any, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from refref_jax.choices import Precision


def check_precision(precision: str) -> None:
    """Checks the name of a precision.

    Raises:
      ValueError: if the name is not one of `Precision`.
    """
    choices = get_args(Precision)
    if precision not in choices:
        raise ValueError(
            f"The precision must be one of {', '.join(choices)}, not {precision!r}. Choose one."
        )


def dense(precision: Precision) -> Callable[..., nn.Dense]:
    """Returns flax's dense layer, `x @ kernel + bias`, with factors in a given precision."""
    return nn.Dense if precision == "float32" else functools.partial(nn.Dense, dot_general=_product)


def _product(left: Array, right: Array, axes: Any, precision: None = None) -> Array:
    """Returns the matrix product of factors rounded to bfloat16, summed in their original type."""
    factors = left.astype(jnp.bfloat16), right.astype(jnp.bfloat16)
    return jax.lax.dot_general(
        *factors, axes, precision=precision, preferred_element_type=left.dtype
    )
