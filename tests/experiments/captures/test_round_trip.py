"""The bundled ball as a capture of COLMAP with a distorted lens, imported by the command."""

import json

import numpy as np
import pytest

from experiments.captures import lenses, photographs, resampling
from experiments.captures.colmap import lens_of
from refref_jax.data import image_files, scene_folder, scene_properties
from refref_jax.data.meshes import read_mesh
from tests.factories.colmap_models import Camera, Image, write_binary, write_text
from tests.processes.command import ROOT, run_command

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"
_VIEWS = 12
_CUSHION = (0.06, 0.02, 1e-3, -5e-4)


def _inverse(lens, pixels):
    """The points of the plane at distance 1 that a lens shows at pixels, by Newton's steps."""
    points = (pixels - lens.intrinsics[2:4]) / lens.intrinsics[:2]
    for _ in range(20):
        off = lenses.to_pixels(lens, points) - pixels
        points = points - np.linalg.solve(lenses.slopes(lens, points), off[..., None])[..., 0]
    assert np.abs(lenses.to_pixels(lens, points) - pixels).max() < 1e-9
    return points


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photographs through a cushion lens, which shows less than the pinhole; another world."""
    folder = tmp_path_factory.mktemp("captures") / "ball"
    frames = scene_folder.read_frames(_SCENE, "train")
    width, height, focal = frames.cameras.width, frames.cameras.height, frames.cameras.focal
    parameters = (focal, focal, 0.5 * width, 0.5 * height, *_CUSHION)
    lens = lens_of("OPENCV", (width, height), list(parameters), folder)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    towards = _inverse(lens, np.stack([columns, rows], axis=-1))
    places = focal * towards + 0.5 * np.array([width, height])
    masks = scene_folder.read_masks(frames)
    turn, shift, scale = _world()
    poses = []
    for number in range(_VIEWS):
        linear = photographs.read_linear(frames.images[number])
        photo = photographs.to_srgb(resampling.interpolate(linear, places))
        mask = resampling.interpolate(masks[number][..., None].astype(np.float32), places)
        for name, pixels in (("images", photo), ("masks", 255 * (mask[..., 0] >= 0.5))):
            (folder / name).mkdir(parents=True, exist_ok=True)
            image_files.write_png(folder / name / f"p{number:02d}.png", pixels.astype(np.uint8))
        pose = frames.cameras.poses[number]
        poses.append(np.c_[turn @ pose[:, :3], scale * turn @ pose[:, 3] + shift])
    cameras = {1: Camera("OPENCV", width, height, parameters)}
    found = [Image(pose, 1, f"p{number:02d}.png") for number, pose in enumerate(poses)]
    corners = scale * np.eye(3) @ turn.T + shift
    points = [(tuple(place), (10 * i, 20, 30)) for i, place in enumerate(corners)]
    write_binary(folder / "sparse" / "0", cameras, found, points)
    write_text(folder.parent / "text", cameras, found, points)
    (folder / "meshes").mkdir()
    mesh = (_SCENE / "meshes" / "ball_body_glass.ply").read_bytes()
    (folder / "meshes" / "ball_body_glass.ply").write_bytes(mesh)
    return folder


def _world():
    """Rotation, shift and scale that take the scene's world to that of the capture."""
    turn, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    return turn * np.sign(np.linalg.det(turn)), np.array([30.0, -4.0, 7.0]), 0.025


@pytest.fixture(scope="module")
def imported(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("imported") / "scene"
    options = (f"--source={capture}", f"--mask_folder={capture / 'masks'}", f"--out={out}")
    return out, run_command("import_capture", *options, "--test_every=4").stdout


def _frames(scene):
    """All images of a scene in the order of the capture, with their frames."""
    found = {}
    for split in ("train", "test"):
        content = json.loads((scene / f"transforms_{split}.json").read_text())
        frames = scene_folder.read_frames(scene, split)
        for number, record in enumerate(content["frames"]):
            found[record["source"]] = (frames, number)
    return [found[name] for name in sorted(found)]


def test_cameras_are_those_of_the_scene_after_the_recorded_motion(imported):
    scene, _ = imported
    record = json.loads((scene / "import.json").read_text())["world"]
    turn, shift, scale = _world()
    original = scene_folder.read_frames(_SCENE, "train").cameras
    for number, (frames, view) in enumerate(_frames(scene)):
        found, pose = frames.cameras.poses[view], original.poses[number]
        position = scale * turn @ pose[:, 3] + shift
        expected = record["scale"] * np.array(record["rotation"]) @ (position - record["centre"])
        np.testing.assert_allclose(found[:, 3], expected, atol=1e-5)
        axes = np.array(record["rotation"]) @ turn @ pose[:, :3]
        np.testing.assert_allclose(found[:, :3], axes, atol=1e-5)
        assert frames.cameras.focal == pytest.approx(original.focal, rel=1e-5)


def test_images_are_those_of_the_scene_but_for_two_interpolations(imported):
    scene, _ = imported
    originals = scene_folder.read_images(scene_folder.read_frames(_SCENE, "train"))
    squares, masks_off = [], []
    masks = scene_folder.read_masks(scene_folder.read_frames(_SCENE, "train"))
    for number, (frames, view) in enumerate(_frames(scene)):
        image = image_files.read_rgb(frames.images[view])
        rows, columns = ((128 - size) // 2 for size in image.shape[:2])
        assert (128 - image.shape[0]) % 2 == (128 - image.shape[1]) % 2 == 0
        cut = np.s_[rows : 128 - rows, columns : 128 - columns]
        squares.append(np.mean((image / 255.0 - originals[number][cut] / 255.0) ** 2))
        masks_off.append(np.mean(image_files.read_mask(frames.masks[view]) != masks[number][cut]))
    psnr = -10.0 * np.log10(np.mean(squares))
    # 30.5 dB for textures of two pixels; a shift by half a pixel leaves 23 dB.
    assert psnr > 30.0 and np.mean(masks_off) < 0.002


def test_the_object_lies_at_the_origin(imported):
    scene, said = imported
    assert "Object:  radius 1.5, 0 from the origin" in said
    record = json.loads((scene / "import.json").read_text())["world"]
    _, shift, scale = _world()
    centre = np.array(record["rotation"]) @ (shift - record["centre"]) * record["scale"]
    radius = np.linalg.norm(read_mesh(_SCENE / "meshes" / "ball_body_glass.ply")[0], axis=1).max()
    assert np.linalg.norm(centre) < 0.15
    # Nine views leave tips of the hull.
    assert 0.85 < radius * scale * record["scale"] < 1.5
    ups = np.stack([frames.cameras.poses[view][:, 1] for frames, view in _frames(scene)])
    np.testing.assert_allclose(ups.mean(axis=0)[:2], 0.0, atol=1e-9)
    assert ups.mean(axis=0)[2] > 0.3


def test_the_scene_is_complete_and_unbounded(imported):
    scene, said = imported
    scene_folder.check_scene(scene, needed=("train", "test"))
    assert scene_properties.read(scene).background.kind == "env"
    assert "resampled" in said and "experiments.reconstruct" in said
    record = json.loads((scene / "import.json").read_text())
    assert record["splits"]["train"]["images"][0]["distortion"].startswith("k1 = 0.06")
    points = (scene / "points.ply").read_bytes()
    assert points.startswith(b"ply") and b"element vertex 3" in points


def test_the_text_model_gives_the_same_scene(capture, imported, tmp_path):
    out = tmp_path / "scene"
    options = (f"--source={capture.parent / 'text'}", f"--images={capture / 'images'}")
    options += (f"--mask_folder={capture / 'masks'}", f"--out={out}", "--test_every=4")
    run_command("import_capture", *options)
    for path in sorted(out.rglob("*")):
        other = imported[0] / path.relative_to(out)
        if path.is_file() and path.name != "import.json":
            assert path.read_bytes() == other.read_bytes()


def test_meshes_move_with_the_cameras(capture, tmp_path):
    """The mesh, in the world of the scene, at the cameras of the scene."""
    out = tmp_path / "scene"
    options = (f"--source={capture}", f"--meshes={capture / 'meshes'}", f"--out={out}")
    said = run_command("import_capture", *options, "--masks=none").stdout
    before, _ = read_mesh(_SCENE / "meshes" / "ball_body_glass.ply")
    after, _ = read_mesh(out / "meshes" / "ball_body_glass.ply")
    record = json.loads((out / "import.json").read_text())["world"]
    moved = record["scale"] * (before - record["centre"]) @ np.array(record["rotation"]).T
    np.testing.assert_allclose(np.sort(moved, axis=0), np.sort(after, axis=0), atol=1e-5)
    assert len(before) == len(after)
    assert np.linalg.norm(after, axis=1).max() == pytest.approx(1.5, rel=1e-3)
    assert "Object:  radius 1.5" in said and "experiments.train" in said
