"""Images of backdrops, which are rendered from the ends of light paths."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import refref_jax
from refref_jax.geometry.cameras import image_rays
from refref_jax.numerics import host_array
from refref_jax.optics.path_settings import PAPER, STRAIGHT, TREE
from refref_jax.render import Model, images, render_image, render_rays
from refref_jax.render.learned_media import LearnedTints
from refref_jax.render.model import BackdropConfig, Params, init_params
from tests.factories import scenes
from tests.factories.small_model import CAMERAS, MODEL

_CLEAR = dataclasses.replace(MODEL, interior="clear", backdrop=BackdropConfig(32))
_TINTED = "learned tints, in a box"

_CASES = {
    _TINTED: (dataclasses.replace(_CLEAR, learned_tints=1), PAPER),
    "radiance by direction, in an environment": (
        dataclasses.replace(
            _CLEAR, space="unbounded", backdrop=BackdropConfig(32, view_dependence="linear")
        ),
        TREE,
    ),
}


@functools.cache
def _model(case):
    config, settings = _CASES[case]
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(0)
    levels = jax.tree.map(lambda x: rng.uniform(0.0, 0.3, x.shape).astype("f4"), shapes.field)
    tints = None
    if config.learned_tints:
        tints = LearnedTints(*rng.normal(size=(2, 1, 3)).astype("f4"))
    return Model(config, settings, scenes.build(scenes.ball()), Params((), levels, tints))


@pytest.mark.slow
@pytest.mark.parametrize("case", _CASES)
def test_images_show_what_complete_light_paths_see(case):
    model, rays = _model(case), image_rays(CAMERAS, 1)
    seen = render_image(model, rays)
    flat = jax.tree.map(lambda x: jnp.asarray(x.reshape(-1, *x.shape[2:])), rays)
    whole = jax.jit(lambda params: render_rays(model._replace(params=params), flat))(model.params)
    met = np.isfinite(images.find_first_surface(model.scene.surfaces, rays).distances)
    assert 0.1 < met.mean() < 0.9 and np.std(seen.linear[met]) > 0.01
    for name, value in seen._asdict().items():
        expected = np.asarray(getattr(whole, name)).reshape(value.shape)
        np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-5, err_msg=name)


def test_straight_rays_and_none_are_rendered():
    model = _model(_TINTED)
    straight = model._replace(settings=STRAIGHT, params=model.params._replace(tints=None))
    config = dataclasses.replace(model.config, learned_tints=0)
    seen = render_image(straight._replace(config=config), image_rays(CAMERAS, 1))
    np.testing.assert_array_equal(seen.accumulation, 1.0)
    nothing = jax.tree.map(lambda x: host_array(x[:0]), image_rays(CAMERAS, 1))
    assert render_image(model, nothing).rgb.shape == (0, 16, 3)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [STRAIGHT, TREE])
def test_scenes_without_objects_show_the_backdrop(settings):
    model = _model("radiance by direction, in an environment")
    rays = image_rays(CAMERAS, 1)
    bare = render_image(model._replace(scene=refref_jax.assemble([]), settings=settings), rays)
    seen = render_image(model, rays)
    met = np.isfinite(images.find_first_surface(model.scene.surfaces, rays).distances)
    np.testing.assert_allclose(bare.linear[~met], seen.linear[~met], atol=1e-6)
    assert np.all(np.isfinite(bare.linear)) and np.abs(bare.linear - seen.linear)[met].max() > 0.01


@pytest.mark.slow
def test_every_ray_may_meet_an_object():
    model = _model("radiance by direction, in an environment")
    whole = image_rays(CAMERAS, 1)
    met = np.isfinite(images.find_first_surface(model.scene.surfaces, whole).distances)
    hits = jax.tree.map(lambda x: host_array(x[met]), whole)
    seen = render_image(model, hits)
    np.testing.assert_allclose(seen.linear, render_image(model, whole).linear[met], atol=1e-6)
    np.testing.assert_allclose(seen.accumulation, 1.0, atol=1e-5)
