"""Training by calls of the library: the script of the README, and what a run's files repeat."""

import ast
import json
import shutil

import imageio.v3 as iio
import jax
import numpy as np
import pytest

from refref_jax.data import image_files, meshes, scene_folder
from refref_jax.geometry.cameras import image_rays
from refref_jax.render import checkpoint_io
from refref_jax.render.images import render_image
from refref_jax.training import fit, run_folder
from refref_jax.training.config import TrainConfig
from tests.factories import readme_script, small_scenes
from tests.factories.cut_ball import cut_ball
from tests.laws import runs
from tests.processes.command import ROOT

pytestmark = [pytest.mark.loose, pytest.mark.longest]


_SMALL = (
    "steps=4, paths='paper', max_res=32, batch=64, pretraced_batches=4, "
    "samples_per_ray=(8, 6), log2_hashmap_size=10"
)


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """The folder of the README's script, after it has run with four steps and small sizes."""
    script = readme_script.small(_SMALL)
    return readme_script.execute(script, tmp_path_factory.mktemp("script"))


def test_the_script_of_the_readme_is_short_and_imports_the_library_alone():
    script = readme_script.read()
    assert len(script.strip().splitlines()) <= 12 and "steps=50" in script
    for node in ast.walk(ast.parse(script)):
        if isinstance(node, ast.Import):
            assert all(alias.name.split(".")[0] == "refref_jax" for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.module.split(".")[0] == "refref_jax"


# `test_splats_run` runs the same tests on splats, which compile in a third of the time.
@pytest.mark.slow
def test_the_script_of_the_readme_trains_and_renders_small_images(four):
    assert run_folder.read_metrics(four)[-1]["step"] == 4
    view = iio.imread(four / "view.png", plugin="pillow")
    assert view.shape == (16, 16, 3) and view.std() > 0.0


@pytest.mark.slow
def test_the_script_of_the_readme_trains_and_renders(tmp_path):
    fifty = readme_script.execute(readme_script.read(), tmp_path)
    lines = run_folder.read_metrics(fifty)
    assert lines[-1]["step"] == 50 and lines[-1]["psnr"] > 12.0
    view = iio.imread(fifty / "view.png", plugin="pillow")
    assert view.shape == (128, 128, 3) and view.std() > 10.0


@pytest.mark.slow
def test_the_configuration_of_a_run_repeats_it_bit_for_bit(four, tmp_path):
    messages = []
    config, again = run_folder.read_config(four), tmp_path / "again"
    model = fit.fit(config, out=again, report=messages.append)
    assert any("given: scene=" in message for message in messages)
    runs.assert_repeats(four, model, again)


@pytest.mark.slow
def test_a_model_is_loaded_without_a_word_and_nothing_is_written(four, caplog, capfd):
    runs.assert_loads_quietly(four, 4, caplog, capfd)


def test_what_is_asked_for_stays_where_the_path_of_the_scene_is_made_absolute(
    monkeypatch, tmp_path
):
    small_scenes.write_scene(tmp_path / "cube_smcvx_ball")
    monkeypatch.chdir(tmp_path)
    asked = {"paths": "straight", "background": "spherical", "radius": 9.0, "batch": 16}
    config = TrainConfig().override(scene="cube_smcvx_ball", **asked)
    made, _ = fit.prepare(config, report=lambda line: None)
    assert {name: made.config.get(name) for name in asked} == asked
    assert made.config.scene.path == str(tmp_path / "cube_smcvx_ball")


def test_fit_refuses_what_names_no_run(tmp_path):
    with pytest.raises(ValueError, match="holds none, or existing"):
        fit.fit(None, out=tmp_path, existing="resume")
    with pytest.raises(ValueError, match="No scene is given"):
        fit.fit(TrainConfig(), out=tmp_path / "run")
    with pytest.raises(ValueError, match="was reconstructed"):
        fit.fit(TrainConfig().override(scene="x", reconstruction="y"), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_is_resumed_with_its_scene_where_it_is_now_and_all_is_reported(
    tmp_path, monkeypatch, capsys
):
    scenes = []

    def train(run, *, scene, **options):
        scenes.append(scene)
        return True

    monkeypatch.setattr(fit, "train", train)
    before, now = tmp_path / "before", tmp_path / "now"
    cut_ball(before)
    lines = []
    config = TrainConfig().override(scene=before, steps=3)
    fit.train_into(tmp_path / "run", config, report=lines.append)
    before.rename(now)
    moved = config.override(scene=now)
    fit.train_into(tmp_path / "run", moved, existing="resume", report=lines.append)
    assert scenes == [str(before), str(now)]
    assert sum(line.startswith("this scene needs: ") for line in lines) == 2
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_fit_takes_objects_in_place_of_the_meshes_and_stops_when_it_is_asked_to(tmp_path):
    scene = ROOT / "experiments" / "data" / "cube_smcvx_ball"
    (part,) = meshes.read_meshes(scene)
    config = TrainConfig().override(scene=scene, steps=30, batch=64, pretraced_batches=4)
    asked, lines = [], []

    def stop():
        asked.append(True)
        return len(asked) > 1

    part = part._replace(index=1.25)
    out = {"out": tmp_path / "run", "report": lines.append}
    model = fit.fit(config, **out, parts=[part], stop=stop)
    assert model.scene.interfaces.index_inside.tolist() == [1.25]
    assert 0 < checkpoint_io.latest_step(tmp_path / "run") < 30
    assert lines[-1].startswith("Stopped at step ")


def test_images_that_change_under_a_run_are_named(tmp_path):
    scene = small_scenes.write_scene(tmp_path / "scene")
    frames = scene_folder.read_frames(scene, "train")
    run_folder.check_images(tmp_path, frames)
    run_folder.check_images(tmp_path, frames)
    moved = scene_folder.read_frames(shutil.copytree(scene, tmp_path / "moved"), "train")
    run_folder.check_images(tmp_path, moved)
    shutil.copy(frames.images[1], moved.images[0])
    with pytest.raises(ValueError, match=r"r_000 of the training images in .*moved/train changed"):
        run_folder.check_images(tmp_path, moved)
    turned = frames._replace(cameras=frames.cameras._replace(focal=9.0))
    with pytest.raises(ValueError, match=r"cameras of the training images"):
        run_folder.check_images(tmp_path, turned)
    fewer = frames._replace(names=("r_000",), images=frames.images[:1], masks=None)
    with pytest.raises(ValueError, match="to continue with the new ones"):
        run_folder.check_images(tmp_path, fewer)
    (tmp_path / "images.json").write_text("{")
    with pytest.raises(ValueError, match=r"images\.json is damaged"):
        run_folder.check_images(tmp_path, frames)


def _exposed(scene, gains):
    """Multiplies the linear light of the training images, which are made smooth and dim first."""
    frames = scene_folder.read_frames(scene, "train")
    for path, gain in zip(frames.images, gains, strict=True):
        linear = gain * np.full((frames.cameras.height, frames.cameras.width, 3), (0.2, 0.3, 0.4))
        encoded = 1.055 * linear ** (1.0 / 2.4) - 0.055
        image_files.write_rgb(path, encoded)


@pytest.mark.slow
def test_a_field_learns_the_gains_of_its_images(tmp_path):
    scene = small_scenes.write_scene(tmp_path / "cube_smcvx_scene", frames=4)
    draw = np.random.default_rng(0).normal(0.0, 0.2, (4, 3))
    gains = np.exp(draw - draw.mean(axis=0))
    _exposed(scene, gains)
    options = {"paths": "straight", "steps": 120, "batch": 64, "pretraced_batches": 4}
    config = TrainConfig().override(scene=str(scene), exposure="per_image", **options)
    lines, periods = [], fit.Periods(log=40, checkpoint=40)
    whole = fit.fit(config, out=tmp_path / "whole", report=lines.append, periods=periods)
    assert whole.config.learned_gains == 4 and any("exposure=per_image" in x for x in lines)
    found = json.loads((tmp_path / "whole" / "gains.json").read_text())
    assert list(found) == list(scene_folder.read_frames(scene, "train").names)
    assert np.abs(np.array(list(found.values())) / gains - 1.0).max() < 0.05
    # Images are rendered with a gain of 1.
    cameras = scene_folder.read_frames(scene, "train").cameras
    seen = np.asarray(render_image(whole, image_rays(cameras, 0)).rgb)
    usual = 1.055 * np.array([0.2, 0.3, 0.4]) ** (1.0 / 2.4) - 0.055
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), usual, atol=0.02)


@pytest.mark.slow
def test_a_stopped_run_with_gains_ends_with_the_same_bits(tmp_path):
    scene = small_scenes.write_scene(tmp_path / "cube_smcvx_scene", frames=4)
    options = {"paths": "straight", "steps": 12, "batch": 64, "pretraced_batches": 4}
    config = TrainConfig().override(scene=str(scene), exposure="per_image", **options)
    given = {"report": lambda line: None, "periods": fit.Periods(log=4, checkpoint=4)}
    whole = fit.fit(config, out=tmp_path / "whole", **given)
    gains = tmp_path / "run" / "gains.json"
    fit.fit(config, out=tmp_path / "run", **given, stop=gains.exists)
    assert 0 < run_folder.read_metrics(tmp_path / "run")[-1]["step"] < 12
    again = fit.fit(None, out=tmp_path / "run", existing="resume", **given)
    pairs = zip(jax.tree.leaves(again.params), jax.tree.leaves(whole.params), strict=True)
    assert all(np.array_equal(ours, theirs) for ours, theirs in pairs)
    assert gains.read_bytes() == (tmp_path / "whole" / "gains.json").read_bytes()
