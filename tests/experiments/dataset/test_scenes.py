import pytest

from experiments.dataset import catalogue, objects, scenes
from experiments.dataset.parts import Object
from experiments.dataset.render_settings import PerSplit, RenderSettings

_CATEGORIES = {"ball": "smcvx", "ball_coloured": "smcvx", "torus": "smncvx", "vial": "mmncvx"}
_CATEGORIES |= {"cube_coloured": "smcvx"}
_OBJECTS = {name: Object(name, kind, lambda detail: []) for name, kind in _CATEGORIES.items()}


def _names(text):
    return [str(scene) for scene in scenes.choose(text, _OBJECTS)]


def test_every_object_stands_before_every_background():
    names = _names("all")
    assert len(set(names)) == 3 * len(_OBJECTS)
    assert names[:3] == ["cube_smcvx_ball", "sphere_smcvx_ball", "env_smcvx_ball"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("env_mmncvx_vial", ["env_mmncvx_vial"]),
        ("torus", ["cube_smncvx_torus", "sphere_smncvx_torus", "env_smncvx_torus"]),
        ("env_*_ball*", ["env_smcvx_ball", "env_smcvx_ball_coloured"]),
        ("cube_*x_c*", ["cube_smcvx_cube_coloured"]),
        ("cube_co*", [f"{kind}_smcvx_cube_coloured" for kind in ("cube", "sphere", "env")]),
        ("cube_smncvx_*, cube_smcvx_ball", ["cube_smcvx_ball", "cube_smncvx_torus"]),
        ("cube_smcvx_ball,cube_*_ball", ["cube_smcvx_ball"]),
    ],
)
def test_names_objects_and_wildcards_choose_in_one_order(text, names):
    assert _names(text) == names


@pytest.mark.parametrize("text", ["cube_smcvx_torus", "", "ball,,torus", "Ball"])
def test_a_name_that_fits_nothing_is_told(text):
    with pytest.raises(ValueError, match="'all' for all of them"):
        scenes.choose(text, _OBJECTS)
    with pytest.raises(ValueError, match="cube_smncvx_torus"):
        scenes.choose("cube_smcvx_torus", _OBJECTS)


def test_the_catalogue_holds_objects_under_their_names():
    assert catalogue.gather() == catalogue.OBJECTS
    categories = [item.category for item in catalogue.OBJECTS.values()]
    assert categories == sorted(categories, key=["smcvx", "smncvx", "mmncvx"].index)
    assert all(name == item.name for name, item in catalogue.OBJECTS.items())


def test_comparisons_of_materials_are_chosen_by_their_own_names_alone():
    objects = catalogue.OBJECTS | catalogue.COMPARISONS
    assert len(scenes.choose("all", objects)) == 150
    assert {s.category for s in scenes.choose("cube_*", objects)} == {"smcvx", "smncvx", "mmncvx"}
    compared = [str(scene) for scene in scenes.choose("cube_materials_*", objects)]
    assert compared == [f"cube_materials_{name}" for name in catalogue.COMPARISONS]
    assert len(compared) == 6 and len(scenes.choose("prism", objects)) == 3


def test_two_objects_of_one_name_are_refused(tmp_path, monkeypatch):
    for name in ("first", "second"):
        text = "from experiments.dataset.parts import Object\n"
        text += "OBJECTS = (Object('same', 'smcvx', lambda detail: []),)\n"
        (tmp_path / f"{name}_made_for_a_test.py").write_text(text)
    monkeypatch.setattr(objects, "__path__", [str(tmp_path)])
    with pytest.raises(ValueError, match="named same"):
        catalogue.gather()


def _settings(**changes):
    return RenderSettings(
        **{"size": 8, "spp": PerSplit(1, 1, 1), "views": PerSplit(2, 0, 6), **changes}
    )


def test_views_are_numbered_from_zero():
    for settings, numbers in (
        (_settings(), [(0, 1), (), (0, 1, 2, 3, 4, 5)]),
        (_settings(preview=True), [(), (), (3,)]),
    ):
        assert [settings.numbers(split) for split in ("train", "val", "test")] == numbers


@pytest.mark.parametrize(
    ("linear", "kept"), [("all", [True, True]), ("test", [False, True]), ("none", [False, False])]
)
def test_linear_images_are_kept_of_the_chosen_splits(linear, kept):
    settings = _settings(linear=linear)
    assert [settings.keeps_linear(split) for split in ("train", "test")] == kept


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": 0}, "The size is 0"),
        ({"spp": PerSplit(1, 1, 0)}, "The spp of test is 0"),
        ({"texture_size": 15}, "The texture_size is 15"),
        ({"views": PerSplit(0, 0, 0)}, "at least one view"),
        ({"views": PerSplit(1, -1, 0)}, "non-negative"),
        ({"views": PerSplit(1, 1, 0), "preview": True}, "--test_views"),
    ],
)
def test_settings_without_meaning_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        _settings(**changes)
