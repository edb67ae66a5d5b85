"""The picture of a benchmark: which view of which scene is where, and what it says below."""

import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.benchmarking.report import data, images
from tests.experiments.benchmarking import made_report

_SCENES = ("cube_smcvx_ball", "env_mmncvx_cup")


def _one_colour(scene, view):
    colours = np.zeros((12, 12, 3))
    colours[..., scene] = 0.2 + 0.3 * view
    return colours


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return made_report.write(tmp_path_factory.mktemp("sheet"), _SCENES, truth=_one_colour)


def test_the_view_in_the_middle_stands_for_a_scene(out):
    for scene in data.read(out).scenes:
        # The views of each method are a decibel apart.
        assert data.typical_view(scene) == "r_1"
        assert data.psnr_masked(scene, "tree", "r_1") == made_report.QUALITY["tree"] + 1.0
        assert data.psnr_masked(scene, "oracle", "r_1") is None


def test_each_scene_has_a_column_of_its_true_image_and_each_method(out):
    path = images.write_sheet(out)
    assert path == out / "pictures.jpg"
    pixels = iio.imread(path).astype(int)
    height, width, _ = pixels.shape
    # The true image is in the upper third, the first scene red and the second green.
    for scene in range(2):
        column = pixels[: height // 3, scene * width // 2 : (scene + 1) * width // 2]
        expected = np.array([0, 0, 0])
        expected[scene] = round(255 * 0.5)
        near = np.abs(column - expected).max(-1) < 12
        assert near.mean() > 0.4


def test_scenes_that_are_gone_have_no_column_and_no_scene_no_picture(out, tmp_path):
    both = iio.imread(images.write_sheet(out)).shape
    copy = tmp_path / "copy"
    shutil.copytree(out.parent, copy)
    for name in ("benchmark.json", "results.json"):
        text = (copy / "out" / name).read_text().replace(str(out.parent), str(copy))
        (copy / "out" / name).write_text(text)
    shutil.rmtree(copy / "scene_1")
    one = iio.imread(images.write_sheet(copy / "out")).shape
    assert one[0] == both[0] and one[1] < 0.6 * both[1]
    shutil.rmtree(copy / "scene_0")
    assert images.write_sheet(copy / "out") is None
    assert not (copy / "out" / images.SHEET).exists()


def test_a_method_without_a_result_leaves_its_place_empty(tmp_path):
    out = made_report.write(tmp_path / "a", _SCENES, methods=("straight", "oracle", "tree"))
    shutil.rmtree(tmp_path / "a/out/jobs/cube_smcvx_ball/tree/run/eval", ignore_errors=True)
    for path in (out / "jobs/cube_smcvx_ball/tree").rglob("*.png"):
        path.unlink()
    pixels = iio.imread(images.write_sheet(out))
    height, width, _ = pixels.shape
    lowest = pixels[3 * height // 4 : -height // 16]
    assert (lowest[:, : width // 2] > 250).mean() > 0.8
    assert (lowest[:, width // 2 :] > 250).mean() < 0.5
