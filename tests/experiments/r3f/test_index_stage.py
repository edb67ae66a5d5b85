"""The index's stage with nothing left out: a background is learned, and an index looked for."""

import dataclasses
import functools

import numpy as np
import pytest

from experiments.r3f import index_stage
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.reconstruct.refractive_index import IndexSearch
from refref_jax.render import checkpoint_io
from refref_jax.training import fit, run_folder
from refref_jax.training.loop import init_state
from refref_jax.training.resolve import read_facts, resolve

pytestmark = [pytest.mark.loose, pytest.mark.computing]


@pytest.mark.slow
def test_a_background_is_learned_beside_the_body_and_once(ball_scene, tmp_path, monkeypatch):
    (part,) = meshes.read_meshes(ball_scene)
    mesh = shaded_mesh(part)
    search = functools.partial(IndexSearch, 1.47, 1.53, spacing=0.03, descents=1, most=4)
    monkeypatch.setattr(index_stage, "IndexSearch", search)
    kept = []
    sampler = fit.PixelSampler

    def note(*arguments, **options):
        kept.append(options["kept"])
        return sampler(*arguments, **options)

    monkeypatch.setattr(fit, "PixelSampler", note)
    look = functools.partial(
        index_stage.run, ball_scene, mesh, tmp_path, seed=3, start=1.49, steps=300, rays=512
    )
    first, again = look(), look()
    assert first == again and len(kept) == 1
    config = run_folder.read_config(tmp_path / "background")
    assert (config.scene.pixels, config.paths.name, config.seed) == ("background", "straight", 3)
    assert 0.2 < kept[0].mean() < 0.95
    assert first.index == pytest.approx(1.5, abs=0.01) and np.isfinite(first.deviation)
    assert len(first.descents) == 2 and (tmp_path / "index.png").stat().st_size > 5000


def test_a_background_that_was_begun_with_other_walls_is_not_taken(
    ball_scene, tmp_path, monkeypatch
):
    monkeypatch.setattr(fit, "train", lambda run, **options: False)
    learn = functools.partial(index_stage.learn_background, ball_scene, tmp_path, seed=3)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            learn(space="bounded", radius=5.0)
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
    learn = functools.partial(index_stage.learn_background, ball_scene, tmp_path, seed=3)
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
