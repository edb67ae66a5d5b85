import json
import shutil
import sys
import tempfile

import numpy as np
import pyarrow.parquet
import pytest
import trimesh

from experiments.dataset import (
    conversion,
    dataset_card,
    layout_parquet,
    published_meshes,
    scene_contents,
    scene_folders,
)
from refref_jax.choices import SPLITS
from refref_jax.data import meshes, scene_assembly, scene_folder, scene_properties, scene_source
from refref_jax.data.scene_names import parse
from tests.factories.cut_ball import COUNTS, cut_ball
from tests.factories.small_parquet import write_copy
from tests.fakes.abandoned_folder import AbandonedFolder
from tests.laws.expectations import scene_error
from tests.processes.command import run_command

_NAME = "cube_smcvx_ball"
_RAW = "image_data/textured_cube_scene/single-convex/ball"
_IMAGES = sum(COUNTS.values())


@pytest.fixture
def ball(tmp_path):
    """A few frames of the bundled scene, of which one has a linear image."""
    scene = cut_ball(tmp_path / "scenes" / _NAME)
    shutil.copyfile(scene / "depth" / "test" / "r_000.exr", scene / "test" / "r_000.exr")
    return scene


def _convert(source, layout, out):
    """Converts all scenes of a place; returns what was left out."""
    out.mkdir(parents=True, exist_ok=True)
    scenes = scene_folders.find(str(source))
    steps = []
    left = [conversion.convert(each, layout, out, step=lambda: steps.append(0)) for each in scenes]
    unpacked = sum(each.images for each in scenes if each.copy is not None)
    assert len(steps) == unpacked + sum(each.images for each in scenes)
    return sum(left, start=type(left[0])())


def _files(folder):
    """Returns the content of all files by their places; of JSON what it means."""
    return {
        path.relative_to(folder).as_posix(): (
            json.loads(path.read_text()) if path.suffix == ".json" else path.read_bytes()
        )
        for path in folder.rglob("*")
        if path.is_file()
    }


def _assert_same_frames(scene, other, *, float_depth=True):
    for split in SPLITS:
        ours, theirs = (scene_folder.read_frames(each, split) for each in (scene, other))
        assert len(ours.names) == COUNTS[split]
        np.testing.assert_array_equal(ours.cameras.poses, theirs.cameras.poses)
        assert ours.cameras[1:] == theirs.cameras[1:]
        for read in (scene_folder.read_images, scene_folder.read_masks):
            np.testing.assert_array_equal(read(ours), read(theirs))
        if not float_depth:
            ours, theirs = (
                each._replace(depths=tuple(path.with_suffix(".png") for path in each.depths))
                for each in (ours, theirs)
            )
        np.testing.assert_array_equal(
            scene_folder.read_distances(ours), scene_folder.read_distances(theirs)
        )


# Round trips.


def test_folders_come_back_as_they_were(ball, tmp_path):
    assert not _convert(ball, "raw", tmp_path / "raw")
    assert not _convert(tmp_path / "raw", "local", tmp_path / "back")
    assert _files(tmp_path / "back" / _NAME) == _files(ball)
    assert not _convert(ball, "local", tmp_path / "copied")
    assert _files(tmp_path / "copied" / _NAME) == _files(ball)


def test_parquet_files_come_back_without_maps_of_floats(ball, tmp_path):
    (ball / "normal").mkdir()
    (ball / "normal" / "r_000.exr").write_bytes(b"normals")
    (ball / "notes.txt").write_text("mine")
    left = _convert(ball, "parquet", tmp_path / "copy")
    assert left == {"depth/test/*.exr": 2, "image/test/*.exr": 1, "normal/*.exr": 1, "*.txt": 1}
    _convert(tmp_path / "copy", "local", tmp_path / "back")
    before, after = _files(ball), _files(tmp_path / "back" / _NAME)
    assert set(before) - set(after) == {
        "depth/test/r_000.exr",
        "depth/test/r_001.exr",
        "test/r_000.exr",
        "normal/r_000.exr",
        "notes.txt",
    }
    assert after == {place: before[place] for place in after}


def test_all_layouts_are_read_alike(ball, tmp_path):
    _convert(ball, "raw", tmp_path / "raw")
    _convert(tmp_path / "raw", "parquet", tmp_path / "copy")
    raw = scene_source.open_scene(tmp_path / "raw" / _RAW)
    unpacked = scene_source.open_scene(
        f"hf:cubebg_single-convex/{_NAME}", copies=[tmp_path / "copy"], cache=tmp_path / "cache"
    )
    _assert_same_frames(ball, raw)
    _assert_same_frames(ball, unpacked, float_depth=False)
    for scene in (raw, unpacked):
        (part,), (same,) = meshes.read_meshes(ball), meshes.read_meshes(scene)
        assert part.name == same.name and part.index == same.index
        np.testing.assert_array_equal(part.vertices, same.vertices)
        told = scene_properties.read(scene)
        assert told.background.extent == 7.3 and told.parts == scene_properties.read(ball).parts
        texture, other = (scene_assembly.read_background(each).texture for each in (ball, scene))
        np.testing.assert_array_equal(texture.texels, other.texels)


# Names and schema of the published layouts.


def test_names_of_the_raw_release(ball, tmp_path):
    _convert(ball, "raw", tmp_path)
    scene = tmp_path / _RAW
    assert {path.name for path in (scene / "test").iterdir()} == {
        *("r_0.png", "r_0.exr", "r_0_mask_0000.png", "r_0_depth_0000.png", "r_0_depth_0000.exr"),
        *("r_1.png", "r_1_mask_0000.png", "r_1_depth_0000.png", "r_1_depth_0000.exr"),
    }
    record = json.loads((scene / "transforms_test.json").read_text())["frames"][1]
    del record["transform_matrix"]
    assert record == {
        "file_path": "./test/r_1",
        "mask_file_path": "./test/r_1_mask_0000.png",
        "depth_file_path": "./test/r_1_depth_0000.png",
    }
    assert (tmp_path / "mesh_files" / "single-convex" / "ball_glass.ply").is_file()
    for name, folder in (
        ("sphere_smncvx_torus", "textured_sphere_scene/single-non-convex/torus_sphere"),
        ("env_mmncvx_wine_glass", "environment_map_scene/multiple-non-convex/wine_glass_hdr"),
    ):
        assert conversion.folder_of(name, "raw", tmp_path) == tmp_path / "image_data" / folder


def test_the_schema_of_hugging_face(ball, tmp_path):
    _convert(ball, "parquet", tmp_path)
    path = tmp_path / "data" / f"{_NAME}-00000-of-00001.parquet"
    table = pyarrow.parquet.read_table(path)
    assert table.schema.names == ["image", "depth", "mask", "transform_matrix"]
    features = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert [features[column]["_type"] for column in table.schema.names[:3]] == ["Image"] * 3
    assert features["transform_matrix"]["feature"]["feature"]["dtype"] == "float64"
    rows = table.to_pylist()
    assert len(rows) == _IMAGES
    assert rows[-1]["image"]["bytes"] == (ball / "test" / "r_001.png").read_bytes()
    assert rows[0]["depth"]["bytes"] == (ball / "depth" / "train" / "r_000.png").read_bytes()
    assert np.shape(rows[0]["transform_matrix"]) == (4, 4)


def test_large_scenes_are_several_files(ball, tmp_path, monkeypatch):
    size = sum(path.stat().st_size for path in ball.rglob("r_*.png"))
    monkeypatch.setattr(layout_parquet, "_BYTES_OF_A_SHARD", size / 2.5)
    monkeypatch.setattr(layout_parquet, "_ROWS_OF_A_GROUP", 1)
    _convert(ball, "parquet", tmp_path / "copy")
    names = [path.name for path in layout_parquet.files_of(parse(_NAME), tmp_path / "copy")]
    assert names == [f"{_NAME}-0000{i}-of-00003.parquet" for i in range(3)]
    _convert(tmp_path / "copy", "local", tmp_path / "back")
    _assert_same_frames(ball, tmp_path / "back" / _NAME, float_depth=False)


def test_a_field_of_view_of_its_own_is_kept(ball, tmp_path):
    for split in SPLITS:
        path = ball / f"transforms_{split}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": 0.5}))
    _convert(ball, "parquet", tmp_path / "copy")
    _convert(tmp_path / "copy", "local", tmp_path / "back")
    _assert_same_frames(ball, tmp_path / "back" / _NAME, float_depth=False)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": 0.6}))
    with scene_error("different fields of view", "Leave the scene as a folder"):
        _convert(ball, "parquet", tmp_path / "other")


def test_published_scenes_become_folders(tmp_path):
    for name in ("cube_smcvx_ball", "env_mmncvx_vial"):
        write_copy(tmp_path / "copy", name=name, rows=6)
    mesh = tmp_path / "copy" / "mesh_files" / "multiple-non-convex" / "vial_water.ply"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=1).export(mesh)
    _convert(tmp_path / "copy", "raw", tmp_path / "raw")
    vial = tmp_path / "raw" / "image_data/environment_map_scene/multiple-non-convex/vial_hdr"
    assert [part.name for part in meshes.read_meshes(vial)] == ["vial_water"]
    shutil.rmtree(vial / "meshes")  # as the authors' folders are
    assert [part.name for part in meshes.read_meshes(vial)] == ["vial_water"]
    assert scene_properties.read(vial).space == "unbounded"
    assert meshes.read_meshes(tmp_path / "raw" / _RAW) == []


def test_parts_of_a_material_are_published_in_one_file(tmp_path):
    parts = []
    for part, radius in (("shell_glass", 1.0), ("stopper_glass", 0.5), ("wine_water", 0.2)):
        mesh = trimesh.creation.icosphere(subdivisions=1, radius=radius)
        mesh.apply_translation([5.0 * radius, 0.0, 0.0])
        parts.append(tmp_path / f"vial_{part}.ply")
        mesh.export(parts[-1])
    published_meshes.write(parts, parse("cube_mmncvx_vial"), tmp_path)
    published_meshes.write(parts, parse("env_mmncvx_vial"), tmp_path)
    folder = tmp_path / "mesh_files" / "multiple-non-convex"
    assert {path.name for path in folder.iterdir()} == {"vial_glass.ply", "vial_water.ply"}
    assert (folder / "vial_water.ply").read_bytes() == parts[2].read_bytes()
    both = trimesh.load_mesh(folder / "vial_glass.ply")
    volumes = [trimesh.load_mesh(path).volume for path in parts[:2]]
    assert len(both.faces) == 160 and both.is_watertight
    assert both.volume == pytest.approx(sum(volumes), rel=1e-5)
    with scene_error("vial_glass.ply", "another mesh"):
        published_meshes.write(parts[:1], parse("sphere_mmncvx_vial"), tmp_path)


# Lists and cards.


def test_the_list_grows_and_the_card_names_all_scenes(tmp_path):
    for names in (["env_mmncvx_vial"], ["cube_smcvx_ball", "cube_smcvx_cube"]):
        path = dataset_card.add_to_list(tmp_path, names)
    assert path.read_text() == "cube_smcvx_ball\ncube_smcvx_cube\nenv_mmncvx_vial\n"
    card = dataset_card.write(tmp_path, dataset_card.names_in(tmp_path))
    assert card.read_text().startswith(
        "---\nconfigs:\n- config_name: cubebg_single-convex\n  data_files:\n"
        "  - split: cube_smcvx_ball\n    path: data/cube_smcvx_ball-*\n"
        "  - split: cube_smcvx_cube\n    path: data/cube_smcvx_cube-*\n"
        "- config_name: envbg_multiple-non-convex\n  data_files:\n"
    )
    assert dataset_card.write(tmp_path, dataset_card.names_in(tmp_path)) == card
    card.write_text("my own")
    assert dataset_card.write(tmp_path, dataset_card.names_in(tmp_path)) is None
    assert card.read_text() == "my own"


# What goes wrong.


@pytest.mark.parametrize("layout", ["local", "raw", "parquet"])
def test_an_interrupted_conversion_leaves_no_scene_and_can_be_repeated(
    ball, tmp_path, layout, monkeypatch
):
    (scene,), out = scene_folders.find(str(ball)), tmp_path / "out"
    out.mkdir()
    count = 0

    def fail():
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt

    with monkeypatch.context() as context:
        # As after kill -9: nothing is cleaned up.
        context.setattr(tempfile, "TemporaryDirectory", AbandonedFolder)
        with pytest.raises(KeyboardInterrupt):
            conversion.convert(scene, layout, out, step=fail)
    assert not conversion.is_there(_NAME, layout, out)
    with scene_error("holds no scene"):
        scene_folders.find(str(out))
    conversion.convert(scene, layout, out, step=lambda: None)
    assert conversion.is_there(_NAME, layout, out)
    assert [each.name for each in scene_folders.find(str(out))] == [_NAME]


def test_scenes_are_chosen_by_name_and_looked_at_before_anything_is_written(ball, tmp_path):
    other = cut_ball(ball.with_name("cube_smcvx_cube"))
    assert [each.name for each in scene_folders.find(str(ball.parent), [_NAME])] == [_NAME]
    with scene_error("no scene cube_smcvx_bal in", f"The nearest there is {_NAME}."):
        scene_folders.find(str(ball.parent), ["cube_smcvx_bal"])
    with scene_error("no scene xylophone", "There are cube_smcvx_ball, cube_smcvx_cube"):
        scene_folders.find(str(ball.parent), ["xylophone"])
    _convert(ball, "raw", tmp_path / "out")
    scenes = scene_folders.find(str(ball.parent))
    with pytest.raises(ValueError, match=r"1 of the 2 scenes already.*--scenes=cube_smcvx_cube"):
        conversion.check_space(scenes, "raw", tmp_path / "out")
    (other / "val" / "r_000.png").unlink()
    with scene_error("val/r_000.png", "does not exist"):
        scene_folders.find(str(ball.parent))
    (ball / "scene.json").write_text("{")
    with scene_error("scene.json", "not valid JSON"):
        scene_contents.named_extras(scene_contents.read(ball))


@pytest.mark.parametrize("layout", ["raw", "parquet"])
def test_a_name_that_the_published_layouts_do_not_know(ball, tmp_path, layout):
    toy = ball.rename(ball.with_name("toy"))
    with scene_error("'toy' is not the name of a scene", "cube_smcvx_toy"):
        conversion.check_space(scene_folders.find(str(toy)), layout, tmp_path)
    _convert(toy, "local", tmp_path / "out")
    assert _files(tmp_path / "out" / "toy") == _files(toy)


def test_depth_of_floats_alone_has_no_place_in_parquet_files(ball, tmp_path):
    path = ball / "transforms_test.json"
    content = json.loads(path.read_text())
    for record in content["frames"]:
        record["depth_file_path"] = record["depth_file_path"].replace(".png", ".exr")
    path.write_text(json.dumps(content))
    with scene_error("8-bit depth", "Write such a PNG"):
        _convert(ball, "parquet", tmp_path / "copy")
    _convert(ball, "raw", tmp_path / "raw")
    _assert_same_frames(ball, tmp_path / "raw" / _RAW)


def test_without_pyarrow_folders_are_converted(ball, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    _convert(ball, "raw", tmp_path / "raw")
    with scene_error("pyarrow", "pip install -e '.[parquet]'"):
        _convert(ball, "parquet", tmp_path / "copy")


# As a user has it.


def test_the_command_says_what_it_did_and_what_is_next(ball, tmp_path):
    options = (f"--scene={ball}", "--to=parquet", f"--out={tmp_path / 'copy'}")
    printed = run_command("dataset.convert", *options).stdout
    assert f"{_IMAGES}/{_IMAGES}" in printed
    assert "left out: 2 files depth/test/*.exr" in printed
    assert f"REFREF_HF={tmp_path / 'copy'} python -m experiments.train" in printed
    assert f"--scene={parse(_NAME).source}" in printed
    assert (tmp_path / "copy" / "scene_list.txt").read_text() == f"{_NAME}\n"
    again = run_command("dataset.convert", *options, fails=True)
    assert again.stderr.startswith("error:") and "holds 1 of the 1 scenes" in again.stderr


def test_commands_take_scenes_of_hugging_face(ball, tmp_path, monkeypatch):
    _convert(ball, "parquet", tmp_path / "copy")
    monkeypatch.setenv("REFREF_HF", str(tmp_path / "copy"))
    monkeypatch.setenv("REFREF_CACHE", str(tmp_path / "cache"))
    source = parse(_NAME).source
    _convert(source, "raw", tmp_path / "raw")
    _assert_same_frames(ball, tmp_path / "raw" / _RAW, float_depth=False)
    shutil.rmtree(tmp_path / "cache")
    shutil.rmtree(tmp_path / "copy" / "mesh_files")
    shutil.rmtree(tmp_path / "copy" / "scene_files" / _NAME / "meshes")
    # Refused once the scene is read.
    options = (f"--out={tmp_path / 'run'}", "--paths=straight", "--batch=99999999")
    refused = run_command("train", f"--scene={source}", *options, fails=True)
    assert f"unpack {_NAME} {_IMAGES}/{_IMAGES}" in refused.stdout
    assert "warning: cube_smcvx_ball has no meshes" in refused.stdout
    assert refused.stderr.startswith("error:") and "batch" in refused.stderr
