import numpy as np
import pytest

from refref_jax.data import image_files, scene_folder
from refref_jax.geometry.cameras import image_rays, planar_depth_to_distance
from tests.factories.cut_ball import cut_ball
from tests.factories.small_scenes import (
    HEIGHT,
    WIDTH,
    edit_transforms,
    truncate,
    write_grey,
    write_scene,
)
from tests.laws.expectations import scene_error

# The bundled ball, and the sphere on which its cameras stand.
_BALL_RADIUS, _CAMERA_DISTANCE = 1.4, 4.0

# The rendered ball has 20480 flat triangles, which lie up to 3e-4 below the sphere.
_FACETS = 1e-2

# Where a ray meets the ball at less than this cosine, the facets move the hit by more.
_GRAZING = 0.1

# Half a level of the 8-bit depth, and single precision.
_HALF_LEVEL = 0.5 * 10.5 / 255.0 + 1e-5

_JSON = "transforms_train.json"


def _first_frame(**changes):
    """An edit of the first frame's record; `None` removes a key."""

    def edit(transforms):
        record = transforms["frames"][0]
        for key, value in changes.items():
            if value is None:
                del record[key]
            else:
                record[key] = value

    return edit


def _pose(matrix):
    return _first_frame(transform_matrix=np.asarray(matrix, np.float64).tolist())


def _changed_pose(row, column, value):
    pose = np.eye(4)
    pose[row, column] = value
    return _pose(pose)


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "cube_smcvx_toy")


@pytest.fixture
def rendered(ball_scene):
    return scene_folder.read_frames(ball_scene, "test")


@pytest.mark.parametrize(("split", "count"), [("train", 60), ("val", 10), ("test", 20)])
def test_bundled_splits(ball_scene, split, count):
    frames = scene_folder.read_frames(ball_scene, split)
    cameras = frames.cameras
    assert len(frames.names) == len(set(frames.names)) == len(cameras.poses) == count
    assert len(frames.images) == len(frames.masks) == len(frames.depths) == count
    assert (cameras.width, cameras.height) == (128, 128)
    distance = np.linalg.norm(cameras.poses[..., 3], axis=1)
    np.testing.assert_allclose(distance, _CAMERA_DISTANCE, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.det(cameras.poses[..., :3]), 1.0, rtol=1e-6)


def test_float_depth_is_preferred(rendered):
    assert {path.suffix for path in rendered.depths} == {".exr"}


def test_float_distances_agree_with_the_eight_bit_ones(rendered):
    coarse = rendered._replace(depths=tuple(p.with_suffix(".png") for p in rendered.depths))
    secant = planar_depth_to_distance(rendered.cameras, np.ones((128, 128)))
    exact = scene_folder.read_distances(rendered) / secant
    rounded = scene_folder.read_distances(coarse) / secant
    assert np.max(exact) > 11.5 > np.min(exact) > 1.0
    np.testing.assert_allclose(np.minimum(exact, 11.5), rounded, rtol=0.0, atol=_HALF_LEVEL)


def test_distances_of_the_ball_are_those_of_a_sphere(rendered):
    masks = scene_folder.read_masks(rendered)
    distances = scene_folder.read_distances(rendered)
    assert np.min(distances[masks]) >= _CAMERA_DISTANCE - _BALL_RADIUS - 1e-3
    assert np.max(distances[masks]) <= _CAMERA_DISTANCE
    for camera in range(20):
        rays = image_rays(rendered.cameras, camera)
        along = -np.sum(rays.origins.astype(np.float64) * rays.directions, axis=-1)
        missed_by = np.sum(rays.origins.astype(np.float64) ** 2, axis=-1) - along**2
        half_chord = np.sqrt(np.maximum(_BALL_RADIUS**2 - missed_by, 0.0))
        np.testing.assert_array_equal(half_chord > 0.0, masks[camera])
        head_on = half_chord > _GRAZING * _BALL_RADIUS
        np.testing.assert_allclose(
            distances[camera][head_on], (along - half_chord)[head_on], atol=_FACETS
        )
        assert np.all(distances[camera][~masks[camera]] > _CAMERA_DISTANCE)


def test_small_scene_is_read_as_written(scene):
    frames = scene_folder.read_frames(scene, "train")
    assert frames.names == ("r_000", "r_001")
    assert (frames.cameras.width, frames.cameras.height) == (WIDTH, HEIGHT)
    assert frames.cameras.focal == pytest.approx(4.0 / np.tan(0.5))
    assert frames.cameras.poses.shape == (2, 3, 4)
    np.testing.assert_array_equal(frames.cameras.poses[1, :, 3], [1.0, 10.0, 20.0])
    images, masks = scene_folder.read_images(frames), scene_folder.read_masks(frames)
    np.testing.assert_array_equal(images[:, 0, 0], [[1] * 3, [2] * 3])
    np.testing.assert_array_equal(np.argwhere(masks), [[0, 1, 2], [1, 1, 3]])


def test_eight_bit_depth_becomes_distance(scene):
    frames = scene_folder.read_frames(scene, "train")
    distances = scene_folder.read_distances(frames)
    x, y = 3.5 / frames.cameras.focal, 2.5 / frames.cameras.focal
    corner = np.sqrt(1.0 + x * x + y * y)
    np.testing.assert_allclose(distances[:, 0, 0], [11.5 * corner, 9.4 * corner], rtol=1e-6)


def test_a_float_depth_beside_the_named_one_is_read(scene):
    depth = np.full((HEIGHT, WIDTH), 3.0)
    depth[0, 0] = 1e10
    image_files.write_exr(scene / "depth" / "train" / "r_001.exr", depth)
    frames = scene_folder.read_frames(scene, "train")
    assert [path.suffix for path in frames.depths] == [".png", ".exr"]
    distances = scene_folder.read_distances(frames)
    assert distances[1, 0, 0] == np.inf
    assert np.all(np.isfinite(distances[0]))


def test_masks_and_depths_are_optional(scene):
    def strip(transforms):
        for record in transforms["frames"]:
            del record["mask_file_path"], record["depth_file_path"]

    edit_transforms(scene, strip)
    frames = scene_folder.read_frames(scene, "train")
    assert frames.masks is None
    assert frames.depths is None
    assert len(scene_folder.read_images(frames)) == 2
    with scene_error("train", "no masks", "Add mask_file_path"):
        scene_folder.read_masks(frames)
    with scene_error("train", "no depth maps", "Add depth_file_path"):
        scene_folder.read_distances(frames)


@pytest.mark.parametrize("angle", [1, 0.01, 3.14])
def test_field_of_view_may_be_any_number_below_pi(scene, angle):
    edit_transforms(scene, lambda transforms: transforms.update(camera_angle_x=angle))
    focal = scene_folder.read_frames(scene, "train").cameras.focal
    assert focal == pytest.approx(4.0 / np.tan(0.5 * angle))


def test_a_pose_may_be_rounded_to_six_digits(scene):
    cosine, sine = round(np.cos(1.0), 6), round(np.sin(1.0), 6)
    pose = np.eye(4)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    edit_transforms(scene, _pose(pose))
    np.testing.assert_array_equal(
        scene_folder.read_frames(scene, "train").cameras.poses[0], pose[:3]
    )


# Broken scenes.


def test_missing_transforms_file(scene):
    with scene_error("transforms_val.json", "does not exist", "Give the folder of a scene"):
        scene_folder.read_frames(scene, "val")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "not valid JSON"),
        (b'{"frames": [', "not valid JSON"),
        (b"\xff\xfe\x00", "not valid JSON"),
        (b"[1, 2]", "not a JSON object"),
    ],
)
def test_transforms_file_that_is_no_json_object(scene, content, problem):
    (scene / _JSON).write_bytes(content)
    with scene_error(_JSON, problem, "Copy it again"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("frames", [[], {}, 7, None])
def test_no_frames(scene, frames):
    edit_transforms(scene, lambda transforms: transforms.update(frames=frames))
    with scene_error(_JSON, "lists no frames", "Add frames"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("key", ["frames", "camera_angle_x"])
def test_missing_key(scene, key):
    edit_transforms(scene, lambda transforms: transforms.pop(key))
    with scene_error(_JSON, repr(key), "Add it"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize(
    "key", ["file_path", "transform_matrix", "mask_file_path", "depth_file_path"]
)
def test_a_frame_that_lacks_what_others_have(scene, key):
    edit_transforms(scene, _first_frame(**{key: None}))
    with scene_error(_JSON, repr(key), "Add it"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("key", ["mask_file_path", "depth_file_path"])
def test_the_frame_that_lacks_a_file_is_named(scene, key):
    edit_transforms(scene, _first_frame(**{key: None}))
    with scene_error("The frame ./train/r_000 of", "1 of 2 frames"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("record", ["./train/r_000", None, []])
def test_a_frame_that_is_no_object(scene, record):
    edit_transforms(scene, lambda transforms: transforms["frames"].append(record))
    with scene_error(_JSON):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("key", ["file_path", "mask_file_path", "depth_file_path"])
@pytest.mark.parametrize("value", [7, ["r_000.png"], None])
def test_a_file_name_that_is_no_text(scene, key, value):
    edit_transforms(scene, lambda transforms: transforms["frames"][0].update({key: value}))
    with scene_error(str(scene)):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("angle", [0.0, -1.0, np.pi, 40.0, np.nan, np.inf, "1.0", None, [1.0]])
def test_bad_field_of_view(scene, angle):
    edit_transforms(scene, lambda transforms: transforms.update(camera_angle_x=angle))
    with scene_error(_JSON, "camera_angle_x", "radians"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize(
    "name",
    ["train/r_000.png", "train/r_001.png", "mask/train/r_001.png", "depth/train/r_000.png"],
)
def test_missing_file(scene, name):
    (scene / name).unlink()
    with scene_error(name, "does not exist", "opy"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("shape", [(WIDTH, HEIGHT), (1, WIDTH), (HEIGHT, 1), (12, 16)])
@pytest.mark.parametrize(
    ("folder", "read"),
    [
        ("train", scene_folder.read_images),
        ("mask/train", scene_folder.read_masks),
        ("depth/train", scene_folder.read_distances),
    ],
)
def test_wrong_size(scene, shape, folder, read):
    write_grey(scene / folder / "r_001.png", np.ones(shape))
    frames = scene_folder.read_frames(scene, "train")
    height, width = shape
    with scene_error(f"{folder}/r_001.png", f"{width} x {height}", "8 x 6", "Render it again"):
        read(frames)


def test_wrong_size_of_float_depth(scene):
    image_files.write_exr(scene / "depth/train/r_001.exr", np.ones((WIDTH, HEIGHT)))
    with scene_error("r_001.exr", "6 x 8", "8 x 6"):
        scene_folder.read_distances(scene_folder.read_frames(scene, "train"))


@pytest.mark.parametrize(
    "edit",
    [
        _pose(np.diag([2.0, 2.0, 2.0, 1.0])),
        _pose(np.diag([1.0, 1.0, 1.01, 1.0])),
        _changed_pose(0, 1, 0.01),
        _pose(np.diag([-1.0, 1.0, 1.0, 1.0])),
        _pose(np.diag([0.0, 0.0, 0.0, 1.0])),
    ],
    ids=["scaled", "slightly-scaled", "sheared", "mirrored", "collapsed"],
)
def test_a_pose_that_is_no_rotation(scene, edit):
    edit_transforms(scene, edit)
    with scene_error(_JSON, "transform_matrix", "Export the poses"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize(
    "edit",
    [
        _changed_pose(1, 1, np.nan),
        _changed_pose(2, 3, np.inf),
        _pose(np.eye(3)),
        _pose(np.eye(4)[:3]),
        _pose(np.zeros((0, 4))),
        _first_frame(transform_matrix=[[1.0, 0.0], [0.0]]),
        _first_frame(transform_matrix="identity"),
        _first_frame(transform_matrix=7),
    ],
    ids=["nan", "inf", "3x3", "3x4", "empty", "ragged", "text", "number"],
)
def test_a_pose_that_is_no_finite_matrix(scene, edit):
    edit_transforms(scene, edit)
    with scene_error(_JSON, "4 x 4", "Export the poses again"):
        scene_folder.read_frames(scene, "train")


def test_a_transposed_pose_is_no_rigid_motion(scene):
    pose = np.eye(4)
    pose[3, :3] = [1.0, 2.0, 3.0]
    edit_transforms(scene, _pose(pose))
    with scene_error(_JSON, "transform_matrix"):
        scene_folder.read_frames(scene, "train")


def test_a_view_without_the_object_is_a_view(scene):
    write_grey(scene / "mask/train/r_001.png", np.zeros((HEIGHT, WIDTH)))
    scene_folder.check_scene(scene)
    frames = scene_folder.read_frames(scene, "train")
    assert scene_folder.read_masks(frames).any(axis=(1, 2)).tolist() == [True, False]
    kept, masks = scene_folder.read_object_views(frames)
    assert kept.names == ("r_000",) and len(masks) == len(kept.cameras.poses) == 1
    for before, after in zip(frames[1:4], kept[1:4], strict=True):
        assert after == before[:1]
    np.testing.assert_array_equal(kept.cameras.poses[0], frames.cameras.poses[0])


def test_masks_none_of_which_marks_the_object(scene):
    for name in ("r_000", "r_001"):
        write_grey(scene / f"mask/train/{name}.png", np.zeros((HEIGHT, WIDTH)))
    with scene_error("mask/train", "None of the 2 masks", "docs/masks.md"):
        scene_folder.read_object_views(scene_folder.read_frames(scene, "train"))


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("train/r_001.png", scene_folder.read_images),
        ("mask/train/r_000.png", scene_folder.read_masks),
        ("depth/train/r_001.png", scene_folder.read_distances),
    ],
)
def test_truncated_image(scene, name, read):
    truncate(scene / name)
    with scene_error(name, "truncated"):
        read(scene_folder.read_frames(scene, "train"))


def test_truncated_first_image(scene):
    truncate(scene / "train/r_000.png")
    with scene_error("train/r_000.png", "truncated"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("other", ["train", "more"])
def test_two_frames_of_one_name(scene, other):
    (scene / other).mkdir(exist_ok=True)
    (scene / other / "r_000.png").write_bytes((scene / "train/r_000.png").read_bytes())

    def repeat(transforms):
        transforms["frames"][1]["file_path"] = f"./{other}/r_000"

    edit_transforms(scene, repeat)
    with scene_error("r_000", "Give every frame a unique name"):
        scene_folder.read_frames(scene, "train")


@pytest.mark.parametrize("split", scene_folder.SPLITS)
@pytest.mark.parametrize("kind", ["", "mask", "depth"])
def test_checking_a_scene_finds_a_broken_file_in_any_split(tmp_path, split, kind):
    scene = cut_ball(tmp_path / "scene")
    scene_folder.check_scene(scene)
    broken = sorted((scene / kind / split).glob("*.png"))[-1]
    broken.write_bytes(broken.read_bytes()[:-30])
    broken.with_suffix(".exr").unlink(missing_ok=True)
    with scene_error(broken.name, "again"):
        scene_folder.check_scene(scene)


def test_checking_a_scene_does_without_val_and_test(tmp_path):
    scene = cut_ball(tmp_path / "scene")
    for split in ("val", "test"):
        (scene / f"transforms_{split}.json").unlink()
    scene_folder.check_scene(scene)
    with scene_error("transforms_test.json"):
        scene_folder.check_scene(scene, needed=("test",))
