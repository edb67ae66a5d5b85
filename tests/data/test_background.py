import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from refref_jax.data import image_files
from refref_jax.data.scene_assembly import read_background
from refref_jax.data.scene_properties import read
from refref_jax.render.backgrounds import (
    CubeBackground,
    Environment,
    LinearTexture,
    SphereBackground,
    SrgbTexture,
)
from tests.laws.expectations import scene_error


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
    assert read(_scene(tmp_path / name)).space == expected


def test_a_relative_path_is_resolved(tmp_path, monkeypatch):
    scene = _scene(tmp_path / "env_smcvx_ball")
    monkeypatch.chdir(scene)
    assert read(type(scene)(".")).space == "unbounded"


@pytest.mark.parametrize(
    ("kind", "expected"), [("env", "unbounded"), ("cube", "bounded"), ("sphere", "spherical")]
)
@pytest.mark.parametrize("name", ["env_ball", "cube_ball"])
def test_scene_json_decides_before_the_name(tmp_path, name, kind, expected):
    scene = _scene(tmp_path / name, {"background": {"type": kind}})
    assert read(scene).space == expected


@pytest.mark.parametrize("content", [{}, {"parts": []}, {"background": {}}])
def test_scene_json_may_be_silent(tmp_path, content):
    assert read(_scene(tmp_path / "env_ball", content)).space == "unbounded"
    assert read(_scene(tmp_path / "cube_ball", content)).space == "bounded"


@pytest.mark.parametrize(
    "content", [{"background": None}, {"background": 7}, {"background": {"type": ["env"]}}]
)
def test_scene_json_of_another_shape(tmp_path, content):
    with scene_error("scene.json", "background", "Give "):
        read(_scene(tmp_path / "env_ball", content))


def _ball_with(tmp_path, ball_scene, change):
    """Copies the bundled scene's background, and changes its record."""
    record = json.loads((ball_scene / "scene.json").read_text())["background"]
    change(record)
    scene = _scene(tmp_path / "cube_ball", {"background": record})
    shutil.copytree(ball_scene / "background", scene / "background")
    return scene


def _image(scene, name, value=0.25):
    pixels = np.full((4, 8, 3), value, np.float32)
    (image_files.write_exr if name.endswith(".exr") else image_files.write_rgb)(
        scene / name, pixels
    )


def test_the_walls_of_the_bundled_scene(ball_scene):
    walls = read_background(ball_scene)
    assert isinstance(walls, CubeBackground) and isinstance(walls.texture, SrgbTexture)
    assert walls.texture.texels.shape == (6, 256, 256, 3)
    assert walls.half_extent == np.float32(7.3)
    np.testing.assert_array_equal(walls.normals[:2], [[1, 0, 0], [-1, 0, 0]])
    np.testing.assert_array_equal(walls.u_axes[:2], [[0, 1, 0], [0, -1, 0]])
    np.testing.assert_array_equal(walls.v_axes[:2], [[0, 0, 1], [0, 0, 1]])
    expected = image_files.read_rgb(ball_scene / "background" / "face_-x.png") / 255.0
    np.testing.assert_allclose(walls.texture.texels[1], expected, rtol=1e-6)
    assert {leaf.dtype for leaf in jax.tree.leaves(walls)} == {np.dtype(np.float32)}
    assert walls.centre is None


def test_the_centre_of_the_background(tmp_path, ball_scene):
    told = read(ball_scene)
    for centre, expected in (((1.0, -2.5, 0.1), [1.0, -2.5, 0.1]), ((0.0, 0.0, 0.0), None)):
        moved = dataclasses.replace(told.background, centre=centre)
        cube = read_background(ball_scene, properties=dataclasses.replace(told, background=moved))
        record = {"type": "sphere", "radius": 5, "image": "sky.png", "centre": list(centre)}
        scene = _scene(tmp_path / f"{centre[0]}", {"background": record})
        _image(scene, "sky.png")
        for found in (cube, read_background(scene)):
            if expected is None:
                assert found.centre is None
            else:
                np.testing.assert_array_equal(found.centre, np.float32(expected))
                assert found.centre.dtype == np.float32


@pytest.mark.parametrize(("image", "kind"), [("sky.png", SrgbTexture), ("sky.exr", LinearTexture)])
def test_spheres_and_environments(tmp_path, image, kind):
    sphere = {"type": "sphere", "radius": 5, "image": image}
    for record in (sphere, {"type": "env", "image": image}):
        scene = _scene(tmp_path / record["type"], {"background": record})
        _image(scene, image)
        read = read_background(scene)
        assert isinstance(read, SphereBackground if record is sphere else Environment)
        assert isinstance(read.texture, kind) and read.texture.texels.shape == (4, 8, 3)
        np.testing.assert_allclose(read.texture.texels, 0.25, atol=1 / 255)
        assert record is not sphere or read.radius == 5.0


@pytest.mark.parametrize("content", [None, {}, {"background": {}}])
def test_a_background_that_is_not_told(tmp_path, content):
    with scene_error("scene.json", "unknown", "cube, sphere, env"):
        read_background(_scene(tmp_path / "a", content))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r.pop("half_extent"), ("half_extent", "Add it")),
        (lambda r: r.update(half_extent=-7.3), ("half_extent", "positive number")),
        (lambda r: r.pop("faces"), ("faces",)),
        (lambda r: r["faces"].pop("+x"), ("six",)),
        (lambda r: r["faces"]["+x"].update(image="no.png"), ("no.png does not exist",)),
        (lambda r: r["faces"]["+x"].update(image=7), ("image is 7",)),
        (lambda r: r["faces"]["+x"].pop("u_axis"), ("u_axis",)),
        (lambda r: r["faces"]["+x"].update(u_axis=[0, 2, 0]), ("'+x'", "perpendicular unit")),
        (lambda r: r["faces"]["+x"].update(u_axis="y"), ("'+x'", "three numbers")),
        (lambda r: r["faces"].update({"+x": r["faces"]["-x"]}), ("do not form a cube",)),
    ],
)
def test_walls_that_are_not_a_cube(tmp_path, ball_scene, change, words):
    scene = _ball_with(tmp_path, ball_scene, change)
    with scene_error("scene.json" if "exist" not in words[0] else "no.png", *words):
        read_background(scene)


@pytest.mark.parametrize("name", ["other.png", "other.exr"])
def test_walls_of_different_images(tmp_path, ball_scene, name):
    scene = _ball_with(tmp_path, ball_scene, lambda r: r["faces"]["+y"].update(image=name))
    _image(scene, name)
    with scene_error("scene.json", "one size"):
        read_background(scene)


def test_an_environment_that_is_not_finite(tmp_path):
    scene = _scene(tmp_path / "a", {"background": {"type": "env", "image": "sky.exr"}})
    _image(scene, "sky.exr", np.inf)
    with scene_error("sky.exr", "not finite"):
        read_background(scene)


def test_an_environment_of_one_channel(tmp_path):
    scene = _scene(tmp_path / "a", {"background": {"type": "env", "image": "sky.exr"}})
    image_files.write_exr(scene / "sky.exr", np.ones((4, 8), np.float32))
    with scene_error("sky.exr", "R, G and B"):
        read_background(scene)


@pytest.mark.parametrize("radius", [None, 0.0, "far"])
def test_a_sphere_has_a_radius(tmp_path, radius):
    record = {"type": "sphere", "image": "sky.png"}
    record |= {} if radius is None else {"radius": radius}
    scene = _scene(tmp_path / "a", {"background": record})
    _image(scene, "sky.png")
    with scene_error("scene.json", "radius"):
        read_background(scene)
