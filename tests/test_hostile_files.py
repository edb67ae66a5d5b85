"""JSON files that are damaged, hostile or somebody else's: one line that names the file, always."""

import shutil

import pytest

from experiments.benchmarking import settings
from experiments.r3f import object_source, records
from refref_jax.data import background, meshes, scene_folder
from refref_jax.render import checkpoint_io
from refref_jax.training import run_folder

_TEXTS = {
    "nested": b"[" * 200_000,
    "nested objects": b'{"a":' * 200_000,
    "not a number": b'{"frames": NaN, "seed": NaN, "parts": NaN, "background": NaN}',
    "truncated": b'{"frames": [{"file_path": "./train/r_0',
    "empty": b"",
    "list": b"[]",
    "null": b"null",
    "text": b'"scene"',
    "binary": b"\x89PNG\r\n\x1a\n\x00\xff",
    "foreign": b'{"nodes": [], "asset": {}, "frames": 3, "parts": 3, "background": 3}',
}

_READERS = {
    "transforms_train.json": scene_folder.check_scene,
    "config.json": run_folder.read_config,
    "model.json": checkpoint_io.read_static,
    "body.json": object_source.read,
    "reconstruction.json": records.read,
    "benchmark.json": settings.read,
}

_SCENE_READERS = {
    "meshes": lambda scene: meshes.read_meshes(scene, indices={}),
    "space": background.space,
    "extent": background.half_extent,
    "background": background.read_background,
}


def _assert_refused(read, folder, name):
    with pytest.raises((ValueError, OSError)) as caught:
        read(folder)
    assert "\n" not in str(caught.value) and name in str(caught.value)


@pytest.mark.parametrize("text", _TEXTS.values(), ids=_TEXTS)
@pytest.mark.parametrize(("name", "read"), _READERS.items(), ids=_READERS)
def test_a_file_that_is_not_what_it_should_be_is_refused_in_one_line(tmp_path, name, read, text):
    (tmp_path / name).write_bytes(text)
    _assert_refused(read, tmp_path, name)


@pytest.mark.parametrize("text", _TEXTS.values(), ids=_TEXTS)
@pytest.mark.parametrize("read", _SCENE_READERS.values(), ids=_SCENE_READERS)
def test_a_scene_json_is_read_or_refused_in_one_line(ball_scene, tmp_path, read, text):
    shutil.copytree(ball_scene / "meshes", tmp_path / "meshes")
    (tmp_path / "scene.json").write_bytes(text)
    try:
        read(tmp_path)
    except ValueError as error:
        assert "\n" not in str(error) and "scene.json" in str(error)
