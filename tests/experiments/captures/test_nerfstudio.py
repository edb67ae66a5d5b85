import json
import math

import numpy as np
import pytest

from experiments.captures import capture as captures
from experiments.captures import nerfstudio
from refref_jax.data import SceneError
from refref_jax.geometry.cameras import Cameras
from tests.factories.small_captures import FOCAL, HEIGHT, LENS, WIDTH, edit, pose_of, write_capture


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "capture")


def test_a_capture_is_read_as_it_was_written(capture):
    read = nerfstudio.read_capture(capture)
    assert [frame.name for frame in read.frames] == [f"images/frame_{i:05d}.png" for i in range(9)]
    assert read.frames[3].intrinsics == (FOCAL, FOCAL, 6.0, 5.0, WIDTH, HEIGHT)
    np.testing.assert_array_equal(read.frames[3].pose, pose_of(3)[:3])
    assert read.frames[3].mask.name == "frame_00003.png"
    assert read.splits is None and not read.has_depth and read.applied_scale == 1.0
    np.testing.assert_array_equal(read.applied, np.eye(4)[:3])
    by_file = nerfstudio.read_capture(capture / "transforms.json")
    assert [frame.image for frame in by_file.frames] == [frame.image for frame in read.frames]


def test_frames_are_ordered_by_name(capture):
    edit(capture, lambda content: content["frames"].reverse())
    assert nerfstudio.read_capture(capture).frames[0].name == "images/frame_00000.png"


def _lens_of_each_frame(content):
    for number, record in enumerate(content["frames"]):
        record |= {key: content[key] for key in LENS} | {"fl_x": 9.0 + number}
    for key in LENS:
        del content[key]


def test_intrinsics_of_each_frame(capture):
    read = nerfstudio.read_capture(edit(capture, _lens_of_each_frame))
    assert [frame.intrinsics.focal_x for frame in read.frames] == [9.0 + i for i in range(9)]
    assert {frame.intrinsics.focal_y for frame in read.frames} == {9.0}


def _only_an_angle(content):
    for key in LENS:
        del content[key]
    content["camera_angle_x"] = math.pi / 2


def test_an_angle_of_view_stands_for_all_else(capture):
    read = nerfstudio.read_capture(edit(capture, _only_an_angle))
    expected = (6.0, 6.0, 6.0, 5.0, WIDTH, HEIGHT)  # 45 degrees to each side: half the width
    assert read.frames[0].intrinsics == pytest.approx(expected)


def test_a_name_without_an_ending_is_a_png(capture):
    edit(capture, lambda content: content["frames"][0].update(file_path="./images/frame_00000"))
    assert nerfstudio.read_capture(capture).frames[0].image.name == "frame_00000.png"


def _distorted(key, value, frame=None):
    def change(content):
        (content if frame is None else content["frames"][frame])[key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_distorted("camera_model", "EQUIRECTANGULAR", 2), "frame_00002.*is 'EQUIRECTANGULAR', wh"),
        (_distorted("camera_model", ["OPENCV"]), r"is \['OPENCV'\], which is not read"),
        (_distorted("k4", 0.1, 4), r"frame_00004\.png .* is OPENCV with k4 = 0\.1, which OPENCV"),
        (_distorted("k1", "0.1"), r"k1 is '0\.1' in .*Give a finite number"),
        (_distorted("fl_x", -3.0), "focal length is -3 for frame_00000"),
        (_distorted("fl_x", "9"), "fl_x is '9' in"),
        (_distorted("cx", math.inf), "cx is inf in .*Give a finite number"),
        (_distorted("w", 24), r"is 12 x 10 pixels, but .* says 24 x 10"),
        (_distorted("fl_x", 8.0, 1), r"fl_x is 9.0 for all frames of .* and 8.0 in one"),
        (_distorted("mask_path", "masks/none.png", 1), "none.png does not exist"),
        (_distorted("file_path", 3, 1), "file_path is 3"),
        (_distorted("transform_matrix", [[1.0]], 1), "frame_00001.*not a finite 4 x 4 matrix"),
        (_distorted("frames", []), "lists no frames"),
        (_distorted("train_filenames", ["images/x.png"]), "lists 'images/x.png', which is no"),
        (_distorted("val_filenames", ["images/frame_00001.png"]), "lists no train_filenames"),
        (_distorted("applied_transform", [[2, 0, 0, 0]]), "applied_transform .* 4 x 4 matrix"),
        (_distorted("applied_scale", -1.0), "applied_scale is -1"),
        (_distorted("train_filenames", 5), "train_filenames is 5 in .*Give a list of names"),
        (_distorted("file_path", "./images/frame_00001.png", 2), "lists .*frame_00001.png twice"),
        (lambda content: content.pop("fl_x") + content.pop("fl_y"), "lacks the focal length"),
    ],
)
def test_what_can_not_be_used_is_named(capture, change, message):
    edit(capture, change)
    with pytest.raises(SceneError, match=message):
        nerfstudio.read_capture(capture)


def test_missing_photographs_are_left_out_unless_half_of_them_are(capture):
    lists = {
        "train_filenames": [f"images/frame_0000{number}.png" for number in range(7)],
        "test_filenames": ["images/frame_00007.png", "images/frame_00008.png"],
    }
    edit(capture, lambda content: content.update(lists))
    for number in (1, 5, 8):
        (capture / "images" / f"frame_0000{number}.png").unlink()
    read = nerfstudio.read_capture(capture)
    assert read.missing == tuple(f"images/frame_0000{number}.png" for number in (1, 5, 8))
    assert [frame.name[-5] for frame in read.frames] == list("023467")
    assert read.splits == {"train": (0, 1, 2, 3, 4), "test": (5,)}
    for number in (2, 3):
        (capture / "images" / f"frame_0000{number}.png").unlink()
    with pytest.raises(SceneError, match=r"frame_00001\.png does not exist.* 5 of its 9 phot"):
        nerfstudio.read_capture(capture)


def test_a_missing_file_and_a_scene_of_ours(tmp_path):
    with pytest.raises(SceneError, match=r"Give the folder that holds transforms\.json"):
        nerfstudio.read_capture(tmp_path)
    (tmp_path / "transforms_train.json").write_text("{}")
    with pytest.raises(SceneError, match="no conversion is needed"):
        nerfstudio.read_capture(tmp_path)


def test_a_broken_image_is_named(capture):
    (capture / "images" / "frame_00002.png").write_bytes(b"no image")
    with pytest.raises(SceneError, match=r"frame_00002\.png cannot be read as an image"):
        nerfstudio.read_capture(capture)


def _listed(train, val, test):
    def change(content):
        for split, numbers in {"train": train, "val": val, "test": test}.items():
            content[f"{split}_filenames"] = [f"./images/frame_{i:05d}.png" for i in numbers]

    return change


def test_frames_without_a_mask_are_left_out(capture):
    whole = nerfstudio.read_capture(edit(capture, _listed([5, 1, 2], [3], [4, 7])))
    assert captures.masked_frames(whole) == (whole, ())

    def change(content):
        for number in (2, 3):
            content["frames"][number].pop("mask_path")

    kept, lacking = captures.masked_frames(nerfstudio.read_capture(edit(capture, change)))
    assert lacking == ("images/frame_00002.png", "images/frame_00003.png")
    assert kept.splits == {"train": (1, 3), "test": (2, 5)}  # numbers of the frames that are left
    names = [kept.frames[number].name for number in kept.splits["train"] + kept.splits["test"]]
    assert names == [f"images/frame_0000{number}.png" for number in (1, 5, 4, 7)]


def test_masks_of_test_frames_alone_are_refused(capture):
    def change(content):
        _listed([0, 1], [], [2])(content)
        for number in (0, 1):
            content["frames"][number].pop("mask_path")

    read = nerfstudio.read_capture(edit(capture, change))
    with pytest.raises(SceneError, match=r"training image has a mask.*frame_00000.*--masks=none"):
        captures.masked_frames(read)


def test_lists_of_files_are_the_splits(capture):
    read = nerfstudio.read_capture(edit(capture, _listed([5, 1, 2], [3], [4, 7])))
    assert read.splits == {"train": (1, 2, 5), "val": (3,), "test": (4, 7)}
    assert list(read.splits) == ["train", "val", "test"]


def test_a_list_that_repeats_another_is_no_split_of_its_own(capture):
    read = nerfstudio.read_capture(edit(capture, _listed([1, 2], [4, 7], [4, 7])))
    assert read.splits == {"train": (1, 2), "test": (4, 7)}


def _cameras(width, focal):
    return Cameras(np.stack([pose_of(1)[:3], pose_of(2)[:3]]), width, HEIGHT, focal)


@pytest.mark.parametrize("other", [FOCAL, 11.0])
def test_what_is_written_is_read_again(capture, other):
    names = {
        "train": ["images/frame_00001.png", "images/frame_00002.png"],
        "test": ["images/frame_00003.png", "images/frame_00004.png"],
    }
    cameras = {"train": _cameras(WIDTH, FOCAL), "test": _cameras(WIDTH, other)}
    nerfstudio.write_capture(capture, cameras, names, {})
    content = json.loads((capture / "transforms.json").read_text())
    assert ("fl_x" in content) == (other == FOCAL)  # nerfstudio wants it here, or in every frame
    assert all(("fl_x" in record) == (other != FOCAL) for record in content["frames"])
    assert content["val_filenames"] == names["test"]  # it asks for all three lists
    read = nerfstudio.read_capture(capture)
    assert read.splits == {"train": (0, 1), "test": (2, 3)}
    np.testing.assert_array_equal(read.frames[1].pose, pose_of(2)[:3])
    assert read.frames[3].intrinsics == (other, other, 6.0, 5.0, WIDTH, HEIGHT)
    assert all(frame.mask is None for frame in read.frames)
