"""Gaussian splats are trained, resumed, written, read, evaluated and exported like a field."""

import json
import subprocess
import sys

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.viewer import cameras as viewing
from experiments.viewer import layers, session
from refref_jax.data import image_files, scene_folder
from refref_jax.geometry.cameras import image_rays
from refref_jax.render import checkpoint_io, images, pixels
from refref_jax.render.model import look_up
from refref_jax.splats.gaussians import Gaussians, read_ply
from refref_jax.training import fit, presets, run_folder
from refref_jax.training.config import TrainConfig
from tests.factories import readme_script
from tests.factories.small_model import CAMERAS
from tests.laws import expectations, runs
from tests.processes.command import ROOT, run_command

pytestmark = [pytest.mark.loose, pytest.mark.longest]

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"
_PERIODS = fit.Periods(log=5, checkpoint=10)


def _config(**changes):
    given = {"field": "splats", "gaussians": 500, "steps": 20, **changes}
    return TrainConfig().override(scene=str(_SCENE), **given)


def _quiet(line):
    del line


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """The folder of the README's script, after it has trained splats."""
    few = readme_script.small("field='splats', gaussians=500, steps=20")
    return readme_script.execute(few, tmp_path_factory.mktemp("script"))


@pytest.fixture(scope="module")
def trained(script, tmp_path_factory):
    """The model that the configuration of the script's run repeats, and the folder of its run."""
    run = tmp_path_factory.mktemp("splats") / "run"
    made = fit.fit(run_folder.read_config(script), out=run, periods=_PERIODS, report=_quiet)
    return made, run


def test_the_script_of_the_readme_trains_splats_and_renders_them(script):
    assert run_folder.read_metrics(script)[-1]["step"] == 20
    view = iio.imread(script / "view.png", plugin="pillow")
    assert view.shape == (16, 16, 3) and view.std() > 0.0


@pytest.mark.slow
def test_the_configuration_of_a_run_repeats_it_bit_for_bit(script, trained):
    runs.assert_repeats(script, *trained)


def test_a_model_is_loaded_without_a_word_and_nothing_is_written(script, caplog, capfd):
    runs.assert_loads_quietly(script, 20, caplog, capfd)


@pytest.mark.slow
def test_a_run_has_metrics_and_a_complete_configuration(trained):
    lines = run_folder.read_metrics(trained[1])
    assert [line["step"] for line in lines] == [5, 10, 15, 20]
    names = {"loss", "psnr", "entries", "relocated", "rays_per_second", "seconds"}
    assert all(names <= set(line) for line in lines)
    config = run_folder.read_config(trained[1])
    assert (config.paths.name, config.model.far_field) == ("straight", "field")
    assert (config.model.gaussians, config.model.splat_filter) == (500, "mip")


@pytest.mark.slow
def test_a_checkpoint_is_read_as_it_was_written(trained):
    made, run = trained
    read = checkpoint_io.load_model(run)
    assert (read.config, read.settings) == (made.config, made.settings)
    assert isinstance(read.params.field, Gaussians) and read.params.field.logits.shape == (500,)
    expectations.assert_same(made.params, read.params)


@pytest.mark.slow
def test_a_stopped_run_is_resumed_bit_for_bit(trained, tmp_path):
    steps = iter([False, False, True])  # before the first step, then after each group of steps
    asked = {"periods": fit.Periods(log=5, checkpoint=100), "report": _quiet}
    fit.fit(_config(), out=tmp_path / "run", stop=lambda: next(steps), **asked)
    assert checkpoint_io.latest_step(tmp_path / "run") == 10
    resumed = fit.fit(None, out=tmp_path / "run", existing="resume", **asked)
    expectations.assert_same(resumed.params, trained[0].params)


@pytest.mark.slow
def test_images_are_rendered_and_smaller_pixels_average_to_them(trained):
    model = trained[0]
    seen = images.render_camera(model, CAMERAS, 0)
    assert seen.rgb.shape == (16, 16, 3) and np.all((seen.rgb >= 0.0) & (seen.rgb <= 1.0))
    assert np.all(np.isfinite(seen.distance)) and np.all(seen.distance > 0.0)
    assert not np.any(seen.dropped)
    finer = images.render_camera(model, CAMERAS, 0, rays_per_pixel=4)
    assert np.mean(np.abs(finer.rgb - seen.rgb)) < 0.05
    images.warm_up(model, CAMERAS, rays_per_pixel=1, chunk=None)


@pytest.mark.slow
def test_the_viewer_draws_windows_of_images(trained):
    model = trained[0]
    subject = session.Subject("made", model, "nested", None, (), (9, 18), None)
    assert subject.layers == ("rgb", "distance") and not subject.has_paths
    for aspect in (0.7, 2.5):  # columns or rows are cropped
        window = session.first_viewpoint(subject, aspect)
        window = viewing.window(window, 18)
        whole = images.render_camera(model, window.camera, 0)
        assert whole.rgb.shape == (18, 32, 3) and window.rays.radii.shape != (18, 32)
        seen, distance = (layers.draw_splats(model, each, window) for each in subject.layers)
        chosen = np.ix_(window.rows, window.columns)
        np.testing.assert_array_equal(seen, image_files.to_bytes(whole.rgb[chosen]))
        assert distance.shape == seen.shape and np.ptp(distance) > 0


@pytest.mark.slow
def test_the_viewer_draws_the_error_of_a_test_view(trained):
    frames = scene_folder.read_frames(_SCENE, "test")
    pixels = layers.view_pixels(frames, 3, 32 * 32)
    image, error = layers.draw_error(trained[0], pixels, chunk=None, cancelled=lambda: False)
    seen = images.render_camera(trained[0], frames.cameras, 3).rgb[2::4, 2::4]
    true = image_files.read_rgb(frames.images[3])[2::4, 2::4] / 255.0
    assert image.shape == (32, 32, 3)
    assert error == pytest.approx(np.sqrt(np.mean(np.square(seen - true))), rel=1e-5)


@pytest.mark.slow
def test_what_needs_rays_or_a_field_is_refused_in_one_sentence(trained):
    model = trained[0]
    rays = image_rays(CAMERAS, 0)
    for render in (images.render_image, pixels.render_rays):
        with pytest.raises(ValueError, match=r"Gaussian splats, which are seen by cameras"):
            render(model, jax.tree.map(lambda x: x[0], rays))
    with pytest.raises(ValueError, match=r"no density at a point\. Train with field=zipnerf"):
        look_up(model.params, model.config, jnp.zeros(3), jnp.ones(3), width=0.1)
    kept = model.config.splats
    classic = model._replace(
        config=model.config.__class__(
            **vars(model.config) | {"splats": kept.__class__(500, "classic")}
        )
    )
    images.render_camera(classic, CAMERAS, 0)
    with pytest.raises(ValueError, match=r"splat_filter=classic are thinner"):
        images.render_camera(classic, CAMERAS, 0, rays_per_pixel=4)


@pytest.mark.slow
def test_commands_take_a_run(trained, tmp_path):
    run = trained[1]
    run_command("evaluate", f"--run={run}", "--split=val", "--limit=1", "--rays_per_pixel=4")
    summary = json.loads((run / "eval" / "val" / "metrics.json").read_text())
    assert summary["method"] == "splats" and summary["results"]["psnr"] > 5.0
    assert np.isfinite(summary["results"]["distance_mae_masked"])
    out = tmp_path / "splats.ply"
    run_command("export", f"--run={run}", "--what=splats", f"--out={out}")
    expectations.assert_same(read_ply(out), trained[0].params.field)
    options = (f"--run={run}", "--what=mesh", f"--out={tmp_path / 'mesh.ply'}")
    refused = run_command("export", *options, fails=True)
    assert "has no density" in refused.stderr and len(refused.stderr.strip().splitlines()) == 1


def test_several_devices_are_refused(tmp_path):
    resolved, scene = fit.prepare(_config(), report=_quiet)
    fit.begin(tmp_path / "run", resolved.config, resolved.model, scene)
    with pytest.raises(ValueError, match="one device in one process"):
        fit.train(tmp_path / "run", mesh=jax.make_mesh((1,), ("batch",)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"paths": "tree"}, r"No effect on Gaussian splats.*: paths=tree\. Leave them out"),
        ({"far_field": "backdrop"}, r"No effect on Gaussian splats.*: far_field=backdrop"),
        ({"batch": 64, "interior": "field"}, r"neither light paths nor a field: batch, interior"),
        ({"learning_rate": 0.1}, r": learning_rate\. "),
        ({"field": "zipnerf"}, r"gaussians have no effect on fields of kind zipnerf"),
        ({"gaussians": 0}, r"gaussians is 0\. Give 1 to"),
        ({"splat_filter": "sharp"}, r"splat_filter is 'sharp'.*mip"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_compiled(changes, message, monkeypatch):
    monkeypatch.setattr(jax, "jit", lambda *a, **k: pytest.fail("it compiles"))
    with pytest.raises(ValueError, match=message):
        fit.prepare(_config(**changes), report=_quiet)


@pytest.mark.slow
def test_presets_have_their_numbers_and_say_only_what_splats_read():
    for name, preset in presets.PRESETS.items():
        resolved, _ = fit.prepare(_config(preset=name, gaussians=None), report=_quiet)
        assert resolved.model.config.splats.gaussians == preset.gaussians
    text = resolved.describe()
    assert "gaussians=" in text and "steps=" in text
    assert "batch" not in text and "samples_per_ray" not in text
    assert resolved.config.get("gaussians") == 1_000_000
    field, _ = fit.prepare(TrainConfig().override(scene=str(_SCENE)), report=_quiet)
    assert field.model.config.splats is None and field.config.get("gaussians") is None


@pytest.mark.slow
def test_nothing_of_splats_is_imported_without_them():
    code = (
        "import sys, refref_jax, refref_jax.render, refref_jax.training.fit, experiments.train;"
        "assert not [name for name in sys.modules if name.startswith('refref_jax.splats')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
