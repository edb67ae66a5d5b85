"""The properties of a scene: what `scene.json` and an overlay say, and what they may not say."""

import contextlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from experiments.dataset import backgrounds, render_settings, scene_record
from refref_jax.choices import Material
from refref_jax.data import SceneError, image_files, meshes, scene_properties
from refref_jax.data.scene_assembly import read_background
from refref_jax.data.scene_names import SceneName
from refref_jax.data.scene_properties import RECORDS, PartDescription, check_file, read
from tests.factories import small_dataset
from tests.laws.expectations import scene_error
from tests.processes.command import ROOT

_MESH = "meshes/cup_glass.ply"


def _examples(page="data_formats.md"):
    """Returns the examples of a page by the name of their file."""
    found = re.findall(
        r"<!-- example: (.*?) -->\n```\w+\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL
    )
    return dict(found)


def _scene(folder, content=None):
    folder.mkdir()
    if content is not None:
        (folder / "scene.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def make_scene(tmp_path):
    """Makes a scene of boxes with the given file names."""

    def make(*names):
        (tmp_path / "cube_toy" / "meshes").mkdir(parents=True)
        for name in names:
            trimesh.creation.box().export(tmp_path / "cube_toy" / "meshes" / name)
        return tmp_path / "cube_toy"

    return make


def _part(**values):
    return {"parts": [{"mesh": _MESH, **values}]}


def _background(**values):
    return {"background": values}


# What can be told.


def test_the_example_of_the_documentation_is_read_completely(tmp_path):
    scene = _scene(tmp_path / "cup", json.loads(_examples()["scene.json"]))
    told = read(scene)
    assert (told.rule, told.ambient_index, told.indices) == ("priority", 1.0, {"glass": 1.52})
    assert (told.space, told.background.kind, told.background.extent) == (
        "spherical",
        "sphere",
        7.3,
    )
    assert told.background.image == str(scene / "background/sphere.png")
    assert told.parts == {
        "cup_wall_glass.ply": PartDescription(
            None, "smooth", (0.95, 1.0, 0.95), (0.0, 0.0, 0.0), 2, True
        ),
        "cup_tea_water.ply": PartDescription(
            1.34, "auto", (1.0, 1.0, 1.0), (0.1, 0.4, 1.2), 1, True
        ),
    }
    assert set(told.origins.values()) == {scene / "scene.json"}


def test_the_materials_of_the_documentation_are_read(tmp_path):
    told = read(_scene(tmp_path / "flask", json.loads(_examples()["materials.json"])))
    glass, pin, stopper, film = told.parts.values()
    assert (glass.index, glass.material.dispersion) == (1.52, (1.51, 1.52, 1.53))
    assert glass.material.roughness == 0.1 and pin.material.kind == "conductor"
    assert pin.material.complex_index == ((0.18, 0.42, 1.37), (3.42, 2.35, 1.77))
    assert (stopper.material.kind, stopper.material.radiance) == ("opaque", None)
    assert (film.material.kind, film.index) == ("thin_sheet", 1.45)


def test_the_interior_of_a_part_is_clear_absorbing_or_a_field(tmp_path):
    found = {}
    for interior in ("clear", "absorbing", "field"):
        told = read(_scene(tmp_path / interior, _part(interior=interior)))
        found[interior] = next(iter(told.parts.values()))
    assert [part.colour_known for part in found.values()] == [True, False, False]
    assert [part.material.interior for part in found.values()] == [None, None, "field"]


def test_one_number_holds_for_all_colours(tmp_path):
    metal = read(_scene(tmp_path / "a", _part(kind="conductor", eta=0.2, k=3)))
    assert next(iter(metal.parts.values())).material.complex_index == ((0.2,) * 3, (3.0,) * 3)
    same = read(_scene(tmp_path / "b", _part(index=[1.5, 1.5, 1.5])))
    assert next(iter(same.parts.values())) == PartDescription(index=1.5)


def test_every_key_of_the_reader_is_documented():
    section = (ROOT / "docs/data_formats.md").read_text().split("## Properties of a scene")[1]
    tables = (
        scene_properties._TOP,
        scene_properties._BACKGROUND,
        scene_properties._FACE,
        scene_properties._PART,
    )
    keys = {key for table in tables for key in table}
    assert len(keys) > 30 and {key for key in keys if f"`{key}`" not in section} == set()


def test_a_scene_without_a_file_has_no_properties(tmp_path):
    told = read(_scene(tmp_path / "cube_ball"))
    assert (told.rule, told.ambient_index, told.parts, told.origins) == (None, 1.0, {}, {})
    assert told.background.kind is None and told.space == "bounded"


@pytest.mark.parametrize("kind", ["cube", "sphere", "env"])
def test_what_the_generator_writes_is_read(tmp_path, kind):
    record = backgrounds.write_background(tmp_path, kind, seed=0, size=64)
    per_split = render_settings.PerSplit(1, 1, 1)
    settings = render_settings.RenderSettings(8, per_split, per_split, rule="facing")
    name = SceneName(kind, "smcvx", "ball")
    part = small_dataset.box(2.0, absorption=(0.1, 0.0, 0.2))
    content = scene_record.describe(name, [part], record, settings)
    assert content["version"] == scene_properties.VERSION
    told = read(_scene(tmp_path / "scene", content))
    assert (told.rule, told.background.kind) == ("facing", kind)
    assert told.parts == {
        "ball_body_glass.ply": PartDescription(
            1.5, "flat", (1.0, 1.0, 1.0), (0.1, 0.0, 0.2), 0, True
        )
    }


def test_the_bundled_scene_is_read_with_its_records(ball_scene):
    content = json.loads((ball_scene / "scene.json").read_text())
    assert "version" not in content and set(content) & set(RECORDS[""])
    told = read(ball_scene)
    assert (told.rule, told.space, told.background.extent) == ("nested", "bounded", 7.3)
    assert told.parts["ball_body_glass.ply"].index == 1.5


def test_both_names_of_a_property_mean_the_same(tmp_path):
    now = _part(index=1.4, tint=[0.5, 1, 1], shading="flat")
    then = _part(ior_inside=1.4, colour_per_interface=[0.5, 1, 1], smooth_normals=False)
    assert read(_scene(tmp_path / "a", now)).parts == read(_scene(tmp_path / "b", then)).parts


def test_the_type_of_a_background_follows_from_its_size(tmp_path):
    assert read(_scene(tmp_path / "a", _background(radius=3))).space == "spherical"
    assert read(_scene(tmp_path / "env_b", _background(half_extent=3))).space == "bounded"


def test_a_material_of_scene_json_is_used_by_its_meshes(make_scene):
    scene = make_scene("a_glass.ply", "b_honey.ply")
    content = {"ior": {"glass": 1.6, "honey": 1.49}}
    (scene / "scene.json").write_text(json.dumps(content))
    assert [part.index for part in meshes.read_meshes(scene)] == [1.6, 1.49]
    assert [part.index for part in meshes.read_meshes(scene, indices={"honey": 2.0})] == [1.6, 2.0]
    (scene / "scene.json").write_text(json.dumps({"ior": {"honey": 1.49, "tea": 1.3}}))
    with scene_error("scene.json", "ior.tea", "fits no mesh"):
        meshes.read_meshes(scene)


def test_the_reader_does_not_import_jax():
    code = "import sys; from refref_jax.data import scene_properties; print('jax' in sys.modules)"
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "False"


# What is refused: the content, and what the message says next to the name of the file.

_WRONG = {
    "unknown key": ({"rul": "nested"}, "rul is not a known key. Write 'rule', or remove it."),
    "foreign key": ({"zzz": 1}, "zzz is not a known key. The keys are version, rule, "),
    "newer version": ({"version": 2}, "version is 2. Give 1, the version that this library reads."),
    "rule": ({"rule": "nestd"}, "rule is 'nestd'. Give one of nested, facing, priority: nested?"),
    "ambient": ({"ambient_index": 0}, "ambient_index is 0. Give a positive number, such as "),
    "material": ({"ior": {"glass": "1.5"}}, "ior.glass is '1.5'. Give a positive number"),
    "materials": ({"ior": 1.5}, "ior is 1.5. Give an object"),
    "type": (_background(type="box"), "background.type is 'box'. Give one of cube, sphere, env."),
    "no type": (_background(image="a.png"), "background lacks the key 'type'."),
    "key of a background": (_background(radios=7), "background.radios is not a known key."),
    "key of another type": (
        _background(type="sphere", half_extent=7),
        "background.half_extent has no effect on a background of type sphere",
    ),
    "radius": (_background(type="sphere", radius=-7), "background.radius is -7. Give a positive"),
    "centre": (
        _background(type="cube", centre=[0, 0, "1"]),
        "background.centre is [0, 0, '1']. Give three numbers.",
    ),
    "centre at infinity": (
        _background(type="sphere", centre=[0, 0, 1e400]),
        "background.centre is [0, 0, inf]. Give three numbers.",
    ),
    "centre of an environment": (
        _background(type="env", centre=[0, 0, 0]),
        "background.centre has no effect on a background of type env",
    ),
    "mapping": (_background(type="env", mapping="planar"), "background.mapping is 'planar'."),
    "face": (
        _background(type="cube", faces={"+x": {"normal": [1, 0]}}),
        "background.faces['+x'].normal is [1, 0]. Give three numbers.",
    ),
    "key of a face": (
        _background(type="cube", faces={"+x": {"imag": "a.png"}}),
        "background.faces['+x'].imag is not a known key. Write 'image', or remove it.",
    ),
    "key of a part": (
        _part(ior=1.5),
        "parts['cup_glass.ply'].ior is not a known key. ",
    ),
    "index": (_part(index=-1.5), "parts['cup_glass.ply'].index is -1.5. Give a positive number"),
    "dispersion": (
        _part(index=[1.5, 0, 1.6]),
        "index is [1.5, 0, 1.6]. Give a positive number, or",
    ),
    "key of dispersion": (_part(dispersion=55), ".dispersion is not a known key."),
    "tint": (_part(tint=[1, 1, 2]), "tint is [1, 1, 2]. Give three numbers from 0 to 1"),
    "absorption": (_part(absorption=-1), "absorption is -1. Give three numbers that are 0 or"),
    "priority": (_part(priority=1.5), "priority is 1.5. Give a whole number"),
    "shading": (_part(shading="soft"), "shading is 'soft'. Give one of auto, smooth, flat"),
    "roughness": (_part(roughness=1.5), "roughness is 1.5. Give a number from 0 to 1."),
    "kind": (_part(kind="opaq"), "kind is 'opaq'. Give one of dielectric, opaque, conductor, "),
    "interior": (_part(interior="empty"), "interior is 'empty'. Give one of clear, absorbing, "),
    "clear tea": (_part(interior="clear", tint=[1, 0, 0]), "is clear, but has a colour. Remove "),
    "radiance": (_part(kind="opaque", radiance="white"), "Give vertex_colours, or three numbers"),
    "radiance of glass": (_part(radiance=[1, 1, 1]), "has no effect on kind dielectric."),
    "index of a surface": (_part(kind="opaque", index=1.5), "no effect on kind opaque."),
    "metal without k": (_part(kind="conductor", eta=0.2), "lacks the key 'k' of a conductor."),
    "metal": (_part(kind="conductor", eta=0.2, k=-1), "k is -1. Give a non-negative number, or"),
    "two names": (_part(index=1.5, ior_inside=1.5), "has both 'index' and 'ior_inside'"),
    "part without mesh": ({"parts": [{"index": 1.5}]}, "parts[0] does not name a file"),
    "part twice": ({"parts": [{"mesh": _MESH}] * 2}, "parts describe cup_glass.ply twice."),
    "notes": ({"notes": 3}, "notes is 3. Give text."),
}


@contextlib.contextmanager
def one_line():
    try:
        yield
    except SceneError as error:
        assert "\n" not in str(error)
        raise


@pytest.mark.parametrize(("content", "message"), _WRONG.values(), ids=_WRONG)
def test_a_wrong_key_or_value_is_refused_in_one_line_with_file_and_key(tmp_path, content, message):
    scene = _scene(tmp_path / "cup", content)
    with scene_error(f"{scene / 'scene.json'}: ", message), one_line():
        read(scene)


@pytest.mark.parametrize("key", sorted({key for keys in RECORDS.values() for key in keys}))
def test_a_record_is_only_accepted_where_generators_write_it(tmp_path, key):
    places = {
        "": {key: "x"},
        "background": _background(type="env", **{key: "x"}),
        "face": _background(type="cube", faces={"+x": {key: "x"}}),
        "part": _part(**{key: "x"}),
    }
    known = {place for place, keys in RECORDS.items() if key in keys}
    for number, (place, content) in enumerate(places.items()):
        scene = _scene(tmp_path / str(number), content)
        if place in known:
            assert read(scene).space
        elif (place, key) != ("background", "faces"):
            with scene_error("scene.json", f"{key} is not a known key"):
                read(scene)


# Overlays.


def _overlaid(tmp_path, below, above):
    """Reads a scene with an overlay in another folder."""
    scene = _scene(tmp_path / "cube_cup", below)
    (tmp_path / "mine").mkdir()
    overlay = tmp_path / "mine" / "overlay.json"
    overlay.write_text(json.dumps(above))
    return read(scene, overlay=overlay), scene / "scene.json", overlay


def test_an_overlay_overrides_key_by_key(tmp_path):
    below = _part(ior_inside=1.5, priority=1, tint=[0.5] * 3) | {"rule": "nested", "notes": "mine"}
    above = _part(index=1.7, smooth_normals=True) | {"rule": "facing", "ambient_index": 1.33}
    told, own, overlay = _overlaid(tmp_path, below, above)
    assert (told.rule, told.ambient_index) == ("facing", 1.33)
    part = told.parts["cup_glass.ply"]
    assert part == PartDescription(1.7, "smooth", (0.5,) * 3, (0.0,) * 3, 1, True)
    assert told.origins["rule"] == overlay and told.origins["notes"] == own


def test_an_overlay_of_another_background_replaces_it(tmp_path, ball_scene):
    below = json.loads((ball_scene / "scene.json").read_text())
    above = json.loads(_examples()["overlay.json"])
    told, _, _ = _overlaid(tmp_path, below, above)
    assert (told.space, told.background.extent, told.background.faces) == ("spherical", 7.3, ())
    assert told.rule == "facing"


def test_an_overlay_of_the_same_background_changes_its_size(tmp_path, ball_scene):
    below = json.loads((ball_scene / "scene.json").read_text())
    told, _, _ = _overlaid(tmp_path, below, _background(half_extent=7))
    assert told.background.extent == 7.0 and len(told.background.faces) == 6


def test_images_of_an_overlay_are_next_to_it(tmp_path):
    told, _, overlay = _overlaid(tmp_path, None, _background(type="env", image="sky.png"))
    image_files.write_rgb(overlay.parent / "sky.png", np.zeros((4, 8, 3), np.float32))
    read = read_background(tmp_path / "cube_cup", properties=told)
    assert read.texture.texels.shape == (4, 8, 3)


def test_a_message_names_the_file_that_is_wrong(tmp_path):
    with scene_error("mine/overlay.json: rule is 'x'"):
        _overlaid(tmp_path, {"rule": "nested"}, {"rule": "x"})
    shutil.rmtree(tmp_path / "mine")
    shutil.rmtree(tmp_path / "cube_cup")
    with scene_error("scene.json: parts['cup_glass.ply'].index is 0"):
        _overlaid(tmp_path, _part(index=0), _part(priority=2))


def test_an_overlay_makes_a_wrong_value_right(tmp_path):
    told, _, _ = _overlaid(tmp_path, _part(roughness=0.3), _part(roughness=0))
    assert told.parts == {"cup_glass.ply": PartDescription()}


def test_an_overlay_that_describes_a_missing_mesh_is_named(make_scene, tmp_path):
    scene, overlay = make_scene("a_glass.ply"), tmp_path / "mine.json"
    overlay.write_text(json.dumps(_part(index=1.4)))
    with scene_error("mine.json describes cup_glass.ply"):
        meshes.read_meshes(scene, properties=read(scene, overlay=overlay))


def test_an_overlay_is_checked_by_itself(tmp_path):
    path = tmp_path / "mine.json"
    with scene_error("mine.json does not exist"):
        check_file(Path(path))
    for content, message in [({"rul": 1}, "'rule'"), (_part(indx=1.5), "'index'")]:
        path.write_text(json.dumps(content))
        with scene_error("mine.json", message):
            check_file(path)
    path.write_text(json.dumps(_background(half_extent=7)))
    assert check_file(path) is None


def test_the_published_layout_implies_a_rule_that_scene_json_overrides(tmp_path):
    scene = tmp_path / "textured_cube_scene" / "single-convex" / "ball"
    scene.mkdir(parents=True)
    told = read(scene)
    assert (told.rule, told.origins["rule"].name) == ("facing", "the published layout")
    (scene / "scene.json").write_text('{"rule": "nested"}')
    told = read(scene)
    assert (told.rule, told.origins["rule"]) == ("nested", scene / "scene.json")


def test_an_overlay_may_change_one_value_of_a_metal(tmp_path):
    told, _, overlay = _overlaid(tmp_path, _part(kind="conductor", eta=0.2, k=3), _part(eta=0.3))
    scene_properties.check_file(overlay)
    assert next(iter(told.parts.values())).material.complex_index == ((0.3,) * 3, (3.0,) * 3)


def test_an_overlay_that_changes_the_kind_replaces_the_material(tmp_path):
    told, _, overlay = _overlaid(tmp_path, _part(index=1.5, tint=[1, 0, 0]), _part(kind="opaque"))
    scene_properties.check_file(overlay)
    assert next(iter(told.parts.values())) == PartDescription(material=Material("opaque"))
