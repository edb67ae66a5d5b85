"""Which scenes and jobs a benchmark has, what is left out, and what may not change."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from experiments.benchmarking import methods, plan, results, settings
from experiments.benchmarking.methods import METHODS, RECONSTRUCTION
from experiments.cli import scenes as cli_scenes
from experiments.runs import config_flags
from refref_jax.data.scene_analysis import SceneAnalysis
from refref_jax.training.config import TrainConfig
from refref_jax.training.resolve import SceneFacts, resolve
from tests.factories.made_benchmark import SETTINGS, write_scene
from tests.factories.small_model import CAMERAS
from tests.factories.small_parquet import write_all
from tests.processes.command import run_command

_ANALYSIS = SceneAnalysis(
    parts=1,
    objects=1,
    convex=True,
    reentry="impossible",
    interior="clear",
    tints="none",
    space="bounded",
)

_INSIDES = ["tree_clear", "tree_tints_given", "tree_tints_learned"]


def _scene(folder, **options):
    return plan.find_scenes([str(write_scene(folder / "cube_smcvx_ball", **options))])[0]


def _planned(scene, chosen, common=SETTINGS):
    """Returns the names of the methods with jobs, and why the others have none."""
    planned, skipped = plan.plan_jobs([scene], methods.parse(chosen.split(",")), common)
    names = [job.method for job in planned if job.method != RECONSTRUCTION]
    return names, {each.method: each.reason for each in skipped}


def _edit(name, old, new):
    def change(scene):
        path = scene / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    return change


def test_methods_are_in_the_order_of_the_table_and_none_hides_a_reconstruction():
    assert [method.name for method in methods.parse(["tree", "straight", "tree"])] == [
        "straight",
        "tree",
    ]
    assert {method.name for method in methods.parse(["all"])} == set(METHODS)
    baselines = methods.parse(["baselines"])
    assert [(each.name, each.requires) for each in baselines] == [
        ("msnerf", ()),
        ("neus", ("walls",)),
        ("unisurf", ("walls",)),
        ("tnsr", ("meshes", "walls")),
        ("tnsr_true_start", ("meshes", "walls")),
        ("raydef", ()),
        ("raydef_polyline", ()),
        ("rosenerf", ()),
        ("splats", ()),
    ]
    for group in ("main", "ablations"):
        names = {each.name for each in methods.parse([group])}
        assert not names & {each.name for each in baselines}
    assert {"oracle", "tree"} < {method.name for method in methods.parse(["ablations"])}
    assert RECONSTRUCTION not in METHODS
    assert METHODS["oracle_no_tir"].train == ("--paths=paper_no_tir", "--interior=field")
    for method in METHODS.values():
        names = [word.partition("=")[0] for word in method.train]
        assert len(set(names)) == len(names), method.name
    for word, message in [("magic", "no method 'magic'"), ("", "--methods is empty")]:
        with pytest.raises(ValueError, match=message):
            methods.parse([word])


def test_the_published_oracle_differs_from_ours_as_the_documents_say():
    ours, theirs = METHODS["oracle"], METHODS["oracle_as_published"]
    assert set(theirs.train) - set(ours.train) == {
        "--contraction=always",
        "--shading=flat",
        "--footprint=cone",
        "--colour_network=skip",
        "--data_loss=charbonnier",
        "--path_losses=transmitted",
        "--adam_b2=0.999",
    }
    assert set(ours.train) < set(theirs.train) and ours.published == theirs.published == "Oracle"
    for name, rays in [("oracle", 4), ("oracle_as_published", 1)]:
        common = dataclasses.replace(SETTINGS, rays_per_pixel=4, limit=3)
        made = plan.options(name, METHODS[name].train, common)
        assert made["evaluate"] == [f"--rays_per_pixel={rays}", "--limit=3"]
    facts = SceneFacts(_ANALYSIS, CAMERAS, (), None, 7.3, ())
    words = dict(word.removeprefix("--").split("=", 1) for word in theirs.train)
    values = {name: config_flags.parse_text(name, word) for name, word in words.items()}
    model = resolve(TrainConfig().override(batch=64, **values), facts).model.config
    assert (model.near, model.far, model.radius, model.space) == (0.5, 150.0, 10.0, "unbounded")
    assert (model.interior, model.footprint) == ("field", "cone")
    assert model.field.colour_network == "skip"


def test_there_is_a_job_for_each_scene_and_method_and_one_reconstruction_a_scene(tmp_path):
    for name in ("cube_smcvx_ball", "env_smncvx_torus"):
        write_scene(tmp_path / name)
    chosen = methods.parse(["straight", "r3f", "r3f_tree"])
    planned, skipped = plan.plan_jobs(plan.find_scenes([f"{tmp_path}/*"]), chosen, SETTINGS)
    first = f"cube_smcvx_ball/{RECONSTRUCTION}"
    assert [(job.name, job.awaited) for job in planned[:4]] == [
        (first, None),
        ("cube_smcvx_ball/straight", None),
        ("cube_smcvx_ball/r3f", first),
        ("cube_smcvx_ball/r3f_tree", first),
    ]
    assert len(planned) == 8 and skipped == []


@pytest.mark.parametrize(
    ("lacks", "left", "reason"),
    [
        ("meshes", ["straight", "r3f"], "no meshes"),
        ("masks", ["straight", "tree", "tree_tints_given"], "no masks"),
        ("colours", ["straight", "tree", "r3f"], "scene.json does not define"),
    ],
)
def test_what_a_scene_lacks_is_skipped_and_said(tmp_path, lacks, left, reason):
    chosen = "straight,tree,tree_tints_given,r3f"
    names, reasons = _planned(_scene(tmp_path, **{lacks: False}), chosen)
    assert sorted(names) == sorted(left) and {*names, *reasons} == set(chosen.split(","))
    assert all(reason in each for each in reasons.values())


def test_a_surface_is_for_scenes_with_walls(tmp_path):
    inside = _scene(tmp_path / "inside")
    assert _planned(inside, "neus,unisurf,tnsr") == (["neus", "unisurf", "tnsr"], {})
    given = dataclasses.replace(inside, options=("--background=unbounded",))
    names, reasons = _planned(given, "straight,neus")
    assert names == ["straight"] and "its background is infinitely far" in reasons["neus"]


def test_a_backdrop_is_for_scenes_where_only_the_background_is_unknown(tmp_path):
    clear = _scene(tmp_path / "clear")
    assert _planned(clear, "tree_backdrop") == (["tree_backdrop"], {})
    untold = _scene(tmp_path / "untold", colours=False)
    opaque = _scene(tmp_path / "opaque", colours=False)
    _edit("scene.json", '"ior_inside": 1.5', '"kind": "opaque"')(Path(opaque.path))
    for scene in (untold, opaque):
        names, reasons = _planned(scene, "tree,tree_backdrop")
        assert names == ["tree"] and "it needs a field" in reasons["tree_backdrop"]


@pytest.mark.parametrize(
    ("colour", "same", "told"),
    [
        ([1.0, 1.0, 1.0], "tree_clear", "(interior clear)"),
        ([0.9, 1.0, 1.0], "tree_tints_given", "(interior absorbing, tints given)"),
        (None, "tree_tints_learned", "(interior absorbing, tints learned)"),
    ],
)
def test_an_ablation_that_a_scene_comes_to_anyway_is_left_out(tmp_path, colour, same, told):
    scene = _scene(tmp_path, colours=colour is not None)
    if colour is not None:
        _edit("scene.json", "[1.0, 1.0, 1.0]", json.dumps(colour))(Path(scene.path))
    names, reasons = _planned(scene, ",".join(["tree", "tree_field", *_INSIDES]))
    assert reasons[same] == f"in this scene it equals tree {told}"
    # Given colours that are not told are wanting.
    assert set(reasons) - {same} <= ({"tree_tints_given"} if colour is None else set())
    assert set(names) == {"tree", "tree_field", *_INSIDES} - set(reasons)


@pytest.mark.parametrize(
    ("preset", "same"), [("small", "tree_differential"), ("paper", "tree_cone")]
)
def test_an_ablation_that_the_preset_has_already_is_left_out(tmp_path, preset, same):
    common = dataclasses.replace(SETTINGS, preset=preset)
    names, reasons = _planned(_scene(tmp_path), "all", common)
    found = {name: reason for name, reason in reasons.items() if "preset" in reason}
    assert found == {same: f"in the preset {preset} it equals tree"}
    assert len(names) + len(reasons) == len(METHODS)


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda scene: (scene / "transforms_test.json").unlink(), "transforms_test.json"),
        (lambda scene: (scene / "test/r_003.png").unlink(), "r_003.png"),
    ],
)
def test_a_scene_without_test_views_is_left_out_and_one_broken_otherwise_is_not(
    tmp_path, spoil, named
):
    scene = _scene(tmp_path)
    (Path(scene.path) / "scene.json").write_text("{")
    assert _planned(scene, "tree,tree_tints_given") == (["tree", "tree_tints_given"], {})
    spoil(Path(scene.path))
    names, reasons = _planned(scene, "main")
    assert names == [] and len(reasons) == 7
    assert all(
        "its test views cannot be read" in each and named in each for each in reasons.values()
    )


def test_scenes_are_found_by_wildcards_and_folders(tmp_path):
    for name in ("a/cube_smcvx_ball", "b/cube_smcvx_ball", "a/mine", "ball[1]", "ball1"):
        write_scene(tmp_path / name)
    (tmp_path / "a" / "preview").mkdir()
    found = plan.find_scenes([str(tmp_path / "a" / "*"), str(tmp_path / "a" / "mine")])
    assert [scene.name for scene in found] == ["cube_smcvx_ball", "mine"]
    assert results.category_and_background("cube_smcvx_ball") == ("smcvx", "cube")
    assert results.category_and_background("mine") == (results.OTHER, results.OTHER)
    for words, message in [
        ([str(tmp_path / "*" / "cube_*")], "are named cube_smcvx_ball"),
        ([str(tmp_path / "a" / "preview")], r"preview/transforms_train\.json does not exist"),
        ([str(tmp_path / "c*")], "matches no scene"),
        ([], "matches no scene"),
    ]:
        with pytest.raises(ValueError, match=message):
            plan.find_scenes(words)
    # A folder whose name looks like wildcards is taken as it is, as long as it is there.
    for name in ("ball[1]", "ball1"):
        (found,) = plan.find_scenes([str(tmp_path / "ball[1]")])
        assert found.path == str(tmp_path / name)
        shutil.rmtree(tmp_path / name)
    (tmp_path / "no[1]scene").mkdir()
    with pytest.raises(ValueError, match=r"scene/transforms_train\.json does not exist"):
        cli_scenes.check_all([str(tmp_path / "no[1]scene")])


def test_all_published_scenes_are_listed_without_unpacking_any(tmp_path, monkeypatch):
    names = write_all(tmp_path / "RefRef")
    monkeypatch.setenv("REFREF_HF", str(tmp_path / "RefRef"))
    monkeypatch.setenv("REFREF_CACHE", str(tmp_path / "cache"))
    out, ball = f"--out={tmp_path / 'out'}", "hf:cubebg_single-convex/cube_smcvx_ball"
    lines = run_command("benchmark", "--scenes=hf:all", "--dry_run", out).stdout.splitlines()
    jobs = [line.split()[2] for line in lines if line.startswith("to do")]
    for method in ("straight", "oracle", "tree"):
        assert sorted(names) == [job.split("/")[0] for job in jobs if job.endswith(f"/{method}")]
    assert len(names) == 150 and len(jobs) == 450
    assert lines[-2:] == [
        "450 jobs, 450 to do.",
        "150 scenes are not unpacked yet: methods may be skipped when they are.",
    ]
    assert not (tmp_path / "cache").exists() and not (tmp_path / "out").exists()
    # What is unpacked is planned as any scene.
    plan.find_scenes([ball])
    found = {scene.name: scene for scene in plan.find_scenes(["hf:*/*_ball"], unpack=False)}
    assert [bool(scene.fingerprint) for scene in found.values()] == [True, False, False]
    assert _planned(found["cube_smcvx_ball"], "straight,tree") == (
        ["straight"],
        {"tree": "it has no meshes"},
    )
    common = dataclasses.replace(SETTINGS, preset="small")
    assert _planned(found["env_smcvx_ball"], "tree,tree_differential", common) == (
        ["tree"],
        {"tree_differential": "in the preset small it equals tree"},
    )
    unpacked = plan.find_scenes(["hf:*/*_ball", ball])
    assert all(scene.fingerprint and Path(scene.path).is_dir() for scene in unpacked)
    assert [scene.name for scene in unpacked] == list(found)


def test_a_benchmark_grows_but_does_not_change(tmp_path):
    out, ball = tmp_path / "out", _scene(tmp_path)
    torus = dataclasses.replace(ball, name="env_smncvx_torus")
    first = settings.asked(SETTINGS, [ball], [METHODS["straight"]])
    settings.write(out, settings.extended(out, first))
    assert settings.read(out) == first
    more = settings.extended(out, settings.asked(SETTINGS, [torus], [METHODS["tree"]]))
    settings.write(out, more)
    assert set(more.scenes) == {ball.name, torus.name} and set(more.methods) == {"straight", "tree"}
    # The same scene, elsewhere.
    moved = dataclasses.replace(ball, path="/moved")
    assert settings.extended(out, settings.asked(SETTINGS, [moved], [])).scenes[ball.name] == moved
    another = dataclasses.replace(ball, fingerprint="other")
    changed = dataclasses.replace(METHODS["tree"], train=("--paths=tree", "--cut=0.5"))
    for common, scenes, chosen, message in [
        ({"steps": 7}, [], [], "started with steps 6, but is now requested with steps 7.*--steps"),
        ({"limit": 3}, [], [], "started without --limit"),
        ({"lpips": "abc"}, [], [], "--lpips_weights"),
        ({}, [another], [], "another scene named cube_smcvx_ball"),
        ({}, [], [changed], "the method tree is --paths=tree, but in this version"),
    ]:
        asked = settings.asked(dataclasses.replace(SETTINGS, **common), scenes, chosen)
        with pytest.raises(ValueError, match=message):
            settings.extended(out, asked)
    (out / settings.FILE).write_text('{"settings": {}}')
    for folder, message in [(out, "is not a valid benchmark"), (tmp_path, "has no benchmark")]:
        with pytest.raises(ValueError, match=message):
            settings.read(folder)


def _append(name):
    def change(scene):
        with (scene / name).open("ab") as file:
            file.write(b"0")

    return change


@pytest.mark.parametrize(
    "change",
    [
        _edit("scene.json", "1.5", "1.9"),
        _edit("meshes/ball_glass.ply", "looked", "booked"),
        _edit("transforms_test.json", "10.5", "10.6"),
        _append("train/r_001.png"),
        _append("mask/train/r_000.png"),
        _append("depth/train/r_000.png"),
        lambda scene: (scene / "depth/train/r_000.exr").write_bytes(b"0"),
        lambda scene: (scene / "train/r_000.png").unlink(),
        lambda scene: (scene / "scene.json").unlink(),
        lambda scene: (scene / "meshes/ball_glass.ply").rename(scene / "meshes/ball_water.ply"),
    ],
)
def test_a_fingerprint_changes_with_what_decides_results_and_with_nothing_else(tmp_path, change):
    scene = write_scene(tmp_path / "ball")
    before = plan.fingerprint(scene)
    shutil.copytree(scene, tmp_path / "elsewhere")
    (scene / "preview.png").write_bytes(b"0")
    assert plan.fingerprint(scene) == before == plan.fingerprint(tmp_path / "elsewhere")
    change(scene)
    assert plan.fingerprint(scene) != before


@pytest.mark.parametrize("text", ["{", "[]", '{"frames": 3}', '{"frames": [3, {"file_path": 1}]}'])
def test_a_broken_scene_has_a_fingerprint_too(tmp_path, text):
    scene = write_scene(tmp_path / "ball")
    (scene / "transforms_train.json").write_text(text)
    assert len(plan.fingerprint(scene)) == 16
