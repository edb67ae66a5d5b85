"""The image files of a benchmark: what is in which tile, on which scale, and what is left out."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.benchmarking import plan, summary
from experiments.benchmarking.report import data, images, sheets
from refref_jax.data import image_files
from tests.factories.made_benchmark import write_benchmark

_SCENES = ("cube_smcvx_ball", "cube_smcvx_cone")


@pytest.fixture
def out(tmp_path):
    """Two scenes by two methods, of which one has other distances in the second scene."""
    out = write_benchmark(tmp_path, _SCENES)
    for path in (out / plan.FOLDER / _SCENES[1] / "tree").rglob("*.exr"):
        image_files.write_exr(path, np.full((12, 12), 5.5, np.float32))
    index = out / summary.RESULTS
    content = json.loads(index.read_text())
    for job in content["jobs"]:
        for image in job["per_image"]:
            image["distance_mae"] = 0.25 if job["method"] == "tree" else None
    index.write_text(json.dumps(content))
    return out


@pytest.fixture
def drawn(out, monkeypatch):
    """The tiles of both files: rows by columns of (array or `None`, text below)."""
    figures = {}
    monkeypatch.setattr(sheets, "_save", lambda figure, path: figures.update({path.name: figure}))
    assert sheets.write(out) == [out / sheets.SHEET, out / sheets.GRID]
    return figures


def _tiles(figure, columns):
    found = [axis for axis in figure.axes if axis.get_subplotspec() is not None]
    cells = [
        (axis.images[0].get_array() if axis.images else None, axis.get_xlabel().strip())
        for axis in found
        if axis.get_label() != "<colorbar>"
    ]
    return [cells[i : i + columns] for i in range(0, len(cells), columns)]


def test_rows_are_methods_and_columns_images_and_distances_of_scenes(drawn):
    rows = _tiles(drawn[sheets.GRID], 4)
    assert len(rows) == 3 and all(pixels is not None for row in rows for pixels, _ in row)
    assert [text for _, text in rows[0]] == ["r_1", "", "r_1", ""]
    assert [text for _, text in rows[1]] == ["16.0 dB", "", "16.0 dB", ""]
    assert [text for _, text in rows[2]] == ["29.0 dB", "mean error 0.25"] * 2
    labels = [axis.get_ylabel() for axis in drawn[sheets.GRID].axes]
    assert [label for label in labels if label][:3] == [
        "ground truth",
        "Straight (Zip-NeRF)",
        "Oracle (path tree)",
    ]
    titles = [axis.get_title() for axis in drawn[sheets.GRID].axes]
    wanted = [_SCENES[0], "distance", _SCENES[1], "distance"]
    assert [title for title in titles if title] == wanted
    # The images are those of the sheet without distances.
    for row, plain in zip(rows, _tiles(drawn[sheets.SHEET], 2), strict=True):
        for place in (0, 1):
            np.testing.assert_array_equal(row[2 * place][0], plain[place][0])


def test_all_distances_of_a_scene_are_on_the_scale_of_the_true_ones(drawn, out):
    rows = _tiles(drawn[sheets.GRID], 4)
    for place, scene in enumerate(data.read(out).scenes):
        view = data.read_view(out, scene, "r_1")
        scale = images.distance_scale(view.truth.distance, [])
        shown = (view.truth, view.rendered["straight"], view.rendered["tree"])
        for row, image in zip(rows, shown, strict=True):
            expected = images.colour(image.distance, scale)
            np.testing.assert_array_equal(row[2 * place + 1][0], expected)
    # That of one method in one scene differs, which is seen.
    assert np.all(rows[2][1][0] == rows[1][1][0]) and np.all(rows[1][3][0] == rows[1][1][0])
    assert np.all(np.any(rows[2][3][0] != rows[1][3][0], axis=-1))


def test_files_are_written_and_the_grid_needs_distances(out):
    assert sheets.write(out) == [out / sheets.SHEET, out / sheets.GRID]
    plain, whole = (iio.imread(out / name) for name in (sheets.SHEET, sheets.GRID))
    assert whole.shape[1] > 1.7 * plain.shape[1] and whole.std() > 10.0
    for path in [*out.rglob("*.exr"), *out.parent.glob("scene_*/depth/*")]:
        path.unlink()
    assert sheets.write(out) == [out / sheets.SHEET] and not (out / sheets.GRID).exists()
