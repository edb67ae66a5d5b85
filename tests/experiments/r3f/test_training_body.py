"""Training with a reconstructed body: which options ask for it, and that it never reads meshes."""

import json
import subprocess
import sys

import pytest

from experiments.r3f import chain, records
from experiments.r3f.records import ReconstructionConfig
from tests import code_generator
from tests.experiments.command import ROOT, run_command
from tests.experiments.r3f.small_scene import write_scene

_GRID = "--resolution=20"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene whose mesh can not be read."""
    scene = write_scene(tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball")
    (scene / "meshes" / "ball_glass.ply").write_bytes(b"broken")
    return scene


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """A reconstruction of it."""
    out = tmp_path_factory.mktemp("made") / "r3f"
    config = ReconstructionConfig("hull", 20, 0, 1.45, 0)
    chain.reconstruct(scene, out, config, compare=False, say=lambda text: None)
    return out


@pytest.fixture(scope="module")
def found(scene, made, tmp_path_factory):
    """What each training's options come to, by name; found in one process."""
    runs = tmp_path_factory.mktemp("runs")
    (runs / "half" / "r3f").mkdir(parents=True)
    r3f, given = "--method=r3f", f"--reconstruction={made}"
    cases = {
        "oracle": [],
        "r3f": [r3f, _GRID, "--ior=1.5"],
        "given": [given],
        "other index": [given, "--method=r3f", "--ior=1.7"],
        "half": [r3f, _GRID, "--ior=1.5"],
        "no estimate": [r3f, _GRID],
        "named index": [r3f, "--ior=glass=1.5"],
        "two indices": [given, "--ior=1.5", "--ior=1.6"],
        "no index": [r3f, "--ior=15"],
        "no number": [r3f, "--ior=glass"],
        "oracle too": [given, "--method=oracle"],
        "no effect": [given, _GRID],
        "no effect of oracle": [_GRID],
        "straight": [r3f, "--paths=straight"],
        "nothing there": ["--reconstruction=nowhere"],
    }
    sent = [[str(runs / name), f"--scene={scene}", *rest] for name, rest in cases.items()]
    result = subprocess.run(
        [sys.executable, "-m", "tests.experiments.r3f.print_bodies"],
        cwd=ROOT,
        env=code_generator.of_users(),
        input=json.dumps(sent),
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return dict(zip(cases, json.loads(result.stdout), strict=True))


def test_the_broken_mesh_stops_the_oracle_alone(found):
    assert "ball_glass.ply can not be read" in found["oracle"]["error"]
    for name in ("r3f", "given", "other index"):
        assert found[name]["error"] is None, name


@pytest.mark.parametrize(("name", "index"), [("r3f", 1.5), ("given", 1.45), ("other index", 1.7)])
def test_light_is_bent_by_the_reconstructed_body(found, made, name, index):
    assert found[name]["body"] == "ball_glass"
    assert found[name]["indices"] == [["ball_glass", index]]
    assert found[name]["inside"] == pytest.approx([index])
    assert found[name]["faces"] == records.read(made).geometry.faces
    assert "1 convex body" in found[name]["printed"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("half", "Continue with --resume"),
        ("no estimate", "--ior=1.5"),
        ("named index", "--ior=glass=1.5, but there is one reconstructed body"),
        ("two indices", "Give its index alone, once"),
        ("no index", "--ior=15 is no index of refraction"),
        ("no number", "--ior=glass is no index of refraction"),
        ("oracle too", "--method=oracle takes the scene's own meshes"),
        ("no effect", "--resolution would have no effect"),
        ("no effect of oracle", "add --method=r3f"),
        ("straight", "--paths=straight knows of no objects"),
        ("nothing there", "nowhere holds no reconstruction"),
    ],
)
def test_mistakes_are_told(found, name, message):
    if name == "no estimate" and found[name]["error"] is None:
        pytest.skip("there is an estimation now")
    assert message in found[name]["error"]


def test_training_reconstructs_and_goes_on(scene, made, tmp_path):
    run = tmp_path / "run"
    options = (f"--scene={scene}", f"--out={run}", "--method=r3f", "--ior=1.45", _GRID)
    small = ("--steps=2", "--batch=64", "--log_every=1", "--interior=clear", "--paths=paper")
    run_command("train", *options, *small)
    assert "r3f" in json.loads((run / "body.json").read_text())["reconstruction"]
    mesh, index = "geometry/ball_glass.ply", "index.json"
    for name in (mesh, index):  # what two processes made is the same to the bit
        assert (run / "r3f" / name).read_bytes() == (made / name).read_bytes()
    again = run_command("train", *options, *small, "--resume")
    assert "trained already" in again.stdout and "left out" not in again.stdout
    other = run_command("train", *options[:3], "--ior=1.6", _GRID, *small, "--resume", fails=True)
    assert "ior 1.45, not 1.6" in other.stderr
    ignored = run_command("train", f"--out={run}", "--resume", "--method=r3f", fails=True)
    assert "--method would have no effect" in ignored.stderr


@pytest.mark.slow
def test_evaluation_names_the_method(scene, made, tmp_path):
    run = tmp_path / "run"
    small = ("--steps=2", "--batch=64", "--interior=clear", "--paths=paper")
    run_command("train", f"--scene={scene}", f"--out={run}", f"--reconstruction={made}", *small)
    run_command("evaluate", f"--run={run}", "--limit=1")
    metrics = json.loads((run / "eval" / "test" / "metrics.json").read_text())
    assert metrics["method"] == "r3f" and metrics["results"]["psnr_masked"] is not None
    run_command("render", f"--run={run}", "--frames=1", "--size=16")
    assert (run / "render" / "orbit" / "rgb" / "r_000.png").is_file()
