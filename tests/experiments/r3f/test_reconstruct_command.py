"""The command, as a user calls it."""

import signal
import subprocess
import sys
import time

import pytest

from tests.factories.silhouettes import write_scene
from tests.processes import code_generator
from tests.processes.command import ROOT, run_command


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball", meshes=False)


@pytest.mark.slow
def test_the_command_tells_where_its_results_are(scene, tmp_path):
    out = tmp_path / "out"
    options = (
        f"--scene={scene}",
        f"--out={out}",
        "--ior=1.5",
        "--resolution=20",
        "--refinement=none",
    )
    result = run_command("reconstruct", *options)
    for name in ("report.md", "pictures", "geometry/ball_glass.ply", "index.json"):
        assert str(out / name) in result.stdout and (out / name).exists()
    assert f"experiments.train --scene={scene} --reconstruction={out}" in result.stdout
    assert "overlap 0.9" in result.stdout and "true surface" not in result.stdout


@pytest.mark.slow
def test_a_killed_command_comes_to_the_same_files(scene, tmp_path):
    options = (f"--scene={scene}", "--ior=1.5", "--resolution=32", "--refinement=none")
    run_command("reconstruct", *options, f"--out={tmp_path / 'whole'}")
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "experiments.reconstruct", *options, f"--out={out}"]
    for number, until in (
        (signal.SIGKILL, "reconstruction.json"),
        (signal.SIGINT, "geometry"),
        (signal.SIGKILL, ".pictures.unfinished"),
    ):
        with subprocess.Popen(command, cwd=ROOT, env=code_generator.of_users()) as process:
            while not (out / until).exists() and process.poll() is None:
                time.sleep(0.01)
            process.send_signal(number)
    run_command("reconstruct", *options, f"--out={out}")
    names = [path.relative_to(out) for path in out.rglob("*") if path.is_file()]
    assert len(names) == 7
    for name in names:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
