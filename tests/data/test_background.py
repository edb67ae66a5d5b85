import json

import pytest

from refref_jax.data.background import half_extent, is_unbounded
from tests.data.expectations import scene_error


def _scene(folder, content=None):
    folder.mkdir()
    if content is not None:
        (folder / "scene.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("name", "unbounded"),
    [
        ("env_smcvx_ball", True),
        ("cube_smcvx_ball", False),
        ("sphere_mmncvx_flask", False),
        ("my_env_scene", False),
        ("env", True),
    ],
)
def test_the_folder_s_name_tells_the_background(tmp_path, name, unbounded):
    assert is_unbounded(_scene(tmp_path / name)) is unbounded


def test_only_the_folder_s_own_name_counts(tmp_path):
    parent = _scene(tmp_path / "env_data")
    assert not is_unbounded(_scene(parent / "cube_smcvx_ball"))


def test_a_relative_path_is_resolved(tmp_path, monkeypatch):
    scene = _scene(tmp_path / "env_smcvx_ball")
    monkeypatch.chdir(scene)
    assert is_unbounded(type(scene)("."))


@pytest.mark.parametrize(("kind", "unbounded"), [("env", True), ("cube", False), ("sphere", False)])
@pytest.mark.parametrize("name", ["env_ball", "cube_ball"])
def test_scene_json_decides_before_the_name(tmp_path, name, kind, unbounded):
    scene = _scene(tmp_path / name, {"background": {"type": kind}})
    assert is_unbounded(scene) is unbounded


@pytest.mark.parametrize("content", [{}, {"parts": []}, {"background": {}}])
def test_scene_json_may_be_silent(tmp_path, content):
    assert is_unbounded(_scene(tmp_path / "env_ball", content))
    assert not is_unbounded(_scene(tmp_path / "cube_ball", content))


@pytest.mark.parametrize(
    "content", [{"background": None}, {"background": 7}, {"background": {"type": ["env"]}}]
)
def test_scene_json_of_another_shape(tmp_path, content):
    with scene_error("scene.json", "or remove the file"):
        is_unbounded(_scene(tmp_path / "env_ball", content))


@pytest.mark.parametrize("content", [[], 7])
def test_scene_json_that_is_no_object(tmp_path, content):
    with scene_error("scene.json", "not a JSON object"):
        is_unbounded(_scene(tmp_path / "env_ball", content))


def test_scene_json_tells_where_the_walls_stand(tmp_path, ball_scene):
    assert half_extent(ball_scene) == 7.3
    assert half_extent(_scene(tmp_path / "a", {"background": {"half_extent": 3}})) == 3.0
    assert half_extent(_scene(tmp_path / "b", {"background": {"type": "cube"}})) is None
    assert half_extent(_scene(tmp_path / "c")) is None


@pytest.mark.parametrize("wrong", ["7", 0, -1.0, [7.3]])
def test_walls_stand_at_a_positive_distance(tmp_path, wrong):
    with scene_error("scene.json", "half_extent", "positive number"):
        half_extent(_scene(tmp_path / "a", {"background": {"half_extent": wrong}}))


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00"])
def test_scene_json_that_is_no_json(tmp_path, content):
    scene = _scene(tmp_path / "env_ball")
    (scene / "scene.json").write_bytes(content)
    with scene_error("scene.json", "not valid JSON"):
        is_unbounded(scene)


def test_bundled_scene_has_walls(ball_scene):
    assert not is_unbounded(ball_scene)
