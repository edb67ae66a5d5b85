"""The command that imports captures, as a user calls it, and what it refuses."""

import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.captures import capture as captures
from experiments.captures import export, nerfstudio, scenes, world
from refref_jax.data import SceneError, image_files, scene_folder
from tests.factories.png_files import write_sixteen_bits
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


def _convert(folder, out, sense="object", numbers=None, *, resample=False, width=None):
    """Writes one split, and returns its layout and what was written."""
    capture = nerfstudio.read_capture(folder)
    chosen = range(len(capture.frames)) if numbers is None else numbers
    frames = [capture.frames[number] for number in chosen]
    layout = scenes.find_layout(frames, width=width, resample=resample)
    poses = scenes.turned_poses(layout, np.stack([frame.pose for frame in frames]))
    content = scenes.Content({}, {}, {}, None)
    written = scenes.write_scene(
        {"train": layout}, {"train": poses}, out, content, sense, step=lambda: None
    )
    return layout, written["train"]


def test_the_command_both_ways(folder, tmp_path):
    options = ("--centre=axes", "--scale=cameras", "--test_every=4")
    to_scene = (f"--source={folder}", f"--out={tmp_path / 'scene'}", *options)
    result = run_command("import_capture", *to_scene)
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
    again = run_command("import_capture", *to_scene, fails=True)
    assert "nothing is overwritten" in again.stderr and "Traceback" not in again.stderr
    back = (f"--source={tmp_path / 'scene'}", f"--out={tmp_path / 'back'}", "--to=nerfstudio")
    result = run_command("import_capture", *back)
    assert "train on the object only" in result.stdout
    assert "ns-train nerfacto --data" in result.stdout
    capture = nerfstudio.read_capture(tmp_path / "back")
    assert {split: len(each) for split, each in capture.splits.items()} == {"train": 6, "test": 3}
    again = (f"--source={tmp_path / 'back'}", f"--out={tmp_path / 'again'}", "--centre=0,0,0")
    run_command("import_capture", *again, "--scale=1")
    for split in capture.splits:
        before, after = (scene_folder.read_frames(tmp_path / x, split) for x in ("scene", "again"))
        np.testing.assert_allclose(after.cameras.poses, before.cameras.poses, atol=1e-6)
        assert after.cameras.focal == pytest.approx(before.cameras.focal, rel=1e-12)
        for read in (scene_folder.read_images, scene_folder.read_masks):
            np.testing.assert_array_equal(read(after), read(before))
        for first, second in zip(before.images, after.images, strict=True):
            assert first.read_bytes() == second.read_bytes()


def test_the_original_world_is_that_of_before_the_applied_transform(folder):
    motion = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]  # what ns-process-data does
    edit(folder, lambda content: content.update(applied_transform=motion, applied_scale=2.0))
    capture = nerfstudio.read_capture(folder)
    kept = np.stack([frame.pose for frame in capture.frames])
    np.testing.assert_array_equal(kept[3], pose_of(3)[:3])
    found = world.undo_motion(kept, capture.applied, capture.applied_scale)
    turned = np.array(motion)[:, :3] @ found[3]
    turned[:, 3] *= 2.0
    np.testing.assert_allclose(turned, pose_of(3)[:3], atol=1e-12)


def _white_but_for(capture, *pixel):
    for path in (capture / "masks").iterdir():
        mask = np.ones((HEIGHT, WIDTH), bool)
        mask[pixel] = False
        image_files.write_mask(path, mask)


def test_masks_mean_what_they_are_said_to(folder, tmp_path):
    assert _convert(folder, tmp_path / "white")[1].masked == pytest.approx(1.0 / 120.0)
    frames = scene_folder.read_frames(tmp_path / "white", "train")
    assert np.argwhere(scene_folder.read_masks(frames)[0]).tolist() == [[4, 5]]
    _white_but_for(folder, 2, 3)
    _convert(folder, tmp_path / "black", "background")
    frames = scene_folder.read_frames(tmp_path / "black", "train")
    assert np.argwhere(scene_folder.read_masks(frames)[0]).tolist() == [[2, 3]]
    assert _convert(folder, tmp_path / "none", "none")[1].masked is None
    assert scene_folder.read_frames(tmp_path / "none", "train").masks is None
    shutil.rmtree(folder / "masks")
    edit(folder, lambda content: [record.pop("mask_path") for record in content["frames"]])
    assert _convert(folder, tmp_path / "scene")[1].masked is None
    assert scene_folder.read_frames(tmp_path / "scene", "train").masks is None


def test_what_masks_are_written_for_nerfstudio(tmp_path):
    scene = write_scene(tmp_path / "scene")
    splits = export.read_splits(scene)
    for sense, white in (("object", 1), ("background", 8 * 6 - 1)):
        export.write_capture(splits, tmp_path / sense, sense, step=lambda: None)
        mask = iio.imread(tmp_path / sense / "masks" / "train_0.png", plugin="pillow")
        assert mask.ndim == 2 and set(np.unique(mask)) == {0, 255}  # one channel, black and white
        assert (mask == 255).sum() == white
    export.write_capture(splits, tmp_path / "none", "none", step=lambda: None)
    assert not (tmp_path / "none" / "masks").exists()
    with pytest.raises(SceneError, match="nothing is overwritten"):
        export.write_capture(splits, tmp_path / "none", "none", step=lambda: None)


def test_images_are_cut_around_the_principal_point(folder, tmp_path):
    edit(folder, lambda content: content.update(cx=4.9, cy=6.0))
    crop = _convert(folder, tmp_path / "scene")[0].crop
    assert (crop.columns.size, crop.rows.size) == (10, 8)
    assert crop.columns.shift == pytest.approx(0.1) and crop.rows.shift == 0.0
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
    image_files.write_mask(folder / "masks" / "frame_00003.png", np.ones((14, WIDTH), bool))

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
            lambda folder: edit(folder, lambda c: c.update(k1=0.1)),
            r"frame_00000\.png has distortion, k1 = 0\.1",
        ),
    ],
)
def test_what_cropping_does_not_bring_into_one_camera_is_refused(folder, tmp_path, spoil, message):
    spoil(folder)
    with pytest.raises(SceneError, match=message):
        _convert(folder, tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def test_focal_lengths_that_differ_by_less_than_shows_share_their_mean(folder, tmp_path):
    _focals([9.0] * 8 + [9.09])(folder)
    crop = _convert(folder, tmp_path / "scene")[0].crop
    assert crop.focal == pytest.approx(9.01)
    assert crop.stretch == pytest.approx(0.08 / 9.01 * 6.0)  # at the image's border


def _import(folder, out, *options, fails=False):
    arguments = (f"--source={folder}", f"--out={out}", *options)
    done = run_command("import_capture", *arguments, fails=fails)
    assert "Traceback" not in done.stderr
    return done.stderr if fails else done.stdout


def _distort(content):
    content.update(k1=0.1, p1=1e-3)
    content["frames"][4].update(camera_model="OPENCV_FISHEYE", k2=0.01, k1=0.1, p1=0.0)
    del content["k1"], content["p1"]
    for record in content["frames"]:
        record.setdefault("k1", 0.1)


def test_lenses_of_each_frame_become_one_pinhole(folder, tmp_path):
    edit(folder, _distort)
    said = _import(folder, tmp_path / "scene", "--masks=none")
    assert "train: 7 images of" in said and "resampled" in said and "limits the field" in said
    frames = scene_folder.read_frames(tmp_path / "scene", "train")
    assert frames.cameras.focal == pytest.approx(FOCAL) and frames.masks is None
    before = pixels_of(1)[HEIGHT // 2 - 1 : HEIGHT // 2 + 1, WIDTH // 2 - 1 : WIDTH // 2 + 1]
    after = scene_folder.read_images(frames)[0]
    rows, columns = (size // 2 for size in after.shape[:2])
    middle = after[rows - 1 : rows + 1, columns - 1 : columns + 1]
    assert np.abs(middle.astype(int) - before).max() <= 1  # a lens moves nothing on its axis


def test_a_portrait_among_landscapes_is_turned(folder, tmp_path):
    upright = np.ascontiguousarray(np.rot90(pixels_of(3)))  # counter-clockwise
    image_files.write_png(folder / "images" / "frame_00003.png", upright)
    image_files.write_mask(folder / "masks" / "frame_00003.png", upright[..., 0] == 4)
    turn = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0, 0, 1, 0], [0, 0, 0, 1]])

    def change(content):
        lens = {key: content.pop(key) for key in ("w", "h", "cx", "cy")}
        for record in content["frames"]:
            record.update(lens)
        content["frames"][3].update(w=10, h=12, cx=5.0, cy=6.0)
        content["frames"][3]["transform_matrix"] = (pose_of(3) @ turn).tolist()

    edit(folder, change)
    options = ("--centre=0,0,0", "--scale=1", "--test_every=9")
    said = _import(folder, tmp_path / "scene", *options)
    assert "train: 1 images of the other format are turned by 90 degrees" in said
    assert "copied" in said
    frames = scene_folder.read_frames(tmp_path / "scene", "train")
    np.testing.assert_array_equal(scene_folder.read_images(frames)[2], pixels_of(3))
    np.testing.assert_array_equal(scene_folder.read_masks(frames)[2], pixels_of(3)[..., 0] == 4)
    np.testing.assert_allclose(frames.cameras.poses[2], pose_of(3)[:3], atol=1e-12)


def test_deep_and_linear_images_are_quantised_once(folder, tmp_path):
    light = np.linspace(0.0, 1.0, WIDTH * HEIGHT * 3, dtype=np.float32).reshape(HEIGHT, WIDTH, 3)
    image_files.write_exr(folder / "images" / "frame_00001.exr", light)
    deep = (257.0 * pixels_of(2)).astype(np.uint16) + 100
    write_sixteen_bits(folder / "images" / "frame_00002.png", deep)
    edit(folder, lambda c: c["frames"][1].update(file_path="images/frame_00001.exr"))
    said = _import(folder, tmp_path / "scene", "--test_every=9")
    assert "copied" in said
    images = scene_folder.read_images(scene_folder.read_frames(tmp_path / "scene", "train"))
    low, high = 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055
    encoded = 255.0 * np.where(light > 0.0031308, high, low)
    assert np.abs(images[0] - encoded).max() <= 0.5001
    assert np.abs(images[1] - deep / 257.0).max() <= 0.5001


def test_views_without_the_object_are_told(folder, tmp_path):
    _mask(folder, np.zeros((HEIGHT, WIDTH)))
    said = _import(folder, tmp_path / "scene", "--test_every=9")
    assert "train: 1 masks mark no object, such as that of images/frame_00003.png" in said
    assert "R3F leaves out these views" in said
    # Its camera looks at the object that the others have marked.
    assert "warning: 1 training views without a marked pixel look at the object" in said
    for path in (folder / "masks").iterdir():
        image_files.write_mask(path, np.zeros((HEIGHT, WIDTH), bool))
    said = _import(folder, tmp_path / "empty")
    assert "Object:" not in said and "train: 7 masks mark no object" in said


def test_masks_of_a_folder_may_be_incomplete(folder, tmp_path):
    edit(folder, lambda content: [record.pop("mask_path") for record in content["frames"]])
    (folder / "masks" / "frame_00005.png").unlink()
    (folder / "masks" / "frame_00004.png").rename(folder / "masks" / "frame_00004.png.png")
    said = _import(folder, tmp_path / "scene", f"--mask_folder={folder / 'masks'}")
    assert "Left out: 1 photographs without a mask, such as images/frame_00005.png." in said
    frames = scene_folder.read_frames(tmp_path / "scene", "train")
    assert len(frames.names) == 7 and scene_folder.read_masks(frames).any(axis=(1, 2)).all()
    (tmp_path / "none").mkdir()
    error = _import(folder, tmp_path / "x", f"--mask_folder={tmp_path / 'none'}", fails=True)
    assert "has no mask of images/frame_00000.png" in error


@pytest.mark.parametrize(
    ("option", "message"),
    [("--scale=1e300", "beyond 1e"), ("--scale=1e-300", "All cameras are at one place")],
)
def test_a_world_that_no_scene_can_hold_is_refused(folder, tmp_path, option, message):
    assert message in _import(folder, tmp_path / "scene", option, "--centre=0,0,0", fails=True)
    assert not (tmp_path / "scene").exists()


def test_a_smaller_width(folder, tmp_path):
    layout, _ = _convert(folder, tmp_path / "scene", resample=True, width=6)
    assert layout.pinhole == pytest.approx((6, 5, FOCAL / 2), rel=1e-6)
    frames = scene_folder.read_frames(tmp_path / "scene", "train")
    assert scene_folder.read_masks(frames).sum() == 0  # a quarter of a pixel is marked
    image = scene_folder.read_images(frames)[2]
    np.testing.assert_allclose(
        image[1:-1, :, 0], 2 * np.arange(1, 4)[:, None].repeat(6, 1) + 0.5, atol=0.51
    )


def _folds(content):
    content.update(k1=-0.9)


@pytest.mark.parametrize(
    ("options", "change", "message"),
    [
        ((), _folds, "images/frame_00001.png folds at most"),
        ((), lambda c: c.update(k1=0.1, cx=1e9), "is (1e+09, 5), outside of its 12 x 10 pixels"),
        ((), lambda c: c.update(ply_file_path="gone.ply"), "gone.ply does not exist, but"),
        ((), lambda c: c.update(fl_x=1e-9, fl_y=1e-9), "The focal length is 1e-09 pixels for imag"),
        (("--width=20000",), None, "Images of 20000 x 16666 pixels are too large"),
        (("--centre=meshes",), None, "there are no meshes. Give their folder: --meshes."),
        (("--centre=masks", "--masks=none"), None, "the capture has no masks. Give --mask_folder."),
        (("--scale=object", "--masks=none"), None, "neither meshes nor masks show it"),
        (("--images=.",), None, "--images is for a model of COLMAP"),
        (("--mask_folder=nowhere",), None, "nowhere is not a folder. Give the folder of the masks"),
        (("--meshes=.",), None, "has no PLY files"),
        (
            (),
            lambda c: c.update(ply_file_path="transforms.json"),
            "cannot be read as a PLY of poin",
        ),
    ],
)
def test_what_cannot_be_imported_leaves_nothing(folder, tmp_path, options, change, message):
    if change is not None:
        edit(folder, change)
    assert message in _import(folder, tmp_path / "scene", *options, fails=True)
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def test_points_of_a_capture_move_with_it(folder, tmp_path):
    cloud = captures.PointCloud(
        np.eye(3), np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    )
    captures.write_points(folder / "sparse.ply", cloud)
    edit(folder, lambda content: content.update(ply_file_path="sparse.ply"))
    _import(folder, tmp_path / "scene", "--centre=1,0,0", "--scale=2")
    moved = captures.read_points(tmp_path / "scene" / "points.ply")
    np.testing.assert_allclose(moved.positions, [[0, 0, 0], [-2, 2, 0], [-2, 0, 2]], atol=1e-6)
    np.testing.assert_array_equal(moved.colours, cloud.colours)
