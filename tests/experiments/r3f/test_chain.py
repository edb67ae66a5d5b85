"""The stages of R3F on a small scene, in this process: results, repetition, interruption."""

import dataclasses
import functools
import json
import shutil
import sys
import types
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh

from experiments.r3f import (
    chain,
    geometry_stage,
    index_stage,
    light_figures,
    light_stage,
    object_source,
    records,
    report,
    training_body,
)
from experiments.r3f.records import ReconstructionConfig
from refref_jax.data import meshes, scene_folder
from refref_jax.geometry.triangle_meshes import corner_normals, make_mesh
from refref_jax.reconstruct import ReconstructionError, opaque_parts, refinement
from refref_jax.reconstruct.bubbles import Bubble, ObjectWithBubbles
from refref_jax.reconstruct.contents import COARSE, Interior
from refref_jax.reconstruct.free_vessels import FreeVessel
from refref_jax.reconstruct.gauss_newton import Fit
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.mesh_distance import compare_meshes
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.opaque_parts import OpaquePart
from refref_jax.reconstruct.refinement import Refinement
from refref_jax.reconstruct.refractive_index import Descent, IndexEstimate
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, mesh_of
from refref_jax.training import config_files
from refref_jax.training.config import TrainConfig
from tests.factories import bodies, scenes, vessels
from tests.factories.silhouettes import RADIUS, without_masks, write_scene
from tests.factories.small_scenes import write_grey

pytestmark = pytest.mark.longest

_UNREFINED = Refinement(denoising=0.0, corners=0)

_CONFIG = ReconstructionConfig("hull", 20, 0, 1.5, None, None, "none", 0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball")


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    """A reconstruction that nothing interrupted, compared with the truth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "compare_meshes", functools.partial(compare_meshes, samples=2000))
        patch.setattr(report, "_HEIGHT", 40)
        out = tmp_path_factory.mktemp("whole") / "out"
        _run(scene, out)
    return out


@pytest.fixture(scope="module")
def blind(scene, tmp_path_factory):
    """The same, which has not looked at the scene's meshes."""
    out = tmp_path_factory.mktemp("blind") / "out"
    _run(scene, out, compare=False)
    return out


def _run(scene, out, config=_CONFIG, *, compare=True):
    return chain.reconstruct(scene, out, config, compare=compare, say=lambda text: None)


def _contents(out):
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("*") if p.is_file()}


def test_a_ball_is_found_from_its_masks(whole):
    found = records.read(whole)
    assert found.scene == "cube_smcvx_ball" and found.config == _CONFIG
    assert found.geometry.mesh == "ball_glass.ply" and found.geometry.masks == 24
    # A ball has no corners.
    assert [words.partition(":")[0] for words in found.geometry.refused] == ["corners"]
    assert found.geometry.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.04)
    assert found.report.split == "test" and len(found.report.overlaps) == 5
    assert found.report.mean_overlap > 0.97 and found.geometry.warnings == ()
    assert found.report.truth.chamfer < 0.005 and found.report.truth.normal_error < 3.0
    index = json.loads((whole / "index.json").read_text())
    assert index == {"source": "given", "index": 1.5, "error": None, "loss": None}


@pytest.mark.slow
def test_the_surface_in_the_file_is_what_light_is_traced_through(
    whole, monkeypatch, scene, tmp_path
):
    written = []
    write = meshes.write_mesh

    def keep(path, *mesh):
        written.append(mesh)
        write(path, *mesh)

    monkeypatch.setattr(meshes, "write_mesh", keep)
    geometry_stage.run(scene, tmp_path, _CONFIG)
    (vertices, faces, normals), body = written[0], chain.read_parts(whole)[0]
    np.testing.assert_array_equal(body.vertices[body.faces], vertices[faces])
    np.testing.assert_array_equal(body.normals, normals)
    assert body.index == 1.5
    # Whoever reads positions alone comes to nearly the same normals.
    by_crease = corner_normals(body.vertices, body.faces)
    assert np.mean(np.sum(by_crease * normals, axis=-1)) > 0.999


def test_the_report_names_its_figures_and_finds_its_pictures(whole):
    text = (whole / "report.md").read_text()
    found = records.read(whole)
    for figure in (f"{found.report.mean_overlap:.4f}", f"{found.report.truth.chamfer:.3%}", "1.5"):
        assert figure in text
    assert "--reconstruction=" in text and "Compared with ball_glass.ply" in text
    links = [part.split(")")[0] for part in text.split("](")[1:]]
    assert len(links) == 4 and all((whole / link).is_file() for link in links)


def test_a_finished_reconstruction_is_not_done_again(scene, whole, monkeypatch):
    before = _contents(whole)
    for module in (geometry_stage, report):
        monkeypatch.setattr(module, "run", None)  # would raise
    _run(scene, whole)
    assert _contents(whole) == before


class _KilledError(BaseException):
    """Nothing that is caught."""


def _killing(function, *, after=False, calls=1):
    """Returns the function until so many calls were made, of which the last one is killed."""
    made = []

    def killed(*arguments, **options):
        made.append(arguments)
        if len(made) == calls and not after:
            raise _KilledError
        result = function(*arguments, **options)
        if len(made) == calls:
            raise _KilledError
        return result

    return killed


@pytest.mark.parametrize(
    ("target", "options"),
    [
        ("experiments.r3f.geometry_stage.refine", {}),
        ("refref_jax.data.meshes.write_mesh", {"after": True}),  # before the renaming
        ("experiments.r3f.geometry_stage.run", {"after": True}),  # renamed, not recorded
        ("experiments.r3f.records.write", {"calls": 2, "after": True}),  # between two stages
        ("experiments.r3f.report_figures.draw_surface", {"after": True}),
        ("experiments.r3f.report.markdown", {}),
        ("experiments.r3f.records.write", {"calls": 4}),  # all done, not recorded
    ],
)
@pytest.mark.slow
def test_whatever_is_killed_comes_to_the_same_files(scene, blind, tmp_path, target, options):
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        module, _, name = target.rpartition(".")
        patch.setattr(target, _killing(getattr(sys.modules[module], name), **options))
        with pytest.raises(_KilledError):
            _run(scene, out, compare=False)
    assert _contents(out) != _contents(blind)
    _run(scene, out, compare=False)
    assert _contents(out) == _contents(blind)


@pytest.mark.slow
def test_a_stage_whose_files_were_removed_is_done_again(scene, blind, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(blind, out)
    shutil.rmtree(out / "geometry")
    shutil.rmtree(out / "pictures")
    _run(scene, out, compare=False)
    assert _contents(out) == _contents(blind)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"resolution": 24}, "resolution 20, not 24"),
        ({"index": None}, "ior 1.5, not estimated"),
        ({"index": 1.6, "seed": 3}, "ior 1.5, not 1.6, seed 0, not 3"),
    ],
)
def test_other_options_are_refused_by_name(scene, whole, change, told):
    before = _contents(whole)
    with pytest.raises(ValueError, match=told):
        _run(scene, whole, dataclasses.replace(_CONFIG, **change))
    assert _contents(whole) == before


def test_another_scene_is_refused_and_a_moved_one_is_not(scene, whole, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(scene, moved)
    _run(moved, whole)
    changed = next((moved / "mask" / "train").iterdir())
    iio.imwrite(changed, 255 - iio.imread(changed))
    with pytest.raises(ValueError, match="other images, masks or poses"):
        _run(moved, whole)


def test_folders_of_other_things_are_left_alone(scene, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="files, but no reconstruction"):
        _run(scene, tmp_path)
    with pytest.raises(ValueError, match="is a file"):
        _run(scene, tmp_path / "notes.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_what_is_missing_is_told_before_anything_is_written(scene, tmp_path, monkeypatch):
    bare = tmp_path / "bare"
    shutil.copytree(scene, bare)
    with pytest.raises(ValueError, match=r"masks.*mask_file_path"):
        _run(without_masks(bare), tmp_path / "out")
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(ValueError, match=r"pip install -e '.\[r3f\]'"):
        _run(scene, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("split", ["val", "test"])
def test_broken_masks_of_held_out_views_are_named_before_anything_is_written(
    scene, tmp_path, split
):
    copy = shutil.copytree(scene, tmp_path / "broken")
    for other in ("val", "test"):
        shutil.copy(copy / "transforms_train.json", copy / f"transforms_{other}.json")
    content = json.loads((copy / f"transforms_{split}.json").read_text())
    mask = copy / "mask" / "no image.png"
    mask.write_bytes(b"no image")
    content["frames"][-1]["mask_file_path"] = str(mask.relative_to(copy))
    (copy / f"transforms_{split}.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"no image\.png"):
        _run(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("compare", "remark"), [(False, "were not read"), (True, "could not be read")]
)
@pytest.mark.slow
def test_broken_meshes_of_the_scene_harm_nothing(scene, whole, tmp_path, compare, remark):
    broken = tmp_path / "cube_smcvx_ball"
    shutil.copytree(scene, broken)
    (broken / "meshes" / "ball_glass.ply").write_bytes(b"broken")
    found = _run(broken, tmp_path / "out", compare=compare)
    assert found.report.truth is None and remark in found.report.remark
    assert remark in (tmp_path / "out" / "report.md").read_text()
    ours, theirs = _contents(tmp_path / "out"), _contents(whole)
    assert ours["geometry/ball_glass.ply"] == theirs["geometry/ball_glass.ply"]


def _estimate(index, deviation):
    nowhere = Descent((index,), (0.02,))
    return IndexEstimate(index, deviation, 0.02, nowhere, (nowhere,))


@pytest.mark.slow
def test_an_index_that_is_not_given_is_estimated_once(scene, tmp_path, monkeypatch):
    asked = []

    def estimate(folder_of_scene, mesh, folder, *, seed, space, radius, centre):
        assert (space, radius) == ("unbounded", 2.5)
        assert folder_of_scene == scene and folder.is_dir() and len(mesh.faces) > 100
        asked.append(seed)
        return _estimate(1.48, 0.01)

    monkeypatch.setattr(index_stage, "run", estimate)
    config = dataclasses.replace(_CONFIG, index=None, seed=7, space="unbounded", radius=2.5)
    for _ in range(2):
        found = _run(scene, tmp_path / "out", config, compare=False)
    assert asked == [7]
    assert (found.index.source, found.index.index, found.index.error) == ("estimated", 1.48, 0.01)
    report = (tmp_path / "out" / "report.md").read_text()
    assert "1.4800** ± 0.0100" in report
    assert "`--background=unbounded` `--radius=2.5`" in report
    assert chain.read_parts(tmp_path / "out")[0].index == 1.48


def _trial(name, mesh, index, errors):
    """A shape that was fitted, without its fit."""
    fit = Fit(np.full(1, index), np.full((1, 1), 1e-6), ())
    return Trial(name, SingleObject(FixedShape(mesh), index), fit, np.asarray(errors))


_SHAPELESS = light_stage.RevolvedObject(None)

_VIEWS = 1e-3 * np.linspace(-1.0, 1.0, 5)


def _stub_light(monkeypatch, *, after, growth=1.001, index=1.51):
    """Replaces what learns and fits, which is tested elsewhere; returns what it is called with."""
    called = []

    def fit(scene, mesh, known, surface, seen, revolved, *, seed):
        called.append((known.index, surface, seen.split, seed))
        before = _trial("masks", mesh, known.index, 0.04 + _VIEWS)
        grown = mesh._replace(vertices=growth * mesh.vertices)
        return before, _trial("sphere", grown, index, after + _VIEWS)

    monkeypatch.setattr(light_stage, "fit", fit)
    monkeypatch.setattr(light_figures, "draw", lambda path, *_: path.write_bytes(b"figure"))
    monkeypatch.setattr(light_stage, "look_at_opaque_parts", lambda *_, **options: _SHAPELESS)
    solved = types.SimpleNamespace(config=types.SimpleNamespace(backdrop="surface"))
    resolved = types.SimpleNamespace(model=solved)
    monkeypatch.setattr(index_stage, "resolve_background", lambda *_, **options: resolved)
    monkeypatch.setattr(index_stage, "learn_backdrop", lambda *_, **options: "surface")
    return called


def _with_validation(scene, target):
    judged = target / scene.name
    shutil.copytree(scene, judged)
    shutil.copy(judged / "transforms_test.json", judged / "transforms_val.json")
    return judged


_LIT = dataclasses.replace(_CONFIG, refinement="light")

_JUDGED = (("masks", 0.04), ("sphere", 0.05))


def test_where_light_explains_no_more_the_surface_stays_and_the_reason_is_told(scene, whole):
    mesh = object_source.read_mesh(whole, records.read(whole))
    masks, worse = (_trial(name, mesh, 1.5, error + _VIEWS) for name, error in _JUDGED)
    _, chosen, remark = light_stage.choose(scene, mesh, (masks, worse))
    assert chosen is masks and "no shape explains the judges significantly better" in remark


@pytest.mark.slow
@pytest.mark.parametrize(("after", "kept"), [(0.03, True), (0.05, False)])
def test_light_is_kept_only_where_validation_views_say_so(
    scene, whole, tmp_path, monkeypatch, after, kept
):
    out, judged = tmp_path / "out", _with_validation(scene, tmp_path)
    shutil.copytree(whole, out)
    old = object_source.read_mesh(out, records.read(out))
    called = _stub_light(monkeypatch, after=after)
    for _ in range(2):
        found = _run(judged, out, _LIT, compare=False)
    assert called == [(1.5, "surface", "val", 0)]
    facts = found.light
    assert (facts.kept, facts.shape) == (kept, "sphere" if kept else "masks")
    assert facts.before == pytest.approx(0.04)
    assert facts.after == pytest.approx(0.03 if kept else 0.04)
    assert [trial.shape for trial in facts.trials] == ["masks", "sphere"]
    assert min(trial.worse for trial in facts.trials) == 0.0
    assert max(trial.worse for trial in facts.trials) == pytest.approx(0.01)
    part = chain.read_parts(out)[0]
    grown = np.ptp(part.vertices) / np.ptp(old.vertices)
    assert grown == pytest.approx(1.001 if kept else 1.0)
    told = (out / "report.md").read_text()
    assert ("(light/ball_glass.ply)" in told) == kept
    assert ("stays as it is, since no shape explains the judges" in told) != kept
    assert ("| **sphere** | 1 | 0.0300 | 0.0000 ± 0.0000 |" in told) == kept
    assert "worse than the best" in told and "judged by validation views" in told
    assert "(light/errors.png)" in told and (out / "light" / "errors.png").is_file()
    # The index was given, so that light leaves it alone.
    assert json.loads((out / "index.json").read_text())["index"] == part.index == 1.5
    if kept:
        (out / "light" / "ball_glass.ply").unlink()
        with pytest.raises(ValueError, match="not finished"):
            chain.read_parts(out)[0]
        assert _run(judged, out, _LIT, compare=False) == found


@pytest.mark.slow
def test_an_estimated_index_is_refined_with_the_surface(scene, whole, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    estimated = dataclasses.replace(_LIT, index=None)
    begun = dataclasses.replace(
        records.read(out),
        config=estimated,
        index=records.IndexFacts("estimated", 1.48, 0.01, 0.04),
        report=None,
    )
    records.write(out, begun)
    _stub_light(monkeypatch, after=0.03)
    found = _run(scene, out, estimated, compare=False)
    assert found.light.kept and found.light.split == "train"
    index = json.loads((out / "index.json").read_text())
    assert index["source"] == "refined" and index["index"] == 1.51
    assert index["error"] == pytest.approx(1e-3) and chain.read_parts(out)[0].index == 1.51
    assert "1.5100** ± 0.0010 (one standard deviation), refined" in (out / "report.md").read_text()


def test_a_body_that_light_blew_up_is_left_out(scene, monkeypatch, tmp_path):
    mesh = bodies.icosphere(2)
    _stub_light(monkeypatch, after=0.01, growth=1.5)
    known, target = records.IndexFacts("estimated", 1.5, 0.01, 0.04), tmp_path / "a" / "b.ply"
    facts = light_stage.run(scene, mesh, known, "surface", target, seed=0)
    assert not facts.kept and not target.exists() and facts.index == 1.5
    assert facts.shape == "masks" and facts.remark.startswith("the sphere was rejected: ")
    assert facts.deviation is None and facts.undetermined == 1.0


@pytest.mark.parametrize("growth", [1.0, 1.5])
def test_bubbles_come_with_the_shape_that_is_chosen(scene, monkeypatch, tmp_path, growth):
    mesh, bubble = bodies.icosphere(3), Bubble(np.array([0.2, 0.1, -0.3]), 0.15)
    grown = mesh._replace(vertices=growth * mesh.vertices)
    masks, solid = _trial("masks", mesh, 1.5, 0.04 + _VIEWS), _trial("ball", grown, 1.52, 0.03)
    model = ObjectWithBubbles(solid.model, solid.fit.x, [bubble])
    fit = Fit(model.start(), 1e-6 * np.eye(5), ())
    solid = solid._replace(by_view=0.03 + _VIEWS)
    # Few views see the bubble: by all of them, it is not significantly better.
    bubbly = Trial("ball with 1 bubble", model, fit, 0.0299 + _VIEWS)
    monkeypatch.setattr(light_stage, "fit", lambda *_, **options: (masks, solid, bubbly))
    monkeypatch.setattr(light_figures, "draw", lambda path, *_: path.write_bytes(b"figure"))
    monkeypatch.setattr(light_stage, "look_at_opaque_parts", lambda *_, **options: _SHAPELESS)
    known, target = records.IndexFacts("estimated", 1.5, 0.01, 0.04), tmp_path / "a" / "b_glass.ply"
    facts = light_stage.run(scene, mesh, known, "surface", target, seed=0)
    if growth > 1.0:  # the shape was rejected, and its bubbles with it
        assert not facts.kept and facts.parts == ()
        return
    assert (facts.shape, facts.index) == ("ball with 1 bubble", pytest.approx(1.52))
    assert [part.mesh for part in facts.parts] == ["b_glass_glass.ply", "b_bubble1_air.ply"]
    assert [part.index for part in facts.parts] == pytest.approx([1.52, 1.0])
    air = meshes.read_part(target.parent / facts.parts[1].mesh, index=1.0)
    radii = np.linalg.norm(air.vertices - bubble.centre, axis=-1)
    np.testing.assert_allclose(radii, bubble.radius, rtol=1e-5)


@pytest.mark.parametrize("is_vessel", [pytest.param(True, marks=pytest.mark.slow), False])
def test_opaque_parts_are_those_of_vessels_alone(scene, monkeypatch, tmp_path, is_vessel):
    outer = vessels.bottle()
    top, colour = float(outer.points[:, 1].max()), (0.02, 0.05, 0.3)
    cap = OpaquePart(top - 0.5, top, colour)
    labels = [OpaquePart(low, low + 0.2, (0.8, 0.8, 0.7)) for low in (top - 1.8, top - 1.4)]
    whole = mesh_of(outer.pose(outer.start()))
    masks = _trial("masks", whole, 1.35, 0.1 + _VIEWS)
    if is_vessel:
        model = Vessel(opaque_parts.clear_part(outer, (cap,)), Interior("air", wall=0.1), COARSE)
    else:
        model = SingleObject(FixedShape(whole), 1.5)
    x = model.start()
    chosen = Trial("the other", model, Fit(x, 1e-6 * np.eye(len(x)), ()), 0.02 + _VIEWS)
    painted = []
    monkeypatch.setattr(light_stage, "fit", lambda *_, **options: (masks, chosen))
    monkeypatch.setattr(
        light_stage,
        "look_at_opaque_parts",
        lambda *_, **options: light_stage.RevolvedObject(outer, (*labels, cap)),
    )

    def draw(path, *options):
        path.write_bytes(b"figure")
        painted.append(options[-1](scenes.rays([[4.0, 0.0, 1.2]], [[-1.0, 0.0, 0.0]])))

    monkeypatch.setattr(light_figures, "draw", draw)
    known, target = records.IndexFacts("estimated", 1.5, 0.01, 0.04), tmp_path / "a" / "b_glass.ply"
    facts = light_stage.run(scene, whole, known, "surface", target, seed=0)
    assert np.isnan(painted[0]).all() != is_vessel
    if not is_vessel:
        assert not facts.kept and facts.parts == () and "opaque" in facts.remark
        return
    opaque = [f"b_{name}_opaque.ply" for name in ("label1", "label2", "cap")]
    files = ["b_glass_glass.ply", "b_air_air.ply", *opaque]
    assert [part.mesh for part in facts.parts] == files
    assert facts.parts[-1].radiance == colour
    part = object_source._read(target.parent, facts.parts[-1])
    assert part.material.kind == "opaque"
    np.testing.assert_allclose(part.radiance, np.broadcast_to(colour, part.radiance.shape))
    glass = meshes.read_part(target.parent / files[0], index=1.5)
    assert glass.vertices[:, 2].max() < part.vertices[:, 2].min()


@pytest.mark.slow
def test_a_label_alone_leaves_solids_and_free_vessels_as_they_are(scene, monkeypatch, tmp_path):
    outer = vessels.bottle()
    low = float(outer.points[:, 1].min()) + 0.9
    revolved = light_stage.RevolvedObject(outer, (OpaquePart(low, low + 0.5, (0.8, 0.8, 0.7)),))
    whole = mesh_of(outer.pose(outer.start()))
    inner = whole._replace(vertices=whole.vertices.mean(axis=0) + 0.5 * whole.vertices)
    free = FreeVessel(whole, inner, Interior("air", wall=0.1), spacings=(0.15, 0.15))
    monkeypatch.setattr(light_stage, "look_at_opaque_parts", lambda *_, **options: revolved)
    monkeypatch.setattr(light_figures, "draw", lambda path, *options: path.write_bytes(b"figure"))
    masks = _trial("masks", whole, 1.35, 0.1 + _VIEWS)
    known = records.IndexFacts("given", 1.5, 0.0, 0.04)
    for number, model in enumerate((SingleObject(FixedShape(whole), 1.5), free)):
        x = model.start()
        chosen = Trial("the other", model, Fit(x, 1e-6 * np.eye(len(x)), ()), 0.02 + _VIEWS)
        monkeypatch.setattr(light_stage, "fit", lambda *_, found=chosen, **options: (masks, found))
        target = tmp_path / str(number) / "b_glass.ply"
        facts = light_stage.run(scene, whole, known, "surface", target, seed=0)
        assert facts.kept and not [part for part in facts.parts if "label" in part.mesh]
        assert len(facts.parts) == 2 * number


def test_a_ring_has_no_ends_and_holds_nothing(monkeypatch):
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=64, minor_sections=32)
    mesh = make_mesh(ring.vertices, ring.faces)
    monkeypatch.setattr(light_stage, "fit_profile", None)  # would raise
    found = light_stage.look_at_opaque_parts(Path("nowhere"), mesh, None, None, seed=0)
    assert found.outer is None and found.opaque == ()


@pytest.mark.parametrize(("after", "doubted"), [(0.03, False), (0.09, True)])
def test_an_object_that_no_model_explains_is_told(after, doubted):
    facts = records.LightFacts(
        kept=True, index=1.99, shape="vessel: liquid", before=0.11, after=after
    )
    line = chain._describe_light(facts)
    assert line.startswith("refinement by light: error of validation views 0.1100 before")
    assert ("warning: an error of 0.0900 is left" in line) == doubted
    found = dataclasses.replace(records.Reconstruction("ball", "", _CONFIG), light=facts)
    assert any("straight rays" in part for part in report._of_light(found)) == doubted


@pytest.mark.parametrize(
    ("after", "given", "interior"),
    [
        (0.03, {}, None),
        (0.07, {}, "field"),
        (0.07, {"interior": "clear"}, "clear"),
        (0.07, {"tints": "learned"}, None),
        (0.07, {"tints": "none"}, "field"),
        (0.07, {"tint_decay": 0.01}, None),
        (0.07, {"exposure": "fixed"}, "field"),
        (0.07, {"pixels": "background"}, None),
        (0.07, {"field": "tnsr"}, None),
        (0.07, {"exposure": "per_image"}, None),
        (0.07, {"exposure": "per_image", "far_field": "field"}, "field"),
        (0.07, {"far_field": "field"}, "field"),
        (None, {}, None),
    ],
)
def test_a_field_learns_what_a_shape_leaves_unexplained_where_masks_show_it(
    scene, whole, tmp_path, after, given, interior
):
    made, said = tmp_path / "made", []
    shutil.copytree(whole, made)
    light = records.LightFacts(kept=True, index=1.5, before=0.11, after=after)
    records.write(made, dataclasses.replace(records.read(made), light=light))
    asked = TrainConfig().override(scene=str(scene), reconstruction=str(made), **given)
    parts, run = [scenes.ball(1.0, subdivisions=1)], tmp_path / "run"
    config = training_body.with_parts(asked, parts, made, run=run, ior=(), say=said.append)
    assert config.model.interior == interior
    told = any("error of 0.0700" in line for line in said)
    assert told == (after == 0.07 and interior != "clear")
    excluding = [line for line in said if "excludes one" in line]
    assert bool(excluding) == (told and interior is None)
    assert all(name in line for line in excluding for name in given)
    ball = config.model.field_ball
    assert (ball is not None) == (interior == "field" and "far_field" not in given)
    if ball is not None:
        assert np.linalg.norm(ball[:3]) + 1.0 < ball[3] < 3.0  # the object is a ball of radius 1
        assert any("field_ball=" in line for line in said)


def test_wrong_masks_and_earlier_runs_have_no_field_around_the_object(
    scene, whole, tmp_path, monkeypatch
):
    made, said = tmp_path / "made", []
    shutil.copytree(whole, made)
    light = records.LightFacts(kept=True, index=1.5, before=0.11, after=0.07)
    records.write(made, dataclasses.replace(records.read(made), light=light))
    asked = TrainConfig().override(scene=str(scene), reconstruction=str(made))
    options = {"ior": (), "say": said.append}
    parts = [scenes.ball(1.0, subdivisions=1)]

    def ball(run):
        config = training_body.with_parts(asked, parts, made, run=tmp_path / run, **options)
        assert config.model.interior == "field"
        return config.model.field_ball

    (tmp_path / "begun").mkdir()
    config_files.write(tmp_path / "begun" / "config.json", asked.decided(interior="field"))
    assert ball("begun") is None
    (tmp_path / "absorbing").mkdir()
    begun = asked.decided(interior="absorbing")
    config_files.write(tmp_path / "absorbing" / "config.json", begun)
    kept = training_body.with_parts(asked, parts, made, run=tmp_path / "absorbing", **options)
    assert kept.model.interior is None and not said

    found = records.read(made)
    doubtful = dataclasses.replace(found, config=dataclasses.replace(found.config, outliers=1))
    records.write(made, doubtful)
    assert ball("doubtful") is None and any("--outliers says" in line for line in said)
    records.write(made, found)

    def fail(scene):
        raise ReconstructionError("Nothing is left after carving.")

    monkeypatch.setattr(geometry_stage, "box_of_masks", fail)
    assert ball("new") is None
    assert any("no ball around it is known: Nothing is left" in line for line in said)


def test_a_ball_that_is_given_is_kept_and_without_masks_there_is_none(scene, whole, tmp_path):
    made, said = tmp_path / "made", []
    shutil.copytree(whole, made)
    light = records.LightFacts(kept=True, index=1.5, before=0.11, after=0.07)
    records.write(made, dataclasses.replace(records.read(made), light=light))
    parts, options = [scenes.ball(1.0, subdivisions=1)], {"run": tmp_path / "run", "ior": ()}

    def model(scene, **given):
        asked = TrainConfig().override(scene=str(scene), reconstruction=str(made), **given)
        return training_body.with_parts(asked, parts, made, say=said.append, **options).model

    ball = (0.0, 0.0, 0.5, 3.0)
    for given in ({}, {"far_field": "field"}):  # which `resolve` refuses
        found = model(scene, field_ball=ball, **given)
        assert (found.interior, found.field_ball) == ("field", ball)
    assert not any("inside the object only" in line for line in said)

    bare = shutil.copytree(scene, tmp_path / scene.name)
    without_masks(bare)
    found = model(bare)
    assert (found.interior, found.field_ball) == ("field", None)
    assert any("inside the object only" in line and "have no masks" in line for line in said)


@pytest.mark.slow
def test_before_a_field_there_is_no_refinement_by_light(scene, whole, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    monkeypatch.setattr(index_stage, "learn_backdrop", lambda *_, **options: None)
    monkeypatch.setattr(light_stage, "fit", None)  # would raise
    monkeypatch.setattr(geometry_stage, "shape_from_outlines", lambda *_, **options: None)
    # The geometry is made again; its refinement is tested elsewhere.
    few = lambda mesh, settings, views: refinement.refine(mesh, _UNREFINED, views=views)
    monkeypatch.setattr(geometry_stage, "refine", few)
    found = _run(scene, out, _LIT, compare=False)
    assert found.light == records.LightFacts(
        False, 1.5, remark="the background is a field, not a surface at a known place"
    )
    assert "There was none, since the background is a field" in (out / "report.md").read_text()
    assert chain.read_parts(out)[0].index == 1.5


def test_training_views_judge_where_there_are_no_validation_masks(scene, tmp_path):
    seen = light_stage.read(scene, seed=0)
    assert seen.split == "train"
    assert set(seen.judges.views.tolist()) == {0, 8, 16}
    assert not np.any(seen.fitted.views % 8 == 0) and len(set(seen.fitted.views.tolist())) == 21
    other = light_stage.read(_with_validation(scene, tmp_path), seed=0)
    assert other.split == "val" and len(set(other.judges.views.tolist())) == 5
    assert len(set(other.fitted.views.tolist())) == 24
    without_masks(tmp_path / scene.name)  # of all splits
    with pytest.raises(ValueError, match="masks"):
        light_stage.read(tmp_path / scene.name, seed=0)


@pytest.mark.parametrize(
    ("target", "options"),
    [
        pytest.param(  # before the renaming
            "refref_jax.data.meshes.write_mesh", {"after": True}, marks=pytest.mark.slow
        ),
        ("experiments.r3f.light_stage.run", {"after": True}),  # renamed, not recorded
    ],
)
def test_a_refinement_that_is_killed_comes_to_the_same_files(
    scene, whole, tmp_path, monkeypatch, target, options
):
    _stub_light(monkeypatch, after=0.03)
    for name in ("one", "other"):
        shutil.copytree(whole, tmp_path / name)
    _run(scene, tmp_path / "one", _LIT, compare=False)
    with pytest.MonkeyPatch.context() as patch:
        module, _, name = target.rpartition(".")
        patch.setattr(target, _killing(getattr(sys.modules[module], name), **options))
        with pytest.raises(_KilledError):
            _run(scene, tmp_path / "other", _LIT, compare=False)
    assert records.read(tmp_path / "other").light is None
    with pytest.raises(ValueError, match="not finished"):
        chain.read_parts(tmp_path / "other")
    _run(scene, tmp_path / "other", _LIT, compare=False)
    assert _contents(tmp_path / "other") == _contents(tmp_path / "one")


@pytest.mark.parametrize(
    ("steps", "refinement"), [(0, "none"), (1, "light"), (60, "light"), (10_000, "light")]
)
def test_reconstructions_of_earlier_versions_are_read(whole, tmp_path, steps, refinement):
    content = json.loads((whole / "reconstruction.json").read_text())
    del content["config"]["refinement"]
    content["config"]["light_steps"] = steps
    (tmp_path / "reconstruction.json").write_text(json.dumps(content))
    assert records.read(tmp_path).config.refinement == refinement


def test_options_may_change_until_a_stage_has_used_them(scene, tmp_path):
    asked = records.Reconstruction("", chain.fingerprint(scene), _CONFIG)
    other = dataclasses.replace(asked, config=dataclasses.replace(_CONFIG, outliers=3))
    assert records.begin(tmp_path / "out", other).config.outliers == 3
    assert records.begin(tmp_path / "out", asked).config == _CONFIG


def test_more_outliers_than_masks_are_refused_before_anything_is_written(scene, tmp_path):
    with pytest.raises(ValueError, match="there are 24 train masks"):
        _run(scene, tmp_path / "out", dataclasses.replace(_CONFIG, outliers=24))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_was_killed_while_it_was_opened_is_taken(scene, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / ".reconstruction.json.unfinished").write_text("{")
    asked = records.Reconstruction("", chain.fingerprint(scene), _CONFIG)
    assert records.begin(out, asked) == asked == records.read(out)


@pytest.mark.slow
@pytest.mark.parametrize("outliers", [0, 1])
def test_a_wrong_mask_is_named_unless_one_may_be_wrong(scene, tmp_path, outliers):
    spoilt = shutil.copytree(scene, tmp_path / scene.name)
    wrong = scene_folder.read_frames(spoilt, "train").masks[5]
    half = iio.imread(wrong)
    half[:, :20] = 0
    iio.imwrite(wrong, half)
    facts = geometry_stage.run(spoilt, tmp_path, dataclasses.replace(_CONFIG, outliers=outliers))
    true = 4 / 3 * np.pi * RADIUS**3
    if outliers:
        assert facts.warnings == () and facts.volume == pytest.approx(true, rel=0.1)
    else:
        seen, taken = facts.warnings
        assert "of 24 training masks overlap with the object by less than 0.9" in seen
        name = wrong.relative_to(spoilt).as_posix()
        assert taken.startswith(f"{name} alone carves away") and "--outliers=1" in taken
        assert facts.volume < 0.7 * true


@pytest.mark.slow
def test_views_without_the_object_are_left_out_and_counted(scene, tmp_path):
    frames = scene_folder.read_frames(scene, "train")
    trials = {name: shutil.copytree(scene, tmp_path / name) for name in ("black", "fewer")}
    for name in ("train/r_003", "train/r_010", "test/r_001"):
        write_grey(trials["black"] / "mask" / f"{name}.png", np.zeros((40, 40)))
    path = trials["fewer"] / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"] = [f for i, f in enumerate(content["frames"]) if i not in (3, 10)]
    path.write_text(json.dumps(content))
    said, found = [], {}
    for name, folder in trials.items():
        out = tmp_path / f"{name}_out"
        found[name] = chain.reconstruct(folder, out, _CONFIG, compare=False, say=said.append)
        found[f"{name}_mesh"] = next((out / "geometry").glob("*.ply")).read_bytes()
    assert found["black"].geometry.masks == len(frames.names) - 2
    assert found["black_mesh"] == found["fewer_mesh"]
    assert [line for line in said if "2 training views are left out" in line] == said[1:2]
    assert len(found["black"].report.overlaps) == 4


def test_where_a_mask_removes_the_body_its_file_is_named(scene, tmp_path):
    spoilt = shutil.copytree(scene, tmp_path / scene.name)
    wrong = scene_folder.read_frames(spoilt, "train").masks[5]
    corner = np.zeros((40, 40), np.uint8)
    corner[:3, :3] = 255
    iio.imwrite(wrong, corner)
    with pytest.raises(ValueError, match=f"{wrong.name} removed the most"):
        _run(spoilt, tmp_path / "out")


def test_masks_without_an_inside_are_refused(scene, tmp_path):
    thin = shutil.copytree(scene, tmp_path / scene.name)
    for path in scene_folder.read_frames(thin, "train").masks:
        lone = np.zeros((40, 40), np.uint8)
        lone[20, 20] = 255
        iio.imwrite(path, lone)
    with pytest.raises(ValueError, match="Use larger images"):
        index_stage.photographs(thin, "train", seed=0, rays=10)


@pytest.mark.slow
def test_an_estimate_that_is_no_number_is_no_result(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(index_stage, "run", lambda *_, **options: _estimate(1.5, np.inf))
    with pytest.raises(ValueError, match="--ior"):
        _run(scene, tmp_path / "out", dataclasses.replace(_CONFIG, index=None))
    with pytest.raises(ValueError, match="not finished"):
        chain.read_parts(tmp_path / "out")[0]
    # What the message advises is taken in the same folder, and only then settled.
    assert _run(scene, tmp_path / "out", _CONFIG).index.source == "given"
    with pytest.raises(ValueError, match=r"ior 1.5, not 1.6"):
        _run(scene, tmp_path / "out", dataclasses.replace(_CONFIG, index=1.6))
    with pytest.raises(ValueError, match="no reconstruction"):
        chain.read_parts(tmp_path)


def test_the_background_of_an_overlay_is_used_and_other_ambient_media_are_refused(tmp_path):
    (tmp_path / "cube_ball").mkdir()
    overlay = tmp_path / "mine.json"
    overlay.write_text('{"background": {"type": "sphere", "radius": 5, "centre": [1, 2, 3]}}')

    def bounds(path, space=None, radius=None):
        return chain.bounds_of(tmp_path / "cube_ball", path, space=space, radius=radius)

    assert bounds(str(overlay)) == ("spherical", 5.0, (1.0, 2.0, 3.0))
    assert bounds(str(overlay), radius=6.0) == ("spherical", 6.0, (1.0, 2.0, 3.0))
    assert bounds("") == (None, None, None)
    (tmp_path / "cube_ball" / "scene.json").write_text('{"ambient_index": 1.333}')
    with pytest.raises(ValueError, match=r"scene\.json: ambient_index is 1\.333, but reconstruct"):
        bounds("")
    overlay.write_text('{"ambient_index": 1}')
    assert bounds(str(overlay)) == (None, None, None)
