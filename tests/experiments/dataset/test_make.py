"""The command, with a process that stands in for Blender: what it leaves behind, and goes on with.

Whether Blender renders what is asked for is told by `test_blender_worker`.
"""

import json
import os
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.dataset import render_settings
from refref_jax.data import background, containment, files, local_layout, meshes
from tests import code_generator
from tests.experiments.command import ROOT
from tests.experiments.dataset import fake_blender

_OPTIONS = (
    "--scenes=*_box,env_mmncvx_box_full",
    "--size=6",
    "--spp=2",
    "--test_spp=4",
    "--train_views=3",
    "--val_views=1",
    "--test_views=2",
    "--workers=2",
)
_SCENES = ["cube_smcvx_box", "env_mmncvx_box_full", "env_smcvx_box", "sphere_smcvx_box"]
_FILES_OF_A_FRAME = 5


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    path = tmp_path_factory.mktemp("bin") / "python"
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{fake_blender.__file__}"\n')
    path.chmod(0o755)
    return path


def _make(out, blender, *options, status=0, **environment):
    result = subprocess.run(
        [
            *(sys.executable, "-m", "tests.experiments.dataset.small_dataset"),
            *(f"--out={out}", f"--blender={blender}", *_OPTIONS, *options),
        ],
        cwd=ROOT,
        env={**code_generator.of_users(), **environment},
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,
    )
    assert result.returncode == status, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result


@pytest.fixture(scope="module")
def made(tmp_path_factory, blender):
    out = tmp_path_factory.mktemp("made") / "dataset"
    result = _make(out, blender)
    assert f"experiments.dataset.check {out}" in result.stdout
    return out


def _contents(out):
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def test_nothing_else_is_left(made):
    assert sorted(os.listdir(made)) == _SCENES
    names = list(_contents(made))
    assert not [name for name in names if "unfinished" in name]
    # 6 frames of 5 files, a linear image of each test frame, 3 transforms, the record, 2 others.
    one = [name for name in names if name.startswith("cube_smcvx_box/")]
    assert len(one) == 6 * _FILES_OF_A_FRAME + 2 + 3 + 1 + 2


# What was killed leaves in turn: no scene, half a scene, a scene without its name, a frame without
# all its files, and several frames.
_MOMENTS = ["background:1", "json:3", "rename:1", "replace:1", "replace:9", "read:4", "rename:2"]


def test_a_killed_command_goes_on_to_the_same_bits(tmp_path, blender, made):
    for number, moment in enumerate(_MOMENTS):
        group = {"GROUP": "1"} if number % 2 else {}
        _make(tmp_path, blender, status=-9, KILL=moment, **group)
        assert [path for path in tmp_path.rglob("*") if ".scratch" in str(path)]
    _make(tmp_path, blender, "--workers=1")
    assert _contents(tmp_path) == _contents(made)


def test_what_is_half_written_is_written_again_and_what_is_whole_is_not(tmp_path, blender, made):
    _make(tmp_path, blender)
    scene = tmp_path / "env_smcvx_box"
    (scene / "depth" / "train" / "r_001.exr").unlink()
    (scene / "train" / "r_001.png.unfinished").write_bytes(b"\x89PNG")
    (scene / "train" / "r_002.png").write_bytes(b"kept")
    result = _make(tmp_path, blender)
    assert "24/24" in result.stdout and "env_smcvx_box train 1" in result.stdout
    contents = _contents(tmp_path)
    assert contents.pop("env_smcvx_box/train/r_002.png") == b"kept"
    assert contents.items() <= _contents(made).items()
    assert "Nothing to do" in _make(tmp_path, blender).stdout


def test_a_process_that_dies_is_reported_and_replaced_once(tmp_path, blender, made):
    dies = tmp_path / "dies"
    dies.mkdir()
    (dies / "once").touch()
    result = _make(tmp_path / "out", blender, FAKE_DIES=str(dies))
    assert "killed by SIGKILL" in result.stderr and "Once more" in result.stderr
    assert _contents(tmp_path / "out") == _contents(made)
    for name in "abcd":
        (dies / name).touch()
    result = _make(tmp_path / "twice", blender, "--workers=1", status=2, FAKE_DIES=str(dies))
    assert "ended twice while it rendered cube_smcvx_box train 0" in result.stderr
    log = result.stderr.split("See ")[1].split(";")[0]
    assert "chatter" in open(log).read()
    _make(tmp_path / "twice", blender)  # dies once more at most, in each of two processes
    assert _contents(tmp_path / "twice") == _contents(made)


def test_what_blender_complains_of_is_told(tmp_path, blender):
    result = _make(tmp_path, blender, status=2, FAKE_ERROR="1")
    assert "can not render cube_smcvx_box" in result.stderr and "no light" in result.stderr
    result = _make(tmp_path, blender, status=2, FAKE_VERSION="4.2.0")
    assert "Blender 4.2.0" in result.stderr and "make dataset-env" in result.stderr
    result = _make(tmp_path, tmp_path / "nowhere", status=2)
    assert "make dataset-env" in result.stderr
    result = _make(tmp_path, "/bin/false", status=2)
    assert "does not start: status 1" in result.stderr


def test_other_settings_are_refused(made, blender):
    before = _contents(made)
    for option, said in [
        ("--size=7", "the size is 6, not 7"),
        ("--spp=3", "the spp train is 2, not 3"),
        ("--val_views=2", "the views val is 1, not 2"),
        ("--rule=facing", "the rule is nested, not facing"),
        ("--exr=all", "the render linear_images is test, not all"),
    ]:
        result = _make(made, blender, option, status=2)
        assert said in result.stderr and "another --out" in result.stderr
    assert _contents(made) == before


def test_a_strange_folder_is_left_alone(tmp_path, blender):
    (tmp_path / "env_smcvx_box").mkdir()
    result = _make(tmp_path, blender, status=2)
    assert "no scene of this command" in result.stderr
    assert os.listdir(tmp_path) == ["env_smcvx_box"]
    assert not os.listdir(tmp_path / "env_smcvx_box")


def test_the_library_reads_what_was_made(made):
    for name in _SCENES:
        local_layout.check_scene(made / name)
        background.read_background(made / name)
    parts = meshes.read_meshes(made / "env_mmncvx_box_full")
    liquid, shell = parts
    assert (shell.index, liquid.index) == (1.5, 1.333)
    assert liquid.absorption == (0.1, 0.0, 0.2) and shell.shading == "flat"
    assert containment.find_containment(parts).parents == (1, -1)
    assert meshes.read_meshes(made / "cube_smcvx_box")[0].tint == (0.5, 1.0, 0.25)
    frames = local_layout.read_frames(made / "cube_smcvx_box", "test")
    assert frames.depths[0].suffix == ".exr"
    assert np.isinf(local_layout.read_distances(frames)[:, 0]).all()
    positions = frames.cameras.poses[:, :, 3]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 4.0)


def test_a_record_tells_what_blender_is_given(made):
    record = json.loads((made / "env_mmncvx_box_full" / "scene.json").read_text())
    shell, liquid = record["parts"]
    assert (shell["outside"], liquid["outside"]) == ("air", "glass")
    assert (liquid["ior_inside"], liquid["ior_outside"]) == (1.333, 1.5)
    assert liquid["watertight"] and liquid["faces"] == 12
    assert "absorption" not in shell and liquid["absorption"] == [0.1, 0.0, 0.2]
    assert record["spp"] == {"train": 2, "val": 2, "test": 4}
    assert record["rule"] == "nested" and record["render"]["bounces"] == 64
    assert record["render"]["generator"] == render_settings.GENERATOR


def test_files_hold_the_same_view(made):
    scene = made / "cube_smcvx_box"
    image = iio.imread(scene / "test" / "r_001.png").astype(float) / 255.0
    linear = files.read_exr(scene / "test" / "r_001.exr")
    decoded = np.where(image > 0.04045, ((image + 0.055) / 1.055) ** 2.4, image / 12.92)
    np.testing.assert_allclose(decoded, linear, atol=0.005)
    depth = files.read_depth(scene / "depth" / "test" / "r_001.exr")
    published = files.read_depth(scene / "depth" / "test" / "r_001.png")
    np.testing.assert_allclose(published, np.minimum(depth, 11.5), atol=0.0206)
    mask = files.read_mask(scene / "mask" / "test" / "r_001.png")
    normal = files.read_exr(scene / "normal" / "test" / "r_001.exr")
    assert np.array_equal(normal.any(axis=-1), mask) and 0 < mask.sum() < mask.size
    assert not (scene / "train" / "r_000.exr").exists()


def test_views_differ_in_pose_and_noise(made):
    poses, images = [], []
    for name in _SCENES:
        for split in ("train", "val"):
            frames = local_layout.read_frames(made / name, split)
            poses.extend(pose.tobytes() for pose in frames.cameras.poses)
            images.extend(image.tobytes() for image in local_layout.read_images(frames))
    assert len(set(poses)) == len(set(images)) == len(_SCENES) * 4


def test_the_rule_facing_gives_every_part_air_outside(tmp_path, blender):
    _make(tmp_path, blender, "--scenes=env_mmncvx_box_full", "--rule=facing", "--exr=none")
    record = json.loads((tmp_path / "env_mmncvx_box_full" / "scene.json").read_text())
    assert [part["outside"] for part in record["parts"]] == ["air", "air"]
    assert [part["ior_outside"] for part in record["parts"]] == [1.0, 1.0]
    assert not [name for name in _contents(tmp_path) if name.endswith("test/r_000.exr")][2:]


def test_a_preview_is_one_view_a_scene_and_a_sheet(tmp_path, blender):
    _make(tmp_path, blender, "--preview")
    out = tmp_path / "preview"
    sheets = sorted(path.name for path in out.glob("*.png"))
    assert sheets == [f"contact_sheet_{kind}.png" for kind in ("cube", "env", "sphere")]
    # Two objects stand before the environment, side by side.
    sizes = {name: iio.imread(out / name).shape for name in sheets}
    assert sizes["contact_sheet_env.png"][1] > 1.5 * sizes["contact_sheet_cube.png"][1]
    frames = local_layout.read_frames(out / "env_smcvx_box", "test")
    assert frames.names == ("r_000",)
    assert not (out / "env_smcvx_box" / "transforms_train.json").exists()
    assert "Nothing to do" in _make(tmp_path, blender, "--preview").stdout
