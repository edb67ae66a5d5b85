"""Direction encodings of fields."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def spherical_harmonics(direction: Float[Array, "3"]) -> Float[Array, "16"]:
    """Returns the real spherical harmonics of degree 0 to 3 at a unit direction.

    Ordered by degree `l`, then by order `m = -l .. l`; orthonormal over the sphere; without the
    Condon-Shortley phase.

    Source: paper (arXiv 2505.05848), supplement (direction encoding); Sloan, Stupid Spherical
    Harmonics Tricks (2008), appendix A2.
    """
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    return jnp.stack(
        [
            0.28209479177387814 * jnp.ones_like(x),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3.0 * zz - 1.0),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5.0 * zz - 1.0),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            0.4570457994644658 * x * (5.0 * zz - 1.0),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3.0 * yy),
        ]
    )
