"""Training with a reconstructed body: which options ask for it, and that it never reads meshes."""

import json

import pytest

from experiments.r3f import chain, records
from experiments.r3f.records import ReconstructionConfig
from tests.factories.silhouettes import write_scene
from tests.fakes import report_pictures
from tests.processes.command import run_command, run_module

pytestmark = pytest.mark.longest

_GRID = "--resolution=20"

# The surface is that from masks: photographs of the scene show nothing.
_MASKS = (_GRID, "--refinement=none")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene whose mesh cannot be read."""
    scene = write_scene(tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball", views=8)
    (scene / "meshes" / "ball_glass.ply").write_bytes(b"broken")
    return scene


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """A reconstruction of it."""
    out = tmp_path_factory.mktemp("made") / "r3f"
    config = ReconstructionConfig("hull", 20, 0, 1.45, None, None, "none", 0)
    with report_pictures.left_empty():  # as in `print_beginnings`
        chain.reconstruct(scene, out, config, compare=False, say=lambda text: None)
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Where trainings are begun."""
    runs = tmp_path_factory.mktemp("runs")
    (runs / "half" / "r3f").mkdir(parents=True)
    (runs / "killed" / "r3f").mkdir(parents=True)
    return runs


def _on_top(runs, moved, scene, r3f):
    """Returns words on top of the file of the run `r3f`, by name, and of it when it has moved."""
    file, there = f"--config={runs / 'r3f' / 'config.json'}", moved / "scenes" / scene.name
    on_top = {
        "file": (),
        "file with index": ("--ior=1.7",),
        "file with named index": ("--ior=glass=1.7",),
        "file with oracle": ("--method=oracle",),
        "file with a grid": (_GRID,),
        "file anew": r3f,
        "file with straight": ("--paths=straight",),
        "file with straight oracle": ("--paths=straight", "--method=oracle"),
    }
    sent = {name: (f"--out={runs / name}", file, *words) for name, words in on_top.items()}
    run = f"--out={moved / 'run'}"
    gone = f"--config={moved / 'gone' / 'run' / 'config.json'}"
    index = f"--config={runs / 'file with index' / 'config.json'}"
    return sent | {
        "file with index taken back": (f"--out={runs / 'taken back'}", index, "--ior=auto"),
        "file anew, resumed": (
            f"--out={runs / 'file anew'}",
            file,
            f"--scene={scene}",
            *r3f,
            "--resume",
        ),
        "run moves": ("copy", str(runs / "r3f"), str(moved / "run")),
        "scene moves": ("copy", str(scene), str(there)),
        "moved, resumed": (run, f"--scene={there}", *r3f, "--resume"),
        "moved, resumed by its file": (
            run,
            f"--config={moved / 'run' / 'config.json'}",
            f"--scene={there}",
            "--resume",
        ),
        "moved without it": (f"--out={runs / 'gone'}", gone),
        "moved without it, told": (
            f"--out={runs / 'told'}",
            gone,
            f"--reconstruction={moved / 'run' / 'r3f'}",
        ),
    }


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """A place that runs move to, with the file of one that has left its reconstruction behind."""
    moved = tmp_path_factory.mktemp("moved")
    (moved / "gone" / "run").mkdir(parents=True)
    return moved


@pytest.fixture(scope="module")
def found(scene, made, runs, moved):
    """What beginning each training came to, by name; all in one process, in this order."""
    r3f, given = ("--method=r3f", *_MASKS, "--ior=1.5"), f"--reconstruction={made}"
    cases = {
        "oracle": (),
        "r3f": r3f,
        "given": (given,),
        "other index": (given, "--method=r3f", "--ior=1.7"),
        "half": r3f,
        "killed": (*r3f, "--resume"),
        "named index": ("--method=r3f", "--ior=glass=1.5"),
        "two indices": (given, "--ior=1.5", "--ior=1.6"),
        "no index": ("--method=r3f", "--ior=15"),
        "no number": ("--method=r3f", "--ior=glass"),
        "oracle too": (given, "--method=oracle"),
        "no effect": (given, _GRID),
        "no effect of oracle": (_GRID,),
        "straight": (*r3f, "--paths=straight"),
        "nothing there": ("--reconstruction=nowhere",),
        "outliers of no hull": (*r3f, "--geometry=occupancy", "--outliers=1"),
    }
    sent = [
        [f"--out={runs / name}", f"--scene={scene}", *options] for name, options in cases.items()
    ]
    again = {
        "r3f begun anew": ("r3f", f"--scene={scene}", *r3f),
        "r3f resumed": ("r3f", f"--scene={scene}", *r3f, "--resume"),
        "r3f resumed alone": ("r3f", "--resume"),
        "r3f with another grid": ("r3f", f"--scene={scene}", *r3f[:-1], "--ior=1.6", "--resume"),
        "r3f by name alone": ("r3f", "--resume", "--method=r3f"),
        "r3f with a given one": ("r3f", f"--scene={scene}", given, "--resume"),
    }
    sent += [[f"--out={runs / run}", *options] for run, *options in again.values()]
    on_top = _on_top(runs, moved, scene, r3f)
    sent += on_top.values()
    sent.append([f"--out={made}", f"--scene={scene}", given])
    left = {"scene": {"path": str(scene), "reconstruction": "r3f"}}
    (moved / "gone" / "run" / "config.json").write_text(json.dumps(left))
    (moved / "options.json").write_text(json.dumps(sent))
    result = run_module("tests.processes.print_beginnings", moved / "options.json")
    names = [*cases, *again, *on_top, "run in its body"]
    return dict(zip(names, json.loads(result.stdout), strict=True))


def test_the_broken_mesh_stops_the_oracle_alone(found):
    assert "ball_glass.ply cannot be read" in found["oracle"]["error"]
    for name in ("r3f", "killed", "given", "other index", "r3f resumed", "r3f resumed alone"):
        assert found[name]["error"] is None, name


@pytest.mark.parametrize(
    ("name", "index"),
    [
        ("r3f", 1.5),
        ("given", 1.45),
        ("other index", 1.7),
        ("file", 1.5),
        ("file with index", 1.7),
        ("file with index taken back", 1.5),
        ("file anew", 1.5),
        ("file anew, resumed", 1.5),
        ("moved, resumed", 1.5),
        ("moved without it, told", 1.5),
    ],
)
def test_light_is_bent_by_the_reconstructed_body(found, made, name, index):
    assert found[name]["body"]["index"] == index
    assert found[name]["indices"] == [["ball_glass", index]]
    assert found[name]["inside"] == pytest.approx([index])
    assert found[name]["faces"] == records.read(made).geometry.faces
    assert "1 convex object" in found[name]["printed"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("half", "Continue with --resume"),
        ("named index", "--ior=glass=1.5 is invalid for the single reconstructed object"),
        ("two indices", "Pass its index once"),
        ("no index", "--ior=15 is not an index of refraction"),
        ("no number", "--ior=glass is not an index of refraction"),
        ("oracle too", "--method=oracle uses the scene's own meshes"),
        ("no effect", "--resolution would have no effect"),
        ("no effect of oracle", "add --method=r3f"),
        ("straight", "--paths=straight ignores objects"),
        ("nothing there", "nowhere has no reconstruction"),
        ("outliers of no hull", "geometry=occupancy, outliers=1: --outliers has no effect"),
        ("run in its body", "is the reconstruction itself"),
        ("r3f begun anew", "already contains a run"),
        ("r3f with another grid", "ior 1.5, not 1.6"),
        ("r3f by name alone", "--method would have no effect"),
        ("r3f with a given one", "created with other options"),
        ("file with named index", "Pass its index once"),
        ("file with oracle", "ball_glass.ply cannot be read"),
        ("file with a grid", "is already reconstructed. Remove it, or add --method=r3f."),
        ("file with straight", "Add --method=oracle, since"),
        ("file with straight oracle", "ball_glass.ply cannot be read"),
        ("moved without it", "which does not exist. Set --reconstruction to"),
    ],
)
def test_mistakes_are_told(found, name, message):
    assert message in found[name]["error"]


def test_what_is_reconstructed_for_a_run_is_kept_and_not_made_again(found, runs, made):
    for name in ("r3f", "killed"):
        assert found[name]["body"]["reconstruction"] == str(runs / name / "r3f")
        mesh = "geometry/ball_glass.ply"  # what two processes made is the same to the bit
        assert (runs / name / "r3f" / mesh).read_bytes() == (made / mesh).read_bytes()
        assert "hull of the training masks" in found[name]["printed"]
    assert "hull of the training masks" not in found["r3f resumed"]["printed"]
    assert found["given"]["body"]["reconstruction"] == str(made)
    for name in ("straight", "no index", "nothing there", "oracle"):
        assert not (runs / name).exists(), name


def test_a_run_and_what_was_reconstructed_for_it_move_together(found, runs, moved, made):
    written = json.loads((runs / "r3f" / "config.json").read_text())["scene"]["reconstruction"]
    beside = json.loads((runs / "file" / "config.json").read_text())["scene"]["reconstruction"]
    absolute = json.loads((runs / "given" / "config.json").read_text())["scene"]["reconstruction"]
    assert (written, beside, absolute) == ("r3f", "../r3f/r3f", str(made))
    assert found["file"]["reconstruction"] == str(runs / "r3f" / "r3f")
    for name in ("moved, resumed", "moved, resumed by its file"):
        assert found[name]["error"] is None
        assert found[name]["reconstruction"] == str(moved / "run" / "r3f")
    assert "hull of the training masks" not in found["moved, resumed by its file"]["printed"]
    told = found["file anew"]
    assert told["reconstruction"] == str(runs / "file anew" / "r3f")
    assert "decided again because of flags that override" in told["printed"]


@pytest.mark.slow
def test_a_reconstructed_body_is_trained_with_and_rendered(scene, tmp_path):
    run = tmp_path / "run"
    options = [f"--scene={scene}", "--method=r3f", "--ior=1.45", *_MASKS, f"--out={run}"]
    options += ["--steps=2", "--batch=64", "--interior=clear", "--paths=paper"]
    run_command("train", *options)
    again = run_command("train", *options, "--resume")
    assert "trained already" in again.stdout
    run_command("evaluate", f"--run={run}", "--limit=1")
    metrics = json.loads((run / "eval" / "test" / "metrics.json").read_text())
    assert metrics["method"] == "r3f" and metrics["results"]["psnr_masked"] is not None
    run_command("render", f"--run={run}", "--frames=1", "--size=16")
    assert (run / "render" / "orbit" / "rgb" / "r_000.png").is_file()
