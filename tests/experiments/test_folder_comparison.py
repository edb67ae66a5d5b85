"""Two folders are compared without a model: as functions, and as a user calls the command."""

import json

import numpy as np
import pytest

from experiments.runs import image_folders
from refref_jax.data import image_files
from refref_jax.training.evaluation import Perceptual
from tests.factories import made_lpips
from tests.factories.small_scenes import truncate, write_grey
from tests.processes.command import run_command

pytestmark = pytest.mark.loose

_NOTHING = Perceptual()


def _write(folder, name, level, *, size=(13, 17)):
    folder.mkdir(exist_ok=True)
    image_files.write_rgb(folder / f"{name}.png", np.full((*size, 3), level))


def _write_distance(folder, name, distance, *, size=(13, 17)):
    folder.mkdir(exist_ok=True)
    image_files.write_exr(folder / f"{name}.exr", np.full(size, np.float32(distance)))


@pytest.fixture
def folders(tmp_path):
    """Two images: of one all pixels differ by a fifth, the other is the same."""
    rendered, target = tmp_path / "rendered", tmp_path / "truth"
    for name, level in (("r_000", 0.2), ("r_001", 0.4)):
        _write(rendered, name, level)
        _write(target, name, 0.4)
    return rendered, target


@pytest.fixture
def masks(tmp_path):
    """The first image's mask is its top row, the second's is empty."""
    mask = np.zeros((13, 17))
    mask[0] = 255
    write_grey(tmp_path / "masks" / "r_000.png", mask)
    write_grey(tmp_path / "masks" / "r_001.png", np.zeros((13, 17)))
    return tmp_path / "masks"


def _compared(rendered, target, masks=None):
    pairs = image_folders.match(rendered, target, masks)
    return list(image_folders.compare(pairs, _NOTHING))


def test_measures_by_hand(folders, masks):
    first, second = _compared(*folders, masks)
    assert (first["name"], second["name"]) == ("r_000", "r_001")
    assert first["psnr"] == pytest.approx(-20.0 * np.log10(0.2))
    assert first["psnr_masked"] == pytest.approx(-20.0 * np.log10(0.2))
    assert second["psnr"] == np.inf and second["ssim"] == pytest.approx(1.0)
    assert second["psnr_masked"] is None
    means = image_folders.summarise([first, second])
    assert means["psnr"] == np.inf and means["lpips"] is None
    assert means["psnr_masked"] == first["psnr_masked"]


def test_distances_are_compared_if_both_folders_hold_them(folders, masks):
    rendered, target = folders
    for name, distance in (("r_000", 3.0), ("r_001", 5.0)):
        _write_distance(rendered, name, distance)
    assert "distance_mae" not in _compared(*folders)[0]
    _write_distance(target, "r_000", 2.5)
    _write_distance(target, "r_001", np.inf)
    first, second = _compared(*folders, masks)
    assert first["distance_mae"] == first["distance_rmse"] == first["distance_mae_masked"] == 0.5
    assert second["distance_mae"] is None
    for folder in folders:
        for path in folder.glob("*.png"):
            path.unlink()
    alone = _compared(*folders)
    assert "psnr" not in alone[0] and alone[0]["distance_mae"] == 0.5
    assert image_folders.summarise(alone)["distance_mae"] == 0.5


def _emptied(rendered, target):
    for path in target.iterdir():
        path.unlink()


def _of_another_kind(rendered, target):
    _emptied(rendered, target)
    _write_distance(target, "r_000", 1.0)


def _with_more(rendered, target):
    for i in range(3):
        _write(rendered, f"s_{i}", 0.1)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda ours, _: (ours / "r_001.png").unlink(), "rendered has no r_001.png, which the oth"),
        (lambda _, theirs: (theirs / "r_000.png").unlink(), "truth has no r_000.png"),
        (_with_more, r"no s_0\.png \(and 2 more\)"),
        (_emptied, "truth contains no .png and no .exr"),
        (_of_another_kind, "nothing in common"),
        (
            lambda _, theirs: _write(theirs, "r_001", 0.4, size=(13, 16)),
            "truth/r_001.png is 16 x 13 pixels, but .*r_001.png is 17 x 13",
        ),
        (lambda ours, _: truncate(ours / "r_000.png"), "r_000.png cannot be read"),
    ],
)
def test_folders_that_do_not_fit_are_named(folders, spoil, message):
    spoil(*folders)
    with pytest.raises(ValueError, match=message):
        _compared(*folders)


def test_all_sizes_are_looked_at_before_anything_is_compared(folders, masks):
    for folder in folders:
        for name in ("r_000", "r_001"):
            _write_distance(folder, name, 1.0)
    assert len(image_folders.match(*folders, masks)) == 2
    _write_distance(folders[0], "r_001", 1.0, size=(12, 17))
    with pytest.raises(ValueError, match=r"r_001\.exr is 17 x 13 pixels, but .* is 17 x 12"):
        image_folders.match(*folders, masks)
    write_grey(masks / "r_001.png", np.zeros((5, 4)))
    with pytest.raises(ValueError, match=r"masks/r_001\.png is 4 x 5 pixels"):
        image_folders.match(*folders, masks)
    (masks / "r_001.png").unlink()
    with pytest.raises(ValueError, match="There is no mask of r_001"):
        image_folders.match(*folders, masks)
    with pytest.raises(ValueError, match="nowhere is not a folder"):
        image_folders.match(folders[0], masks / "nowhere", None)
    (folders[0] / "r_001.exr").write_text("no EXR")
    with pytest.raises(ValueError, match=r"rendered/r_001\.exr cannot be read as EXR"):
        image_folders.match(*folders, None)


def test_the_command_prints_a_table_and_writes_only_what_is_asked(folders, masks, tmp_path):
    out = tmp_path / "new" / "metrics.json"
    options = (*folders, f"--masks={masks}", f"--out={out}")
    printed = run_command("metrics", *options).stdout
    assert printed.count("warning: LPIPS") == 1 and "docs/metrics.md" in printed
    assert "r_001" in printed and "mean" in printed and str(out) in printed
    summary = json.loads(out.read_text())
    assert summary["results"]["psnr"] == "inf" and summary["results"]["lpips"] is None
    assert [row["name"] for row in summary["per_image"]] == ["r_000", "r_001"]
    assert summary["per_image"][0]["psnr"] == pytest.approx(-20.0 * np.log10(0.2))
    out.write_text("{}")
    refused = run_command("metrics", *options, fails=True)
    assert "--overwrite" in refused.stderr and "Traceback" not in refused.stderr
    assert out.read_text() == "{}"


@pytest.mark.slow
def test_the_command_overwrites_when_asked_and_writes_nothing_unasked(folders, masks, tmp_path):
    out, weights = tmp_path / "metrics.json", made_lpips.write(tmp_path / "weights.npz")
    out.write_text("{}")
    run_command("metrics", *folders, f"--out={out}", "--overwrite")
    assert json.loads(out.read_text())["masks"] is None
    before = sorted(tmp_path.rglob("*"))
    options = [f"--masks={masks}", f"--lpips_weights={weights}"]
    printed = run_command("metrics", *folders, *options).stdout
    again = f"{folders[0]} {folders[1]} {options[0]} {options[1]} --out=metrics.json"
    assert again in printed and sorted(tmp_path.rglob("*")) == before
    missing = run_command("metrics", folders[0], fails=True)
    assert "TRUTH is missing" in missing.stderr
