"""Backgrounds of scenes as they are written, read again by the library."""

import json

import numpy as np
import pytest

from experiments.dataset import backgrounds
from experiments.dataset.landscapes import ENVIRONMENTS, make_environment
from experiments.dataset.textures.faces import FACES, make_face
from experiments.dataset.textures.spheres import SPHERES
from refref_jax.data import image_files, scene_assembly, scene_properties
from refref_jax.render.backgrounds import CubeBackground, Environment, SphereBackground
from tests.processes.command import ROOT

_BUNDLED = ROOT / "experiments" / "data" / "cube_smcvx_ball"
_SIZE = 32


def _write(scene, kind, seed=0, size=_SIZE):
    record = backgrounds.write_background(scene, kind, seed=seed, size=size)
    (scene / "scene.json").write_text(json.dumps({"background": record}))
    return record


def test_a_cube_comes_back_with_the_walls_of_the_bundled_scene(tmp_path):
    record = _write(tmp_path, "cube", seed=4)
    read = scene_assembly.read_background(tmp_path)
    assert isinstance(read, CubeBackground) and read.half_extent == np.float32(7.3)
    told = scene_properties.read(tmp_path)
    assert (told.background.extent, told.space) == (7.3, "bounded")
    for wall, face in enumerate(record["faces"].values()):
        expected = make_face(face["texture"], _SIZE)
        # Half a step of eight bits.
        np.testing.assert_allclose(read.texture.texels[wall], expected, atol=0.5 / 255 + 1e-6)
    names = {path.name for path in (tmp_path / "background").iterdir()}
    assert names == {f"face_{wall}.png" for wall in ("+x", "-x", "+y", "-y", "+z", "-z")}
    bundled = json.loads((_BUNDLED / "scene.json").read_text())["background"]
    for walls in (record, bundled):
        names = [face.pop("texture") for face in walls["faces"].values()]
        assert len(set(names)) == 6 and set(names) <= set(FACES)
    assert record == bundled


def test_spheres_and_environments_come_back(tmp_path):
    record = _write(tmp_path, "sphere")
    read = scene_assembly.read_background(tmp_path)
    assert isinstance(read, SphereBackground) and read.radius == np.float32(7.3)
    assert read.texture.texels.shape == (_SIZE, 2 * _SIZE, 3)
    told = scene_properties.read(tmp_path)
    assert (told.background.extent, told.space) == (7.3, "spherical")
    assert record["texture"] in SPHERES
    record = _write(tmp_path, "env")
    read = scene_assembly.read_background(tmp_path)
    assert isinstance(read, Environment) and scene_properties.read(tmp_path).space == "unbounded"
    np.testing.assert_array_equal(read.texture.texels, make_environment(record["texture"], _SIZE))


@pytest.mark.parametrize("kind", ["cube", "sphere", "env"])
def test_the_same_seed_writes_the_same_bytes(tmp_path, kind):
    first, second = (_write(tmp_path / name, kind, seed=9) for name in "ab")
    assert first == second
    for path in sorted((tmp_path / "a" / "background").iterdir()):
        again = tmp_path / "b" / "background" / path.name
        if path.suffix == ".png":
            assert path.read_bytes() == again.read_bytes()
        else:
            np.testing.assert_array_equal(image_files.read_exr(path), image_files.read_exr(again))


def test_other_seeds_draw_others_and_all_are_drawn(monkeypatch, tmp_path):
    for maker in ("_face", "_sphere", "_environment"):
        monkeypatch.setattr(
            backgrounds, maker, lambda name, size: np.zeros((size, size, 3), np.float32)
        )
    drawn = {kind: set() for kind in backgrounds.KINDS}
    for seed in range(60):
        for kind in backgrounds.KINDS:
            record = backgrounds.write_background(tmp_path, kind, seed=seed, size=2)
            faces = record.get("faces", {"only": record})
            drawn[kind] |= {face["texture"] for face in faces.values()}
    assert drawn == {"cube": set(FACES), "sphere": set(SPHERES), "env": set(ENVIRONMENTS)}


def test_a_file_that_is_cut_off_leaves_the_old_one(monkeypatch, tmp_path):
    _write(tmp_path, "env")
    path = tmp_path / "background" / "env.exr"
    whole = path.read_bytes()

    def cut_off(path, pixels):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(image_files, "write_exr", cut_off)
    with pytest.raises(KeyboardInterrupt):
        _write(tmp_path, "env", seed=1)
    assert path.read_bytes() == whole


def test_wrong_kinds_and_sizes_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"no background 'box'\. Choose from cube, sphere, env"):
        backgrounds.write_background(tmp_path, "box", seed=0, size=16)
    for kind in backgrounds.KINDS:
        with pytest.raises(ValueError, match=r"is too small\. Request 16"):
            backgrounds.write_background(tmp_path, kind, seed=0, size=8)
