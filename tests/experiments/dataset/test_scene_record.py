"""The record of parts of every kind, as JSON."""

import json

import numpy as np
import pytest

from experiments.dataset import catalogue, published_meshes, scene_record, scene_setup
from experiments.dataset.parts import ObjectPart
from experiments.dataset.render_settings import PerSplit, RenderSettings
from refref_jax.data import image_files, meshes
from refref_jax.data.scene_names import SceneName
from tests.factories.small_dataset import box

_SETTINGS = RenderSettings(8, PerSplit(1, 1, 1), PerSplit(1, 1, 1))


def _record(parts, name="thing"):
    scene = SceneName("cube", "materials", name)
    return json.loads(json.dumps(scene_record.describe(scene, parts, {}, _SETTINGS)))["parts"]


def _sheet(height, edge):
    corners = 0.5 * edge * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return ObjectPart(
        "sheet", "glass", corners + np.array([0.0, 0.0, height]), faces, kind="thin_sheet"
    )


def _compared(name):
    return _record(catalogue.COMPARISONS[name].make(0.1), name)


def test_each_comparison_states_its_material():
    shell, core = _compared("emissive_core")
    assert "kind" not in shell and shell["ior_inside"] == 1.5 and core["watertight"]
    assert (core["kind"], core["radiance"], core["outside"]) == (
        "opaque",
        "vertex_colours",
        "glass",
    )
    (gold,) = _compared("gold_torus")
    assert gold["kind"] == "conductor" and len(gold["eta"]) == len(gold["k"]) == 3
    assert not {"ior_inside", "index", "roughness"} & set(gold)
    (sheet,) = _compared("thin_dome")
    assert (sheet["kind"], sheet["ior_inside"], sheet["watertight"]) == ("thin_sheet", 1.5, False)
    (prism,) = _compared("prism")
    assert prism["index"] == [1.48, 1.52, 1.58] and "ior_inside" not in prism
    for share in (0.1, 0.3):
        (ball,) = _compared(f"frosted_ball_{round(100 * share):03d}")
        assert ball["roughness"] == share and "kind" not in ball


@pytest.mark.parametrize("name", list(catalogue.COMPARISONS))
def test_comparisons_are_oriented_outwards(name):
    for part in catalogue.COMPARISONS[name].make(0.1):
        corners = part.vertices[part.faces]
        volume = np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) / 6.0
        assert volume > 0.0 and np.linalg.norm(part.vertices, axis=1).max() < 2.0
        assert part.colours is None or len(part.colours) == len(part.vertices)


_KINDS = {
    "emissive_core": {"shell_glass": "dielectric", "core_opaque": "opaque"},
    "gold_torus": {"body_conductor": "conductor"},
    "thin_dome": {"sheet_glass": "thin_sheet"},
    "prism": {"body_glass": "dielectric"},
    "frosted_ball_030": {"body_glass": "dielectric"},
}


@pytest.mark.parametrize("name", list(_KINDS))
def test_the_library_reads_comparisons(tmp_path, name):
    scene, parts = SceneName("cube", "materials", name), catalogue.COMPARISONS[name].make(0.1)
    (tmp_path / "meshes").mkdir()
    scene_setup.write_meshes(tmp_path, scene, parts)
    record = scene_record.describe(scene, parts, {"type": "cube", "half_extent": 7.3}, _SETTINGS)
    (tmp_path / "scene.json").write_text(json.dumps(record))
    read = {part.name.removeprefix(f"{name}_"): part for part in meshes.read_meshes(tmp_path)}
    assert {key: part.material.kind for key, part in read.items()} == _KINDS[name]
    if name == "emissive_core":
        light = read["core_opaque"].radiance
        bytes_ = parts[1].colours[parts[1].faces] / 255.0
        np.testing.assert_allclose(light, image_files.srgb_to_linear(bytes_), atol=1e-6)
        assert np.ptp(light) > 0.5
    elif name == "gold_torus":
        assert read["body_conductor"].material.complex_index == (parts[0].eta, parts[0].k)
    elif name == "prism":
        assert read["body_glass"].material.dispersion == parts[0].index
    elif name == "frosted_ball_030":
        assert read["body_glass"].material.roughness == 0.3


def test_nothing_is_inside_a_thin_sheet_but_it_may_be_inside_a_body():
    shell = box(2.0, "shell", "water")
    outside = [
        part["outside"] for part in _record([shell, _sheet(0.0, 1.0), box(0.2, "core")][::-1])
    ]
    assert outside == ["water", "water", "air"]
    crossing = _sheet(0.0, 3.0)
    with pytest.raises(ValueError, match="shell and sheet of thing intersect"):
        _record([shell, crossing])


def test_what_is_inside_a_dispersive_part_states_all_indices_around_it():
    outer = box(2.0, "outer")._replace(index=(1.4, 1.5, 1.6))
    _, inner = _record([outer, box(1.0, "inner", "air")])
    assert inner["ior_outside"] == [1.4, 1.5, 1.6] and inner["ior_inside"] == 1.0


def test_an_absorbing_part_may_contain_what_no_light_enters():
    liquid = box(2.0, "liquid", "water", absorption=(0.1, 0.2, 0.3))
    stem = box(1.0, "stem", "opaque", kind="opaque", albedo=(0.1, 0.2, 0.3))
    assert [part["outside"] for part in _record([liquid, stem])] == ["air", "water"]
    with pytest.raises(ValueError, match="liquid of thing absorbs light"):
        _record([liquid, box(1.0, "bubble", "air")])
    with pytest.raises(ValueError, match="bubble of thing is inside stem"):
        _record([stem, box(0.5, "bubble", "air")])


def test_opaque_parts_are_not_published_under_a_material_in_the_name_of_their_object(tmp_path):
    files = [tmp_path / f"perfume_red_{name}.ply" for name in ("shell_glass", "cap_opaque")]
    for path in files:
        path.write_bytes(path.name.encode())
    published_meshes.write(files, SceneName("cube", "mmncvx", "perfume_red"), tmp_path / "out")
    (written,) = (tmp_path / "out").rglob("*.ply")
    assert (
        written.name == "perfume_red_glass.ply" and written.read_bytes() == files[0].name.encode()
    )
