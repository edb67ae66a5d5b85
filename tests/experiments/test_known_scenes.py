"""The commands that need no learning, on a few views of the bundled scene."""

import csv
import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.dataset import checks
from experiments.runs import known_scene, view_numbers
from refref_jax.data import image_files
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"
_QUICK = ("--views=0,10", "--rays_per_pixel=1")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """The folder of a rendering with the tree, and what was printed."""
    out = tmp_path_factory.mktemp("known") / "tree"
    result = run_command(
        "render_known", f"--scene={_SCENE}", "--paths=tree", f"--out={out}", *_QUICK
    )
    return out, result.stdout


# At each run, `test_against_cycles` compares the same images.
@pytest.mark.slow
def test_a_rendering_is_measured_and_pictured(rendered):
    out, printed = rendered
    summary = json.loads((out / "metrics.json").read_text())
    assert (summary["scene"], summary["paths"]) == ("cube_smcvx_ball", "tree")
    assert (summary["min_throughput"], summary["max_bends"]) == (0.02, 24)
    assert summary["truncated_paths"] == "background"
    assert [view["index"] for view in summary["views"]] == [0, 10]
    # Those of one camera ray, as `test_against_cycles` has them.
    assert summary["casts_per_pixel"] == pytest.approx(2.45, rel=0.02)
    assert summary["paths_per_pixel"] == pytest.approx(1.56, rel=0.02)
    assert summary["seconds"] > 0.0 and 0.0 <= summary["dropped"] < 1e-3
    for view in summary["views"]:
        picture = image_files.read_rgb(out / "rgb" / f"{view['name']}.png") / 255.0
        target = image_files.read_rgb(_SCENE / "test" / f"{view['name']}.png") / 255.0
        mask = image_files.read_mask(_SCENE / "mask" / "test" / f"{view['name']}.png")
        # The picture on disk is the one that was measured.
        for key, where in (("psnr", mask | True), ("psnr_masked", mask), ("psnr_outside", ~mask)):
            found = -10.0 * np.log10(np.mean((picture - target)[where] ** 2))
            assert view[key] == pytest.approx(found, abs=0.1)
    for key in ("psnr", "psnr_masked", "psnr_outside"):
        values = [view[key] for view in summary["views"]]
        assert summary["mean"][key] == pytest.approx(np.mean(values))
    # One ray a pixel: what is left is mostly aliasing.
    assert summary["mean"]["psnr_masked"] > 20.0
    assert iio.imread(out / "comparison.png").ndim == 3
    assert str(out / "metrics.json") in printed and "path_trade_off" in printed


@pytest.mark.slow
def test_results_are_replaced_when_asked_and_other_files_not_at_all(rendered, tmp_path):
    out, _ = rendered
    ours = tmp_path / "again"
    shutil.copytree(out, ours)
    (ours / "notes.txt").write_text("mine")
    measures = tmp_path / "measures.json"
    options = (f"--scene={_SCENE}", "--paths=straight", f"--out={ours}", "--rays_per_pixel=4")
    refused = run_command("render_known", *options, fails=True)
    assert "--overwrite" in refused.stderr and (ours / "metrics.json").exists()
    options += ("--overwrite", "--views=3", f"--json={measures}")
    run_command("render_known", *options)
    assert {path.name for path in (ours / "rgb").iterdir()} == {"r_003.png"}
    assert not (ours / "metrics.json").exists()  # it was of what is replaced
    assert (ours / "notes.txt").read_text() == "mine"
    summary = json.loads(measures.read_text())
    assert summary["casts_per_pixel"] == 0.0 and summary["paths_per_pixel"] == 1.0
    noted = json.loads((ours / "command.json").read_text())
    assert noted["command"] == "experiments.render_known"
    assert noted["options"]["paths"] == "straight" and noted["options"]["rule"] == "nested"
    measures.write_text("{}")
    refused = run_command("render_known", *options, fails=True)
    assert "not written by this command" in refused.stderr and measures.read_text() == "{}"


@pytest.mark.slow
def test_light_that_has_no_bend_left_may_be_dark(rendered, tmp_path):
    out = tmp_path / "dark"
    options = (f"--scene={_SCENE}", "--paths=paper", "--bends=1", "--unfinished=dark", *_QUICK)
    told = run_command("render_known", *options, f"--out={out}").stdout
    assert "dropped: truncated paths" in told and "path buffer overflow" not in told
    summary = json.loads((out / "metrics.json").read_text())
    assert (summary["max_bends"], summary["truncated_paths"]) == (1, "black")
    mask = image_files.read_mask(_SCENE / "mask" / "test" / "r_010.png")
    dark, kept = (
        image_files.read_rgb(folder / "rgb" / "r_010.png") / 255.0 for folder in (out, rendered[0])
    )
    # What entered the ball ends inside: a few per cent of light, the first reflection, are seen.
    assert np.median(dark[mask]) < 0.5 * np.median(kept[mask])
    # Around it nothing bends, so nothing is unfinished. A mask is of the pixels' middles, as rays.
    assert np.mean(np.any(dark != kept, axis=-1)[~mask]) < 1e-3


@pytest.mark.slow
def test_the_curve_has_a_row_for_every_setting(tmp_path):
    out = tmp_path / "curve"
    result = run_command(
        "path_trade_off",
        f"--scenes={_SCENE}",
        f"--out={out}",
        "--views=0",
        "--rays_per_pixel=1",
        "--cuts=0.2,0.02",
        "--bends=24",
    )
    with (out / "path_trade_off.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["sweep"], row["name"]) for row in rows] == [
        ("settings", "straight"),
        ("settings", "paper"),
        ("cut", "0.2"),
        ("cut", "0.02"),
        ("bends", "24"),
    ]
    decibels, casts = (
        [float(row[key]) for row in rows] for key in ("psnr_masked", "casts_per_pixel")
    )
    assert decibels[0] < decibels[1] < decibels[3] and casts[0] == 0.0
    assert casts[2] < casts[3] == casts[4]
    assert all(float(row["seconds_per_pixel"]) > 0.0 for row in rows)
    for sweep in ("cut", "bends"):
        assert iio.imread(out / f"path_trade_off_{sweep}.png").ndim == 3
    assert str(out / "path_trade_off.csv") in result.stdout


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--rays_per_pixel=5", "square"),
        ("--views=0,99", "no view 99"),
        ("--out=README.md/x", "README.md"),
    ],
)
def test_mistakes_end_with_one_line_before_anything_is_written(tmp_path, option, message):
    given = {"--scene": _SCENE, "--out": tmp_path / "out"} | dict([option.split("=", 1)])
    words = [f"{name}={value}" for name, value in given.items()]
    refused = run_command("render_known", *words, fails=True)
    assert message in refused.stderr and "Traceback" not in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1
    assert "Compiling" not in refused.stdout
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [("first", "--views=0,10,20"), ("1,1", "twice"), ("-1", "list of numbers"), ("5", "0 to 4")],
)
def test_views_keep_their_order_and_exist(text, message):
    with pytest.raises(ValueError, match=message):
        view_numbers.choose(text, 5)
    assert view_numbers.choose("3, 0", 5) == (3, 0)
    assert tuple(view_numbers.choose("all", 3)) == (0, 1, 2)


def test_a_scene_without_a_known_background_is_named(tmp_path):
    scene = tmp_path / "scene"
    shutil.copytree(_SCENE, scene)
    (scene / "scene.json").unlink()
    out = tmp_path / "out"
    refused = run_command("render_known", f"--scene={scene}", f"--out={out}", fails=True)
    assert "The background is unknown" in refused.stderr and not out.exists()


@pytest.fixture
def described(tmp_path):
    """Makes the bundled scene with other properties, and an overlay of it."""
    folder = tmp_path / "cube_smcvx_ball"
    folder.mkdir()
    for path in _SCENE.iterdir():
        if path.name != "scene.json":
            (folder / path.name).symlink_to(path)
    content = json.loads((_SCENE / "scene.json").read_text())
    changed = content | {"rule": "priority", "ambient_index": 1.2}
    (folder / "scene.json").write_text(json.dumps(changed))
    (tmp_path / "mine.json").write_text('{"rule": "facing", "ambient_index": 1.25}')
    return folder, str(tmp_path / "mine.json")


@pytest.mark.parametrize(
    ("rule", "overlaid", "ambient", "note"),
    [
        (None, False, 1.2, "note: rule=priority, from scene.json."),
        ("nested", False, 1.2, "note: rule=nested overrides scene.json: priority."),
        (None, True, 1.25, "note: rule=facing, from mine.json."),
    ],
)
def test_the_rule_and_the_ambient_medium_are_those_of_the_scene(
    described, capsys, rule, overlaid, ambient, note
):
    scene, overlay = described
    read = known_scene.read_scene(
        scene,
        split="test",
        views="0",
        rule=rule,
        indices={},
        overlay=overlay if overlaid else None,
    )
    assert (read.interior_list is not None) == (rule is None and not overlaid)
    assert read.objects.interfaces.index_outside.tolist() == [np.float32(ambient)]
    assert note in capsys.readouterr().out.splitlines()


@pytest.mark.slow
def test_dataset_check_uses_the_properties_of_the_scene(described):
    scene, _ = described
    made_of, _ = checks.check_meshes(scene)
    read = checks.read_views(scene, made_of, count=1)
    assert read.interior_list is not None
    assert read.objects.interfaces.index_outside.tolist() == [np.float32(1.2)]
