"""What is shown: colours by hand, the sum of the branches, bands that are called off."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.figures import comparison
from experiments.viewer import layers, session
from experiments.viewer.session import Subject
from refref_jax.data import image_files
from refref_jax.data.scene_folder import read_frames
from refref_jax.geometry.cameras import image_rays
from refref_jax.optics.interface_rules import RULES
from refref_jax.optics.path_settings import PAPER, STRAIGHT
from refref_jax.render import Model, images, render_image
from refref_jax.render import pixels as rendering
from tests.factories import scenes
from tests.factories.small_model import CAMERAS, MODEL, initial

_RAYS = image_rays(CAMERAS, 0)
_OPTIONS = {"chunk": 4096, "most": 256, "cancelled": lambda: False}


@pytest.fixture(scope="module")
def model():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "TILE", 256)
        scene = scenes.build(scenes.ball(1.3, subdivisions=2))
        yield Model(MODEL, PAPER, scene, initial(MODEL))


def _blank():
    return rendering.blank(jnp.zeros((0, 3)))


def test_a_model_offers_what_it_has(model):
    assert layers.offered(model, truth=True) == (
        "rgb",
        "refraction only",
        "reflection only",
        "distance",
        "normals",
        "mask",
        "error",
    )
    straight = model._replace(settings=STRAIGHT)
    assert layers.offered(straight, truth=False) == ("rgb", "distance")


@pytest.mark.slow
def test_the_two_branches_sum_to_the_picture(model):
    both, through, mirrored = (
        render_image(model, _RAYS, branch=branch).linear
        for branch in ("both", "transmitted", "reflected")
    )
    np.testing.assert_allclose(through + mirrored, both, atol=1e-6)
    beside = layers.draw(model, layers.MASK, _RAYS, **_OPTIONS)[..., 0] == 0
    assert beside.any() and not mirrored[beside].any()
    # The paper's reflection carries Fresnel's share of each pixel of the body, and it is small.
    assert (mirrored[~beside].mean(-1) > 0.0).all()
    assert mirrored[~beside].mean() < 0.3 * through[~beside].mean()


@pytest.mark.slow
def test_another_index_is_another_picture_of_the_same_programs(model):
    subject = Subject("made", model, "nested", None, ("glass",), (9, 18), 4096)
    first = session.first_choice(subject)
    before = layers.draw(model, layers.RGB, _RAYS, **_OPTIONS)
    programs = (images._trace_tile, images._render_chunk)
    compiled = [program._cache_size() for program in programs]
    other = session.chosen_model(subject, dataclasses.replace(first, indices=(1.2,)))
    after = render_image(other, _RAYS)
    for branch in ("both", "transmitted", "reflected"):
        render_image(model, _RAYS, branch=branch)
    assert [program._cache_size() for program in programs] == compiled
    thin = render_image(other, _RAYS, branch="reflected").linear.mean()
    thick = render_image(model, _RAYS, branch="reflected").linear.mean()
    assert thin < 0.5 * thick and np.any(image_files.to_bytes(after.rgb) != before)


@pytest.mark.slow
def test_the_mask_is_the_disc_of_the_ball_and_distances_have_one_scale(model):
    mask = layers.draw(model, layers.MASK, _RAYS, **_OPTIONS)
    assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    # A ray meets a ball of 1.3 around the origin if it passes nearer than that.
    nearest = np.linalg.norm(np.cross(_RAYS.origins, _RAYS.directions), axis=-1)
    np.testing.assert_array_equal(mask[nearest < 1.26], 255)
    np.testing.assert_array_equal(mask[nearest > 1.3], 0)
    cropped = jax.tree.map(lambda x: x[4:11], _RAYS)
    drawn = layers.draw(model, layers.MASK, cropped, **_OPTIONS)
    np.testing.assert_array_equal(drawn, mask[4:11])
    # Distances have one scale from everywhere.
    seen = render_image(model, _RAYS).distance
    expected = comparison.colour_distances([seen], farthest=2.0 * MODEL.radius)[0]
    np.testing.assert_array_equal(layers.draw(model, layers.DISTANCE, _RAYS, **_OPTIONS), expected)


def test_a_drawing_that_is_called_off_ends_at_the_next_band(model, monkeypatch):
    rendered = []

    def render(model, rays, **_):
        rendered.append(rays.radii.shape)
        return _blank()._replace(rgb=np.zeros((*rays.radii.shape, 3)))

    monkeypatch.setattr(layers.images, "TILE", 64)  # bands of four rows
    monkeypatch.setattr(layers, "render_image", render)
    options = _OPTIONS | {"cancelled": lambda: len(rendered) == 2}
    assert layers.draw(model, layers.RGB, _RAYS, **options) is None
    assert rendered == [(4, 16), (4, 16)]
    options = _OPTIONS | {"cancelled": lambda: True}
    assert layers.draw(model, layers.NORMALS, _RAYS, **options) is None


def test_bands_are_joined_in_order(model, monkeypatch):
    monkeypatch.setattr(layers.images, "TILE", 48)  # bands of three rows, the last of one
    monkeypatch.setattr(
        layers,
        "render_image",
        lambda model, rays, **_: _blank()._replace(rgb=0.5 + 0.5 * rays.directions),
    )
    drawn = layers.draw(model, layers.RGB, _RAYS, **_OPTIONS)
    np.testing.assert_array_equal(drawn, image_files.to_bytes(0.5 + 0.5 * _RAYS.directions))


def test_an_error_is_that_of_the_pixels_that_are_drawn(model, ball_scene, monkeypatch):
    frames = read_frames(ball_scene, "test")
    pixels = layers.view_pixels(frames, 2, 128 * 128 // 4)
    assert pixels.target.shape == (64, 64, 3)
    true = image_files.read_rgb(frames.images[2]) / 255.0
    np.testing.assert_allclose(pixels.target, true[1::2, 1::2], atol=1e-6)
    every = layers.view_pixels(frames, 2, 10**6)
    np.testing.assert_array_equal(
        every.window.rays.directions, image_rays(frames.cameras, 2).directions
    )
    np.testing.assert_array_equal(
        every.window.rays.directions[1::2, 1::2], pixels.window.rays.directions
    )
    monkeypatch.setattr(layers.images, "TILE", 64 * 64)  # one band
    off = np.float32(0.1) * (pixels.target < 0.8)
    monkeypatch.setattr(
        layers,
        "render_image",
        lambda model, rays, **_: _blank()._replace(rgb=pixels.target + off),
    )
    options = {"chunk": 4096, "cancelled": lambda: False}
    image, error = layers.draw_error(model, pixels, **options)
    assert error == pytest.approx(0.1 * np.sqrt(np.mean(off > 0.0)), rel=1e-4)
    assert set(np.unique(image)) == {0, 102}  # 0.1 times 4, of 255
    assert layers.draw_error(model, pixels, chunk=1, cancelled=lambda: True) is None


@pytest.mark.parametrize("ambient", [1.0, 1.25])
@pytest.mark.parametrize("rule", RULES)
def test_other_indices_are_those_of_the_rule(rule, ambient):
    others = {"tints": [[0.9, 1.0, 1.0]] * 2, "priorities": [1, 2], "ambient": ambient}
    made = RULES[rule]([1.5, 1.33], [-1, 0], **others)
    changed = layers.with_indices(made, (1.6, 1.4), rule)
    expected = RULES[rule]([1.6, 1.4], [-1, 0], **others)
    for ours, theirs in zip(changed, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype
