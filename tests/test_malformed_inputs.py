"""Malformed inputs: each is refused in one line that names the file, and the key or the remedy.

Every case breaks one file of a small scene, which is otherwise read and resolved as for training.
"""

import json
import shutil
import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

from refref_jax.data import ALLOW_OUTSIDE, SceneError, file_inside, image_files, scene_folder
from refref_jax.training.config import TrainConfig
from refref_jax.training.resolve import read_facts, resolve
from tests.factories.small_scenes import HEIGHT, WIDTH, png_chunk, write_grey, write_scene

_TRANSFORMS, _SCENE, _MESH = "transforms_train.json", "scene.json", "meshes/ball_glass.ply"
_IMAGE, _MASK, _DEPTH = "train/r_000.png", "mask/train/r_000.png", "depth/train/r_000.exr"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A small scene without a fault: a ball, two cameras beside it, a cube behind them."""
    scene = write_scene(tmp_path_factory.mktemp("sound") / "cube_ball")
    (scene / "meshes").mkdir()
    trimesh.creation.icosphere(1).export(scene / _MESH)
    part = {"mesh": _MESH, "index": 1.5, "tint": [1, 1, 1]}
    background = {"type": "cube", "half_extent": 7.3}
    content = {"version": 1, "rule": "nested", "background": background, "parts": [part]}
    (scene / _SCENE).write_text(json.dumps(content))
    _edit(scene, _TRANSFORMS, lambda c: [_place(f, 0, 3, 4.0) for f in c["frames"]])
    _edit(scene, _TRANSFORMS, lambda c: [_place(f, i, 3, 0.0) for f in c["frames"] for i in (1, 2)])
    _edit(scene, _TRANSFORMS, lambda c: _place(c["frames"][1], 2, 3, 4.0))
    return scene


def _place(frame, row, column, value):
    frame["transform_matrix"][row][column] = value


def _edit(scene, name, edit):
    content = json.loads((scene / name).read_text())
    edit(content)
    (scene / name).write_text(json.dumps(content))


def _in(name, **values):
    return lambda scene: _edit(scene, name, lambda content: content.update(values))


def _frame(**values):
    return lambda scene: _edit(scene, _TRANSFORMS, lambda c: c["frames"][0].update(values))


def _frames(edit):
    return lambda scene: _edit(scene, _TRANSFORMS, lambda c: [edit(f) for f in c["frames"]])


def _part(**values):
    return lambda scene: _edit(scene, _SCENE, lambda c: c["parts"][0].update(values))


def _background(**values):
    return lambda scene: _edit(scene, _SCENE, lambda c: c["background"].update(values))


def _write(name, content):
    return lambda scene: (scene / name).write_bytes(content)


def _matrix(matrix):
    return _frame(transform_matrix=matrix)


def _outside(scene):
    shutil.copy(scene / _IMAGE, scene.parent / "outside.png")
    _frame(file_path="../outside")(scene)


def _absolute(scene):
    shutil.copy(scene / _IMAGE, scene.parent / "outside.png")
    _frame(file_path=str(scene.parent / "outside"))(scene)


def _exr(name, channels):
    def write(scene):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(scene / name))

    return write


def _save(image, kind, **options):
    return lambda scene: image.save(scene / _IMAGE, kind, **options)


def _declared_size(width, height):
    """A PNG whose header declares a size, and whose pixels are missing."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + header
        + png_chunk(b"IDAT", zlib.compress(b""))
        + png_chunk(b"IEND", b"")
    )


def _as_folder(name):
    def replace(scene):
        (scene / name).unlink()
        (scene / name).mkdir()

    return replace


def _only_obj(scene):
    (scene / _MESH).rename(scene / "meshes" / "ball_glass.obj")


def _meshes_as_file(scene):
    shutil.rmtree(scene / "meshes")
    (scene / "meshes").write_text("x")


def _mesh(**options):
    return lambda scene: trimesh.creation.icosphere(1, **options).export(scene / _MESH)


def _flat(scene):
    box = trimesh.creation.box()
    trimesh.Trimesh(box.vertices * [1, 1, np.nan], box.faces, process=False).export(scene / _MESH)


_PLY = "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
_PLY += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"

_HUGE, _DEEP = 10**400, 200_000
_RGB = Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
_POSE = np.eye(4).tolist()
_PIXELS = np.zeros((HEIGHT, WIDTH), np.float32)

# How a scene is broken, and what the message says, beside the name of the file.
_CASES = {
    # JSON.
    "nested": (_write(_TRANSFORMS, b"[" * _DEEP), _TRANSFORMS, "nested too deeply"),
    "nested and closed": (
        _write(_TRANSFORMS, b'{"frames":' + b"[" * _DEEP + b"]" * _DEEP + b"}"),
        _TRANSFORMS,
        "nested too deeply",
    ),
    "nested objects": (_write(_SCENE, b'{"a":' * _DEEP), _SCENE, "nested too deeply"),
    "nested a little": (
        _write(_SCENE, b'{"notes":' + b"[" * 90 + b"]" * 90 + b"}"),
        _SCENE,
        "nested too deeply",
    ),
    "key twice": (_write(_SCENE, b'{"rule": "nested", "rule": "facing"}'), _SCENE, "'rule' twice"),
    "key twice in a frame": (
        _write(_TRANSFORMS, b'{"frames": [{"file_path": "a", "file_path": "b"}]}'),
        _TRANSFORMS,
        "'file_path' twice",
    ),
    "empty file": (_write(_TRANSFORMS, b""), _TRANSFORMS, "not valid JSON"),
    "cut short": (_write(_TRANSFORMS, b'{"frames": [{"fi'), _TRANSFORMS, "not valid JSON"),
    "more after the end": (_write(_SCENE, b"{} {}"), _SCENE, "Extra data"),
    "UTF-16": (_write(_SCENE, '{"rule": 1}'.encode("utf-16")), _SCENE, "not valid JSON"),
    "5,000 digits": (_write(_SCENE, b'{"ambient_index": %s}' % (b"1" * 5000)), _SCENE, "digits"),
    "a list": (_write(_TRANSFORMS, b"[]"), _TRANSFORMS, "not a JSON object"),
    # Cameras.
    "angle true": (_in(_TRANSFORMS, camera_angle_x=True), _TRANSFORMS, "camera_angle_x is True"),
    "angle of no size": (_in(_TRANSFORMS, camera_angle_x=1e-300), _TRANSFORMS, "is 1e-300"),
    "angle in degrees": (_in(_TRANSFORMS, camera_angle_x=60), _TRANSFORMS, "radians"),
    "angle too large": (_in(_TRANSFORMS, camera_angle_x=_HUGE), _TRANSFORMS, "000...000"),
    "angle text": (_in(_TRANSFORMS, camera_angle_x="1"), _TRANSFORMS, "camera_angle_x is '1'"),
    "distortion": (_in(_TRANSFORMS, k1=0.23), _TRANSFORMS, "k1 is 0.23"),
    "distortion of a frame": (_frame(p2=-0.1), _TRANSFORMS, "p2 is -0.1"),
    "focal length": (_in(_TRANSFORMS, fl_x=100), _TRANSFORMS, "fl_x is 100"),
    "principal point": (_in(_TRANSFORMS, cx=1.5), _TRANSFORMS, "cx is 1.5"),
    "width": (_in(_TRANSFORMS, w=800), _TRANSFORMS, "w is 800"),
    "height text": (_in(_TRANSFORMS, h="6"), _TRANSFORMS, "h is '6'"),
    "frames an object": (_in(_TRANSFORMS, frames={"a": 1}), _TRANSFORMS, "lists no frames"),
    "frame a list": (_in(_TRANSFORMS, frames=[[[]]]), _TRANSFORMS, "'file_path'"),
    "misspelt mask": (
        _frames(lambda f: f.update(mask_file_pth=f.pop("mask_file_path"))),
        _TRANSFORMS,
        "Write 'mask_file_path'",
    ),
    "mask of nerfstudio": (
        _frames(lambda f: f.update(mask_path=f.pop("mask_file_path"))),
        _TRANSFORMS,
        "Write 'mask_file_path'",
    ),
    "misspelt depth": (
        _frames(lambda f: f.update(depth_filepath=f.pop("depth_file_path"))),
        _TRANSFORMS,
        "Write 'depth_file_path'",
    ),
    "misspelt angle": (
        lambda s: _edit(s, _TRANSFORMS, lambda c: c.update(camera_angle=c.pop("camera_angle_x"))),
        _TRANSFORMS,
        "Write 'camera_angle_x'",
    ),
    "pose of truths": (_matrix([[True, 0, 0, 0], *_POSE[1:]]), _TRANSFORMS, "4 x 4 matrix"),
    "pose of texts": (_matrix([["1", "0", "0", "0"], *_POSE[1:]]), _TRANSFORMS, "4 x 4 matrix"),
    "pose of one number": (_matrix(1.0), _TRANSFORMS, "4 x 4 matrix"),
    "pose without a row": (_matrix(_POSE[:3]), _TRANSFORMS, "4 x 4 matrix"),
    "pose of unequal rows": (_matrix([[1, 0], [0]]), _TRANSFORMS, "4 x 4 matrix"),
    "pose too large": (_matrix([[1, 0, 0, _HUGE], *_POSE[1:]]), _TRANSFORMS, "4 x 4 matrix"),
    "pose far away": (_matrix([[1, 0, 0, 1e9], *_POSE[1:]]), _TRANSFORMS, "to the origin"),
    "pose not finite": (_matrix([[1, 0, 0, 1e999], *_POSE[1:]]), _TRANSFORMS, "4 x 4 matrix"),
    # Names of files.
    "image outside": (_outside, _TRANSFORMS, "--allow_outside"),
    "image absolute": (_absolute, _TRANSFORMS, "--allow_outside"),
    "mask outside": (_frame(mask_file_path="../../m.png"), _TRANSFORMS, "mask_file_path is '../"),
    "depth outside": (_frame(depth_file_path="/dev/zero"), _TRANSFORMS, "is '/dev/zero'"),
    "name with a zero": (_frame(file_path="train/\0"), _TRANSFORMS, "Use the name of a file"),
    "half a character": (_frame(file_path="train/\ud800"), _TRANSFORMS, "Use the name of a file"),
    "long name": (_frame(file_path="a" * 5000), _TRANSFORMS, "Use the name of a file"),
    "no name": (_frame(mask_file_path=""), _TRANSFORMS, "Use the name of a file"),
    "name a number": (_frame(file_path=7), _TRANSFORMS, "file_path is 7"),
    "name a list": (_frame(depth_file_path=["a"]), _TRANSFORMS, "depth_file_path is ['a']"),
    "name with an ending": (_frame(file_path="train/r_000.png"), "r_000.png.png", "does not exist"),
    "texture outside": (
        _in(_SCENE, background={"type": "sphere", "radius": 7, "image": "../x.png"}),
        _SCENE,
        "--allow_outside",
    ),
    "texture of a face outside": (
        _background(faces={"+x": {"image": "/etc/hostname"}}),
        _SCENE,
        "--allow_outside",
    ),
    # Properties.
    "unknown key": (_in(_SCENE, rul="nested"), _SCENE, "Write 'rule'"),
    "unknown key of a part": (_part(indx=1.5), _SCENE, "Write 'index'"),
    "unknown key of a background": (_background(radios=7), _SCENE, "Write 'radius'"),
    "long key": (_in(_SCENE, **{"a" * 5000: 1}), _SCENE, "is not a known key"),
    "index of 1e9": (_part(index=1e9), _SCENE, "index is 1000000000.0"),
    "index true": (_part(index=True), _SCENE, "index is True"),
    "material of 1e9": (_in(_SCENE, ior={"glass": 1e9}), _SCENE, "ior.glass is 1000000000.0"),
    "ambient of 1e9": (_in(_SCENE, ambient_index=1e9), _SCENE, "ambient_index is 1000000000.0"),
    "ambient of 1e-9": (_in(_SCENE, ambient_index=1e-9), _SCENE, "ambient_index is 1e-09"),
    "tint true": (_part(tint=[True, True, True]), _SCENE, "tint is [True, True, True]"),
    "absorption": (_part(absorption=[1e300] * 3), _SCENE, "absorption is [1e+300"),
    "priority": (_part(priority=10**30), _SCENE, "a whole number"),
    "version true": (_in(_SCENE, version=True), _SCENE, "version is True"),
    "parts an object": (_in(_SCENE, parts={}), _SCENE, "not a list"),
    "notes a list": (_in(_SCENE, notes=list(range(9999))), _SCENE, "notes is [0, 1, 2"),
    "cube in front of the cameras": (_background(half_extent=1), _SCENE, "camera 0 is 4 from"),
    "sphere in front of the cameras": (
        _in(_SCENE, background={"type": "sphere", "radius": 3.9}),
        _SCENE,
        "background.radius is 3.9",
    ),
    "cube beside the cameras": (_background(centre=[100, 0, 0]), _SCENE, "from its centre"),
    "cube of 1e30": (_background(half_extent=1e30), _SCENE, "half_extent is 1e+30"),
    "centre at 1e30": (_background(centre=[0, 0, 1e30]), _SCENE, "centre is [0, 0, 1e+30]"),
    "no background": (_in(_SCENE, background=None), _SCENE, "background is None"),
    # Meshes.
    "meshes gone": (lambda s: shutil.rmtree(s / "meshes"), "ball_glass.ply", "Restore it"),
    "mesh gone": (lambda s: (s / _MESH).unlink(), "ball_glass.ply", "Restore it"),
    "meshes a file": (_meshes_as_file, "meshes", "not a folder"),
    "mesh in another format": (_only_obj, "ball_glass.obj", "Export the mesh as PLY"),
    "mesh empty": (_write(_MESH, b""), _MESH, "export it again"),
    "mesh a folder": (_as_folder(_MESH), _MESH, "cannot be read"),
    "mesh of 9e11 vertices": (
        _write(_MESH, _PLY.format("binary_little_endian 1.0", 900_000_000_000).encode()),
        _MESH,
        "export it again",
    ),
    "mesh far away": (_mesh(radius=1e30), _MESH, "beyond 1e+06"),
    "mesh not finite": (_flat, _MESH, "not finite"),
    # Images.
    "image text": (_write(_IMAGE, b"hello"), _IMAGE, "cannot be read as an image"),
    "image a folder": (_as_folder(_IMAGE), _IMAGE, "does not exist"),
    "image of a program": (_write(_IMAGE, b"%!PS-Adobe-3.0 EPSF-3.0\n"), _IMAGE, "cannot be read"),
    "image of 4e9 pixels": (_write(_IMAGE, _declared_size(65_000, 65_000)), _IMAGE, "Scale it"),
    "image of 1e8 pixels": (_write(_IMAGE, _declared_size(10_000, 10_000)), _IMAGE, "Scale it"),
    "image of 7e7 pixels": (_write(_IMAGE, _declared_size(10_000, 7_000)), _IMAGE, "10000 x 7000"),
    "moving image": (_save(_RGB, "PNG", save_all=True, append_images=[_RGB] * 3), _IMAGE, "4 pict"),
    "image of inks": (_save(_RGB.convert("CMYK"), "JPEG"), _IMAGE, "CMYK"),
    "mask of another size": (lambda s: write_grey(s / _MASK, np.ones((3, 3))), _MASK, "3 x 3"),
    "depth of two channels": (_exr(_DEPTH, {"Y": _PIXELS, "Z": _PIXELS}), _DEPTH, "one channel"),
    "depth not a number": (_exr(_DEPTH, {"Z": _PIXELS * np.nan}), _DEPTH, "not a number"),
    "depth text": (_write(_DEPTH, b"v/1\x01"), _DEPTH, "cannot be read as EXR"),
}


def _read(scene):
    config = TrainConfig().override(scene=str(scene), preset="tiny", batch=16)
    return resolve(config, read_facts(config.scene))


def test_there_are_more_than_eighty_and_the_scene_itself_is_read(sound):
    assert len(_CASES) >= 80
    _read(sound)


@pytest.mark.parametrize(("spoil", "name", "told"), _CASES.values(), ids=_CASES)
def test_a_malformed_input_is_refused_in_one_line(sound, tmp_path, spoil, name, told):
    scene = shutil.copytree(sound, tmp_path / sound.name)
    spoil(scene)
    with pytest.raises(ValueError) as caught:
        _read(scene)
    message = str(caught.value)
    assert name in message and told in message
    assert "\n" not in message and len(message) < 500 + 2 * len(str(tmp_path))
    message.encode()  # it can be printed


def test_files_outside_are_allowed_to_a_trusted_scene(sound, tmp_path, monkeypatch):
    scene = shutil.copytree(sound, tmp_path / sound.name)
    _outside(scene)
    for value in ("", "0"):
        monkeypatch.setenv(ALLOW_OUTSIDE, value)
        with pytest.raises(SceneError, match=ALLOW_OUTSIDE):
            _read(scene)
    monkeypatch.setenv(ALLOW_OUTSIDE, "1")
    assert _read(scene).config.model.preset == "tiny"


def test_names_through_a_link_to_the_scene_are_inside_it(sound, tmp_path):
    scene, link = shutil.copytree(sound, tmp_path / sound.name), tmp_path / "link"
    link.symlink_to(scene)
    name = str(scene / "train" / "r_000.png")
    assert file_inside([link], name, where="file_path", path=link / _TRANSFORMS) == scene / name


def test_lenses_that_differ_by_rounding_are_read(sound, tmp_path):
    scene = shutil.copytree(sound, tmp_path / sound.name)
    middle = {"cx": 0.5 * (WIDTH - 1), "cy": 0.5 * (HEIGHT - 1)}
    _in(_TRANSFORMS, k1=1e-12, p2=-1e-9, fl_x=None, **middle)(scene)
    assert scene_folder.read_frames(scene, "train").cameras.width == WIDTH


def test_links_within_a_scene_lead_where_they_lead(sound, tmp_path):
    scene = shutil.copytree(sound, tmp_path / sound.name)
    shutil.move(scene / "train", tmp_path / "elsewhere")
    (scene / "train").symlink_to(tmp_path / "elsewhere")
    assert _read(scene).model == _read(sound).model


@pytest.mark.parametrize(
    "values",
    [
        {"aabb_scale": 16, "scale": 0.33, "k1": 0, "w": WIDTH, "h": float(HEIGHT)},
        {"camera_model": "OPENCV", "cx": WIDTH / 2, "cy": HEIGHT / 2, "camera_angle_y": 0.8},
    ],
)
def test_keys_of_other_programs_are_ignored(sound, tmp_path, values):
    scene = shutil.copytree(sound, tmp_path / sound.name)
    _in(_TRANSFORMS, **values)(scene)
    _frames(partial(dict.update, rotation=0.01, normal_file_path="./normal/r_000"))(scene)
    assert _read(scene).model == _read(sound).model


def test_a_scene_without_meshes_can_be_trained_along_straight_rays(sound, tmp_path):
    scene = shutil.copytree(sound, tmp_path / sound.name)
    shutil.rmtree(scene / "meshes")
    config = TrainConfig().override(scene=str(scene), preset="tiny", batch=16, paths="straight")
    resolved = resolve(config, read_facts(config.scene))
    assert resolved.model.settings.max_bends == 0


def test_transparency_is_composited_in_blocks_as_at_once(tmp_path, monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 256, (37, 11, 4), dtype=np.uint8)
    image_files.write_png(tmp_path / "a.png", pixels)
    whole = image_files.read_rgb(tmp_path / "a.png")
    monkeypatch.setattr(image_files, "_BLOCK", 50)
    np.testing.assert_array_equal(image_files.read_rgb(tmp_path / "a.png"), whole)


def test_a_file_may_be_in_any_of_several_folders(tmp_path):
    inside = partial(file_inside, [tmp_path / "a", tmp_path / "b"], where="image", path=Path("x"))
    assert inside("c.png") == tmp_path / "a" / "c.png"
    assert inside("../b/c.png").resolve() == tmp_path / "b" / "c.png"
    assert inside(str(tmp_path / "b" / "c.png")) == tmp_path / "b" / "c.png"
    for name in ("../c.png", "../bc.png", "/c.png", "c/../../c.png"):
        with pytest.raises(SceneError, match="x: image is "):
            inside(name)


def test_photographs_with_a_preview_behind_them_are_read(tmp_path):
    picture = Image.new("RGB", (6, 4), (200, 100, 50))
    picture.save(tmp_path / "phone.jpg", "MPO", save_all=True, append_images=[picture])
    assert image_files.read_rgb(tmp_path / "phone.jpg").shape == (4, 6, 3)
