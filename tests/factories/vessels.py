"""A bottle in front of a smooth backdrop, and pixels of it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.reconstruct import gauss_newton, photometry
from refref_jax.reconstruct.families import fit_revolution
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.render import backdrop
from refref_jax.sampling.scene_bounds import Domain
from tests.factories import lit_scenes, revolved

_mipmap = jax.jit(backdrop.mipmap, static_argnames="space")


@functools.cache
def bottle():
    """A bottle, 2.6 high."""
    knee = revolved.arc((0.75, -1.15), 0.15, -90, 0)
    neck = revolved.arc((0.35, 1.2), 0.1, 0, 90)
    shoulder = [[0.9, -0.2], [0.85, 0.1], [0.7, 0.35], [0.52, 0.55], [0.45, 0.75]]
    profile = np.concatenate([[[0.0, -1.3]], knee, shoulder, neck, [[0.0, 1.3]]])
    return fit_revolution(revolved.revolve(revolved.even(profile, 160), azimuths=64))


def smooth_backdrop():
    """A cube of smooth random radiance."""
    side, random = 32, np.random.default_rng(0)
    pyramid = backdrop.init(side, radiance=0.4)
    levels = [
        jnp.asarray(level + size * random.normal(size=level.shape), jnp.float32)
        for level, size in zip(pyramid, (0.12, 0.12, 0.08, 0.04), strict=True)
    ]
    mips = _mipmap(tuple(jnp.maximum(level, -0.1) for level in levels), space="bounded")
    return Backdrop(Domain(8.0, "bounded"), mips, tuple(jnp.ones_like(mip) for mip in mips))


def photographs(model, surface, *, count=4096, reach=0.6):
    """Pixels of a model at its start, without noise."""
    rays, views = lit_scenes.pixels(count, reach=reach)
    traced = gauss_newton.traced_object(model.pose(model.start()))
    rgb = photometry.encode(photometry.predict(traced, surface, rays).linear)
    return Photographs(jax.device_get(rays), rgb, views)
