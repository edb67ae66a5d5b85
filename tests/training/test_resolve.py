"""What training comes to: from what scenes require and options to a model."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from refref_jax import configuration
from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.scene_analysis import SceneAnalysis
from refref_jax.data.scene_assembly import make_part
from refref_jax.geometry.triangle_meshes import make_mesh
from refref_jax.optics.path_settings import (
    PAPER,
    STRAIGHT,
    TREE,
    capacity_factors,
    make_path_settings,
)
from refref_jax.render import checkpoint_io
from refref_jax.sampling.scene_bounds import Bounds
from refref_jax.training import config_files, run_folder
from refref_jax.training.config import (
    BACKDROP_ONLY,
    SURFACE_ONLY,
    FieldConfig,
    LossConfig,
    PathsConfig,
    SceneConfig,
    TrainConfig,
    options_of,
)
from refref_jax.training.fit import prepare
from refref_jax.training.presets import override_model, samples_of
from refref_jax.training.resolve import SceneFacts, build_scene, resolve
from tests.factories.small_model import CAMERAS, MODEL
from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

_CLEAR = SceneAnalysis(
    parts=1,
    objects=1,
    convex=True,
    reentry="impossible",
    interior="clear",
    tints="none",
    space="bounded",
)
_TINTED = _CLEAR._replace(
    parts=3, convex=False, reentry="possible", interior="absorbing", tints="given"
)
_UNTOLD = _TINTED._replace(tints="learned")
_EMPTY = _CLEAR._replace(parts=0, objects=0, convex=False, interior="none")


def _resolve(found, **given):
    facts = SceneFacts(found, CAMERAS, (), None, None, ())
    return resolve(TrainConfig().override(batch=64, **given), facts)


@pytest.mark.parametrize(
    ("found", "given", "expected"),
    [
        (_CLEAR, {}, ("tree", "clear", "none", 0)),
        (_TINTED, {}, ("tree", "absorbing", "given", 0)),
        (_UNTOLD, {}, ("tree", "absorbing", "learned", 3)),
        (_EMPTY, {}, ("straight", "field", "none", 0)),
        (_UNTOLD, {"paths": "paper"}, ("paper", "absorbing", "learned", 3)),
        (_UNTOLD, {"paths": "straight"}, ("straight", "field", "none", 0)),
        (_UNTOLD, {"max_bends": 0}, ("tree", "field", "none", 0)),
        (_TINTED, {"tints": "learned"}, ("tree", "absorbing", "learned", 3)),
        (_CLEAR, {"tints": "learned"}, ("tree", "absorbing", "learned", 1)),
        (_CLEAR, {"interior": "absorbing"}, ("tree", "absorbing", "given", 0)),
        (_CLEAR, {"interior": "field"}, ("tree", "field", "none", 0)),
        (_UNTOLD, {"interior": "clear"}, ("tree", "clear", "none", 0)),
    ],
)
def test_resolve_takes_what_the_scene_requires(found, given, expected):
    made = _resolve(found, **given)
    config, model = made.config, made.model.config
    assert (config.paths.name, model.interior, config.model.tints, model.learned_tints) == expected
    assert made.warnings == ()


@pytest.mark.parametrize("found", [_CLEAR, _TINTED, _UNTOLD, _EMPTY])
@pytest.mark.parametrize("given", [{}, {"paths": "straight"}, {"field": "nerfacto", "steps": 7}])
def test_resolve_leaves_nothing_open_and_is_idempotent(found, given):
    made = _resolve(found, **given)
    straight = made.model.settings.max_bends == 0
    for option in options_of():
        left = straight and option.name == "reentry"
        unused = ("sub_spaces", "eikonal_weight", "curvature_weight", "gaussians", "splat_filter")
        left |= option.name in (*BACKDROP_ONLY, *SURFACE_ONLY, *unused, "deformation_weights")
        left |= option.name == "exposure"  # of a field fixed, unless it is asked for
        assert left == (made.config.get(option.name) is None), option.name
        assert made.reasons[option.name]
    again = resolve(made.config, SceneFacts(found, CAMERAS, (), None, None, ()))
    assert (again.config, again.model) == (made.config, made.model)


def test_options_of_a_field_that_a_backdrop_ignores_are_named():
    made = _resolve(_CLEAR, far_field="backdrop", steps=100)
    assert "No effect on a backdrop: steps, batch. Use far_field=field." in made.warnings
    assert not any("No effect" in line for line in _resolve(_CLEAR, steps=100).warnings)
    implied = _resolve(_CLEAR, iterations=8, steps=100)
    assert implied.config.model.far_field == "backdrop" and implied.warnings == made.warnings


def test_a_backdrop_has_a_size_and_a_number_of_iterations():
    made = _resolve(_CLEAR, far_field="backdrop", backdrop_resolution=64)
    assert made.model.config.backdrop.resolution == 64
    assert made.config.model.iterations > 0
    again = resolve(made.config, SceneFacts(_CLEAR, CAMERAS, (), None, None, ()))
    assert (again.config, again.model) == (made.config, made.model)


_AROUND = {"far_field": "backdrop", "interior": "field"}


def test_a_field_in_a_ball_is_in_front_of_a_backdrop():
    ball = (0.0, 0.0, 1.0, 2.0)
    made = _resolve(_CLEAR, **_AROUND, field_ball=ball)
    assert made.model.config.backdrop.field_ball == ball
    again = resolve(made.config, SceneFacts(_CLEAR, CAMERAS, (), None, None, ()))
    assert (again.config, again.model) == (made.config, made.model)
    decided = TrainConfig().override(far_field="field").decided(interior="field", field_ball=ball)
    without = resolve(decided, SceneFacts(_CLEAR, CAMERAS, (), None, None, ()))
    assert without.config.model.field_ball is None and without.model.config.backdrop is None


@pytest.mark.parametrize(
    ("found", "given", "message"),
    [
        ("clear", {"far_field": "field", "backdrop_resolution": 64}, "=64 needs far_field"),
        ("clear", {"far_field": "field", "iterations": 8}, "iterations=8 needs far_field"),
        ("clear", {"interior": "field", "iterations": 8}, "iterations=8 needs far_field"),
        ("clear", {"far_field": "field", "field_ball": (0, 0, 0, 2)}, "needs far_field=b"),
        ("clear", {"far_field": "backdrop", "field_ball": (0, 0, 0, 2)}, "needs interior=field"),
        ("clear", {**_AROUND, "field_ball": (0, 0, 0, 0)}, "is not a ball. Give its centre"),
        ("clear", {**_AROUND, "field_ball": (0, 0, 0, 200)}, "larger than a ball"),
        ("clear", {**_AROUND, "pixels": "background"}, "cannot train the field in front. Use"),
        ("clear", {"field_ball": (0, 0, 0, math.inf)}, "is not a ball. Give its centre"),
        ("clear", {**_AROUND, "field_ball": (0, 0, math.nan, 1)}, r"field_ball\[2\] is NaN"),
        ("clear", {"far_field": "backdrop", "contraction": "always"}, "contraction=always"),
        ("clear", {"far_field": "backdrop", "paths": "straight"}, "straight rays"),
        ("clear", {"far_field": "backdrop", "backdrop_resolution": 3}, "backdrop_resolution is 3"),
        ("clear", {"far_field": "backdrop", "backdrop_resolution": 8193}, "Give 4 to 8192"),
    ],
)
def test_a_backdrop_is_refused_where_the_scene_needs_a_field(found, given, message):
    with pytest.raises(ValueError, match=message):
        _resolve({"clear": _CLEAR, "untold": _UNTOLD}[found], **given)


@pytest.mark.parametrize(
    ("stated", "share", "expected"),
    [("scene.json", 0.0, "backdrop"), ("scene.json", 0.5, "field"), ("", 0.0, "field")],
)
def test_a_background_beside_the_objects_may_be_a_backdrop(stated, share, expected):
    facts = SceneFacts(
        _EMPTY, CAMERAS, (), None, None, (), stated=stated, misfits=lambda **bounds: share
    )
    asked = TrainConfig().override(pixels="background", paths="straight")
    made = resolve(asked, facts)
    assert made.config.model.far_field == expected
    assert (made.model.config.backdrop is not None) == (expected == "backdrop")
    assert made.config.scene.pixels == "background"
    field = resolve(asked.override(far_field="field"), facts)
    assert field.model.config.backdrop is None


def test_gains_of_images_are_learned_with_a_field_inside_unless_a_backdrop_is_behind_it():
    given = {"interior": "field", "exposure": "per_image"}
    made = _resolve(_CLEAR, far_field="field", **given)
    assert made.model.config.learned_gains == len(CAMERAS.poses)
    with pytest.raises(ValueError, match="exposure=fixed, or far_field=field"):
        _resolve(_CLEAR, far_field="backdrop", **given)


@pytest.mark.parametrize(("ball", "expected"), [((0, 0, 0, 2), "backdrop"), (None, "field")])
def test_a_field_in_a_ball_explains_what_masks_show_in_front_of_a_backdrop(ball, expected):
    facts = SceneFacts(
        _CLEAR,
        CAMERAS,
        (),
        None,
        None,
        (),
        stated="scene.json",
        misfits=lambda *, masked=False, **bounds: 0.0 if masked else 0.5,
    )
    asked = TrainConfig().override(batch=64).decided(interior="field", field_ball=ball)
    assert resolve(asked, facts).config.model.far_field == expected


@pytest.mark.parametrize(
    ("found", "share", "given", "expected"),
    [
        (_CLEAR, 0.0, {}, (16, 8)),
        (_TINTED, 0.0, {"paths": "paper"}, (16, 8)),
        (_CLEAR._replace(space="spherical"), 0.0, {}, (16, 8)),
        (_CLEAR._replace(space="unbounded"), 0.0, {}, (32, 20)),
        (_CLEAR, 0.5, {}, (32, 20)),
        (_CLEAR, 0.0, {"interior": "field"}, (32, 20)),
        (_CLEAR, 0.0, {"paths": "straight"}, (32, 20)),
        (_CLEAR, 0.0, {"contraction": "always"}, (32, 20)),
        (_CLEAR, 0.0, {"samples_per_ray": (9, 7)}, (9, 7)),
        (_CLEAR, 0.0, {"preset": "small"}, (48, 32)),
        (_CLEAR._replace(field_parts=(0,)), 0.0, {}, (32, 20)),
    ],
)
def test_a_field_that_only_shows_walls_needs_few_samples(found, share, given, expected):
    facts = SceneFacts(
        found, CAMERAS, (), None, None, (), stated="scene.json", misfits=lambda **bounds: share
    )
    made = resolve(TrainConfig().override(batch=64, far_field="field", **given), facts)
    assert made.config.model.samples_per_ray == samples_of(made.model.config) == expected
    unstated = resolve(made.config.override(samples_per_ray=None), facts._replace(stated=""))
    assert unstated.config.model.samples_per_ray != (16, 8)


@pytest.mark.parametrize(
    "given", [{"preset": "small"}, {"paths": "straight"}, {"samples_per_ray": (9, 7)}]
)
def test_images_are_not_compared_with_walls_if_no_fewer_samples_depend_on_it(given):
    def misfits(**bounds):
        raise AssertionError("The images were read.")

    stated = {"stated": "scene.json", "misfits": misfits}
    facts = SceneFacts(_CLEAR, CAMERAS, (), None, None, (), **stated)
    resolve(TrainConfig().override(batch=64, far_field="field", **given), facts)


@pytest.mark.parametrize(
    "given",
    [
        {"paths": "straight"},
        {"max_bends": 0},
        {"background": "unbounded"},
        {"radius": 3.0},
        {"centre": (0.0, 0.0, 1.0)},
        {"scene": "b"},
    ],
)
def test_the_number_of_samples_is_decided_again_with_what_it_follows_from(given):
    config = TrainConfig().override(far_field="field", interior="clear")
    config = config.decided(samples_per_ray=(16, 8), paths="tree")
    assert config.override(**given).model.samples_per_ray is None
    assert config.override(samples_per_ray=(5, 4), **given).model.samples_per_ray == (5, 4)


@pytest.mark.parametrize(
    ("given", "option"),
    [
        ({"paths": "straight", "interior": "absorbing"}, "interior=absorbing"),
        ({"paths": "straight", "interior": "clear"}, "interior=clear"),
        ({"max_bends": 0, "interior": "clear"}, "interior=clear"),
        ({"paths": "straight", "reentry": "impossible"}, "reentry=impossible"),
    ],
)
def test_resolve_refuses_an_inside_for_straight_light(given, option):
    with pytest.raises(ValueError, match=f"{option} has no effect"):
        _resolve(_TINTED, **given)


def test_resolve_grants_straight_light_what_it_has_anyway():
    made = _resolve(_TINTED, paths="straight", interior="field", reentry="possible")
    assert made.model.config.interior == "field" and made.model.settings == STRAIGHT


def test_resolve_promises_in_the_budget_what_the_scene_keeps():
    assert _resolve(_CLEAR).model.settings == dataclasses.replace(TREE, reentry="impossible")
    assert _resolve(_TINTED).model.settings == TREE
    paper = _resolve(_TINTED, paths="paper", max_bends=3).model.settings
    assert paper == dataclasses.replace(PAPER, max_bends=3)
    assert _resolve(_EMPTY).model.settings == STRAIGHT
    assert _resolve(_CLEAR, reentry="possible").model.settings == TREE
    assert _resolve(_TINTED, min_throughput=0.005).model.settings.min_throughput == 0.005


def test_a_finer_cut_has_room_for_its_paths_however_it_is_made():
    usual = capacity_factors(TREE)
    for fine in (
        make_path_settings("tree", min_throughput=TREE.min_throughput / 4.0),
        dataclasses.replace(TREE, min_throughput=0.005),
    ):
        assert capacity_factors(fine) == tuple(2.0 * x for x in usual)
    longer = capacity_factors(dataclasses.replace(TREE, max_bends=48))
    assert longer == usual._replace(segments_per_ray=2.0 * usual.segments_per_ray)
    # Never without bound.
    assert (
        capacity_factors(make_path_settings("tree", min_throughput=0.0)).paths_per_ray
        < 10.0 * usual.paths_per_ray
    )
    assert make_path_settings("tree", min_throughput=0.1, max_bends=3) == dataclasses.replace(
        TREE, min_throughput=0.1, max_bends=3
    )
    own = dataclasses.replace(TREE, paths_per_ray=3.0)
    assert capacity_factors(dataclasses.replace(own, min_throughput=0.005)).paths_per_ray == 3.0
    # What an earlier version wrote out grows as well.
    written = dataclasses.replace(TREE, live_per_ray=6.0, segments_per_ray=24.0, paths_per_ray=8.0)
    assert (
        capacity_factors(dataclasses.replace(written, min_throughput=0.005)).paths_per_ray == 16.0
    )


def test_resolve_warns_of_what_is_doubtful():
    made = _resolve(_TINTED, interior="clear", reentry="impossible")
    assert made.model.config.interior == "clear" and made.model.settings.reentry == "impossible"
    assert len(made.warnings) == 2 and made.describe().count("warning: ") == 2


@pytest.mark.parametrize(
    ("found", "given", "message"),
    [
        (_UNTOLD, {"tints": "given"}, "scene.json lacks"),
        (_TINTED, {"tints": "learned", "interior": "clear"}, "no effect with interior clear"),
        (_TINTED, {"tints": "given", "interior": "field"}, "no effect with interior field"),
        (_TINTED, {"tints": "given", "paths": "straight"}, "and straight rays"),
        (_TINTED, {"tints": "none"}, "an absorbing interior has colours"),
        (_EMPTY, {"tints": "learned"}, "no effect"),
        (_EMPTY, {"paths": "tree"}, "no meshes"),
        (_CLEAR, {"min_throughput": 2.0}, "min_throughput is 2.0"),
        (_CLEAR, {"max_bends": -1}, "bends"),
        (_CLEAR, {"paths": "straight", "max_bends": 10}, "neither min_throughput nor max_bends"),
        (
            _CLEAR,
            {"paths": "straight", "min_throughput": 0.02},
            "neither min_throughput nor max_bends",
        ),
        (_CLEAR, {"dilatation": 0.5}, "There is no option 'dilatation'"),
        (_CLEAR, {"samples_per_ray": (32,)}, "is for 0 proposal levels, but preset tiny has 1"),
        (_CLEAR, {"samples_per_ray": (32, 0)}, "not a list of positive numbers"),
        (_CLEAR, {"multisamples": 3}, "multisamples is 3"),
        (_CLEAR, {"log2_hashmap_size": 40}, "log2_hashmap_size is 40"),
        (_CLEAR, {"max_res": 3}, "max_res=3"),
        (_CLEAR, {"radius": -1.0}, "radius is -1"),
        (_CLEAR, {"dilation": -0.5}, "dilation is -0.5"),
        (_CLEAR, {"paths": "treee"}, "paths is 'treee', not one of"),
        (_CLEAR, {"steps": "50"}, "steps is '50', not of type int"),
        (_CLEAR, {"samples_per_ray": [32, "20"]}, "not of type int"),
        (_CLEAR, {"steps": 10**30}, "steps is 10"),
        (_CLEAR, {"seed": -1}, "seed is -1"),
        (_CLEAR, {"blurs": [0.1, 0.1, 0.1]}, "3 blurs for 1 proposal levels"),
        (_CLEAR, {"distortion_weight": -1.0}, "weight or blur"),
        (_CLEAR, {"max_res": 10**30}, "max_res is 10"),
        (_CLEAR, {"steps": 0}, "steps is 0"),
        (_CLEAR, {"learning_rate": float("nan")}, "learning_rate is NaN"),
    ],
)
def test_resolve_refuses_what_can_not_be(found, given, message):
    with pytest.raises(ValueError, match=message):
        _resolve(found, **given)


def test_a_field_learns_the_exposure_of_each_image_if_it_is_asked_to():
    resolved = _resolve(_EMPTY, exposure="per_image")
    assert resolved.config.model.far_field == "field"
    assert resolved.model.config.learned_gains == len(CAMERAS.poses)
    assert "exposure=per_image" in resolved.describe()
    assert _resolve(_EMPTY).model.config.learned_gains == 0
    assert _resolve(_EMPTY, exposure="fixed").model.config.learned_gains == 0
    with pytest.raises(ValueError, match=r"No effect on Gaussian splats.*exposure"):
        _resolve(_EMPTY, exposure="per_image", field="splats")


def test_override_takes_decisions_again_that_follow_from_a_change():
    config = _resolve(_TINTED, scene="a").config
    paper = config.override(paths="paper")
    open_ = paper.paths.min_throughput, paper.model.interior, paper.model.samples_per_ray
    assert (open_, paper.model.multisamples) == ((None, None, None), 1)
    assert config.override(paths="tree", steps=2500) == config
    shorter = config.override(steps=100).schedule
    assert (shorter.warmup, shorter.anneal, shorter.peak) == (None, None, 1e-2)
    assert config.override(steps=100, warmup=7).schedule.warmup == 7
    # Lists, mappings and paths are taken as users write them.
    plain = TrainConfig().override(
        samples_per_ray=[8, 4], ior={"glass": 1.52}, scene=Path("a"), min_throughput=0
    )
    assert (plain.model.samples_per_ray, plain.scene.indices) == ((8, 4), (("glass", 1.52),))
    assert (plain.scene.path, type(plain.paths.min_throughput)) == ("a", float)
    # Also those that followed from what is decided again.
    straight = _resolve(_EMPTY, scene="a").config.override(scene="b").paths
    assert (straight.name, straight.min_throughput, straight.max_bends) == (None, None, None)
    assert config.override(rule="facing").paths.reentry is None
    assert config.override(ior=[["glass", 1.4]]).paths.reentry is not None
    # What was never set is no change.
    assert TrainConfig().override(interior="field", scene="a").model.interior == "field"


def test_what_was_asked_for_stays_and_what_was_decided_is_decided_again():
    overrides = {"paths": "straight", "radius": 9.0, "steps": 100}
    made = _resolve(_TINTED, scene="a", **overrides)
    config = made.config
    assert set(config.chosen) == {"scene", "paths", "radius", "steps", "batch"}
    other = config.override(scene="b", preset="small")
    assert {name: other.get(name) for name in overrides} == overrides
    open_ = ("interior", "tints", "background", "samples_per_ray", "warmup")
    assert {other.get(name) for name in open_} == {None}
    decided, kept = config.followers(scene="b")
    assert {"paths", "radius"} <= kept and {"interior", "background"} <= decided
    assert not decided & config.overrides()
    # Until it is taken back, or something else is asked for.
    assert config.override(paths=None).paths.name is None
    assert "paths" not in config.override(paths=None).chosen
    assert config.override(paths="tree").override(scene="b").paths.name == "tree"
    # Resolving neither adds a wish nor drops one, and the reasons tell both apart.
    again = _resolve_again(config)
    assert again.config.chosen == config.chosen and again.config == config
    assert (again.reasons["paths"], made.reasons["min_throughput"]) == ("given", "paths=straight")
    assert again.reasons["min_throughput"] == "as the configuration has it"
    # Another object is no wish, and has another index of refraction.
    part = config.decided(reconstruction="r3f", ior={"ball": 1.5})
    assert part.chosen == config.chosen and part.override(reconstruction="x").scene.indices == ()


def test_a_wish_that_is_taken_back_is_none():
    config = TrainConfig().override(preset="small", ior={"glass": 1.4}, seed=3)
    assert config.chosen == ("ior", "preset", "seed")
    taken = config.override(preset=None, ior={}, seed=None)
    assert taken.chosen == () and taken == TrainConfig()
    assert TrainConfig().override(preset="tiny").chosen == ("preset",)


def test_numbers_of_numpy_are_numbers():
    given = {
        "min_throughput": np.float64(0.25),
        "steps": np.int64(7),
        "samples_per_ray": [3, np.int32(4)],
    }
    config = TrainConfig().override(**given, radius=np.float32(2.5), blurs=[np.float64(0.5)])
    assert (config.paths.min_throughput, config.schedule.steps, config.scene.radius) == (
        0.25,
        7,
        2.5,
    )
    for value in (config.paths.min_throughput, config.scene.radius, *config.losses.blurs):
        assert type(value) is float
    assert type(config.schedule.steps) is int
    for wrong in ({"steps": True}, {"steps": np.float64(7.0)}, {"min_throughput": np.bool_(True)}):
        with pytest.raises(ValueError, match="not of type"):
            TrainConfig().override(**wrong)


_MADE = """
from pathlib import Path
import numpy as np
from refref_jax.training.config import *
def refused(kind, **given):
    try:
        print(kind(**given))
    except ValueError as error:
        print(error)
refused(PathsConfig, name="trea")
refused(PathsConfig, min_throughput="x")
refused(ScheduleConfig, steps="x")
refused(SceneConfig, path=3)
refused(LossConfig, distortion_over="inside")
refused(FieldConfig, samples_per_ray=[3, "4"])
refused(FieldConfig, preset=None)
refused(TrainConfig, paths={"min_throughput": 0.1})
refused(TrainConfig, seed=1.5)
refused(TrainConfig, chosen=("cot",))
print(FieldConfig(samples_per_ray=[3, 4]).samples_per_ray)
print(SceneConfig(Path("a"), indices={"glass": 2}).indices)
print(type(PathsConfig(min_throughput=np.float64(0.5)).min_throughput))
"""


def test_records_are_checked_in_full_when_they_are_made():
    # In a process of its own: the tests' own would refuse wrong types before the records do.
    command = [sys.executable, "-c", _MADE]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    expected = [
        "paths is 'trea', not one of",
        "min_throughput is 'x', not of type float",
        "steps is 'x', not of type int",
        "scene is 3, not of type str",
        "distortion is 'inside', not one of",
        "samples_per_ray[1] is '4', not of type int",
        "preset is None, not one of",
        "paths is {'min_throughput': 0.1}, not of type PathsConfig",
        "seed is 1.5, not of type int",
        "chosen names 'cot'",
        "(3, 4)",
        "(('glass', 2.0),)",
        "<class 'float'>",
    ]
    for told, meant in zip(done.stdout.splitlines(), expected, strict=True):
        assert meant in told, done.stderr


def test_losses_have_one_place_for_what_is_usual():
    made = _resolve(_CLEAR).config.losses
    assert dataclasses.replace(made, blurs=None, hash_decay=None) == LossConfig()


def test_wishes_of_a_file_that_does_not_tell_them():
    partial = TrainConfig(scene=SceneConfig(path="a"), paths=PathsConfig(name="straight"))
    assert partial.overrides() == {"scene", "paths"}
    assert partial.override(scene="b").paths.name == "straight"
    # A run of an earlier version: decisions look as wishes do, and are taken again.
    before = dataclasses.replace(_resolve(_TINTED, scene="a", paths="paper").config, chosen=None)
    assert before.overrides() == set() and before.override(scene="b").paths.name is None


def _resolve_again(config):
    return resolve(config, SceneFacts(_TINTED, CAMERAS, (), None, None, ()))


_BALL = Bounds(near=0.5, far=150.0, radius=10.0, space="unbounded")


@pytest.mark.parametrize(
    ("found", "given", "expected"),
    [
        # The size of a background is not used, even if it is given.
        (_CLEAR, {}, _BALL),
        (_CLEAR, {"radius": 5.0}, _BALL),
        (_CLEAR._replace(space="spherical"), {}, _BALL),
        (_EMPTY, {"near": 0.0, "far": 20.0}, dataclasses.replace(_BALL, near=0.0, far=20.0)),
        (_CLEAR._replace(space="unbounded"), {}, dataclasses.replace(_BALL, far=10_000.0)),
        (
            _CLEAR._replace(space="unbounded"),
            {"radius": 5.0},
            dataclasses.replace(_BALL, far=10_000.0, radius=5.0),
        ),
    ],
)
def test_contraction_makes_the_bounds_of_the_released_code(found, given, expected):
    facts = SceneFacts(found, CAMERAS, (), None, 6.5, ())
    made = resolve(TrainConfig().override(batch=64, contraction="always", **given), facts)
    model = made.model.config
    assert Bounds(model.near, model.far, model.radius, model.space) == expected
    # The configuration still says what is behind the objects.
    walls = found.space != "unbounded"
    assert made.config.scene.space == found.space
    assert made.config.scene.radius == given.get("radius", 6.5 if walls else 10.0)
    reason = "given" if "far" in given else "contraction=always"
    assert made.reasons["far"] == made.reasons["near"] == reason
    again = resolve(made.config, facts)
    assert (again.config, again.model) == (made.config, made.model)


def test_near_and_far_planes_are_decided_by_the_scene_unless_they_are_given():
    model = _resolve(_CLEAR, radius=2.0).model.config
    assert (model.near, model.far) == (0.05, pytest.approx(4.0 + 2.0 * 3.0**0.5))
    made = _resolve(_CLEAR, near=0.25)
    assert (made.model.config.near, made.config.model.near) == (0.25, 0.25)
    assert (made.reasons["near"], made.reasons["far"]) == ("given", "background=bounded")
    assert made.config.get("far") == made.model.config.far
    endless = _CLEAR._replace(space="unbounded")
    assert _resolve(endless).config.get("far") == 1000.0
    assert _resolve(endless, far=300.0).model.config.far == 300.0
    # Decided again for another background, unless it was given.
    again = made.config.override(radius=3.0)
    assert (again.model.near, again.model.far) == (0.25, None)


@pytest.mark.parametrize("space", ["bounded", "spherical"])
def test_a_far_plane_behind_a_background_is_refused(space):
    with pytest.raises(ValueError, match=f"far=150 has no effect in a {space} scene"):
        _resolve(_CLEAR._replace(space=space), far=150.0)


@pytest.mark.parametrize("name", ["near", "far"])
@pytest.mark.parametrize("distance", [-1.0, math.inf])
def test_a_plane_that_is_no_distance_is_refused(name, distance):
    with pytest.raises(ValueError, match=f"{name} is {distance}. Give 0 or a positive"):
        FieldConfig(**{name: distance})
    with pytest.raises(ValueError, match="Give 0 <= near < far"):
        _resolve(_CLEAR, contraction="always", near=150.0)


@pytest.mark.parametrize("shading", ["scene", "smooth", "flat"])
@pytest.mark.parametrize("stored", [False, True])
def test_shading_reaches_the_normals_of_the_scene(shading, stored):
    part = make_part(trimesh.creation.box(), index=1.5, shading="smooth")
    smooth = make_mesh(part.vertices, part.faces, crease_angle=math.pi).normals
    flat = make_mesh(part.vertices, part.faces, crease_angle=0.0).normals
    kept = np.roll(smooth, 1, axis=-1) if stored else smooth
    part = part._replace(normals=kept) if stored else part
    facts = SceneFacts(_CLEAR, CAMERAS, (part,), find_containment([part]), None, ())
    made = build_scene(resolve(TrainConfig().override(batch=64, shading=shading), facts), facts)
    expected = {"flat": flat, "smooth": smooth, "scene": kept}
    np.testing.assert_array_equal(np.sort(np.abs(flat), axis=-1), [[[0.0, 0.0, 1.0]] * 3] * 12)
    # The tree of boxes orders the faces, and repeats some.
    rows = lambda x: {tuple(row) for row in 0.0 + np.asarray(x, np.float64).reshape(-1, 9).round(4)}
    same = {name for name, x in expected.items() if rows(x) == rows(made.surfaces.normals)}
    assert same == ({shading} if stored or shading == "flat" else {"scene", "smooth"})


def test_a_skip_reaches_the_colour_network():
    assert _resolve(_CLEAR).model.config.field.colour_network == "plain"
    for field in ("zipnerf", "nerfacto", "msnerf", "neus"):
        made = _resolve(_CLEAR, field=field, colour_network="skip")
        assert made.model.config.field.colour_network == "skip"


@pytest.mark.parametrize("field", ["zipnerf", "msnerf", "raydef", "rosenerf"])
def test_light_above_white_reaches_the_field(field):
    assert _resolve(_CLEAR, field=field).model.config.field.brightest == 1.0
    assert _resolve(_CLEAR, field=field, brightest=2.0).model.config.field.brightest == 2.0


@pytest.mark.parametrize("field", ["nerfacto", "neus"])
def test_other_fields_have_no_light_above_white(field):
    with pytest.raises(ValueError, match=rf"brightest=2 has no effect on field kind {field}"):
        _resolve(_CLEAR, field=field, brightest=2.0)


@pytest.mark.parametrize("brightest", [0.5, 9.0])
def test_the_brightest_colour_is_at_least_white(brightest):
    with pytest.raises(ValueError, match=r"brightest is .* Give 1 to 8"):
        FieldConfig(brightest=brightest)


def test_override_model_replaces_one_thing_an_option():
    asked = FieldConfig(
        samples_per_ray=(5, 4),
        multisamples=6,
        log2_hashmap_size=8,
        max_res=32,
        precision="bfloat16",
        footprint="differential",
        dilation=0.25,
    )
    made = override_model(MODEL, asked)
    assert samples_of(made) == (5, 4)
    assert (made.multisamples, made.footprint, made.dilation) == (6, "differential", 0.25)
    assert (made.field.grid.hashmap_size, made.field.grid.max_res) == (256, 32)
    assert made.field.precision == made.proposals[0].field.precision == "bfloat16"
    # The proposals keep their grids.
    assert made.proposals[0].field.grid == MODEL.proposals[0].field.grid
    assert override_model(MODEL, FieldConfig()) == MODEL


def test_a_configuration_is_read_as_it_was_written(tmp_path):
    config = _resolve(_TINTED, ior=(("glass", 1.52),), scene="a").config
    configuration.write(tmp_path / "config.json", config)
    read = config_files.read_to_begin(tmp_path / "config.json")
    assert read == config and read.chosen == config.chosen == ("scene", "ior", "batch")
    (tmp_path / "partial.json").write_text('{"paths": {"cut": 0.01}, "seed": 3}')
    partial = config_files.read_to_begin(tmp_path / "partial.json")
    assert partial == TrainConfig().override(min_throughput=0.01, seed=3)


def test_a_reconstruction_is_named_as_seen_from_its_run(tmp_path, monkeypatch):
    near, far = tmp_path / "runs" / "a" / "r3f", tmp_path / "r3f"
    near.mkdir(parents=True)
    (tmp_path / "runs" / "b").mkdir()
    config = TrainConfig().override(scene="a", steps=3)
    for name, folder, written in [
        ("a", near, "r3f"),
        ("b", near, "../a/r3f"),
        ("a", far, str(far)),
        ("a", "", ""),
    ]:
        file = tmp_path / "runs" / name / "config.json"
        config_files.write(file, config.decided(reconstruction=folder))
        assert json.loads(file.read_text())["scene"]["reconstruction"] == written
        read = config_files.read(file)
        assert read.scene.reconstruction == str(folder) and read.chosen == ("scene", "steps")
    # A path that was written by hand may be as seen from the working directory.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.json").write_text('{"scene": {"reconstruction": "runs/a/r3f"}}')
    (near / "mine.json").write_text('{"scene": {"reconstruction": "runs/a/r3f"}}')
    assert config_files.read(tmp_path / "mine.json").scene.reconstruction == str(near)
    assert config_files.read(near / "mine.json").scene.reconstruction == "runs/a/r3f"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 200_000, "nested too deeply"),
        ('{"seed": NaN}', "NaN, not a number"),
        ('{"paths": {"cut": NaN}}', "NaN, not a number"),
        ('{"seed": 0', "is not a valid TrainConfig"),
        ('{"sead": 0}', "unknown key 'sead': did you mean 'seed'"),
        ('{"paths": {"cut": 2}}', "min_throughput is 2.0, outside"),
        ("[]", "not an object"),
        ('{"loss": 1, "batch": 2, "pool": 3}', "not started again"),
        ('{"seed": -1}', "seed is -1"),
        (b"\xff\xfe\x00", "is not a valid TrainConfig"),
    ],
)
def test_a_file_that_is_no_configuration_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "config.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message) as caught:
        config_files.read_to_begin(path)
    assert "\n" not in str(caught.value)


def test_the_configuration_of_an_earlier_version_is_read(tmp_path):
    resolved = _resolve(_TINTED, scene="a", paths="paper", steps=100, seed=3)
    config, model = resolved.config, resolved.model
    checkpoint_io.write_static(tmp_path, model)
    schedule, losses = vars(config.schedule), vars(config.losses)
    before = {
        "scene": {"path": "a", "rule": "nested", "indices": []},
        "paths": "paper",
        "loss": losses,
        "schedule": {n: schedule[n] for n in ("steps", "warmup", "peak", "end", "anneal")},
        "batch": schedule["batch"],
        "pool": schedule["pretraced_batches"],
        "seed": 3,
        "pixels": "all",
    }
    (tmp_path / "config.json").write_text(json.dumps(before))
    assert run_folder.read_config(tmp_path) == config


def test_options_of_an_earlier_version_are_taken_by_their_present_names():
    former = TrainConfig().override(samples=(5, 4), entries=8, cut=0.25, pool=3, dye_decay=0.5)
    present = TrainConfig().override(
        samples_per_ray=(5, 4),
        log2_hashmap_size=8,
        min_throughput=0.25,
        pretraced_batches=3,
        tint_decay=0.5,
    )
    assert former == present and former.chosen == present.chosen
    chosen = configuration.build({"chosen": ["pool", "steps"]}, TrainConfig).chosen
    assert chosen == ("pretraced_batches", "steps")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Makes scenes of the bundled one, whose part is described otherwise, or has no mesh."""
    bundled = ROOT / "experiments" / "data" / "cube_smcvx_ball"

    def make(name, *, mesh=True, **described):
        folder = tmp_path_factory.mktemp("scenes") / name
        folder.mkdir()
        for path in bundled.iterdir():
            if path.name not in ("scene.json", "meshes"):
                (folder / path.name).symlink_to(path)
        content = json.loads((bundled / "scene.json").read_text())
        if mesh:
            (folder / "meshes").symlink_to(bundled / "meshes")
        content["parts"] = [{"mesh": "meshes/ball_body_glass.ply", **described}] if mesh else []
        (folder / "scene.json").write_text(json.dumps(content))
        return str(folder)

    return make


@pytest.mark.slow
def test_prepare_resolves_scenes(scene):
    tint, absorption = [0.5, 0.75, 1.0], [0.0, 0.25, 0.0]
    tinted = scene("tinted", colour_per_interface=tint, absorption=absorption)
    clear = scene("clear", colour_per_interface=[1, 1, 1])
    untold, empty = scene("untold"), scene("empty", mesh=False)
    cases = [
        (clear, {}, ("tree", "clear")),
        (tinted, {}, ("tree", "absorbing")),
        (tinted, {"tints": "learned"}, ("tree", "absorbing")),
        (tinted, {"interior": "field"}, ("tree", "field")),
        (tinted, {"interior": "clear"}, ("tree", "clear")),
        (untold, {}, ("tree", "absorbing")),
        (empty, {}, ("straight", "field")),
        (
            tinted,
            {"paths": "paper", "max_bends": 4, "samples_per_ray": (7, 6)},
            ("paper", "absorbing"),
        ),
        (tinted, {"field": "nerfacto", "log2_hashmap_size": 12}, ("tree", "absorbing")),
        (clear, {"paths": "paper_no_tir", "distortion": "everywhere"}, ("paper_no_tir", "clear")),
    ]
    for place, given, expected in cases:
        lines = []
        config = TrainConfig().override(scene=place, **given)
        made, scene = prepare(config, report=lines.append)
        assert (made.config.paths.name, made.config.model.interior) == expected
        # Colours that are given lie on the paths; all others must not, or they would count twice.
        on_paths = made.config.model.tints == "given"
        assert on_paths == (expected[1] == "absorbing" and place == tinted and "tints" not in given)
        if place != empty:
            found = scene.interfaces.tint[0], scene.interfaces.absorption[0]
            expected = (tint, absorption) if on_paths else ([1.0] * 3, [0.0] * 3)
            np.testing.assert_array_equal(found, expected)
        assert any("this scene" in line for line in lines)
    with pytest.raises(ValueError, match="lacks colour_per"):
        prepare(TrainConfig().override(scene=untold, tints="given"))
    with pytest.raises(ValueError, match="no meshes"):
        prepare(TrainConfig().override(scene=empty, paths="tree"))


@pytest.mark.parametrize("name", ["warmup", "anneal"])
def test_resolve_refuses_a_warm_up_that_is_longer_than_the_run(name):
    with pytest.raises(ValueError, match=f"{name} is 50, but there are 5 steps. Give fewer."):
        _resolve(_CLEAR, steps=5, **{name: 50})
    assert _resolve(_CLEAR, steps=5).config.schedule.warmup <= 5
