"""Renderings by other programs: found by name, checked before they are read, measured as ours."""

import json

import numpy as np
import pytest

from experiments.runs import renderings
from refref_jax.data import image_files, scene_folder
from refref_jax.training import evaluation
from refref_jax.training.evaluation import Perceptual
from tests.factories.made_benchmark import write_renderings, write_scene
from tests.factories.small_scenes import HEIGHT, WIDTH, truncate
from tests.processes.command import run_command

pytestmark = pytest.mark.loose


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scenes" / "cube_smcvx_ball")


def _frames(scene):
    return scene_folder.read_frames(scene, "test")


def _measured(folder, scene, limit=None):
    given = {"split": "test", "limit": limit, "perceptual": Perceptual()}
    return list(renderings.measure(folder, scene, **given))


def test_they_are_measured_by_hand(tmp_path, scene):
    rows = _measured(write_renderings(tmp_path / "a", scene, level=0.2, distance=9.0), scene)
    assert [row["name"] for row in rows] == [f"r_{i:03d}" for i in range(7)]
    # The scene is 1 / 255 everywhere; 0.2 is 51 / 255.
    assert rows[0]["psnr"] == pytest.approx(-20.0 * np.log10(50.0 / 255.0), abs=1e-4)
    assert rows[0]["psnr_masked"] == pytest.approx(rows[0]["psnr"], abs=1e-4)
    # Its depth map is 11.5, planar: a pixel's distance is that over its cosine with the axis.
    frames = _frames(scene)
    true = scene_folder.read_distances(frames)[0]
    assert rows[0]["distance_mae"] == pytest.approx(np.mean(true - 9.0), abs=1e-4)
    assert true.min() > 11.5 and rows[0]["distance_mae_masked"] > 2.5
    for kind in ("surface", "substituted"):
        assert rows[0][f"{kind}_mae"] == rows[0]["distance_mae"]


def test_they_are_measured_as_a_model_without_objects_would_be(tmp_path, scene):
    generator = np.random.default_rng(0)
    folder = write_renderings(tmp_path / "a", scene, distance=3.0)
    rgb = generator.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    distance = generator.uniform(2.0, 20.0, (HEIGHT, WIDTH)).astype(np.float32)
    image_files.write_rgb(folder / "r_003.png", rgb / 255.0)
    image_files.write_exr(folder / "r_003.exr", distance)
    (row,) = [row for row in _measured(folder, scene) if row["name"] == "r_003"]
    seen = evaluation.Rendering(
        rgb=(rgb / 255.0).astype(np.float32),
        distance=distance,
        mean_distance=distance,
        accumulation=np.ones_like(distance),
        linear=rgb / 255.0,
        dropped=np.zeros((HEIGHT, WIDTH, 3)),
    )
    truth = evaluation.read_truth(scene, "test")
    expected = evaluation.measure(seen, truth, 3, first=None, perceptual=Perceptual())
    assert expected.pop("dropped") == 0.0
    assert row == {"name": "r_003", **expected}


def test_without_distances_they_are_not_known_and_some_views_suffice(tmp_path, scene):
    folder = write_renderings(tmp_path / "a", scene)
    for i in (1, 2, 4, 5):
        (folder / f"r_{i:03d}.png").unlink()
    with pytest.raises(ValueError, match=r"lacks 4 of 7 views: r_001\.png, r_002\.png, r_004"):
        renderings.find(folder, _frames(scene))
    rows = _measured(folder, scene, limit=3)
    assert [row["name"] for row in rows] == ["r_000", "r_003", "r_006"]
    assert {rows[0][f"{kind}_mae"] for kind in ("distance", "surface", "substituted")} == {None}


def test_both_layouts_are_the_same_renderings(tmp_path, scene):
    folder, frames = write_renderings(tmp_path / "a", scene, distance=3.0), _frames(scene)
    (folder / "notes.txt").write_text("mine")
    (folder / "comparison.png").write_text("not an image of a view")
    found = renderings.find(folder, frames)
    renderings.copy(found, tmp_path / "b")
    (tmp_path / "b" / "rgb" / "old.png").write_text("of an earlier copy")
    renderings.copy(found, tmp_path / "b")
    names = sorted(path.name for path in (tmp_path / "b").glob("*/*"))
    assert len(names) == 14 and "old.png" not in names
    copied = renderings.find(tmp_path / "b", frames)
    assert renderings.digest(copied) == renderings.digest(found)
    path = folder / "r_002.exr"
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([255 - content[-1]]))  # of the same size
    assert renderings.digest(renderings.find(folder, frames)) != renderings.digest(copied)
    path.write_bytes(content)
    assert renderings.digest(renderings.find(folder, frames)) == renderings.digest(copied)


def _other_size(folder, name="r_001.png"):
    image_files.write_rgb(folder / name, np.zeros((HEIGHT + 1, WIDTH, 3)))


def _other_map(folder):
    image_files.write_exr(folder / "r_001.exr", np.zeros((HEIGHT, WIDTH + 2), np.float32))


def _no_images(folder):
    for path in folder.glob("*.png"):
        path.unlink()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_no_images, r"contains no \.png. Save an image for each view there, named like r_000.png"),
        (lambda a: (a / "r_004.png").unlink(), r"lacks 1 of 7 views: r_004\.png\. Save"),
        (lambda a: (a / "r_004.exr").unlink(), r"lacks 1 of 7 views: r_004\.exr\. Save"),
        (_other_size, r"r_001\.png is \d+ x \d+ pixels, but the scene's images are"),
        (_other_map, r"r_001\.exr is \d+ x \d+ pixels, but the scene's images are"),
        (lambda a: truncate(a / "r_000.exr", 0.05), r"r_000\.exr cannot be read"),
    ],
)
def test_folders_that_do_not_fit_are_named(tmp_path, scene, spoil, message):
    folder = write_renderings(tmp_path / "a", scene, distance=3.0)
    spoil(folder)
    with pytest.raises(ValueError, match=message):
        renderings.find(folder, _frames(scene))
    with pytest.raises(ValueError, match="nowhere is not a folder"):
        renderings.find(tmp_path / "nowhere", _frames(scene))


def test_the_command_compares_a_folder_with_a_scene(tmp_path, scene):
    folder = write_renderings(tmp_path / "a", scene, level=0.2, distance=9.0)
    out = tmp_path / "metrics.json"
    words = (folder, scene, "--split=test", "--limit=3")
    printed = run_command("metrics", *words, f"--out={out}").stdout
    assert "r_003" in printed and "r_001" not in printed
    summary = json.loads(out.read_text())
    expected = _measured(folder, scene, limit=3)
    for row, wanted in zip(summary["per_image"], expected, strict=True):
        assert row["psnr"] == wanted["psnr"] and row["distance_mae"] == wanted["distance_mae"]
    refused = run_command("metrics", folder, scene, "--masks=masks", fails=True).stderr
    assert f"--masks would have no effect, because {scene} is a scene" in refused
    refused = run_command("metrics", folder, folder, "--limit=2", fails=True).stderr
    assert f"--limit would have no effect, because {folder} is no scene" in refused
