"""The readable rendering of one ray equals the compiled one, on rays of three scenes."""

import dataclasses

import jax
import numpy as np
import pytest

from refref_jax.optics.path_settings import PAPER, TREE
from refref_jax.render import Model, init_params, render_ray, render_rays
from tests.factories import scenes
from tests.factories.small_model import MODEL

_CLEAR = dataclasses.replace(MODEL, interior="clear", footprint="differential")
_TINTED = dataclasses.replace(MODEL, interior="absorbing", learned_tints=2, last_sample="end")

_SCENES = {
    "glass ball, path tree": (_CLEAR, TREE, [scenes.ball(subdivisions=3)]),
    "water in glass, learned tints": (
        _TINTED,
        PAPER,
        [scenes.ball(), scenes.ball(0.7, index=1.333, name="drink_water")],
    ),
    "box, the paper's paths, field inside": (MODEL, PAPER, [scenes.box()]),
}


# The most paths to render one by one, uncompiled.
_SLOW = ("glass ball, path tree", "water in glass, learned tints")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in _SLOW)) for name in _SCENES]
)
def test_render_ray_equals_render_rays(name):
    config, settings, parts = _SCENES[name]
    model = Model(config, settings, scenes.build(*parts), _params(config))
    rays = scenes.rays([[-4.0, 0.21, 0.33]], [1.0, 0.02, 0.01])
    expected = _compiled(model, rays)
    assert expected.distance[0] > 0.0
    got = render_ray(model, jax.tree.map(lambda x: x[0], rays))
    np.testing.assert_allclose(got, expected.rgb[0], atol=2e-6)
    # The object bends the ray: its background is not that of a straight one.
    ends = scenes.trace_ends(model.scene, rays, settings=settings).ends
    assert np.max(ends.num_bends) >= 2


def _compiled(model, rays):
    def render(params, scene):
        return render_rays(model._replace(params=params, scene=scene), rays)

    return jax.jit(render)(model.params, model.scene)


def _params(config):
    """Random parameters whose densities and colours vary strongly in space."""
    params = init_params(jax.random.PRNGKey(3), config)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.PRNGKey(4), len(leaves))
    noisy = [x + 0.5 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, noisy)
