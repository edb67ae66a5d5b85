"""The properties of a scene reach its training: rule, ambient medium and overlay, with reasons."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from refref_jax.data import SceneError, meshes
from refref_jax.training import config_files, run_folder
from refref_jax.training.config import TrainConfig
from refref_jax.training.fit import prepare
from tests.factories import small_scenes

pytestmark = pytest.mark.loose

_PARTS = [{"mesh": "meshes/cup_glass.ply"}, {"mesh": "meshes/tea_water.ply"}]


@pytest.fixture
def scene(tmp_path):
    """Writes scenes of water inside glass, with the given properties."""

    def write(name="cube_smcvx_cup", **properties):
        folder = small_scenes.write_scene(tmp_path / name)
        (folder / "meshes").mkdir()
        trimesh.creation.box([2.0] * 3).export(folder / "meshes/cup_glass.ply")
        trimesh.creation.box([1.0] * 3).export(folder / "meshes/tea_water.ply")
        (folder / "scene.json").write_text(json.dumps({"parts": _PARTS, **properties}))
        return str(folder)

    return write


def _prepare(scene, parts=None, **given):
    """Returns the resolved run, the indices outside of glass and water, and the printed lines."""
    lines = []
    config = TrainConfig().override(scene=scene, batch=16, **given)
    made, built = prepare(config, parts=parts, report=lines.append)
    return made, np.asarray(built.interfaces.index_outside).tolist(), lines


def test_the_rule_of_scene_json_decides(scene):
    made, outside, _ = _prepare(scene(rule="facing"))
    assert (made.config.scene.rule, made.reasons["rule"]) == ("facing", "scene.json")
    assert outside == [1.0, 1.0]
    assert "  scene.json: " in made.describe() and "rule=facing" in made.describe()


def test_without_a_rule_parts_are_nested(scene):
    made, outside, lines = _prepare(scene())
    assert (made.config.scene.rule, made.reasons["rule"]) == ("nested", "by default")
    assert outside == [1.0, 1.5]
    assert not any("overrides" in line for line in lines)


def test_options_override_scene_json_and_say_so(scene):
    background = {"type": "sphere", "radius": 60.0}
    parts = [{**_PARTS[0], "index": 1.6}, _PARTS[1]]
    place = scene(rule="facing", background=background, parts=parts)
    given = {"rule": "nested", "radius": 70.0, "ior": {"glass": 1.7}}
    made, outside, lines = _prepare(place, **given)
    assert outside == [1.0, np.float32(1.7)] and made.config.scene.radius == 70.0
    assert made.reasons["rule"] == made.reasons["radius"] == "given"
    assert lines[-4:-1] == [
        "note: rule=nested overrides scene.json: facing.",
        "note: radius=70 overrides scene.json: 60.",
        "note: index=1.7 of cup_glass overrides scene.json: 1.6.",
    ]
    _, _, lines = _prepare(place, background="bounded")
    assert "note: background=bounded overrides scene.json: sphere." in lines


def test_the_ambient_medium_of_scene_json_is_around_all_parts(scene):
    assert _prepare(scene(ambient_index=1.25))[1] == [1.25, 1.5]
    assert _prepare(scene("facing", ambient_index=1.25, rule="facing"))[1] == [1.25, 1.25]


def test_an_overlay_decides_before_scene_json(scene, tmp_path):
    overlay = tmp_path / "mine.json"
    overlay.write_text('{"rule": "facing", "background": {"type": "sphere", "radius": 50}}')
    place = scene(rule="nested", background={"type": "cube", "half_extent": 73})
    made, outside, _ = _prepare(place, properties=str(overlay))
    assert outside == [1.0, 1.0] and made.config.scene.properties == str(overlay.resolve())
    found = [made.config.get(name) for name in ("rule", "background", "radius")]
    assert found == ["facing", "spherical", 50.0]
    assert made.reasons["rule"] == made.reasons["radius"] == "mine.json"
    assert _prepare(place)[0].config.scene.rule == "nested"
    overlay.write_text('{"rle": "facing"}')
    with pytest.raises(SceneError, match=r"mine\.json: rle is not a known key\. Write 'rule'"):
        _prepare(place, properties=str(overlay))


def test_the_rule_is_decided_again_for_another_scene_or_overlay(scene, tmp_path):
    overlay = tmp_path / "mine.json"
    overlay.write_text('{"rule": "nested"}')
    first, second = scene("a", rule="facing"), scene("b")
    made, _, _ = _prepare(first)
    assert made.config.override(scene=second).scene.rule is None
    assert made.config.override(properties=str(overlay)).scene.rule is None
    kept = _prepare(first, rule="facing")[0].config.override(scene=second)
    assert kept.scene.rule == "facing"


def test_a_configuration_of_an_earlier_version_keeps_its_rule(scene, tmp_path):
    place = scene(rule="facing")
    made, _, _ = _prepare(place, rule="nested")
    content = json.loads(json.dumps(dataclasses.asdict(made.config)))
    content["chosen"].remove("rule")
    del content["scene"]["properties"]
    (tmp_path / "config.json").write_text(json.dumps(content))
    again = config_files.read_to_begin(tmp_path / "config.json")
    assert again.scene.rule == "nested" and again.scene.properties == ""
    lines = []
    made, built = prepare(again, report=lines.append)
    assert made.reasons["rule"] == "as the configuration has it"
    assert np.asarray(built.interfaces.index_outside).tolist() == [1.0, 1.5]
    assert "note: rule=nested overrides scene.json: facing." in lines


def test_a_resolved_configuration_resolves_to_itself(scene):
    made, _, _ = _prepare(scene(rule="facing"))
    again, _ = prepare(made.config, report=lambda line: None)
    assert again.config == made.config and again.model == made.model


def test_objects_in_place_of_the_meshes_do_not_take_their_rule(scene):
    place = scene(rule="priority")
    (part, _) = meshes.read_meshes(Path(place))
    made, outside, _ = _prepare(place, parts=[part])
    assert (made.config.scene.rule, made.reasons["rule"]) == ("nested", "by default")
    assert outside == [1.0]


@pytest.mark.slow
def test_a_run_continues_after_its_overlay_has_moved(scene, tmp_path):
    overlay = tmp_path / "mine.json"
    overlay.write_text('{"rule": "facing"}')
    place = scene()
    config = TrainConfig().override(scene=place, batch=16, properties=str(overlay))
    made, built = prepare(config, report=lambda line: None)
    run_folder.create(tmp_path / "run", made.config, made.model, built)
    moved = overlay.rename(tmp_path / "moved.json")
    again, same = prepare(config.override(properties=str(moved)), report=lambda line: None)
    run_folder.check_unchanged(tmp_path / "run", again.config, again.model, same)
    moved.write_text('{"rule": "nested"}')
    again, other = prepare(config.override(properties=str(moved)), report=lambda line: None)
    with pytest.raises(ValueError, match=r"other options \(rule, reentry\)"):
        run_folder.check_unchanged(tmp_path / "run", again.config, again.model, other)
