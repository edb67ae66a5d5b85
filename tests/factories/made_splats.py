"""Gaussians in front of a camera, for tests."""

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.splats.gaussians import Gaussians, View

FOCAL, WIDTH, HEIGHT = 35.0, 40, 28


def gaussians(count, *, seed=1, sizes=(0.02, 0.25)):
    """Returns random Gaussians around the origin."""
    draw = np.random.default_rng(seed)
    values = Gaussians(
        draw.uniform(-1.2, 1.2, (count, 3)),
        draw.normal(size=(count, 4)),
        np.log(draw.uniform(*sizes, (count, 3))),
        2.0 * draw.normal(size=count),
        draw.normal(size=(count, 3)),
        0.2 * draw.normal(size=(count, 15, 3)),
    )
    return jax.device_put(jax.tree.map(np.float32, values))


def view(*, seed=1, distance=2.0):
    """Returns a view of the origin from a random side."""
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    position = -turn.T @ np.array([0.0, 0.0, distance])
    return jax.device_put(View(*map(np.float32, (turn, position, FOCAL))))


def one(mean, *, scale=0.1, opacity=0.8, colour=(1.0, 0.0, 0.0), quaternion=(1, 0, 0, 0)):
    """Returns a single Gaussian of one colour, as a list of one; scales are one or three."""
    opacity = np.float64(opacity)
    with np.errstate(divide="ignore"):
        scales = np.log(np.broadcast_to(np.float64(scale), 3))
        logit = np.log(opacity) - np.log1p(-opacity)
    constant = (np.array(colour) - 0.5) / 0.28209479177387814
    values = (mean, quaternion, scales, logit, constant, np.zeros((15, 3)))
    return jax.device_put(Gaussians(*(np.float32(x)[None] for x in values)))


def joined(*parts):
    """Returns all Gaussians of several lists."""
    return jax.device_put(jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))


AHEAD = View(jnp.eye(3), jnp.zeros(3), jnp.float32(20.0))
"""The camera at the origin that looks along z."""
