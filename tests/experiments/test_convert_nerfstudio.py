"""The command that converts captures, as a user calls it, and what it refuses."""

import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.captures import conversion as from_nerfstudio
from experiments.captures import conversion as to_nerfstudio
from experiments.captures import nerfstudio
from experiments.captures.conversion import View
from refref_jax.data import SceneError, image_files, scene_folder
from tests.factories.small_captures import (
    FOCAL,
    HEIGHT,
    WIDTH,
    edit,
    pixels_of,
    pose_of,
    write_capture,
)
from tests.factories.small_scenes import write_scene
from tests.processes.command import run_command

pytestmark = pytest.mark.loose


@pytest.fixture
def folder(tmp_path):
    return write_capture(tmp_path / "capture")


def _convert(folder, out, sense="object", numbers=None):
    capture = nerfstudio.read_capture(folder)
    chosen = range(len(capture.frames)) if numbers is None else numbers
    views = [View(capture.frames[number], capture.frames[number].pose) for number in chosen]
    return from_nerfstudio.write_scene({"train": views}, out, sense, step=lambda: None)["train"]


def test_the_command_both_ways(folder, tmp_path):
    options = ("--centre=auto", "--scale=auto", "--test_every=4")
    to_scene = (f"--source={folder}", f"--out={tmp_path / 'scene'}", *options)
    result = run_command("convert_nerfstudio", *to_scene)
    assert "train: 6 images of 12 x 10" in result.stdout and "test: 3 images" in result.stdout
    assert "World: x -> 0.8 (x - (" in result.stdout  # from 5 units to the data set's 4
    assert "Cameras: 4 to 4 from the origin" in result.stdout
    assert "experiments.reconstruct" in result.stdout
    scene_folder.check_scene(tmp_path / "scene", needed=("train", "test"))
    train = scene_folder.read_frames(tmp_path / "scene", "train")
    numbers = [1, 2, 3, 5, 6, 7]
    expected = np.stack([pose_of(number)[:3] for number in numbers])
    expected[..., 3] *= 0.8
    np.testing.assert_allclose(train.cameras.poses, expected, atol=1e-9)
    assert train.cameras.focal == pytest.approx(FOCAL)
    np.testing.assert_array_equal(
        scene_folder.read_images(train), [pixels_of(number) for number in numbers]
    )
    again = run_command("convert_nerfstudio", *to_scene, fails=True)
    assert "nothing is overwritten" in again.stderr and "Traceback" not in again.stderr
    back = (f"--source={tmp_path / 'scene'}", f"--out={tmp_path / 'back'}", "--to=nerfstudio")
    result = run_command("convert_nerfstudio", *back)
    assert "train on the object only" in result.stdout
    assert "ns-train nerfacto --data" in result.stdout
    capture = nerfstudio.read_capture(tmp_path / "back")
    views = {
        split: [View(capture.frames[i], capture.frames[i].pose) for i in numbers]
        for split, numbers in capture.splits.items()
    }
    assert {split: len(each) for split, each in views.items()} == {"train": 6, "test": 3}
    from_nerfstudio.write_scene(views, tmp_path / "again", "object", step=lambda: None)
    for split in views:
        before, after = (scene_folder.read_frames(tmp_path / x, split) for x in ("scene", "again"))
        np.testing.assert_allclose(after.cameras.poses, before.cameras.poses, atol=1e-6)
        assert after.cameras.focal == pytest.approx(before.cameras.focal, rel=1e-12)
        for read in (scene_folder.read_images, scene_folder.read_masks):
            np.testing.assert_array_equal(read(after), read(before))


def test_the_original_world_is_that_of_before_the_applied_transform(folder):
    motion = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]  # what ns-process-data does
    edit(folder, lambda content: content.update(applied_transform=motion, applied_scale=2.0))
    capture = nerfstudio.read_capture(folder)
    kept = from_nerfstudio.positions(capture, original=False)
    np.testing.assert_array_equal(kept[3], pose_of(3)[:3])
    found = from_nerfstudio.positions(capture, original=True)
    turned = np.array(motion)[:, :3] @ found[3]
    turned[:, 3] *= 2.0
    np.testing.assert_allclose(turned, pose_of(3)[:3], atol=1e-12)


def _white_but_for(capture, *pixel):
    for path in (capture / "masks").iterdir():
        mask = np.ones((HEIGHT, WIDTH), bool)
        mask[pixel] = False
        image_files.write_mask(path, mask)


def test_masks_mean_what_they_are_said_to(folder, tmp_path):
    assert _convert(folder, tmp_path / "white").masked == pytest.approx(1.0 / 120.0)
    frames = scene_folder.read_frames(tmp_path / "white", "train")
    assert np.argwhere(scene_folder.read_masks(frames)[0]).tolist() == [[4, 5]]
    _white_but_for(folder, 2, 3)
    _convert(folder, tmp_path / "black", "background")
    frames = scene_folder.read_frames(tmp_path / "black", "train")
    assert np.argwhere(scene_folder.read_masks(frames)[0]).tolist() == [[2, 3]]
    assert _convert(folder, tmp_path / "none", "none").masked is None
    assert scene_folder.read_frames(tmp_path / "none", "train").masks is None
    shutil.rmtree(folder / "masks")
    edit(folder, lambda content: [record.pop("mask_path") for record in content["frames"]])
    assert _convert(folder, tmp_path / "scene").masked is None
    assert scene_folder.read_frames(tmp_path / "scene", "train").masks is None


def test_what_masks_are_written_for_nerfstudio(tmp_path):
    scene = write_scene(tmp_path / "scene")
    splits = to_nerfstudio.read_splits(scene)
    for sense, white in (("object", 1), ("background", 8 * 6 - 1)):
        to_nerfstudio.write_capture(splits, tmp_path / sense, sense, step=lambda: None)
        mask = iio.imread(tmp_path / sense / "masks" / "train_0.png", plugin="pillow")
        assert mask.ndim == 2 and set(np.unique(mask)) == {0, 255}  # one channel, black and white
        assert (mask == 255).sum() == white
    to_nerfstudio.write_capture(splits, tmp_path / "none", "none", step=lambda: None)
    assert not (tmp_path / "none" / "masks").exists()
    with pytest.raises(SceneError, match="nothing is overwritten"):
        to_nerfstudio.write_capture(splits, tmp_path / "none", "none", step=lambda: None)


def test_images_are_cut_around_the_principal_point(folder, tmp_path):
    edit(folder, lambda content: content.update(cx=4.9, cy=6.0))
    done = _convert(folder, tmp_path / "scene")
    assert (done.lens.columns.size, done.lens.rows.size) == (10, 8)
    assert done.lens.columns.shift == pytest.approx(0.1) and done.lens.rows.shift == 0.0
    frames = scene_folder.read_frames(tmp_path / "scene", "train")
    np.testing.assert_array_equal(scene_folder.read_images(frames)[2], pixels_of(2)[2:, :10])
    assert np.argwhere(scene_folder.read_masks(frames)[0]).tolist() == [[2, 5]]
    assert frames.cameras.focal == pytest.approx(FOCAL)  # of pixels, whatever is cut away


def test_photographs_become_png(folder, tmp_path):
    smooth = np.full((HEIGHT, WIDTH, 3), (200, 100, 50), np.uint8)
    iio.imwrite(folder / "images" / "photo.jpg", smooth, plugin="pillow", quality=95)
    edit(folder, lambda content: content["frames"][0].update(file_path="images/photo.jpg"))
    _convert(folder, tmp_path / "scene")
    read = scene_folder.read_images(scene_folder.read_frames(tmp_path / "scene", "train"))
    photo = iio.imread(folder / "images" / "photo.jpg", plugin="pillow")
    assert any(np.array_equal(photo, each) for each in read)


def _tall(folder):
    image_files.write_png(folder / "images" / "frame_00003.png", np.zeros((14, WIDTH, 3), np.uint8))

    def change(content):
        del content["w"], content["h"], content["cx"], content["cy"]

    edit(folder, change)


def _mask(folder, marked):
    image_files.write_mask(folder / "masks" / "frame_00003.png", marked.astype(bool))


def _focals(values):
    def change(content):
        del content["fl_x"], content["fl_y"]
        for record, value in zip(content["frames"], values, strict=True):
            record["fl_x"] = value

    return lambda folder: edit(folder, change)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_tall, r"frame_00003\.png is 12 x 14 pixels, but images/frame_00000\.png is 12 x 10"),
        (lambda folder: edit(folder, lambda c: c.update(fl_y=12.0)), "are not square: fl_x is 9"),
        (_focals([9.0] * 8 + [12.0]), r"frame_00008\.png is 12 pixels, but the mean is 9\.33"),
        (lambda folder: edit(folder, lambda c: c.update(cx=1.0)), r"point of .* is \(1, 5\), far"),
        (
            lambda f: _mask(f, np.ones((5, 6))),
            r"frame_00003\.png is 6 x 5 pixels, but its",
        ),
        (
            lambda f: _mask(f, np.zeros((HEIGHT, WIDTH))),
            r"frame_00003\.png marks no object",
        ),
    ],
)
def test_what_a_scene_can_not_hold_is_refused(folder, tmp_path, spoil, message):
    spoil(folder)
    with pytest.raises(SceneError, match=message):
        _convert(folder, tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def test_focal_lengths_that_differ_by_less_than_shows_share_their_mean(folder, tmp_path):
    _focals([9.0] * 8 + [9.09])(folder)
    done = _convert(folder, tmp_path / "scene")
    assert done.lens.focal == pytest.approx(9.01)
    assert done.lens.stretch == pytest.approx(0.08 / 9.01 * 6.0)  # at the image's border
