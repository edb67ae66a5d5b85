"""What training comes to: from the needs of scenes and options to a model."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from experiments.runs import choices, model_options
from experiments.runs.choices import Wishes, choose
from experiments.runs.model_options import ModelOptions, override, parse_samples
from refref_jax.data.needs import Needs
from refref_jax.optics.budgets import PAPER, STRAIGHT, TREE
from tests.experiments.command import ROOT
from tests.small_model import CONFIG, MODEL, SAVED

_CLEAR = Needs(
    parts=1,
    bodies=1,
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
_EMPTY = _CLEAR._replace(parts=0, bodies=0, convex=False, interior="none")


@pytest.mark.parametrize(
    ("needs", "wishes", "expected"),
    [
        (_CLEAR, Wishes(), ("tree", "clear", "none", 0)),
        (_TINTED, Wishes(), ("tree", "absorbing", "given", 0)),
        (_UNTOLD, Wishes(), ("tree", "absorbing", "learned", 3)),
        (_EMPTY, Wishes(), ("straight", "field", "none", 0)),
        (_UNTOLD, Wishes(paths="paper"), ("paper", "absorbing", "learned", 3)),
        (_UNTOLD, Wishes(paths="straight"), ("straight", "field", "none", 0)),
        (_UNTOLD, Wishes(bends=0), ("tree", "field", "none", 0)),
        (_TINTED, Wishes(tints="learned"), ("tree", "absorbing", "learned", 3)),
        (_CLEAR, Wishes(tints="learned"), ("tree", "absorbing", "learned", 1)),
        (_CLEAR, Wishes(tints="given"), ("tree", "clear", "none", 0)),
        (_CLEAR, Wishes(interior="absorbing"), ("tree", "absorbing", "given", 0)),
        (_CLEAR, Wishes(interior="field"), ("tree", "field", "none", 0)),
        (_UNTOLD, Wishes(interior="clear"), ("tree", "clear", "none", 0)),
    ],
)
def test_needs_choose_unless_options_do(needs, wishes, expected):
    chosen = choose(needs, wishes)
    assert (chosen.paths, chosen.interior, chosen.tints, chosen.learned_tints) == expected
    assert chosen.warnings == ()


@pytest.mark.parametrize(
    ("wishes", "option"),
    [
        (Wishes(paths="straight", interior="absorbing"), "--interior=absorbing"),
        (Wishes(paths="straight", interior="clear"), "--interior=clear"),
        (Wishes(bends=0, interior="clear"), "--interior=clear"),
        (Wishes(paths="straight", reentry="impossible"), "--reentry=impossible"),
    ],
)
def test_straight_light_has_no_inside(wishes, option):
    with pytest.raises(ValueError, match=f"{option} has no effect"):
        choose(_TINTED, wishes)
    with pytest.raises(ValueError, match="has no effect"):
        choose(_EMPTY, wishes._replace(bends=None, paths=None))


def test_what_straight_light_has_anyway_may_be_asked_for():
    wishes = Wishes(paths="straight", interior="field", reentry="possible")
    assert choose(_TINTED, wishes).interior == "field"


def test_the_budget_promises_what_the_scene_keeps():
    assert choose(_CLEAR, Wishes()).budget == dataclasses.replace(TREE, reentry="impossible")
    assert choose(_TINTED, Wishes()).budget == TREE
    assert choose(_TINTED, Wishes(paths="paper", bends=3)).budget == dataclasses.replace(
        PAPER, bends=3
    )
    assert choose(_EMPTY, Wishes()).budget == STRAIGHT
    assert choose(_CLEAR, Wishes(reentry="possible")).budget == TREE
    fine = choose(_TINTED, Wishes(cut=TREE.cut / 4.0)).budget
    assert fine.cut == TREE.cut / 4.0 and fine.paths_per_ray == 2.0 * TREE.paths_per_ray


def test_doubtful_wishes_are_granted_with_a_word():
    chosen = choose(_TINTED, Wishes(interior="clear", reentry="impossible"))
    assert chosen.interior == "clear" and chosen.budget.reentry == "impossible"
    assert len(chosen.warnings) == 2
    assert all(text.startswith("warning: --") and "\n" not in text for text in chosen.warnings)


@pytest.mark.parametrize(
    ("needs", "wishes", "message"),
    [
        (_UNTOLD, Wishes(tints="given"), "scene.json does not tell"),
        (_TINTED, Wishes(tints="learned", interior="clear"), "no effect with interior clear"),
        (_CLEAR, Wishes(tints="learned", interior="clear"), "no effect with interior clear"),
        (_TINTED, Wishes(tints="given", interior="field"), "no effect with interior field"),
        (_TINTED, Wishes(tints="given", paths="straight"), "at most 0 bends"),
        (_EMPTY, Wishes(tints="learned"), "no effect"),
        (_EMPTY, Wishes(paths="tree"), "no meshes"),
        (_CLEAR, Wishes(cut=2.0), "The cut"),
        (_CLEAR, Wishes(bends=-1), "bends"),
        (_CLEAR, Wishes(paths="straight", bends=10), "no --cut and no --bends"),
        (_CLEAR, Wishes(paths="straight", cut=0.02), "no --cut and no --bends"),
    ],
)
def test_wishes_that_contradict_are_refused(needs, wishes, message):
    with pytest.raises(ValueError, match=message):
        choose(needs, wishes)


def test_every_choice_is_told_with_its_options():
    lines = choices.report(CONFIG, SAVED, choose(_UNTOLD, Wishes()))
    text = "\n".join(lines)
    assert "paths tree" in text and "tints learned" in text and "samples 8,6" in text
    for name in choices.Wishes._fields + ModelOptions._fields:
        assert f"--{name}" in text
    straight = dataclasses.replace(SAVED, budget=STRAIGHT)
    assert "re-entry" not in "\n".join(choices.report(CONFIG, straight, choose(_EMPTY, Wishes())))


def test_no_options_leave_a_model_as_it_is():
    assert override(MODEL, ModelOptions(), preset="tiny") == MODEL


def test_every_option_of_a_model_replaces_one_thing():
    asked = ModelOptions((5, 4), 6, 8, 32, "bfloat16", "differential")
    made = override(MODEL, asked, preset="tiny")
    assert model_options.samples_of(made) == (5, 4)
    assert (made.multisamples, made.footprint) == (6, "differential")
    assert (made.field.grid.entries, made.field.grid.finest) == (256, 32)
    assert made.field.precision == made.proposals[0].field.precision == "bfloat16"
    # The proposals keep their grids.
    assert made.proposals[0].field.grid == MODEL.proposals[0].field.grid
    for name in ModelOptions._fields:
        lone = override(MODEL, ModelOptions(**{name: getattr(asked, name)}), preset="tiny")
        assert lone != MODEL


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ModelOptions(samples=(32,)), r"has 0 proposal rounds, preset tiny has 1. Give 2 numbers"),
        (ModelOptions(samples=(8, 8, 8)), r"has 2 proposal rounds, preset tiny has 1"),
        (ModelOptions(multisamples=3), r"--multisamples=3"),
        (ModelOptions(entries=0), r"--entries=0"),
        (ModelOptions(entries=40), r"--entries=40"),
        (ModelOptions(finest=3), r"--finest=3"),
    ],
)
def test_what_a_model_can_not_have_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        override(MODEL, options, preset="tiny")


def test_samples_are_positive_numbers():
    assert parse_samples(["32", "20"]) == (32, 20)
    for words in ([""], ["0", "4"], ["-3"], ["4", "a"], ["1.5"]):
        with pytest.raises(ValueError, match="--samples"):
            parse_samples(words)


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
        return f"--scene={folder}"

    return make


@pytest.mark.slow
def test_scenes_and_options_become_plans(scene):
    clear = scene("clear", colour_per_interface=[1, 1, 1])
    tint, absorption = [0.5, 0.75, 1.0], [0.0, 0.25, 0.0]
    tinted = scene("tinted", colour_per_interface=tint, absorption=absorption)
    untold, empty = scene("untold"), scene("empty", mesh=False)
    asked = [
        (clear,),
        (tinted,),
        (tinted, "--tints=learned"),
        (tinted, "--interior=field"),
        (tinted, "--interior=clear"),
        (untold,),
        (untold, "--tints=given"),
        (empty,),
        (empty, "--paths=tree"),
        (tinted, "--paths=paper", "--bends=4", "--samples=7,6", "--footprint=differential"),
        (tinted, "--field=nerfacto", "--entries=12"),
        (clear, "--paths=paper_no_tir", "--distortion=everywhere"),
        (clear, "--paths=paper_no_reflection"),
    ]
    result = subprocess.run(
        [sys.executable, "-m", "tests.experiments.print_plans"],
        cwd=ROOT,
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        check=True,
    )
    plans = json.loads(result.stdout)
    assert [number for number, plan in enumerate(plans) if plan["error"] is not None] == [6, 8]
    assert "scene.json does not tell" in plans[6]["error"]
    assert "no meshes" in plans[8]["error"]
    defaults = [(plan["paths"], plan["interior"]) for plan in plans if plan["error"] is None]
    assert defaults == [
        ("tree", "clear"),
        ("tree", "absorbing"),
        ("tree", "absorbing"),
        ("tree", "field"),
        ("tree", "clear"),
        ("tree", "absorbing"),
        ("straight", "field"),
        ("paper", "absorbing"),
        ("tree", "absorbing"),
        ("paper_no_tir", "clear"),
        ("paper_no_reflection", "clear"),
    ]
    # Colours that are given lie on the paths; all others must not, or they would count twice.
    for number, plan in enumerate(plans):
        if plan["error"] is None:
            given = number in (1, 9, 10)
            np.testing.assert_array_equal(plan["tint"][0], tint if given else [1.0] * 3)
            np.testing.assert_array_equal(plan["absorption"][0], absorption if given else [0.0] * 3)
            assert plan["learned_tints"] == (1 if number in (2, 5) else 0)
    assert plans[0]["reentry"] == "impossible" and "no re-entry" in plans[0]["printed"]
    assert "no meshes: no tracer" in plans[7]["printed"]
    assert [plan["printed"].count("warning: ") for plan in (plans[1], plans[4])] == [0, 1]
    nerfacto = plans[10]
    assert (nerfacto["proposals"], nerfacto["samples"]) == ([48, 24], 16)
    assert "nerfacto, grid 2^12, finest 512, float32" in nerfacto["printed"]
    assert [plans[n]["blurs"] for n in (0, 10)] == [[0.03], [0.03, 0.003]]
    last = plans[9]
    assert (last["bends"], last["proposals"], last["samples"]) == (4, [7], 6)
    assert last["footprint"] == "differential"
    ablated = ("reflections", "total_reflection", "distortion_over")
    assert [[plan[key] for key in ablated] for plan in (plans[9], *plans[11:])] == [
        ["first", "followed", "outside"],
        ["first", "ended", "everywhere"],
        ["none", "followed", "outside"],
    ]
