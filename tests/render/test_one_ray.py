"""The readable rendering of one ray equals the compiled one, on rays of three scenes."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from refref_jax.fields import registry
from refref_jax.optics import path_tracing
from refref_jax.optics.path_settings import PAPER, TREE
from refref_jax.render import (
    Model,
    init_params,
    pixels,
    render_ray,
    render_rays,
    volume_rendering,
)
from refref_jax.sampling.scene_bounds import DistanceWarp
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


@pytest.mark.slow
@pytest.mark.parametrize("name", _SCENES)
def test_render_ray_equals_render_rays(name, monkeypatch):
    config, settings, parts = _SCENES[name]
    model = Model(config, settings, scenes.build(*parts), _params(config))
    rays = scenes.rays([[-4.0, 0.21, 0.33]], [1.0, 0.02, 0.01])
    expected = _compiled(model, rays)
    assert expected.distance[0] > 0.0
    _compile_parts(monkeypatch)
    ray = jax.tree.map(lambda x: x[0], rays)
    got = render_ray(model, ray)
    np.testing.assert_allclose(got, expected.rgb[0], atol=2e-6)
    # The object bends the ray: its background is not that of a straight one.
    assert max(path.num_bends for path in pixels._light_paths(model, ray)) >= 2


def _compiled(model, rays):
    def render(params, scene):
        return render_rays(model._replace(params=params, scene=scene), rays)

    return jax.jit(render)(model.params, model.scene)


def _compile_parts(monkeypatch):
    """Compiles what `render_ray` calls, each in one program instead of operation by operation."""
    for module, name, fixed in [
        (path_tracing, "trace", ("settings", "detail")),
        (volume_rendering, "polyline", ("config",)),
        (registry, "density", ("config",)),
        (registry, "radiance", ("config",)),
    ]:
        compiled = jax.jit(getattr(module, name), static_argnames=fixed)
        monkeypatch.setattr(module, name, compiled)
    _compile_samples(monkeypatch)


def _compile_samples(monkeypatch):
    """Compiles `sample`, whose numbers of the scene are constants of the program."""
    original = volume_rendering.sample

    @functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
    def compiled(config, near, unit, count, line, far, histograms, options):
        warp = DistanceWarp(near, far, unit)
        return original(config, line, warp, histograms, count, **options)

    def sample(config, line, warp, histograms, count, **options):
        return compiled(config, warp.near, warp.unit, count, line, warp.far, histograms, options)

    monkeypatch.setattr(volume_rendering, "sample", sample)


@functools.partial(jax.jit, static_argnums=0)
def _params(config):
    """Random parameters whose densities and colours vary strongly in space."""
    params = init_params(jax.random.PRNGKey(3), config)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.PRNGKey(4), len(leaves))
    noisy = [x + 0.5 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, noisy)
