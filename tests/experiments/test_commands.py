"""The commands, as a user calls them: on the bundled scene, for a handful of steps."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio.v3 as iio
import jax
import numpy as np
import pytest
import trimesh

from experiments.figures import video
from refref_jax.data import image_files
from refref_jax.render import load_model
from tests.processes import code_generator
from tests.processes.command import ROOT, TINY, run_command

pytestmark = [pytest.mark.loose, pytest.mark.longest]

# The kinds of distances that an evaluation measures, and how.
_DISTANCES = ("distance", "surface", "substituted")
_ERRORS = ("mae", "mae_masked", "rmse", "rmse_masked")


def test_training_writes_a_readable_run(trained):
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [3, 6]
    for line in lines:
        assert {"step", "loss", "psnr", "dropped", "rays_per_second", "seconds"} <= set(line)
        assert np.all(np.isfinite(list(line.values())))
    config = json.loads((trained / "config.json").read_text())
    assert config["paths"]["name"] == "tree" and config["schedule"]["steps"] == 6
    assert {path.name for path in (trained / "checkpoints").iterdir()} == {"3", "6"}


def test_a_finished_run_is_neither_repeated_nor_overwritten(trained):
    before = (trained / "metrics.jsonl").read_text()
    told = run_command("train", f"--out={trained}", "--resume").stdout
    assert f"{trained} is trained already: 6 steps." in told
    assert (trained / "metrics.jsonl").read_text() == before
    scene = json.loads((trained / "config.json").read_text())["scene"]["path"]
    refused = run_command("train", f"--scene={scene}", f"--out={trained}", fails=True)
    assert "--resume" in refused.stderr and "Traceback" not in refused.stderr
    changed = run_command(
        "train", f"--scene={scene}", f"--out={trained}", "--resume", "--seed=3", fails=True
    )
    assert "other options" in changed.stderr
    ignored = run_command("train", f"--out={trained}", "--resume", "--seed=3", fails=True)
    assert "--seed would have no effect" in ignored.stderr


@pytest.mark.slow
def test_as_users_compile_it_a_training_is_the_same(trained, tmp_path):
    scene = json.loads((trained / "config.json").read_text())["scene"]["path"]
    options = (f"--scene={scene}", f"--out={tmp_path / 'run'}", *TINY)
    run_command("train", *options, env=code_generator.of_users())
    ours, theirs = (
        [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        for run in (trained, tmp_path / "run")
    )
    assert [line["step"] for line in ours] == [line["step"] for line in theirs] == [3, 6]
    for mine, other in zip(ours, theirs, strict=True):
        assert mine["loss"] == pytest.approx(other["loss"], rel=1e-3)


@pytest.mark.slow
def test_a_run_goes_on_with_a_scene_that_has_moved(trained, tmp_path):
    run, scene = tmp_path / "run", tmp_path / "moved"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    shutil.copytree(config["scene"]["path"], scene)
    config["scene"]["path"] = "nowhere"
    (run / "config.json").write_text(json.dumps(config))
    shutil.rmtree(run / "checkpoints" / "6")
    run_command("train", f"--scene={scene}", f"--out={run}", "--resume", *TINY)
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"3", "6"}


@pytest.mark.slow
def test_a_mesh_that_no_camera_sees_is_warned_about(tmp_path):
    scene = tmp_path / "scene"
    shutil.copytree(ROOT / "experiments" / "data" / "cube_smcvx_ball", scene)
    path = next((scene / "meshes").iterdir())
    trimesh.load(path).apply_translation([500.0, 0.0, 0.0]).export(path)
    result = run_command("train", f"--scene={scene}", f"--out={tmp_path / 'run'}", *TINY)
    assert "no camera ray hits the meshes" in result.stdout
    assert "advice: rule nested: there is one part" in result.stdout


@pytest.mark.slow
def test_an_interrupted_run_is_saved_and_goes_on(tmp_path):
    run = tmp_path / "run"
    options = ["--scene=experiments/data/cube_smcvx_ball", "--batch=64", f"--out={run}"]
    options.append("--paths=straight")  # the rest is the same, and compiles sooner
    command = [sys.executable, "-m", "experiments.train", *options, "--log_every=1"]
    options = {"cwd": ROOT, "text": True}
    with subprocess.Popen(command, stdout=subprocess.PIPE, **options) as process:
        while not (run / "metrics.jsonl").exists() and process.poll() is None:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate()
    assert process.returncode == 130
    assert "--resume" in printed
    stopped_at = int(re.search(r"Stopped at step (\d+)", printed).group(1))
    assert {path.name for path in (run / "checkpoints").iterdir()} == {str(stopped_at)}
    lines = (run / "metrics.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["step"] == stopped_at


def test_evaluation_writes_images_metrics_and_a_comparison(trained):
    result = run_command("evaluate", f"--run={trained}", "--split=val", "--limit=2")
    out = trained / "eval" / "val"
    assert str(out / "comparison.png") in result.stdout
    summary = json.loads((out / "metrics.json").read_text())
    assert summary["scene"] == "cube_smcvx_ball"
    assert summary["method"] == "tree"
    assert summary["step"] == 6 and summary["rays_per_pixel"] == 1
    assert set(summary["results"]) == {
        "psnr",
        "psnr_masked",
        "ssim",
        "lpips",
        "flip",
        *(f"{kind}_{error}" for kind in _DISTANCES for error in _ERRORS),
        "dropped",
        "seconds_per_image",
    }
    # The body's mesh knows the distance to it, and the truth knows it altogether.
    assert summary["results"]["surface_mae_masked"] < summary["results"]["distance_mae_masked"]
    assert summary["results"]["surface_mae_masked"] < 0.1
    assert summary["results"]["substituted_mae_masked"] == 0.0
    assert summary["results"]["lpips"] is None and result.stdout.count("warning: LPIPS") == 1
    assert len(summary["per_image"]) == 2
    mean = np.mean([image["psnr"] for image in summary["per_image"]])
    np.testing.assert_allclose(summary["results"]["psnr"], mean)
    for image in summary["per_image"]:
        rgb = image_files.read_rgb(out / "rgb" / f"{image['name']}.png")
        distance = image_files.read_exr(out / "distance" / f"{image['name']}.exr")
        assert rgb.shape == (128, 128, 3) and distance.shape == (128, 128)
        # The picture on disk is the one that was measured.
        scene = Path(json.loads((trained / "config.json").read_text())["scene"]["path"])
        target = image_files.read_rgb(scene / "val" / f"{image['name']}.png") / 255.0
        psnr = -10 * np.log10(np.mean((rgb / 255.0 - target) ** 2))
        assert psnr == pytest.approx(image["psnr"], abs=0.05)
    assert iio.imread(out / "comparison.png").ndim == 3


def test_a_loaded_model_compiles_an_image_once(trained):
    # What is bound to a device compiles the first chunk of an image and the others apart.
    params = load_model(trained).params
    assert not any(leaf.committed for leaf in jax.tree.leaves(params))


@pytest.mark.slow
def test_rendering_an_orbit_writes_pictures_distances_and_gifs(trained):
    run_command(
        "render",
        f"--run={trained}",
        "--views=orbit",
        "--frames=2",
        "--size=24",
        "--rays_per_pixel=4",
    )
    out = trained / "render" / "orbit"
    assert {path.name for path in (out / "rgb").iterdir()} == {"r_000.png", "r_001.png"}
    assert image_files.read_exr(out / "distance" / "r_001.exr").shape == (24, 24)
    assert iio.imread(out / "rgb.gif").shape[:3] == (2, 24, 24)
    assert iio.imread(out / "distance.gif").shape[1:] == (24, 24, 3)
    if video.has_ffmpeg():
        assert iio.imread(out / "rgb.mp4", plugin="FFMPEG").shape == (2, 24, 24, 3)


@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        ("train", ("--scene=experiments/data/cube_smcvx_ball", "--ior=gold=0.5"), "gold"),
        ("train", ("--scene=experiments/data/cube_smcvx_ball", "--batch=99999999"), "batch"),
        ("train", ("--scene=experiments/data/cube_smcvx_ball", "--out=README.md/x"), "README.md"),
        ("evaluate", ("--run=RUN", "--lpips_weights=none.npz"), "none.npz cannot be read"),
        ("render", ("--run=RUN",), "run/model.json does not exist"),
        ("render", ("--run=nowhere", "--rays_per_pixel=0"), "Give 1."),
        ("export", ("--run=RUN", "--what=mesh", "--out=x.ply"), "run/model.json does not"),
        ("export", ("--run=RUN", "--what=body", "--out=x.ply"), "run/geometry.npz cannot"),
    ],
)
def test_mistakes_end_with_one_line_that_says_what_to_do(tmp_path, command, options, message):
    if command == "train":
        options = (f"--out={tmp_path / 'out'}", *options)
    run = tmp_path / "run"  # which is none, but for one file
    run.mkdir()
    (run / "config.json").write_text("{}")
    options = [word.replace("RUN", str(run)) for word in options]
    result = run_command(command, *options, fails=True)
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
