"""What making scenes leaves behind, and goes on with; another process stands in for Blender.

Whether Blender renders what is asked for is told by `test_blender_worker`.
"""

import json
import os
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh

from experiments.dataset import render_settings
from experiments.dataset.render_settings import PerSplit
from experiments.dataset.workers import BlenderError
from refref_jax.data import image_files, mesh_queries, meshes, scene_assembly, scene_folder
from tests.factories import small_dataset
from tests.factories.small_dataset import make
from tests.fakes import fake_blender
from tests.processes import code_generator
from tests.processes.command import ROOT

_SCENES = ["cube_smcvx_box", "env_mmncvx_box_full", "env_smcvx_box", "sphere_smcvx_box"]
_FILES_OF_A_FRAME = 5


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    path = tmp_path_factory.mktemp("bin") / "python"
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{fake_blender.__file__}"\n')
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory, blender):
    out = tmp_path_factory.mktemp("made") / "dataset"
    assert make(out, blender)
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


# Killed at these moments it leaves: no scene, half a scene, one without its name, a view without
# files, one without all files, several views.
_MOMENTS = ["mesh:1", "record:1", "rename:1", "read:1", "replace:3", "replace:20", "rename:2"]


def test_a_killed_command_goes_on_to_the_same_bits(tmp_path, blender, made):
    subprocess.run(
        [sys.executable, small_dataset.__file__, tmp_path, blender, *_MOMENTS],
        cwd=ROOT,
        env={**code_generator.of_users(), "PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert (tmp_path / ".refref_making").exists() and (tmp_path / "cube_smcvx_box").exists()
    assert make(tmp_path, blender, workers=1)
    assert _contents(tmp_path) == _contents(made)


def test_what_is_half_written_is_written_again_and_what_is_whole_is_not(
    tmp_path, blender, made, capsys
):
    make(tmp_path, blender)
    scene = tmp_path / "env_smcvx_box"
    (scene / "depth" / "train" / "r_001.exr").unlink()
    (scene / "train" / "r_001.png.unfinished").write_bytes(b"\x89PNG")
    (scene / "train" / "r_002.png").write_bytes(b"kept")
    capsys.readouterr()
    make(tmp_path, blender)
    assert "24/24  env_smcvx_box train 1" in capsys.readouterr().out
    contents = _contents(tmp_path)
    assert contents.pop("env_smcvx_box/train/r_002.png") == b"kept"
    assert contents.items() <= _contents(made).items()
    assert make(tmp_path, blender) and "Nothing to do" in capsys.readouterr().out


def test_a_process_that_dies_is_reported_and_replaced_once(
    tmp_path, blender, made, capsys, monkeypatch
):
    dies = tmp_path / "dies"
    dies.mkdir()
    monkeypatch.setenv("FAKE_DIES", str(dies))
    (dies / "once").touch()
    make(tmp_path / "out", blender)
    assert "killed by SIGKILL" in capsys.readouterr().err
    assert _contents(tmp_path / "out") == _contents(made)
    (dies / "once").touch()
    (dies / "twice").touch()
    with pytest.raises(BlenderError, match=r"ended twice .* cube_smcvx_box train 0"):
        make(tmp_path / "twice", blender, workers=1)
    (log,) = (tmp_path / "twice").glob(".refref_making/*/worker_0.log")
    assert "chatter" in log.read_text()
    make(tmp_path / "twice", blender)
    assert _contents(tmp_path / "twice") == _contents(made)


def test_what_blender_complains_of_is_told(tmp_path, blender, monkeypatch):
    with pytest.raises(BlenderError, match="does not start: status 1"):
        make(tmp_path, "/bin/false")
    monkeypatch.setenv("FAKE_ERROR", "1")
    with pytest.raises(BlenderError, match=r"cannot render cube_smcvx_box .*no light"):
        make(tmp_path, blender)
    monkeypatch.setenv("FAKE_VERSION", "4.2.0")
    with pytest.raises(BlenderError, match=r"Blender 4\.2\.0.*make dataset-env"):
        make(tmp_path, blender)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"size": 7}, "the size is 6, not 7"),
        ({"views": PerSplit(3, 2, 2)}, "the views val is 1, not 2"),
        ({"linear": "all"}, "the render linear_images is test, not all"),
        ({"preview": True}, "the views train is 3, not"),
    ],
)
def test_other_settings_are_refused(made, blender, changes, said):
    before = _contents(made)
    with pytest.raises(ValueError, match=f"{said}.*another --out"):
        make(made, blender, **changes)
    assert _contents(made) == before


def test_a_strange_folder_is_left_alone(tmp_path, blender):
    (tmp_path / "env_smcvx_box").mkdir()
    with pytest.raises(ValueError, match="not a scene of this command"):
        make(tmp_path, blender)
    assert os.listdir(tmp_path) == ["env_smcvx_box"]
    assert not os.listdir(tmp_path / "env_smcvx_box")


def test_two_commands_never_work_in_one_folder(tmp_path, blender, monkeypatch):
    def again(*arguments, **options):
        with pytest.raises(ValueError, match="Another process"):
            make(tmp_path, blender)
        return write_background(*arguments, **options)

    write_background = small_dataset.write_background
    monkeypatch.setattr(small_dataset, "write_background", again)
    assert make(tmp_path, blender, "env_smcvx_box")


def test_the_library_reads_what_was_made_and_blender_is_given(made):
    for name in _SCENES:
        scene_folder.check_scene(made / name)
        scene_assembly.read_background(made / name)
    parts = meshes.read_meshes(made / "env_mmncvx_box_full")
    liquid, shell = parts
    assert (shell.index, liquid.index) == (1.5, 1.333)
    assert liquid.absorption == (0.1, 0.0, 0.2) and shell.shading == "flat"
    assert mesh_queries.find_containment(parts).parents == (1, -1)
    assert meshes.read_meshes(made / "cube_smcvx_box")[0].tint == (0.5, 1.0, 0.25)
    frames = scene_folder.read_frames(made / "cube_smcvx_box", "test")
    assert frames.depths[0].suffix == ".exr"
    assert np.isinf(scene_folder.read_distances(frames)[:, 0]).all()
    record = json.loads((made / "env_mmncvx_box_full" / "scene.json").read_text())
    shell, liquid = record["parts"]
    assert (shell["outside"], liquid["outside"]) == ("air", "glass")
    assert (liquid["ior_inside"], liquid["ior_outside"]) == (1.333, 1.5)
    assert liquid["watertight"] and liquid["faces"] == 12 and "absorption" not in shell
    assert record["spp"] == {"train": 2, "val": 2, "test": 4}
    assert record["rule"] == "nested" and record["render"]["bounces"] == 64
    assert record["render"]["generator"] == render_settings.GENERATOR


def test_files_hold_the_same_view(made):
    scene = made / "cube_smcvx_box"
    image = iio.imread(scene / "test" / "r_001.png").astype(float) / 255.0
    linear = image_files.read_exr(scene / "test" / "r_001.exr")
    decoded = np.where(image > 0.04045, ((image + 0.055) / 1.055) ** 2.4, image / 12.92)
    np.testing.assert_allclose(decoded, linear, atol=0.005)
    depth = image_files.read_depth(scene / "depth" / "test" / "r_001.exr")
    published = image_files.read_depth(scene / "depth" / "test" / "r_001.png")
    np.testing.assert_allclose(published, np.minimum(depth, 11.5), atol=0.0206)
    mask = image_files.read_mask(scene / "mask" / "test" / "r_001.png")
    normal = image_files.read_exr(scene / "normal" / "test" / "r_001.exr")
    assert np.array_equal(normal.any(axis=-1), mask) and 0 < mask.sum() < mask.size
    assert not (scene / "train" / "r_000.exr").exists()


def test_views_differ_in_pose_and_noise(made):
    poses, images = [], []
    for name in _SCENES:
        for split in ("train", "val"):
            frames = scene_folder.read_frames(made / name, split)
            poses.extend(pose.tobytes() for pose in frames.cameras.poses)
            images.extend(image.tobytes() for image in scene_folder.read_images(frames))
    assert len(set(poses)) == len(set(images)) == len(_SCENES) * 4


def test_the_rule_facing_gives_every_part_air_outside(tmp_path, blender):
    make(tmp_path, blender, "env_mmncvx_box_full", rule="facing", linear="none")
    scene = tmp_path / "env_mmncvx_box_full"
    record = json.loads((scene / "scene.json").read_text())
    outside = [(part["outside"], part["ior_outside"]) for part in record["parts"]]
    assert outside == [("air", 1.0)] * 2 and not list((scene / "test").glob("*.exr"))


def test_opaque_parts_are_lit_or_emit_known_light(tmp_path, blender):
    """The record and the mesh file; the library's reader is tested with the library."""
    parts = {}
    for opaque in ("lit", "emitting"):
        out = tmp_path / opaque
        assert make(out, blender, "env_mmncvx_box_opaque", opaque=opaque)
        scene = out / "env_mmncvx_box_opaque"
        record = json.loads((scene / "scene.json").read_text())
        assert record["render"].get("opaque", "lit") == opaque
        parts[opaque] = {part["mesh"]: part for part in record["parts"]}
    name = "meshes/box_opaque_core_opaque.ply"
    shell, lit = parts["lit"].values()
    assert shell["absorption"] == [0.1, 0.0, 0.2] and "kind" not in shell
    assert (lit["kind"], lit["albedo"], lit["outside"]) == ("opaque", [0.5, 0.2, 0.1], "water")
    assert not {"ior_inside", "index", "colour_per_interface", "radiance"} & set(lit)
    emitting = parts["emitting"][name]
    assert emitting["radiance"] == "vertex_colours" and "albedo" not in emitting
    assert parts["emitting"]["meshes/box_opaque_shell_water.ply"] == shell
    plain = trimesh.load(tmp_path / "lit" / scene.name / name, process=False)
    mesh = trimesh.load(tmp_path / "emitting" / scene.name / name, process=False)
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    colours = mesh.visual.vertex_colors[:, :3].astype(float)
    assert plain.visual.kind is None and np.ptp(colours, axis=0).min() > 10
    upper = mesh.vertices[:, 2] > 0.0
    assert (colours[upper].min(axis=0) > colours[~upper].max(axis=0)).all()
    # Diffuse light of 0.5 is 188 in sRGB: nothing is brighter than the albedo.
    assert colours.max() <= 188
    with pytest.raises(ValueError, match="another --out"):
        make(tmp_path / "lit", blender, "env_mmncvx_box_opaque", opaque="emitting")


def test_a_preview_is_a_test_view_as_it_is_in_the_whole(tmp_path, blender, made):
    assert render_settings.preview_view(small_dataset.SETTINGS.views.test) == 0
    make(tmp_path, blender, preview=True)
    assert scene_folder.read_frames(tmp_path / "env_smcvx_box", "test").names == ("r_000",)
    assert not (tmp_path / "env_smcvx_box" / "transforms_train.json").exists()
    image = "env_smcvx_box/test/r_000.png"
    assert _contents(tmp_path)[image] == _contents(made)[image]
