"""The index's stage with nothing left out: a background is learned, and an index looked for."""

import dataclasses
import functools
import json
import shutil

import numpy as np
import pytest

from benchmarks.oracles import colours
from experiments.r3f import index_stage
from refref_jax.choices import SATURATED
from refref_jax.data import image_files, meshes, scene_analysis, scene_folder
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.reconstruct.refractive_index import IndexSearch
from refref_jax.render import checkpoint_io
from refref_jax.training import backdrop_equations, fit, run_folder
from refref_jax.training.loop import init_state
from refref_jax.training.resolve import read_facts, resolve

pytestmark = [pytest.mark.loose, pytest.mark.computing]


def _unstated(scene, folder):
    """The scene without a statement of what is behind the object, which is learned as a field."""
    copy = shutil.copytree(scene, folder / "ball")
    content = json.loads((copy / "scene.json").read_text())
    del content["background"]
    (copy / "scene.json").write_text(json.dumps(content))
    return copy


_SEARCH = functools.partial(IndexSearch, 1.47, 1.53, spacing=0.03, descents=1, most=4)


@pytest.mark.slow
def test_a_background_is_learned_beside_the_body_and_once(ball_scene, tmp_path, monkeypatch):
    (part,) = meshes.read_meshes(ball_scene)
    mesh = shaded_mesh(part)
    monkeypatch.setattr(index_stage, "IndexSearch", _SEARCH)
    monkeypatch.setattr(index_stage, "RAYS", 512)
    kept = []
    sampler = fit.PixelSampler

    def note(*arguments, **options):
        kept.append(options["kept"])
        return sampler(*arguments, **options)

    monkeypatch.setattr(fit, "PixelSampler", note)
    scene = _unstated(ball_scene, tmp_path)
    estimate = functools.partial(
        index_stage.run, scene, mesh, tmp_path, seed=3, start=1.49, steps=300
    )
    first, again = estimate(), estimate()
    assert first == again and len(kept) == 1
    config = run_folder.read_config(tmp_path / "background")
    assert (config.scene.pixels, config.paths.name, config.seed) == ("background", "straight", 3)
    assert config.model.far_field == "field"
    assert 0.2 < kept[0].mean() < 0.95
    assert first.index == pytest.approx(1.5, abs=0.01) and np.isfinite(first.deviation)
    assert len(first.descents) == 2 and (tmp_path / "index.png").stat().st_size > 5000


@pytest.mark.slow
def test_a_backdrop_is_solved_beside_the_body_and_the_index_found_before_it(
    ball_scene, tmp_path, monkeypatch
):
    (part,) = meshes.read_meshes(ball_scene)
    monkeypatch.setattr(index_stage, "IndexSearch", _SEARCH)
    monkeypatch.setattr(index_stage, "MANY_RAYS", 6000)
    among, solve = [], backdrop_equations.read

    def note(*arguments, **options):
        among.append(options["among"])
        return solve(*arguments, **options)

    monkeypatch.setattr(backdrop_equations, "read", note)
    estimate = functools.partial(
        index_stage.run, ball_scene, shaded_mesh(part), tmp_path, seed=3, start=1.49
    )
    first, again = estimate(), estimate()
    assert first == again and len(among) == 1
    config = run_folder.read_config(tmp_path / "background")
    assert (config.scene.pixels, config.model.far_field) == ("background", "backdrop")
    # No pixel that sees the object is solved for.
    masks = scene_folder.read_masks(scene_folder.read_frames(ball_scene, "train"))
    assert not np.any(among[0] & masks) and among[0].mean() > 0.2
    assert first.index == pytest.approx(1.5, abs=3e-3) and 0.0 < first.deviation < 3e-3
    assert len(first.descents) == 2 and (tmp_path / "index.png").stat().st_size > 5000


def _with_drifting_exposure(scene, folder):
    """Returns the scene with a gain of each training image and channel, and these gains."""
    copy, generator = shutil.copytree(scene, folder / "drifting"), np.random.default_rng(0)
    frames = scene_folder.read_frames(copy, "train")
    drawn = generator.normal(0.0, 0.12, (len(frames.names), 3))
    gains = np.exp(drawn - drawn.mean(axis=0))
    for path, gain in zip(frames.images, gains, strict=True):
        linear = colours.srgb_to_linear(image_files.read_rgb(path) / 255.0) * gain
        image_files.write_rgb(path, np.clip(colours.linear_to_srgb(linear), 0.0, 1.0))
    return copy, dict(zip(frames.names, gains.tolist(), strict=True))


@pytest.mark.slow
def test_photographs_are_divided_by_their_gains_but_where_they_are_saturated(ball_scene, tmp_path):
    scene, gains = _with_drifting_exposure(ball_scene, tmp_path)
    draw = functools.partial(index_stage.photographs, split="train", seed=0, rays=2000)
    true, raw, seen = draw(ball_scene), draw(scene), draw(scene, gains=gains)
    np.testing.assert_array_equal(true.views, seen.views)
    saturated = raw.rgb >= SATURATED
    assert np.abs(raw.rgb - true.rgb)[~saturated].mean() > 0.01
    np.testing.assert_allclose(seen.rgb[~saturated], true.rgb[~saturated], atol=0.01)
    np.testing.assert_array_equal(seen.rgb[saturated], raw.rgb[saturated])


def test_gains_that_do_not_fit_the_images_are_refused(ball_scene, tmp_path):
    with pytest.raises(ValueError, match=r"no gain of the image .*renamed"):
        index_stage.photographs(ball_scene, "train", seed=0, gains={"other": (1.0, 1.0, 1.0)})
    file = tmp_path / "background" / "gains.json"
    file.parent.mkdir()
    assert index_stage.read_gains(tmp_path) is None
    for content in (
        "{",
        "[]",
        '{"a": 1}',
        '{"a": [1, 2]}',
        '{"a": [1, 0, 2]}',
        '{"a": [1, NaN, 2]}',
    ):
        file.write_text(content)
        with pytest.raises(ValueError, match=r"gains\.json cannot be read .*Restore it"):
            index_stage.read_gains(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("far_field", ["field", "backdrop"])
def test_the_index_is_found_where_the_exposure_of_images_drifts(
    ball_scene, tmp_path, monkeypatch, far_field
):
    (part,) = meshes.read_meshes(ball_scene)
    monkeypatch.setattr(index_stage, "IndexSearch", _SEARCH)
    monkeypatch.setattr(index_stage, "RAYS", 2048)
    monkeypatch.setattr(index_stage, "MANY_RAYS", 6000)
    scene, gains = _with_drifting_exposure(ball_scene, tmp_path)
    scene = _unstated(scene, tmp_path) if far_field == "field" else scene
    estimate = functools.partial(index_stage.run, scene, shaded_mesh(part), seed=3, start=1.49)
    known = estimate(folder=tmp_path / "known", exposure="per_image")
    unknown = estimate(folder=tmp_path / "unknown")
    assert run_folder.read_config(tmp_path / "known" / "background").model.far_field == far_field
    found = index_stage.read_gains(tmp_path / "known")
    assert found.keys() == gains.keys() and index_stage.read_gains(tmp_path / "unknown") is None
    ratio = np.array([found[name] for name in gains]) / np.array(list(gains.values()))
    assert np.std(ratio / ratio.mean(axis=0)) < 0.04
    assert known.index == pytest.approx(1.5, abs=0.006)
    assert known.error < 0.9 * unknown.error


@pytest.mark.slow
def test_a_background_that_was_begun_as_a_field_stays_one(ball_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(fit, "train", lambda run, **options: False)
    learn = functools.partial(index_stage.learn_background, ball_scene, tmp_path, seed=3)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(scene_analysis, "MOST_MISFITS", -1.0)
        patch.setattr(scene_analysis, "misfits", lambda *_, **options: 0.5)
        learn()
    begun = run_folder.read_config(tmp_path / "background")
    assert begun.model.far_field == "field"
    with pytest.raises(KeyboardInterrupt):
        learn()
    assert run_folder.read_config(tmp_path / "background") == begun


@pytest.mark.slow
def test_no_field_is_trained_where_only_a_backdrop_is_of_use(ball_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(fit, "train", None)  # would raise
    scene = _unstated(ball_scene, tmp_path)
    assert index_stage.learn_backdrop(scene, tmp_path, seed=3) is None
    assert not (tmp_path / "background").exists()


@pytest.mark.slow
def test_a_background_that_was_begun_with_other_walls_is_not_taken(
    ball_scene, tmp_path, monkeypatch
):
    monkeypatch.setattr(fit, "train", lambda run, **options: False)
    learn = functools.partial(index_stage.learn_background, ball_scene, tmp_path, seed=3)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            learn(space="bounded", radius=5.0)
    assert run_folder.read_config(tmp_path / "background").model.iterations == 24
    for space, radius in (("bounded", 9.0), ("unbounded", 5.0)):
        with pytest.raises(ValueError, match="another --background or --radius"):
            learn(space=space, radius=radius)


@pytest.mark.slow
def test_a_background_suits_the_search_for_the_index_and_its_configuration_is_true(
    ball_scene, tmp_path, monkeypatch
):
    def train_nothing(run, **options):
        saved, config = checkpoint_io.read_static(run), run_folder.read_config(run)
        state = init_state(config.seed, saved.config, config.schedule)
        with run_folder.Checkpoints(run, keep=1) as checkpoints:
            checkpoints.save(state)
        return True

    monkeypatch.setattr(fit, "train", train_nothing)
    scene = _unstated(ball_scene, tmp_path)
    learn = functools.partial(index_stage.learn_background, scene, tmp_path, seed=3)
    model = learn()
    assert (model.config.interior, model.config.footprint) == ("clear", "cone")
    run = tmp_path / "background"
    config, saved = run_folder.read_config(run), checkpoint_io.read_static(run)
    assert config.model.footprint == saved.config.footprint == "cone"
    assert config.model.interior == saved.config.interior
    assert resolve(config, read_facts(config.scene, parts=())).model == saved
    # Earlier versions wrote it otherwise, which is no matter along straight light.
    for footprint in ("cone", "differential"):
        before = dataclasses.replace(saved.config, interior="clear", footprint=footprint)
        checkpoint_io.write_static(run, dataclasses.replace(saved, config=before))
        assert learn().config == model.config
    other = dataclasses.replace(saved, config=dataclasses.replace(saved.config, samples=7))
    checkpoint_io.write_static(run, other)
    with pytest.raises(ValueError, match="other fields or samples"):
        learn()
