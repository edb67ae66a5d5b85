"""A body before a field whose colours are known, and pixels of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.geometry.rays import Rays
from refref_jax.optics.path_settings import TREE
from refref_jax.reconstruct.refractive_index import Evidence
from refref_jax.render import Model, init_params, render_rays
from tests.factories import scenes
from tests.factories.small_model import MODEL

CONFIG = dataclasses.replace(MODEL, interior="clear")


def params(*, contrast=1.0):
    """A field of patches, a few units wide, that differ in every colour.

    A contrast of 1 is faint, 0.02 around a mean of 0.7; of 3 it is that of a picture, 0.3.
    """
    plain = init_params(jax.random.key(3), CONFIG)
    noise = jax.random.key(4)

    def louder(path, leaf):
        table = leaf.ndim == 2 and leaf.shape[-1] == 2
        return contrast * (jax.random.normal(noise, leaf.shape) if table else leaf)

    return plain._replace(field=jax.tree_util.tree_map_with_path(louder, plain.field))


def pixels(count=256, *, views=8, reach=0.75, seed=0):
    """Rays from some cameras onto a body at the origin, and the view of each."""
    generator = np.random.default_rng(seed)
    eyes = generator.normal(size=(views, 3))
    eyes *= 4.0 / np.linalg.norm(eyes, axis=1, keepdims=True)
    view = np.arange(count) % views
    targets = generator.normal(size=(count, 3))
    targets *= reach * generator.uniform(size=(count, 1)) / np.linalg.norm(targets, axis=1)[:, None]
    return scenes.rays(eyes[view], targets - eyes[view]), view


def evidence(scene, *, count=256, seed=0, contrast=1.0):
    """Pixels as the tree of light paths shows them."""
    rays, view = pixels(count, seed=seed)
    field = params(contrast=contrast)
    seen = jax.jit(lambda rays: render_rays(Model(CONFIG, TREE, scene, field), Rays(*rays)).rgb)
    return Evidence(field, rays, jnp.asarray(seen(rays))), view
