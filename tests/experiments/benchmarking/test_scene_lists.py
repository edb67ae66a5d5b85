"""Lists of scenes with properties: what they say, and how it reaches jobs and results."""

import json
import re

import pytest

from experiments.benchmarking import methods, plan, results, scene_lists, settings, worker
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.scene_lists import ListedScene, expand
from tests.factories.made_benchmark import SETTINGS, write_scene
from tests.processes.command import ROOT


def _write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return str(path)


def _examples():
    page = (ROOT / "docs/benchmark.md").read_text()
    return dict(re.findall(r"<!-- example: (.*?) -->\n```\w+\n(.*?)```", page, re.DOTALL))


def test_the_examples_of_the_documentation_are_read(tmp_path):
    (tmp_path / "under_water.json").write_text('{"ambient_index": 1.333}')
    path = _write(tmp_path / "scenes.json", _examples()["scenes.json"])
    assert expand([path]) == [
        ListedScene(str(tmp_path / "scenes/cup"), ("--rule=facing", "--ior=glass=1.52")),
        ListedScene(
            "hf:spherebg_single-convex/sphere_smcvx_ball",
            ("--background=spherical", "--radius=7.3"),
        ),
        ListedScene(
            str(tmp_path / "scenes/env_*"), (), str((tmp_path / "under_water.json").resolve())
        ),
    ]
    path = _write(tmp_path / "scenes.csv", _examples()["scenes.csv"])
    assert expand([path, " other "]) == [
        ListedScene(
            str(tmp_path / "scenes/cup"),
            ("--rule=facing", "--ior=glass=1.52", "--ior=water=1.33"),
        ),
        ListedScene(
            "hf:spherebg_single-convex/sphere_smcvx_ball",
            ("--background=spherical", "--radius=7.3"),
        ),
        ListedScene("other"),
    ]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "a.json is not valid JSON"),
        ("a.json", {"scene": []}, "only key 'scenes'"),
        ("a.json", [], "a.json lists no scene"),
        ("a.json", [{"rule": "nested"}], "scene 1 does not have the key 'scene'"),
        ("a.json", [{"scene": "x", "rul": "nested"}], "scene 1: 'rul' is not.*Write 'rule'"),
        ("a.json", [{"scene": "x"}, {"scene": "y", "rule": "x"}], "scene 2: rule is 'x'. Give one"),
        ("a.json", [{"scene": "x", "background": "cube"}], "background is 'cube'. Give one of bou"),
        ("a.json", [{"scene": "x", "radius": -1}], "radius is -1. Give a positive number"),
        ("a.json", [{"scene": "x", "ior": 1.5}], "ior is 1.5. Give positive numbers"),
        ("a.json", [{"scene": "x", "properties": 3}], "properties is 3. Give the name"),
        ("a.json", [{"scene": "x", "properties": "no.json"}], "no.json does not exist"),
        ("a.csv", "scene,rule\n", "a.csv lists no scene"),
        ("a.csv", "scene,radius\nx,far\n", "radius is 'far'"),
        ("a.csv", "scene,ior\nx,glass\n", "ior is .*glass=1.52 in CSV"),
        ("a.csv", "scene,rules\nx,nested\n", "'rules' is not a known key. Write 'rule'"),
        ("a.csv", "scene\nx,nested\n", "is not a known key"),
    ],
)
def test_a_wrong_list_is_refused_in_one_line(tmp_path, name, content, message):
    with pytest.raises(ValueError, match=message) as caught:
        expand([_write(tmp_path / name, content)])
    assert name in str(caught.value) or "no.json" in message
    assert "\n" not in str(caught.value)


def test_a_list_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"nowhere\.csv does not exist"):
        expand(["nowhere.csv"])


@pytest.fixture
def listed(tmp_path):
    """Writes a scene, and returns a function that finds it in a list with properties."""
    write_scene(tmp_path / "cube_smcvx_ball")

    def find(**properties):
        rows = [{"scene": "cube_smcvx_*", **properties}]
        return plan.find_scenes([_write(tmp_path / "list.json", rows)])[0]

    return find


def test_properties_are_part_of_a_scene_and_of_its_fingerprint(listed, tmp_path):
    plain = plan.find_scenes([str(tmp_path / "cube_smcvx_ball")])[0]
    assert listed() == plain and plain.options == ()
    first, second = listed(rule="facing"), listed(rule="nested")
    assert first.options == ("--rule=facing",)
    (tmp_path / "mine.json").write_text('{"ambient_index": 1.333}')
    third = listed(properties="mine.json")
    (tmp_path / "mine.json").write_text('{"ambient_index": 1.25}')
    fourth = listed(properties="mine.json")
    found = {each.fingerprint for each in (plain, first, second, third, fourth)}
    assert len(found) == 5 and first.path == second.path == plain.path
    out = tmp_path / "out"
    settings.write(out, settings.asked(SETTINGS, [first], [METHODS["tree"]]))
    assert settings.read(out).scenes[first.name] == first
    with pytest.raises(ValueError, match=r"scene\.json or properties"):
        settings.extended(out, settings.asked(SETTINGS, [second], []))


def test_a_scene_has_one_set_of_properties(tmp_path, listed):
    place = listed().path
    path = _write(tmp_path / "two.json", [{"scene": place}, {"scene": place, "rule": "facing"}])
    with pytest.raises(ValueError, match="listed with different properties"):
        plan.find_scenes([path])


def test_the_overlay_of_a_scene_decides_which_methods_fit(tmp_path, listed):
    (tmp_path / "mine.json").write_text(
        '{"parts": [{"mesh": "ball_glass.ply", "absorption": [1, 0, 0]}]}'
    )
    chosen = methods.parse(["tree", "tree_clear"])
    for properties, skipped in [({}, ["tree_clear"]), ({"properties": "mine.json"}, [])]:
        found = plan.plan_jobs([listed(**properties)], chosen, SETTINGS)
        assert [each.method for each in found[1]] == skipped


def test_properties_reach_trainings_and_reconstructions_and_are_recorded(
    tmp_path, listed, stand_in
):
    (tmp_path / "mine.json").write_text('{"ambient_index": 1.0}')
    given = {"rule": "facing", "radius": 7, "ior": {"glass": 1.6}, "properties": "mine.json"}
    scene = listed(background="spherical", **given)
    jobs, _ = plan.plan_jobs([scene], methods.parse(["straight", "r3f"]), SETTINGS)
    out = tmp_path / "out"
    assert [worker.run_job(out, job) for job in jobs] == [None] * 3
    overlay = f"properties={(tmp_path / 'mine.json').resolve()}"
    trained = {
        job.method: (plan.job_folder(out, job) / "run" / "trained_with").read_text().split()
        for job in jobs
        if job.method in METHODS
    }
    bounds = {"background=spherical", "radius=7", overlay}
    assert set(trained["straight"]) > {"rule=facing", "ior=glass=1.6", *bounds}
    assert set(trained["r3f"]) > bounds
    assert not [word for word in trained["r3f"] if word.startswith(("rule=", "ior="))]
    everything = results.read_all(out, settings.asked(SETTINGS, [scene], []))
    assert len(everything) == 3
    for record in everything:
        told = record.options[plan.PROPERTIES]
        bounds = ["--background=spherical", "--radius=7"]
        assert told[:-1] == ["--rule=facing", *bounds, "--ior=glass=1.6"]
        assert re.fullmatch(r"--properties=sha256:[0-9a-f]{16}", told[-1])
    other = listed(rule="nested")
    with pytest.raises(ValueError, match="is of another scene"):
        results.read_all(out, settings.asked(SETTINGS, [other], []))


def test_the_scenes_of_lists_are_checked_before_they_are_opened(tmp_path):
    path = _write(tmp_path / "a.json", [{"scene": "ball"}, {"scene": "hf:x/y"}])
    assert scene_lists.sources([path, "z"]) == [str(tmp_path / "ball"), "hf:x/y", "z"]


def test_numbers_of_a_list_keep_all_their_digits(tmp_path):
    path = tmp_path / "scenes.csv"
    path.write_text("scene,radius,ior\nball,7.29998123,glass=1.45833333\n")
    (listed,) = scene_lists.expand([str(path)])
    assert listed.options == ("--radius=7.29998123", "--ior=glass=1.45833333")
