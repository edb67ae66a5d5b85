import json
import os
import sys
import tempfile
import time
import types
import warnings

import pytest
import trimesh

from refref_jax.data import meshes, parquet_scenes, scene_folder, scene_properties
from refref_jax.data.scene_source import SceneWarning, expand, open_scene
from tests.factories.small_parquet import CONFIG, NAME, write_copy
from tests.factories.small_scenes import truncate, write_scene
from tests.fakes.abandoned_folder import AbandonedFolder
from tests.laws.expectations import scene_error

_SOURCE = f"hf:{CONFIG}/{NAME}"
_MESHES = "mesh_files/single-convex"


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A local copy of the published repositories, with a scene of six views and its mesh."""
    folder = tmp_path / "RefRef"
    write_copy(folder, rows=6)
    _write_mesh(folder / _MESHES / "ball_glass.ply")
    monkeypatch.setenv("REFREF_HF", str(folder))
    monkeypatch.setenv("REFREF_CACHE", str(tmp_path / "cache"))
    return folder


def _write_mesh(path, radius=1.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.icosphere(subdivisions=1, radius=radius).export(path)


def test_a_folder_is_returned_as_it_is(tmp_path):
    scene = write_scene(tmp_path / "toy")
    assert open_scene(scene) == open_scene(str(scene)) == scene
    assert open_scene("nowhere").name == "nowhere"  # its readers say what is missing


def test_a_scene_is_unpacked_with_its_meshes(copy, tmp_path):
    _write_mesh(copy / _MESHES / "ball_coloured_glass.ply", radius=0.5)
    _write_mesh(copy / _MESHES / "ball_glass_est.ply", radius=0.6)
    steps = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = open_scene(_SOURCE, progress=lambda done, total: steps.append((done, total)))
    assert scene.name == NAME and scene.is_relative_to(tmp_path / "cache")
    assert steps[-1] == (6, 6)
    scene_folder.check_scene(scene)
    (part,) = meshes.read_meshes(scene)
    assert part.name == "ball_glass" and part.index == 1.5
    assert (scene / "meshes/ball_glass.ply").read_bytes() == (
        copy / _MESHES / "ball_glass.ply"
    ).read_bytes()
    assert scene_properties.read(scene).space == "bounded"


def test_a_scene_is_unpacked_once(copy, monkeypatch):
    scene = open_scene(_SOURCE)
    monkeypatch.setattr(parquet_scenes, "unpack", None)
    assert open_scene(_SOURCE) == scene


def test_what_changes_in_the_copy_is_unpacked_anew(copy):
    scene = open_scene(_SOURCE)
    write_copy(copy, rows=9)
    longer = open_scene(_SOURCE)
    assert longer != scene
    assert len(scene_folder.read_frames(longer, "val").names) == 3
    assert len(scene_folder.read_frames(scene, "val").names) == 2  # whoever reads it goes on


def test_files_may_be_in_the_folder_of_the_configuration(tmp_path):
    elsewhere = tmp_path / "other"
    write_copy(elsewhere, rows=9, folder=CONFIG)
    _write_mesh(elsewhere / _MESHES / "ball_glass.ply")
    scene = open_scene(_SOURCE, copies=[elsewhere], cache=tmp_path / "cache")
    assert len(scene_folder.read_frames(scene, "train").names) == 3


def test_several_folders_may_be_given(tmp_path, monkeypatch):
    images, additional = tmp_path / "RefRef", tmp_path / "RefRef_additional"
    write_copy(images, rows=6)
    _write_mesh(additional / _MESHES / "ball_glass.ply")
    monkeypatch.setenv("REFREF_HF", os.pathsep.join(map(str, (images, additional))))
    scene = open_scene(_SOURCE, cache=tmp_path / "cache")
    assert [part.name for part in meshes.read_meshes(scene)] == ["ball_glass"]


def test_own_files_of_a_scene_go_before_the_published_meshes(copy):
    own = copy / "scene_files" / NAME
    _write_mesh(own / "meshes" / "ball_body_water.ply")
    (own / "scene.json").write_text('{"background": {"type": "env", "image": "sky/a.exr"}}')
    (own / "sky").mkdir()
    (own / "sky" / "a.exr").write_bytes(b"sky")
    scene = open_scene(_SOURCE)
    assert [part.name for part in meshes.read_meshes(scene)] == ["ball_body_water"]
    assert (scene / "sky" / "a.exr").read_bytes() == b"sky"
    assert scene_properties.read(scene).space == "unbounded"


def test_without_meshes_a_scene_is_read_with_a_warning(copy):
    (copy / _MESHES / "ball_glass.ply").unlink()
    with pytest.warns(SceneWarning, match=f"{_MESHES} of a folder in REFREF_HF") as caught:
        scene = open_scene(_SOURCE)
    assert str(scene / "meshes") in str(caught[0].message)
    assert meshes.read_meshes(scene) == []
    scene_folder.check_scene(scene)


def test_a_scene_that_was_unpacked_in_part_is_never_used(copy, tmp_path, monkeypatch):
    class PowerFailure(BaseException):
        pass

    def fail(done, total):
        if done == 4:
            raise PowerFailure

    with monkeypatch.context() as context:
        # As after kill -9: nothing is cleaned up.
        context.setattr(tempfile, "TemporaryDirectory", AbandonedFolder)
        with pytest.raises(PowerFailure):
            open_scene(_SOURCE, progress=fail)
    (abandoned,) = (tmp_path / "cache").glob("*/.unpacking-*")
    assert list(abandoned.rglob("*.png"))
    scene = open_scene(_SOURCE)
    scene_folder.check_scene(scene)
    assert len(scene_folder.read_frames(scene, "test").names) == 2
    assert abandoned.is_dir()  # another process may be at it
    long_ago = time.time() - 100_000
    os.utime(abandoned, (long_ago, long_ago))
    scene.rename(scene.with_name("away"))
    open_scene(_SOURCE)
    assert not abandoned.exists()


def test_a_scene_that_another_process_has_unpacked_meanwhile_is_used(copy):
    scenes = []

    def meanwhile(done, total):
        if done == total and not scenes:
            scenes.append(None)
            scenes[0] = open_scene(_SOURCE)

    assert open_scene(_SOURCE, progress=meanwhile) == scenes[0]
    scene_folder.check_scene(scenes[0])


def test_a_broken_file_leaves_nothing_behind(copy, tmp_path):
    truncate(next((copy / "data").iterdir()))
    with scene_error("truncated", "copy it again"):
        open_scene(_SOURCE)
    assert not list((tmp_path / "cache").rglob("*.png"))


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("hf:cubebg_single-convex/cube_smcvx_bal", (f"The nearest there is {_SOURCE}.",)),
        ("hf:cubebg_single-convex/cube_smcvx_xylophone", ("no scene", "Copy its files there")),
        ("hf:cubebg_single-convx/cube_smcvx_ball", ("Write cubebg_single-convex",)),
        ("hf:spherebg_single-convex/cube_smcvx_ball", (_SOURCE,)),
    ],
)
def test_a_scene_that_there_is_not(copy, source, words):
    with pytest.raises(ValueError) as caught:
        open_scene(source)
    assert all(word in str(caught.value) for word in words)


def test_an_object_of_another_category_is_suggested(copy):
    for name in ("env_mmncvx_ampoule", "cube_mmncvx_ampoule", "sphere_mmncvx_ampoule"):
        write_copy(copy, name=name, rows=3)
    with pytest.raises(ValueError, match="hf:cubebg_multiple-non-convex/cube_mmncvx_ampoule"):
        open_scene("hf:cubebg_single-convex/cube_smcvx_ampoule")


def test_a_missing_shard(copy):
    write_copy(copy, name="cube_smcvx_cube", rows=9, shards=3)[1].unlink()
    with scene_error("File 1 of the 3 parquet files of cube_smcvx_cube", "is missing"):
        open_scene("hf:cubebg_single-convex/cube_smcvx_cube")


def test_a_scene_that_is_there_twice(copy):
    write_copy(copy, rows=9, shards=3)
    with scene_error("more than once", "Keep only one set"):
        open_scene(_SOURCE)


def test_a_copy_that_is_no_folder(copy, monkeypatch):
    monkeypatch.setenv("REFREF_HF", "nowhere")
    with scene_error("nowhere is not a folder", "or REFREF_HF"):
        open_scene(_SOURCE)


def test_the_folder_of_a_copy_is_no_scene(copy):
    with scene_error("1 scenes, not a scene", f"REFREF_HF={copy}", _SOURCE):
        open_scene(copy)


def test_a_bare_name_of_a_material_is_a_mesh_of_the_object_named_so(copy):
    write_copy(copy, name="cube_smcvx_diamond", rows=3)
    source = "hf:cubebg_single-convex/cube_smcvx_diamond"
    _write_mesh(copy / _MESHES / "diamond.ply")
    (part,) = meshes.read_meshes(open_scene(source))
    assert part.name == "diamond" and part.index == 2.418
    # It is not a mesh of other objects, and a name with the object goes before.
    assert [part.name for part in meshes.read_meshes(open_scene(_SOURCE))] == ["ball_glass"]
    _write_mesh(copy / _MESHES / "diamond_diamond.ply")
    assert [part.name for part in meshes.read_meshes(open_scene(source))] == ["diamond_diamond"]


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        (None, {"rule": "facing"}),
        ({"background": {"type": "env"}}, {"rule": "facing", "background": {"type": "env"}}),
        ({"rule": "nested", "parts": []}, {"rule": "nested", "parts": []}),
    ],
)
def test_an_unpacked_scene_states_the_rule_of_cycles(copy, own, expected):
    if own is not None:
        (copy / "scene_files" / NAME).mkdir(parents=True)
        (copy / "scene_files" / NAME / "scene.json").write_text(json.dumps(own))
    assert json.loads((open_scene(_SOURCE) / "scene.json").read_text()) == expected


def test_a_broken_scene_json_is_left_to_its_readers(copy):
    (copy / "scene_files" / NAME).mkdir(parents=True)
    (copy / "scene_files" / NAME / "scene.json").write_text("{")
    scene = open_scene(_SOURCE)
    assert (scene / "scene.json").read_text() == "{"
    with scene_error("scene.json", "not valid"):
        meshes.read_meshes(scene)


def test_patterns_are_expanded_from_a_copy(copy):
    for name in ("sphere_smcvx_ball", "cube_smcvx_cube", "cube_mmncvx_cup"):
        write_copy(copy, name=name, rows=3)
    assert expand("hf:all") == [
        "hf:cubebg_multiple-non-convex/cube_mmncvx_cup",
        _SOURCE,
        "hf:cubebg_single-convex/cube_smcvx_cube",
        "hf:spherebg_single-convex/sphere_smcvx_ball",
    ]
    assert expand(f"hf:{CONFIG}") == expand("hf:*/cube_smcvx_*") == expand("hf:all")[1:3]
    for source in (_SOURCE, "scenes/*", "hf:nonsense"):
        assert expand(source) == [source]


@pytest.mark.parametrize(
    ("pattern", "near"),
    [
        ("hf:*/cube_smcvx_bal", _SOURCE),
        ("hf:cubebg_single-convx*", f"hf:{CONFIG}"),
        ("hf:spherebg_*/*", _SOURCE),
    ],
)
def test_a_pattern_without_a_match(copy, pattern, near):
    with pytest.raises(ValueError) as caught:
        expand(pattern)
    message = str(caught.value)
    assert message.startswith(f"{pattern} matches none of the 1 scenes in {copy}. The nearest")
    assert near in message and "\n" not in message


def test_a_pattern_without_any_parquet_files(tmp_path):
    with scene_error("hf:all matches no scene", str(tmp_path), "Set REFREF_HF"):
        expand("hf:all", copies=[tmp_path])


# Hugging Face itself, by a client that the test replaces.


class _Client(types.ModuleType):
    def __init__(self, repositories):
        super().__init__("huggingface_hub")
        self.repositories, self.asked = repositories, []
        self.HfApi = lambda: self

    def list_repo_files(self, repository, *, repo_type):
        assert repo_type == "dataset"
        self.asked.append(repository)
        folder = self.repositories[repository]
        return [path.relative_to(folder).as_posix() for path in folder.rglob("*.p*")]

    def hf_hub_download(self, repository, name, *, repo_type):
        assert repo_type == "dataset"
        self.asked.append(name)
        return str(self.repositories[repository] / name)


def test_without_a_copy_files_are_downloaded_once(tmp_path, monkeypatch):
    images, additional = tmp_path / "1", tmp_path / "2"
    write_copy(images, rows=6)
    write_copy(images, name="cube_smcvx_cube", rows=6)
    _write_mesh(additional / _MESHES / "ball_glass.ply")
    client = _Client({"yinyue27/RefRef": images, "yinyue27/RefRef_additional": additional})
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)
    monkeypatch.delenv("REFREF_HF", raising=False)
    assert expand("hf:*/*_cube") == ["hf:cubebg_single-convex/cube_smcvx_cube"]
    client.asked.clear()
    scene = open_scene(_SOURCE, cache=tmp_path / "cache")
    scene_folder.check_scene(scene)
    assert [part.name for part in meshes.read_meshes(scene)] == ["ball_glass"]
    assert client.asked[2:] == [f"data/{NAME}-00000-of-00001.parquet", f"{_MESHES}/ball_glass.ply"]
    monkeypatch.setitem(sys.modules, "huggingface_hub", _Client({}))
    assert open_scene(_SOURCE, cache=tmp_path / "cache") == scene  # no network is needed


def test_a_download_that_fails(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", _Client({}))
    with scene_error("yinyue27/RefRef", "KeyError", "REFREF_HF"):
        open_scene(_SOURCE, copies=[], cache=tmp_path)


def test_without_copy_and_client(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with scene_error("neither a local copy", "REFREF_HF", "pip install huggingface_hub"):
        open_scene(_SOURCE, copies=[], cache=tmp_path)


def test_a_folder_of_the_raw_release_finds_the_published_meshes(tmp_path):
    scene = write_scene(tmp_path / "image_data/environment_map_scene/single-convex/ball_hdr")
    for name in ("ball_glass", "ball_coloured_glass", "ball_glass_est", "cube_glass"):
        _write_mesh(tmp_path / _MESHES / f"{name}.ply")
    assert [part.name for part in meshes.read_meshes(open_scene(scene))] == ["ball_glass"]
    assert scene_properties.read(scene).space == "unbounded"
    _write_mesh(scene / "meshes" / "ball_body_water.ply")
    assert [part.name for part in meshes.read_meshes(scene)] == ["ball_body_water"]


def test_a_bare_name_of_a_material_is_found_for_the_raw_release(tmp_path):
    place = tmp_path / "image_data/textured_sphere_scene/single-convex"
    scene, other = (write_scene(place / f"{name}_sphere") for name in ("diamond", "ball"))
    _write_mesh(tmp_path / _MESHES / "diamond.ply")
    (part,) = meshes.read_meshes(open_scene(scene))
    assert part.name == "diamond" and part.index == 2.418
    assert meshes.read_meshes(other) == []
