"""COLMAP's models: what is read of both forms, and what is refused."""

import shutil

import numpy as np
import pytest

from experiments.captures import colmap
from experiments.captures.lenses import Distortion, Intrinsics
from refref_jax.data import SceneError, image_files
from refref_jax.geometry.cameras import orbit
from tests.factories.colmap_models import Camera, Image, write_binary, write_text

_SIMPLE = Camera("SIMPLE_RADIAL", 12, 10, (9.0, 6.25, 5.5, 0.1))
_OPENCV = Camera("OPENCV", 10, 12, (9.0, 9.5, 5.0, 6.0, -0.1, 0.02, 1e-3, -2e-3))
_NAMES = ("b 2.png", "a.png", "below/c.png")
_POINTS = [((0.5, -1.25, 1e-3), (255, 0, 7)), ((3.0, 2.0, 1.0), (1, 2, 3))]
_WRITERS = {"text": write_text, "binary": write_binary}


def _images(poses):
    return [
        Image(pose, 3 + (i == 2), name)
        for i, (pose, name) in enumerate(zip(poses, _NAMES, strict=True))
    ]


@pytest.fixture(scope="module")
def poses():
    turned = orbit(3, distance=4.0, elevation=0.3, size=8, angle_x=1.0).poses
    turned[1, :, :3] = np.diag([1.0, -1.0, -1.0])  # half a turn: w = 0
    return turned


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "images"
    for number, name in enumerate(_NAMES):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        size = (12, 10, 3) if number == 2 else (10, 12, 3)
        image_files.write_png(folder / name, np.full(size, 50 * number, np.uint8))
    return folder


def _write(folder, form, poses, *, cameras=None, images=None):
    cameras = {3: _SIMPLE, 4: _OPENCV} if cameras is None else cameras
    return _WRITERS[form](folder, cameras, images or _images(poses), _POINTS)


@pytest.mark.parametrize("form", _WRITERS)
def test_cameras_poses_and_points_are_those_written(tmp_path, photos, poses, form):
    model = _write(tmp_path / "sparse", form, poses)
    read = colmap.read_capture(model, photos)
    assert [frame.name for frame in read.frames] == ["a.png", "b 2.png", "below/c.png"]
    assert read.frames[0].lens == (
        Intrinsics(9.0, 9.0, 6.25, 5.5, 12, 10),
        Distortion(False, (0.1, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0)),
    )
    assert read.frames[2].distortion.tangential == (1e-3, -2e-3)
    assert read.frames[2].intrinsics == (9.0, 9.5, 5.0, 6.0, 10, 12)
    for frame, number in zip(read.frames, (1, 0, 2), strict=True):
        np.testing.assert_allclose(frame.pose, poses[number], atol=1e-14)
    np.testing.assert_array_equal(read.points.positions, [place for place, _ in _POINTS])
    np.testing.assert_array_equal(read.points.colours, [colour for _, colour in _POINTS])
    assert read.splits is None and not read.has_depth


def test_text_and_binary_are_equal_bit_for_bit(tmp_path, photos, poses):
    text, binary = (
        colmap.read_capture(_write(tmp_path / form, form, poses), photos) for form in _WRITERS
    )
    for first, second in zip(text.frames, binary.frames, strict=True):
        assert (first.name, first.lens, first.image) == (second.name, second.lens, second.image)
        np.testing.assert_array_equal(first.pose, second.pose)
    np.testing.assert_array_equal(text.points.positions, binary.points.positions)


def test_a_point_is_seen_where_colmap_projects_it(tmp_path, photos, poses):
    frame = colmap.read_capture(_write(tmp_path / "m", "text", poses), photos).frames[0]
    words = next(
        line for line in (tmp_path / "m" / "images.txt").read_text().splitlines() if "a.png" in line
    ).split()
    w, x, y, z, *shift = map(float, words[1:8])
    point, axis = np.array([0.3, -0.4, 0.2]), np.array([x, y, z])
    # Rotation by a quaternion, Rodrigues: v + 2 w (a x v) + 2 a x (a x v).
    across = np.cross(axis, point)
    theirs = point + 2.0 * w * across + 2.0 * np.cross(axis, across) + shift
    ours = frame.pose[:, :3].T @ (point - frame.pose[:, 3])
    np.testing.assert_allclose(ours, theirs * [1.0, -1.0, -1.0], atol=1e-13)


@pytest.mark.parametrize("place", [".", "sparse/0", "sparse", "colmap/sparse/0", "0"])
def test_where_a_model_is_found(tmp_path, poses, place):
    _write(tmp_path / place, "binary", poses)
    assert colmap.find_model(tmp_path) == tmp_path / place
    assert colmap.find_model(tmp_path / "nowhere") is None


def test_models_that_could_not_be_joined_are_found(tmp_path, poses):
    for name in ("0", "1", "2"):
        _write(tmp_path / "sparse" / name, "text", poses)
    (tmp_path / "sparse" / "3").mkdir()
    sparse = tmp_path / "sparse"
    assert colmap.other_models(sparse / "0") == [sparse / "1", sparse / "2"]
    assert colmap.other_models(sparse / "2") == [sparse / "0", sparse / "1"]
    _write(tmp_path / "alone", "text", poses)
    assert colmap.other_models(tmp_path / "alone") == []


@pytest.mark.parametrize("form", _WRITERS)
@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (Camera("FOV", 12, 10, (9.0, 9.0, 6.0, 5.0, 0.1)), r"cameras\.\w+ has .* model FOV, which"),
        (Camera("THIN_PRISM_FISHEYE", 12, 10, (9.0,) * 12), "THIN_PRISM_FISHEYE, .*undistorter"),
        (Camera("SIMPLE_PINHOLE", 12, 10, (-9.0, 6.0, 5.0)), "f = -9.*export the model again"),
        (Camera("SIMPLE_PINHOLE", 12, 10, (9.0, np.nan, 5.0)), "cx = nan"),
        (Camera("SIMPLE_PINHOLE", 24, 20, (9.0, 6.0, 5.0)), r"a\.png is 12 x 10 pixels, but .* 24"),
    ],
)
def test_cameras_that_are_not_read(tmp_path, photos, poses, form, camera, message):
    model = _write(tmp_path / "m", form, poses, cameras={3: camera, 4: _OPENCV})
    with pytest.raises(SceneError, match=message):
        colmap.read_capture(model, photos)


@pytest.mark.parametrize("form", _WRITERS)
@pytest.mark.parametrize(
    ("image", "message"),
    [
        ({"camera": 7}, r"a\.png has the camera 7, which the file of cameras lacks"),
        ({"name": "../a.png"}, r"the name of an image is '\.\./a\.png', which is outside"),
        ({"pose": np.full((3, 4), np.nan)}, "no unit quaternion"),
        ({"pose": np.eye(3, 4, 0) + 1e7 * np.eye(3, 4, 3)}, "Coordinates are at most 1e"),
    ],
)
def test_images_that_are_not_read(tmp_path, photos, poses, form, image, message, monkeypatch):
    images = _images(poses)
    images[1] = images[1]._replace(**image)
    if np.any(np.isnan(images[1].pose)):
        monkeypatch.setattr(
            "tests.factories.colmap_models.to_colmap", lambda pose: ((0.9, 0, 0, 0), pose[:, 3])
        )
        images[1] = images[1]._replace(pose=poses[0])
    with pytest.raises(SceneError, match=message):
        colmap.read_capture(_write(tmp_path / "m", form, poses, images=images), photos)


@pytest.mark.parametrize("form", _WRITERS)
def test_missing_photographs_are_left_out_unless_half_of_them_are(tmp_path, photos, poses, form):
    model = _write(tmp_path / "m", form, poses)
    names = [frame.name for frame in colmap.read_capture(model, photos).frames]
    (photos / names[0]).unlink()
    read = colmap.read_capture(model, photos)
    assert read.missing == (names[0],) and [frame.name for frame in read.frames] == names[1:]
    (photos / names[1]).unlink()
    with pytest.raises(SceneError, match=r"does not exist.* 2 of its 3 photographs.*--images"):
        colmap.read_capture(model, photos)


def test_binary_files_that_end_early(tmp_path, photos, poses):
    whole = _write(tmp_path / "whole", "binary", poses)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        content = (whole / name).read_bytes()
        for kept in {0, 5, 20, len(content) // 2, len(content) - 1}:
            model = shutil.copytree(whole, tmp_path / "cut", dirs_exist_ok=True)
            (model / name).write_bytes(content[:kept])
            with pytest.raises(SceneError, match=rf"{name} (ends after|has a name)"):
                colmap.read_capture(model, photos)


def _lines(change):
    def edit(path):
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return edit


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("cameras.txt", _lines(lambda x: [*x, "5 PINHOLE 12"]), "has the line '5 PINHOLE 12'"),
        ("cameras.txt", _lines(lambda x: [*x, "5 PINHOLE 12 x 1"]), "invalid literal for int"),
        (
            "cameras.txt",
            _lines(lambda x: [*x, "5 PINHOLE 12 10 9"]),
            "with 1 parameters, not the 4",
        ),
        ("images.txt", _lines(lambda x: x[:1] + x[2:]), r"images\.txt has the line"),
        ("images.txt", _lines(lambda x: x[:1]), "has no images"),
        ("points3D.txt", _lines(lambda x: [*x, "1 2 3"]), "without position or colour"),
        ("points3D.txt", _lines(lambda x: [*x, "1 2 nan 3 4 5 6 0"]), "not finite"),
        ("images.txt", lambda path: path.write_bytes(b"\xff\xfe"), "is no text"),
        ("images.txt", lambda path: path.unlink(), r"images\.txt does not exist"),
    ],
)
def test_text_files_that_are_wrong(tmp_path, photos, poses, name, change, message):
    model = _write(tmp_path / "m", "text", poses)
    change(model / name)
    with pytest.raises(SceneError, match=message):
        colmap.read_capture(model, photos)


def test_points_are_optional(tmp_path, photos, poses):
    model = _write(tmp_path / "m", "text", poses)
    (model / "points3D.txt").unlink()
    assert colmap.read_capture(model, photos).points is None
