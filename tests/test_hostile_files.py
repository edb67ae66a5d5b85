"""JSON files that are damaged, hostile or somebody else's: one line that names the file, always."""

import json
import shutil

import pytest

from experiments.benchmarking import settings
from experiments.r3f import object_source, records
from refref_jax.data import meshes, scene_assembly, scene_folder, scene_properties
from refref_jax.render import checkpoint_io
from refref_jax.training import config_files, run_folder
from refref_jax.training.config import TrainConfig
from tests.factories.small_model import SAVED

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
    "properties": scene_properties.read,
    "overlay": lambda scene: scene_properties.check_file(scene / "scene.json"),
    "background": scene_assembly.read_background,
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


_LARGE = 10**400

_VALUES = {
    "cut": ({"paths": {"cut": _LARGE}}, "TrainConfig.paths.min_throughput is too large"),
    "seed": ({"seed": -_LARGE}, "TrainConfig.seed is too large"),
    "samples": (
        {"model": {"samples": [_LARGE]}},
        "TrainConfig.model.samples_per_ray[0] is too large",
    ),
    "end of text": ({"scene": {"path": "a\0b"}}, "TrainConfig.scene.path is 'a\\x00b', "),
    "half a character": ({"scene": {"path": "\ud800x"}}, "scene.path is '\\ud800x', "),
    "unknown wish": ({"chosen": ["seed", "cot"]}, "chosen names 'cot'"),
}


@pytest.mark.parametrize(("content", "message"), _VALUES.values(), ids=_VALUES)
def test_a_value_that_nothing_can_hold_is_refused_with_its_file_and_key(tmp_path, content, message):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError) as caught:
        config_files.read_to_begin(path)
    assert message in str(caught.value) and "mine.json" in str(caught.value)
    str(caught.value).encode()  # it can be printed


def test_a_number_that_is_too_large_is_refused_in_a_model_and_in_python(tmp_path):
    checkpoint_io.write_static(tmp_path, SAVED)
    content = json.loads((tmp_path / "model.json").read_text())
    content["settings"]["min_throughput"] = _LARGE
    (tmp_path / "model.json").write_text(json.dumps(content))
    with pytest.raises(
        ValueError, match=r"model\.json .*SavedModel\.settings\.min_throughput is too large"
    ):
        checkpoint_io.read_static(tmp_path)
    with pytest.raises(ValueError, match="min_throughput is too large"):
        TrainConfig().override(min_throughput=_LARGE)


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    (tmp_path / "mine.json").write_bytes(b'\xef\xbb\xbf{"seed": 3}')
    assert config_files.read_to_begin(tmp_path / "mine.json").seed == 3
