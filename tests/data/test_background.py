import json

import pytest

from refref_jax.data.background import half_extent, space
from tests.data.expectations import scene_error


def _scene(folder, content=None):
    folder.mkdir()
    if content is not None:
        (folder / "scene.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("env_smcvx_ball", "unbounded"),
        ("cube_smcvx_ball", "bounded"),
        ("sphere_mmncvx_flask", "bounded"),
        ("my_env_scene", "bounded"),
        ("env", "unbounded"),
    ],
)
def test_the_folder_s_name_tells_the_background(tmp_path, name, expected):
    assert space(_scene(tmp_path / name)) == expected


def test_only_the_folder_s_own_name_counts(tmp_path):
    parent = _scene(tmp_path / "env_data")
    assert space(_scene(parent / "cube_smcvx_ball")) == "bounded"


def test_a_relative_path_is_resolved(tmp_path, monkeypatch):
    scene = _scene(tmp_path / "env_smcvx_ball")
    monkeypatch.chdir(scene)
    assert space(type(scene)(".")) == "unbounded"


@pytest.mark.parametrize(
    ("kind", "expected"), [("env", "unbounded"), ("cube", "bounded"), ("sphere", "bounded")]
)
@pytest.mark.parametrize("name", ["env_ball", "cube_ball"])
def test_scene_json_decides_before_the_name(tmp_path, name, kind, expected):
    scene = _scene(tmp_path / name, {"background": {"type": kind}})
    assert space(scene) == expected


@pytest.mark.parametrize("content", [{}, {"parts": []}, {"background": {}}])
def test_scene_json_may_be_silent(tmp_path, content):
    assert space(_scene(tmp_path / "env_ball", content)) == "unbounded"
    assert space(_scene(tmp_path / "cube_ball", content)) == "bounded"


@pytest.mark.parametrize(
    "content", [{"background": None}, {"background": 7}, {"background": {"type": ["env"]}}]
)
def test_scene_json_of_another_shape(tmp_path, content):
    with scene_error("scene.json", "or remove the file"):
        space(_scene(tmp_path / "env_ball", content))


@pytest.mark.parametrize("content", [[], 7])
def test_scene_json_that_is_no_object(tmp_path, content):
    with scene_error("scene.json", "not a JSON object"):
        space(_scene(tmp_path / "env_ball", content))


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
        space(scene)


def test_bundled_scene_has_walls(ball_scene):
    assert space(ball_scene) == "bounded"
