import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.cameras import image_rays
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import PAPER, STRAIGHT, TREE, everything
from refref_jax.render import Model, images, render_image, render_rays
from tests.factories import scenes
from tests.factories.small_model import CAMERAS, MODEL, initial


@pytest.fixture(scope="module", autouse=True)
def tile():
    """One image fills a tile: more rays would only take longer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "TILE", 256)
        yield


@pytest.fixture(scope="module")
def model():
    return Model(MODEL, PAPER, scenes.build(scenes.ball(1.3, subdivisions=2)), initial(MODEL))


@pytest.fixture(scope="module")
def whole(model, rays):
    return render_image(model, rays)


@pytest.mark.slow
def test_an_image_has_the_shape_of_its_rays(whole):
    assert whole.rgb.shape == (16, 16, 3)
    assert whole.distance.shape == whole.mean_distance.shape == (16, 16)
    assert np.all((whole.rgb >= 0.0) & (whole.rgb <= 1.0))
    assert np.all(np.isfinite(whole.distance)) and np.all(whole.distance >= MODEL.near)
    np.testing.assert_allclose(whole.accumulation, 1.0, atol=1e-5)


@pytest.mark.parametrize("chunk", [64, 100, 1000])
@pytest.mark.slow
def test_the_size_of_a_chunk_does_not_matter(model, rays, whole, chunk):
    pieces = render_image(model, rays, chunk=chunk)
    for ours, expected in zip(pieces, whole, strict=True):
        np.testing.assert_allclose(ours, expected, atol=2e-5)


@pytest.mark.slow
def test_rendering_in_one_piece_gives_the_same(model, rays, whole):
    flat = _first(rays, 256)
    single = jax.jit(lambda params: render_rays(model._replace(params=params), flat))
    for ours, expected in zip(single(model.params), whole, strict=True):
        np.testing.assert_allclose(ours, expected.reshape(ours.shape), atol=2e-5)


@pytest.mark.slow
def test_one_ray_through_glass_has_the_room_of_its_tile(model, rays, monkeypatch):
    monkeypatch.setattr(images, "TILE", 64)
    images._trace_tile.clear_cache()
    # The ray has two paths. 64 copies of it would have to share the room of 96, and lose 4 %.
    scarce = dataclasses.replace(TREE, paths_per_ray=1.5)
    middle = jax.tree.map(lambda x: x[8, 8:9], rays)
    seen = render_image(model._replace(settings=scarce), middle)
    images._trace_tile.clear_cache()
    np.testing.assert_array_equal(seen.dropped, 0.0)
    np.testing.assert_allclose(seen.accumulation, 1.0, atol=1e-5)


@pytest.mark.slow
def test_an_image_of_several_tiles(model, rays, whole, monkeypatch):
    monkeypatch.setattr(images, "TILE", 100)
    images._trace_tile.clear_cache()
    tiled = render_image(model, rays)
    images._trace_tile.clear_cache()
    for ours, expected in zip(tiled, whole, strict=True):
        np.testing.assert_allclose(ours, expected, atol=2e-5)


@pytest.mark.slow
def test_nothing_is_compiled_twice(model):
    render_image(model, image_rays(CAMERAS, 0))
    before = images._trace_tile._cache_size(), images._render_chunk._cache_size()
    for camera in (1, 2):
        render_image(model, image_rays(CAMERAS, camera))
    assert (images._trace_tile._cache_size(), images._render_chunk._cache_size()) == before


@pytest.mark.slow
@pytest.mark.parametrize("rays_per_pixel", [1, 4])
def test_no_image_compiles_after_the_warm_up_off_cpus(model, monkeypatch, rays_per_pixel):
    monkeypatch.setattr(images, "runs_on_cpu", lambda: False)
    monkeypatch.setattr(images, "TILE", 16)
    monkeypatch.setattr(images, "_SMALLEST_TILE", 16)
    straight = model._replace(settings=STRAIGHT)
    images.warm_up(straight, CAMERAS, rays_per_pixel=rays_per_pixel, chunk=64)
    before = images._trace_tile._cache_size(), images._render_chunk._cache_size()
    images.render_camera(straight, CAMERAS, 0, rays_per_pixel=rays_per_pixel, chunk=64)
    assert (images._trace_tile._cache_size(), images._render_chunk._cache_size()) == before


def _first(images, count):
    """Returns the first pixels of each image."""
    return jax.tree.map(lambda x: x.reshape(256, *x.shape[2:])[:count], images)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (2, 0), (3, 1, 2)])
def test_rays_may_have_any_leading_axes(model, rays, whole, shape):
    count = int(np.prod(shape))
    some = jax.tree.map(lambda x: x.reshape((*shape, *x.shape[1:])), _first(rays, count))
    seen = render_image(model, some)
    for ours, image in zip(seen, whole, strict=True):
        expected = _first(image, count).reshape((*shape, *image.shape[2:]))
        assert ours.shape == expected.shape
        np.testing.assert_allclose(ours, expected, atol=2e-5)


def test_a_chunk_of_nothing_is_refused(model, rays):
    with pytest.raises(ValueError, match="chunk is 0"):
        render_image(model, rays, chunk=0)


def test_rays_that_only_fill_up_a_tile_are_not_rendered(model, rays):
    flat = _first(rays, 200)
    full, _ = images.crop(flat, None, 0, 256)
    assert full.radii.shape == (256,)
    tile = images._trace_tile(model.scene, full, 200, settings=STRAIGHT, detail=everything(0))
    assert int(tile.count) == 200


@pytest.mark.slow
def test_rays_that_miss_pay_nothing_for_reflection(model, rays):
    flat = _first(rays, 256)
    paper = images._trace_tile(
        model.scene, flat, 256, settings=PAPER, detail=everything(PAPER.max_bends)
    )
    straight = images._trace_tile(model.scene, flat, 256, settings=STRAIGHT, detail=everything(0))
    count = int(paper.count)
    reflections = np.asarray(paper.paths.statuses)[:count] == PathStatus.NOT_TRACED
    hits = np.sum((np.asarray(paper.paths.num_bends)[:count] > 0) & ~reflections)
    assert 0 < hits < 256
    assert count - int(straight.count) == np.sum(reflections) == hits


@pytest.mark.slow
def test_gradients_reach_the_fields_and_are_finite(model, rays):
    flat = jax.tree.map(lambda x: x[::16], _first(rays, 256))

    @jax.jit
    @jax.grad
    def slope(params):
        return jnp.mean(render_rays(model._replace(params=params), flat).rgb)

    gradient = jax.tree.leaves(slope(model.params))
    assert all(np.all(np.isfinite(leaf)) for leaf in gradient)
    assert any(np.any(np.asarray(leaf) != 0.0) for leaf in gradient)
