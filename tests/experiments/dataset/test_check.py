import json
import shutil

import numpy as np
import pytest
import trimesh

from experiments.dataset import checks, scene_check
from experiments.dataset.check_page import SceneReport, write_page
from refref_jax.data.mesh_checks import Finding
from refref_jax.optics import path_settings
from tests.factories.cut_ball import cut_ball
from tests.factories.small_scenes import truncate
from tests.processes.command import run_command


def _view(**changes):
    grey = np.full((4, 4, 3), 0.5)
    numbers = {
        "psnr": 50.0,
        "psnr_masked": 45.0,
        "dropped": 0.0,
        "mask_share": 0.0,
        "depth_share": 1.0,
        "depth_error": 1e-5,
        "normal_degrees": 0.01,
    }
    return checks.View(name="r_000", target=grey, rgb=grey, **numbers | changes)


@pytest.fixture
def copy(tmp_path):
    return cut_ball(tmp_path / "scenes" / "cube_smcvx_ball")


def test_pixels_near_a_silhouette_are_left_out_by_hand():
    depth = np.full((11, 11), np.inf)
    depth[1:10, 1:10] = 3.0
    inner = checks.away_from_silhouettes(np.isfinite(depth), depth)
    # The step at the border reaches one pixel inwards; the margin goes two farther.
    assert inner.sum() == 9 and inner[4:7, 4:7].all()
    depth[:, 5] = np.where(np.isfinite(depth[:, 5]), 2.0, np.inf)  # a thin part before another
    assert not checks.away_from_silhouettes(np.isfinite(depth), depth).any()
    slope = np.tile(3.0 + 0.05 * np.arange(20), (20, 1))
    hit = np.ones_like(slope, bool)
    assert checks.away_from_silhouettes(hit, slope).all()
    hit[10, 10] = False  # a mask that lacks a pixel counts
    assert not checks.away_from_silhouettes(hit, slope)[9:12, 9:12].any()


@pytest.mark.parametrize(
    ("changes", "convex", "message"),
    [
        ({}, True, None),
        ({"psnr_masked": 39.0}, True, "39.0 dB masked PSNR, not at least 40"),
        ({"psnr_masked": 39.0}, False, None),
        ({"psnr_masked": 32.9}, False, "not at least 33"),
        ({"psnr_masked": np.nan}, False, "nan dB"),
        ({"mask_share": 0.003}, False, "0.30% of pixels"),
        ({"depth_share": 0.99}, False, "only 99.00% of pixels"),
        ({"depth_share": np.nan}, False, None),
    ],
)
def test_what_does_not_hold_is_told(changes, convex, message):
    found = checks.complaints(convex, [], [_view(**changes)])
    assert not found if message is None else len(found) == 1 and message in found[0]


def test_colours_are_not_compared_where_the_light_of_a_part_is_unknown(tmp_path):
    assert checks.complaints(False, [], [_view(psnr_masked=9.0)], colours=False) == []
    (found,) = checks.complaints(False, [], [_view(mask_share=0.1)], colours=False)
    assert "the mask differs" in found
    assert checks.unknown_light(tmp_path) == []
    cap = {"mesh": "meshes/vial_cap_opaque.ply", "kind": "opaque", "albedo": [0.1, 0.1, 0.1]}
    parts = [{"mesh": "meshes/vial_shell_glass.ply"}, cap]
    (tmp_path / "scene.json").write_text(json.dumps({"parts": parts}))
    assert checks.unknown_light(tmp_path) == ["vial_cap_opaque.ply"]
    cap["radiance"] = [0.1, 0.1, 0.1]
    (tmp_path / "scene.json").write_text(json.dumps({"parts": parts}))
    assert checks.unknown_light(tmp_path) == []


def test_findings_are_complaints_unless_they_are_notes():
    findings = [Finding(severity, "cup", "is odd") for severity in ("note", "warning", "error")]
    assert checks.complaints(False, findings, []) == ["cup: is odd"] * 2


@pytest.mark.slow
def test_the_bundled_scene_agrees_with_cycles(copy):
    report = scene_check.check_scene(copy, path_settings.TREE, views=1, side=6)
    assert report.complaints == [] and report.notes == [] and len(report.views) == 1
    assert report.views[0].psnr_masked > checks.PSNR_CONVEX
    assert report.views[0].depth_error < 2e-4


def test_a_preview_has_test_views_only(copy):
    for split in ("train", "val"):
        (copy / f"transforms_{split}.json").unlink()
    assert scene_check.find_scenes(copy.parent, None) == [copy]
    report = scene_check.check_scene(copy, path_settings.TREE, views=0, side=1)
    assert report.complaints == [] and report.views == []
    shutil.rmtree(copy / "mask")
    assert (
        "mask" in scene_check.check_scene(copy, path_settings.TREE, views=0, side=1).complaints[0]
    )


def test_a_background_of_another_size_than_rendered_is_found(copy):
    assert checks.check_background(copy) == []
    path = copy / "scene.json"
    stated = json.loads(path.read_text())
    stated["background"]["half_extent"] = 7.4
    path.write_text(json.dumps(stated))
    (finding,) = checks.check_background(copy)
    assert finding.severity == "error"
    assert "a background cube of size " in finding.message and "states 7.4" in finding.message
    stated["background"] |= {"half_extent": 7.3, "centre": [0.0, 0.2, 0.0]}
    path.write_text(json.dumps(stated))
    (finding,) = checks.check_background(copy)
    assert " around (" in finding.message and "states 7.3 around (0, 0.2, 0)" in finding.message
    (copy / "depth/train/r_000.png").write_bytes(b"")
    (finding,) = checks.check_background(copy)
    assert "r_000.png" in finding.message
    path.unlink()
    assert checks.check_background(copy) == []


@pytest.mark.slow
def test_a_mesh_that_is_not_where_it_was_rendered_is_found(copy):
    path = next((copy / "meshes").iterdir())
    trimesh.load(path).apply_translation([0.0, 0.0, 0.04]).export(path)
    told = " ".join(scene_check.check_scene(copy, path_settings.TREE, views=1, side=3).complaints)
    assert "dB masked PSNR" in told and "the mask differs" in told and "depths agree" in told
    for path in (copy / "depth" / "test").glob("*.exr"):
        path.unlink()
    report = scene_check.check_scene(copy, path_settings.PAPER, views=1, side=1)
    assert any("no depth was compared" in note for note in report.notes)


def test_a_broken_scene_is_reported_and_the_others_go_on(copy):
    other = copy.parent / "cube_smcvx_other"
    shutil.copytree(copy, other)
    picture = other / "mask" / "val" / "r_000.png"
    truncate(picture)
    out = copy.parents[1] / "report"
    result = run_command("dataset.check", copy.parent, "--views=0", f"--out={out}", fails=True)
    assert result.returncode == 1 and "1 of 2 scenes passed" in result.stdout
    assert str(picture) in result.stdout and str(out / "check.html") in result.stdout
    figures = {report["name"]: report for report in json.loads((out / "check.json").read_text())}
    assert figures["cube_smcvx_ball"]["complaints"] == []
    assert str(picture) in figures["cube_smcvx_other"]["complaints"][0]
    with pytest.raises(ValueError, match="holds no scene"):
        scene_check.find_scenes(out, None)
    with pytest.raises(ValueError, match="cube_smcvx_bal"):
        scene_check.find_scenes(copy.parent, ["cube_smcvx_bal"])
    assert scene_check.find_scenes(copy, None) == [copy]
    assert scene_check.find_scenes(copy.parent, ["cube_smcvx_ball"]) == [copy]


def test_the_page_stands_alone_and_shows_failures_first():
    good = SceneReport("good", [], ["a <note>"], [_view()])
    bad = SceneReport("bad & broken", ["a < b"], [], [_view(depth_share=np.nan)])
    page = write_page([good, bad], title="Scenes")
    assert page.count("<section") == 2 and page.count("data:image/png;base64,") == 6
    assert page.index("<h2>bad &amp; broken") < page.index("<h2>good")
    assert "a &lt; b" in page and "a &lt;note&gt;" in page and "1 failed" in page
    assert "http" not in page and 'src="/' not in page
