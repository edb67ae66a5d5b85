import sys

import numpy as np
import pytest

from refref_jax.data import parquet_scenes, scene_folder
from refref_jax.data.parquet_scenes import METADATA_KEY, Contents
from refref_jax.geometry.cameras import focal_length, planar_depth_to_distance
from tests.factories.small_parquet import write_copy
from tests.factories.small_scenes import HEIGHT, WIDTH, truncate
from tests.laws.expectations import scene_error


def _unpack(shards, tmp_path, progress=lambda done, total: None):
    scene = tmp_path / "cube_smcvx_ball"
    scene.mkdir()
    parquet_scenes.unpack(shards, scene, progress=progress)
    return scene


def _told(frames, angle=1.0):
    return {METADATA_KEY: parquet_scenes.encode(Contents(frames, angle))}


@pytest.mark.slow
def test_three_hundred_rows_are_three_splits(tmp_path):
    steps = []
    shards = write_copy(tmp_path, shards=2)
    scene = _unpack(shards, tmp_path, lambda done, total: steps.append((done, total)))
    assert steps == [(i + 1, 300) for i in range(300)]
    scene_folder.check_scene(scene)
    for first, split in ((0, "train"), (100, "val"), (200, "test")):
        frames = scene_folder.read_frames(scene, split)
        cameras = frames.cameras
        assert cameras.focal == pytest.approx(focal_length(WIDTH, 1.1656107902526855), rel=1e-12)
        assert frames.names[0] == "r_000" and frames.names[-1] == "r_099"
        rows = np.arange(first, first + 100)
        np.testing.assert_array_equal(cameras.poses[:, 0, 3], rows)
        assert np.all(cameras.poses[:, 1, 3] == 1.0 / 3.0)  # not rounded on the way
        images = scene_folder.read_images(frames)
        np.testing.assert_array_equal(images[:, 0, 0, :2], np.stack([rows % 256, rows // 256], 1))
        masks = scene_folder.read_masks(frames)
        np.testing.assert_array_equal(masks.sum((1, 2)), 1)
        assert np.all(masks[np.arange(100), rows % masks.shape[1], rows % masks.shape[2]])
        depth = 1.0 + 10.5 * (1.0 - rows % 256 / 255.0)
        secant = planar_depth_to_distance(cameras, np.ones((1, HEIGHT, WIDTH)))[0, 2, 3]
        distances = scene_folder.read_distances(frames)[:, 2, 3]
        np.testing.assert_allclose(distances, depth * secant, rtol=1e-6)


def test_metadata_tells_splits_and_field_of_view(tmp_path):
    shards = write_copy(tmp_path, rows=7, metadata=_told({"train": 5, "val": 0, "test": 2}))
    scene = _unpack(shards, tmp_path)
    assert not (scene / "transforms_val.json").exists()
    test = scene_folder.read_frames(scene, "test")
    assert len(scene_folder.read_frames(scene, "train").names) == 5
    np.testing.assert_array_equal(test.cameras.poses[:, 0, 3], [5, 6])
    assert test.cameras.focal == pytest.approx(focal_length(WIDTH, 1.0))


def test_other_numbers_of_rows_are_thirds(tmp_path):
    shards = write_copy(tmp_path, rows=6)
    assert parquet_scenes.read_contents(shards).frames == {"train": 2, "val": 2, "test": 2}


@pytest.mark.parametrize("rows", [2, 301, 0])
def test_rows_that_are_no_thirds(tmp_path, rows):
    with scene_error("00000-of-00001.parquet", f"{rows} rows", "copy the files again"):
        parquet_scenes.read_contents(write_copy(tmp_path, rows=rows))


def test_rows_that_are_not_those_of_the_metadata(tmp_path):
    shards = write_copy(tmp_path, rows=6, metadata=_told({"train": 5, "val": 0, "test": 2}))
    with scene_error("6 rows", "5 train, 0 val, 2 test"):
        parquet_scenes.read_contents(shards)


@pytest.mark.parametrize("text", [b"", b"[]", b'{"frames": 3}', b'{"frames": {"train": -1}}'])
def test_metadata_that_is_broken(tmp_path, text):
    shards = write_copy(tmp_path, rows=6, metadata={METADATA_KEY: text})
    with scene_error("metadata", "Convert the scene again"):
        parquet_scenes.read_contents(shards)


@pytest.mark.parametrize("column", ["image", "transform_matrix"])
def test_a_missing_column(tmp_path, column):
    with scene_error(f"lacks the column {column}", "depth", "Use a file of the data set"):
        parquet_scenes.read_contents(write_copy(tmp_path, rows=3, drop=(column,)))


def test_masks_and_depth_maps_are_optional(tmp_path):
    def strip(rows):
        for each in rows:
            each["mask"] = None

    shards = write_copy(tmp_path, rows=3, edit=strip, drop=("depth",))
    frames = scene_folder.read_frames(_unpack(shards, tmp_path), "val")
    assert frames.masks is None and frames.depths is None
    assert len(scene_folder.read_images(frames)) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image": None}, ("row 4", "no image")),
        ({"image": {"bytes": None, "path": "r_4.png"}}, ("row 4", "no image")),
        ({"mask": None}, ("train", "no mask")),
        ({"transform_matrix": [[1.0, 0.0]]}, ("row 4", "4 x 4")),
        ({"transform_matrix": None}, ("row 4", "4 x 4")),
        ({"transform_matrix": (2.0 * np.eye(4)).tolist()}, ("row 4", "0 0 0 1")),
    ],
)
def test_a_broken_row(tmp_path, change, words):
    shards = write_copy(tmp_path, rows=15, edit=lambda rows: rows[4].update(change))
    with scene_error(*words):
        _unpack(shards, tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_file(tmp_path, share):
    (shard,) = write_copy(tmp_path, rows=6)
    truncate(shard, share)
    with scene_error(shard.name, "truncated", "copy it again"):
        parquet_scenes.read_contents([shard])


def test_a_file_that_is_broken_in_the_middle(tmp_path):
    (shard,) = write_copy(tmp_path, rows=300)
    content = bytearray(shard.read_bytes())
    content[100:20000] = bytes(19900)
    shard.write_bytes(content)
    with scene_error(shard.name, "copy it again"):
        _unpack([shard], tmp_path)


def test_without_pyarrow(tmp_path, monkeypatch):
    shards = write_copy(tmp_path, rows=3)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with scene_error("pyarrow", "pip install -e '.[parquet]'"):
        parquet_scenes.read_contents(shards)
