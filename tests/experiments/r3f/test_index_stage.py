"""The index's stage with nothing left out: a background is learned, and an index looked for."""

import functools

import numpy as np
import pytest

from experiments.r3f import index_stage
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.reconstruct.refractive_index import IndexSearch
from refref_jax.training import fit, run_folder

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
