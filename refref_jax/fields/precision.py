"""The arithmetic of a field: single precision, or half of it where that is enough.

With `bfloat16` a field reads its tables, and multiplies its matrices, in bfloat16. Parameters,
sums, gradients and what leaves the field stay in float32: a bfloat16 has eight bits, and a sum of
many small gradients would lose them.

Source: Micikevicius et al., Mixed Precision Training (2018), for the float32 masters.
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
    """Checks a name.

    Raises:
      ValueError: if it is not one of `Precision`.
    """
    choices = get_args(Precision)
    if precision not in choices:
        raise ValueError(
            f"The precision is one of {', '.join(choices)}, not {precision!r}. Choose one."
        )


def dense(precision: Precision) -> Callable[..., nn.Dense]:
    """Returns flax's dense layer, `x @ kernel + bias`, with the factors in a precision."""
    return nn.Dense if precision == "float32" else functools.partial(nn.Dense, dot_general=_product)


def _product(left: Array, right: Array, axes: Any, precision: None = None) -> Array:
    """Returns the matrix product of factors in bfloat16, summed in the type they came in."""
    factors = left.astype(jnp.bfloat16), right.astype(jnp.bfloat16)
    return jax.lax.dot_general(
        *factors, axes, precision=precision, preferred_element_type=left.dtype
    )
