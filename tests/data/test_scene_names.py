import typing

import pytest

from experiments.dataset import catalogue, parts
from refref_jax.data import scene_names
from refref_jax.data.scene_names import SceneName
from tests.laws.expectations import scene_error


@pytest.mark.parametrize(
    ("text", "name", "config"),
    [
        ("cube_smcvx_cube", SceneName("cube", "smcvx", "cube"), "cubebg_single-convex"),
        (
            "sphere_smncvx_torus_coloured",
            SceneName("sphere", "smncvx", "torus_coloured"),
            "spherebg_single-non-convex",
        ),
        ("env_mmncvx_ampoule", SceneName("env", "mmncvx", "ampoule"), "envbg_multiple-non-convex"),
    ],
)
def test_published_names(text, name, config):
    assert scene_names.is_name(text)
    assert scene_names.parse(text) == name
    assert str(name) == text
    assert name.config == config
    assert scene_names.parse_source(f"hf:{config}/{text}") == name
    assert scene_names.parse_source(name.source) == name


def test_nine_configurations_of_every_background_and_category():
    names = [
        SceneName(background, category, "cup")
        for background in scene_names.BACKGROUNDS
        for category in scene_names.CATEGORIES
    ]
    assert [name.config for name in names] == list(scene_names.CONFIGS)
    assert len(set(scene_names.CONFIGS)) == 9
    ours = typing.get_args(parts.Category)
    assert tuple(scene_names.CATEGORIES) == tuple(x for x in ours if x != "materials")


@pytest.mark.parametrize(
    ("text", "suggestion"),
    [
        ("cube_smcvx", "cube_smcvx_ball"),
        ("cubes_smcvx_cat", "cube_smcvx_cat"),
        ("sphere_smnvcx_cat", "sphere_smncvx_cat"),
        ("env_wine_glass", "env_smcvx_wine_glass"),
        ("toy", "cube_smcvx_toy"),
        ("", "cube_smcvx_ball"),
        ("env_mmncvx_", "env_mmncvx_ball"),
        ("cube_smcvx_../up", "cube_smcvx_up"),
    ],
)
def test_other_names_are_refused_with_a_suggestion(text, suggestion):
    assert not scene_names.is_name(text)
    with scene_error(repr(text), f"Use a name such as {suggestion}."):
        scene_names.parse(text)


@pytest.mark.parametrize(
    ("source", "suggestion"),
    [
        ("hf:cube_smcvx_cat", "hf:cubebg_single-convex/cube_smcvx_cat"),
        ("hf:", "hf:cubebg_single-convex/cube_smcvx_ball"),
        ("hf:cubebg_single_convex/cube_smcvx_cat", "Write cubebg_single-convex."),
        ("hf:nonsense/cube_smcvx_cat", "envbg_multiple-non-convex"),
        ("hf:envbg_single-convex/cube_smcvx_cat", "hf:cubebg_single-convex/cube_smcvx_cat"),
        ("hf:cubebg_single-convex/cube_cat", "cube_smcvx_cat"),
    ],
)
def test_other_sources_are_refused_with_a_suggestion(source, suggestion):
    with scene_error(suggestion):
        scene_names.parse_source(source)


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("textured_cube_scene/single-convex/ball", "cube_smcvx_ball"),
        ("textured_sphere_scene/single-convex/ball_sphere", "sphere_smcvx_ball"),
        ("environment_map_scene/multiple-non-convex/flower_vase_hdr", "env_mmncvx_flower_vase"),
        ("env_map_scene/single-convex/ball_hdr", "env_smcvx_ball"),
        ("HDR_map_scene/single-convex/ball_hdr", "env_smcvx_ball"),
    ],
)
def test_folders_of_the_raw_release(tmp_path, folder, name):
    found = scene_names.of_raw_folder(tmp_path / folder)
    assert str(found) == scene_names.of_folder(tmp_path / folder) == name
    if not folder.startswith(("env_map", "HDR")):  # names that were seen, but are not written
        assert found.raw_folder == folder


@pytest.mark.parametrize("folder", ["cube_smcvx_ball", "toys/single-convex/ball", "a/b/c"])
def test_other_folders_are_called_as_they_are(tmp_path, folder):
    assert scene_names.of_raw_folder(tmp_path / folder) is None
    assert scene_names.of_folder(tmp_path / folder) == (tmp_path / folder).name


@pytest.mark.parametrize("folder", ["image_data/env_map_scene/single-convex/ball_hdr", "ball"])
def test_the_raw_release_implies_the_rule_of_cycles(tmp_path, folder):
    expected = None if folder == "ball" else "facing"
    assert scene_names.published_rule(tmp_path / folder) == expected


_ALL = [
    SceneName(background, item.category, item.name)
    for background in scene_names.BACKGROUNDS
    for item in catalogue.OBJECTS.values()
]


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("hf:all", 150),
        ("hf:*", 150),
        ("hf:*/*", 150),
        ("hf:cubebg_*/*", 50),
        ("hf:cubebg_*", 50),
        ("hf:cubebg_single-convex", 9),
        ("hf:*/*_ball", 3),
        ("hf:*/cube_smcvx_*", 9),
        ("hf:*/sphere_smcvx_[a-c]*", 6),
        ("hf:env*/*_torus*", 2),
        ("hf:spherebg_*/cube_*", 0),
        ("hf:*/Cube_*", 0),
    ],
)
def test_patterns_select_scenes(source, count):
    assert scene_names.is_pattern(source)
    found = scene_names.select(source, _ALL)
    assert len(found) == len(set(found)) == count
    assert found == [name for name in _ALL if name in found]  # in their order


@pytest.mark.parametrize(
    "source", ["all", "cubebg_single-convex", "scenes/*", "hf:cubebg_single-convex/cube_smcvx_ball"]
)
def test_other_sources_are_no_patterns(source):
    assert not scene_names.is_pattern(source)
