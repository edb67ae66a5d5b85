"""Runs with a backdrop: solved, paused and continued, rendered, and refused where none fits."""

import json
import shutil

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from refref_jax.data import image_files, meshes, scene_folder
from refref_jax.geometry.cameras import image_rays, orbit, project
from refref_jax.render import Model, pixels, render_image, render_rays
from refref_jax.render.model import look_up
from refref_jax.training import backdrop_equations, backdrop_fit, backdrop_solver, run_folder
from refref_jax.training.config import TrainConfig
from refref_jax.training.fit import Periods, fit, prepare
from tests.factories.cut_ball import cut_ball
from tests.factories.small_model import CAMERAS

pytestmark = [pytest.mark.loose, pytest.mark.longest]

_ROUND = backdrop_solver.ROUND


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return cut_ball(tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball")


def _config(scene):
    return TrainConfig().override(
        scene=str(scene), far_field="backdrop", backdrop_resolution=64, iterations=2 * _ROUND
    )


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "whole"
    lines = []
    model = fit(_config(scene), out=folder, report=lines.append)
    return folder, model, lines


def test_a_backdrop_is_solved_and_rendered(scene, run):
    folder, model, lines = run
    assert isinstance(model, Model) and model.params.proposals == ()
    assert any("far_field=backdrop" in line for line in lines)
    reached = run_folder.read_metrics(folder)
    assert [line["step"] for line in reached] == list(range(1, len(reached) + 1))
    assert reached[-1]["psnr"] > reached[0]["psnr"] + 5.0
    frames = scene_folder.read_frames(scene, "train")
    seen = render_image(model, image_rays(frames.cameras, 0))
    error = np.asarray(seen.rgb) - scene_folder.read_images(frames)[0] / 255.0
    assert -10.0 * np.log10(np.mean(error**2)) > 19.0
    np.testing.assert_allclose(seen.accumulation, 1.0, atol=1e-4)


@pytest.mark.slow
def test_the_scene_alone_chooses_the_backdrop(scene, tmp_path):
    asked = TrainConfig().override(scene=str(scene))
    lines = []
    resolved, _ = prepare(asked, report=lines.append)
    assert resolved.config.model.far_field == "backdrop"
    assert "behind the objects is the cube that scene.json states" in resolved.describe()
    assert "preset=" not in resolved.describe() and "steps=" not in resolved.describe()
    given = {"steps": 9, "preset": "tiny", "far_field": "field", "paths": "straight"}
    for name, value in given.items():
        other, _ = prepare(asked.override(**{name: value}), report=lines.append)
        assert other.config.model.far_field == "field", name
        assert "preset=tiny" in other.describe()


@pytest.mark.slow
def test_a_field_inside_that_is_a_decision_keeps_the_backdrop(scene):
    asked = TrainConfig().override(scene=str(scene))
    decided, _ = prepare(asked.decided(interior="field"), report=lambda line: None)
    assert decided.config.model.far_field == "backdrop"
    assert decided.model.config.interior == "field" and "preset=tiny" in decided.describe()
    fewer = asked.override(steps=100).decided(interior="field")  # of the field in front of it
    assert prepare(fewer, report=lambda line: None)[0].config.model.far_field == "backdrop"
    given, _ = prepare(asked.override(interior="field"), report=lambda line: None)
    assert given.config.model.far_field == "field"


def test_images_without_a_pixel_of_background_are_refused(scene, tmp_path):
    copy = shutil.copytree(scene, tmp_path / "scene")
    for path in scene_folder.read_frames(copy, "train").masks:
        mask = iio.imread(path)
        iio.imwrite(path, np.full_like(mask, 255))
    config = _config(copy).override(pixels="background")
    with pytest.raises(ValueError, match="sees the background alone"):
        fit(config, out=tmp_path / "run")


@pytest.mark.slow
def test_a_wrong_size_of_the_background_leads_to_a_field_or_is_told(scene):
    lines = []
    wrong = TrainConfig().override(scene=str(scene), radius=9.5)
    resolved, _ = prepare(wrong, report=lines.append)
    assert resolved.config.model.far_field == "field"
    assert "of the images' patches differ from the cube" in resolved.reasons["far_field"]
    asked, _ = prepare(wrong.override(far_field="backdrop"), report=lines.append)
    assert len(asked.warnings) == 1 and "its size (9.5) or centre is wrong" in asked.warnings[0]


def test_distances_are_those_of_the_walls_along_the_path(scene, run):
    frames = scene_folder.read_frames(scene, "test")
    seen = render_image(run[1], image_rays(frames.cameras, 0))
    away = ~scene_folder.read_masks(frames)[0]
    error = np.abs(np.asarray(seen.distance) - scene_folder.read_distances(frames)[0])[away]
    assert np.median(error) < 1e-3 and np.quantile(error, 0.95) < 0.05


@pytest.mark.slow
def test_the_radiance_has_gradients_through_the_renderer(scene, run):
    frames, model = scene_folder.read_frames(scene, "train"), run[1]
    row = jax.tree.map(lambda x: x[64, ::16], image_rays(frames.cameras, 0))

    @jax.jit
    @jax.grad
    def slope(params):
        return jnp.mean(render_rays(model._replace(params=params), row).linear)

    slopes = [np.asarray(level) for level in slope(model.params).field]
    assert all(np.all(np.isfinite(level)) for level in slopes)
    # A uniformly brighter surface is a uniformly brighter image.
    np.testing.assert_allclose(slopes[0].sum(), 1.0, rtol=1e-3)


def test_a_model_with_a_backdrop_has_no_field_to_look_up(run):
    model = run[1]
    with pytest.raises(ValueError, match="no density at a point"):
        look_up(model.params, model.config, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]), width=0.1)
    with pytest.raises(ValueError, match="the model has a backdrop"):
        pixels.render_ray(model, jax.tree.map(lambda x: x[0, 0], image_rays(CAMERAS, 0)))


def _after_a_round(run):
    return lambda: len(run_folder.read_metrics(run)) == _ROUND


@pytest.mark.slow
def test_a_paused_run_continues_to_the_same_bits(scene, run, tmp_path):
    stop = _after_a_round(tmp_path / "run")
    fit(_config(scene), out=tmp_path / "run", stop=stop, report=lambda line: None)
    assert run_folder.read_metrics(tmp_path / "run")[-1]["step"] == _ROUND
    # A run of an earlier version lacks some options.
    stored = json.loads((tmp_path / "run" / "config.json").read_text())
    for name in ("most_pixels", "exposure", "view_dependence"):
        del stored["model"][name]
    (tmp_path / "run" / "config.json").write_text(json.dumps(stored))
    lines = []
    again = fit(None, out=tmp_path / "run", existing="resume", report=lines.append)
    pairs = zip(jax.tree.leaves(again.params), jax.tree.leaves(run[1].params), strict=True)
    assert all(np.array_equal(ours, theirs) for ours, theirs in pairs)
    fit(None, out=tmp_path / "run", existing="resume", report=lines.append)
    assert "trained already" in lines[-1]


@pytest.mark.slow
def test_a_paused_run_stops_where_one_without_a_pause_stops(scene, tmp_path):
    config = _config(scene).override(iterations=20 * _ROUND, backdrop_resolution=16)
    told = []

    def train(name, rounds=None):
        out, count = tmp_path / name, rounds and rounds * _ROUND
        stop = (lambda: len(run_folder.read_metrics(out)) == count) if count else lambda: False
        existing = "resume" if out.exists() else "refuse"
        progress = lambda step, total, text: told.append(text)
        quiet = {"report": lambda line: None, "progress": progress}
        fit(config, out=out, existing=existing, stop=stop, **quiet)
        return run_folder.read_metrics(out)[-1]["step"]

    whole = train("whole")
    assert 3 * _ROUND <= whole < 20 * _ROUND
    assert told[-1].startswith(f"solved in {whole} iterations")
    assert train("paused", rounds=whole // _ROUND - 1) == whole - _ROUND
    assert train("paused") == whole
    assert train("at its end", rounds=whole // _ROUND) == whole
    assert train("at its end") == whole


@pytest.mark.parametrize(
    ("rounds", "expected"),
    [
        ([30.0, 34.0], np.inf),
        ([30.0, 34.0, 35.0], 0.25),  # a quarter of the gain before
        ([20.0, 30.0, 31.0, 33.0], 2.0),  # gains that grow go on
        ([30.0, 31.0, 30.9], -0.1),
        ([30.0, 29.0, 29.1], 0.1),
    ],
)
def test_gains_of_rounds_are_expected_to_fall_geometrically(rounds, expected):
    assert backdrop_fit._expected_gain(rounds) == pytest.approx(expected)


@pytest.mark.slow
def test_gains_of_the_images_are_learned_resumed_and_written(scene, tmp_path):
    config = _config(scene).override(exposure="per_image")
    lines, stop = [], _after_a_round(tmp_path / "run")
    fit(config, out=tmp_path / "run", stop=stop, report=lines.append)
    assert any("exposure=per_image" in line for line in lines)
    fit(None, out=tmp_path / "run", existing="resume", report=lines.append)
    gains = json.loads((tmp_path / "run" / "gains.json").read_text())
    assert list(gains) == list(scene_folder.read_frames(scene, "train").names)
    values = np.array(list(gains.values()))
    np.testing.assert_allclose(np.exp(np.log(values).mean(axis=0)), 1.0, atol=1e-5)
    assert 1e-5 < np.max(np.abs(values - 1.0)) < 0.1


@pytest.fixture(scope="module")
def filled(scene, tmp_path_factory):
    """The scene with an opaque ball in the glass, which its images do not show."""
    folder = tmp_path_factory.mktemp("scenes") / "cube_smcvx_ball"
    shutil.copytree(scene, folder)
    core = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    core.export(folder / "meshes" / "ball_core_opaque.ply")
    properties = json.loads((folder / "scene.json").read_text())
    properties["parts"].append({"mesh": "meshes/ball_core_opaque.ply", "kind": "opaque"})
    (folder / "scene.json").write_text(json.dumps(properties))
    return folder


@pytest.mark.slow
def test_a_field_on_opaque_parts_is_trained_in_front_of_the_backdrop(filled, tmp_path):
    options = {"backdrop_resolution": 64, "iterations": _ROUND}
    config = TrainConfig().override(scene=str(filled), **options)
    config = config.override(far_field="backdrop", steps=6, batch=64, pretraced_batches=2)
    lines = []
    model = fit(config, out=tmp_path / "run", report=lines.append)
    assert model.config.backdrop.in_front == "field"
    assert any("steps=6" in line for line in lines) and not any("No effect" in x for x in lines)
    reached = run_folder.read_metrics(tmp_path / "run")
    assert reached[-1]["step"] == 6 and np.isfinite(reached[-1]["loss"])
    seen = run_folder.read_coverage(tmp_path / "run")
    assert seen.shape == (6, 65, 65) and np.sum(seen) > 1e4
    # The backdrop is that of the pixels that see nothing else, and training leaves it as it is.
    frames = scene_folder.read_frames(filled, "train")
    seen = render_image(model, image_rays(frames.cameras, 0))
    away = ~scene_folder.read_masks(frames)[0]
    error = (np.asarray(seen.rgb) - scene_folder.read_images(frames)[0] / 255.0)[away]
    assert -10.0 * np.log10(np.mean(error**2)) > 19.0
    # A run that was stopped after some steps ends with the same bits.
    periods = Periods(log=2, checkpoint=2)
    again = {"out": tmp_path / "again", "report": lines.append, "periods": periods}
    fit(config, **again, stop=lambda: bool(run_folder.read_metrics(tmp_path / "again")))
    assert 0 < run_folder.read_metrics(tmp_path / "again")[-1]["step"] < 6
    resumed = fit(None, **again, existing="resume")
    pairs = zip(jax.tree.leaves(resumed.params), jax.tree.leaves(model.params), strict=True)
    assert all(np.array_equal(ours, theirs) for ours, theirs in pairs)


@pytest.mark.slow
def test_a_field_around_a_mesh_that_is_too_small_is_where_masks_show_the_object(scene, tmp_path):
    frames = scene_folder.read_frames(scene, "train")
    (whole,) = meshes.read_meshes(scene)
    radius = float(np.max(np.linalg.norm(whole.vertices, axis=-1)))
    ball = (0.0, 0.0, 0.0, 1.5 * radius)
    options = {"backdrop_resolution": 64, "iterations": _ROUND, "field_ball": ball}
    config = TrainConfig().override(scene=str(scene), interior="field", **options)
    config = config.override(far_field="backdrop", steps=6, batch=64, pretraced_batches=2)
    small = whole._replace(vertices=0.5 * whole.vertices)
    model = fit(config, out=tmp_path / "run", parts=[small], report=lambda line: None)
    hull = np.asarray(model.params.field.hull)
    middles = np.linspace(-1.0, 1.0, 2 * len(hull) + 1)[1::2] * ball[3]
    away = np.linalg.norm(np.stack(np.meshgrid(*3 * [middles], indexing="ij")), axis=0)
    # Three views leave more than the ball, but none of it is lost.
    assert np.all(hull[away < radius] == 1.0) and np.mean(hull) < 0.5
    masks = scene_folder.read_masks(frames)
    front = backdrop_fit.read_front(model.config, model.scene, scene)
    assert np.all(front.pixels[masks])
    np.testing.assert_array_equal(front.hull.occupancy, hull)
    assert masks.sum() > 2 * backdrop_equations.meets(model.scene, frames.cameras).sum()
    seen = render_image(model, image_rays(frames.cameras, 0))
    beside = image_files.well_outside(masks)[0]
    error = (np.asarray(seen.rgb) - scene_folder.read_images(frames)[0] / 255.0)[beside]
    assert -10.0 * np.log10(np.mean(error**2)) > 19.0


@pytest.mark.parametrize("size", [100, 400])
def test_a_rod_thinner_than_a_cell_is_in_the_hull(tmp_path, size):
    cameras, ball = (
        orbit(12, distance=4.0, elevation=0.4, size=size, angle_x=0.9),
        (0.0, 0.0, 0.0, 1.8),
    )
    rod = np.stack([np.zeros(201), np.zeros(201), np.linspace(-0.7, 0.7, 201)], axis=-1)
    for view, pose in enumerate(cameras.poses):
        column, row = np.floor(project(rod, pose, cameras).pixels).astype(np.int64).T
        mask = np.zeros((size, size), bool)
        mask[row, column] = True
        image_files.write_mask(tmp_path / f"{view}.png", mask)
    masks = tuple(tmp_path / f"{view}.png" for view in range(12))
    frames = scene_folder.Frames(tuple("abcdefghijkl"), masks, masks, None, cameras)
    grid = backdrop_fit._hull(frames, ball, cells=96).occupancy
    cells = np.floor((rod / 1.8 + 1.0) * 0.5 * len(grid)).astype(np.int64)
    assert np.all(grid[tuple(cells.T)] == 1.0) and np.mean(grid) < 2e-3
    with pytest.raises(ValueError, match=r"No point of field_ball=9\.0,0\.0,0\.0,1\.0 is in all"):
        backdrop_fit._hull(frames, (9.0, 0.0, 0.0, 1.0), cells=96)
    # Nothing is claimed of what no camera sees.
    grid = backdrop_fit._hull(frames, (0.0, 0.0, 0.0, 5.0), cells=96).occupancy
    assert np.mean(grid) < 2e-3


@pytest.mark.slow
def test_opaque_parts_lead_to_a_backdrop_with_a_field_in_front_of_it(filled):
    resolved, _ = prepare(TrainConfig().override(scene=str(filled)), report=lambda line: None)
    assert resolved.config.model.far_field == "backdrop"
    assert resolved.model.config.backdrop.in_front == "field"
    assert "preset=tiny" in resolved.describe()
    gains = TrainConfig().override(scene=str(filled), exposure="per_image")
    with pytest.raises(ValueError, match="cannot be learned with a field in front"):
        prepare(gains, report=lambda line: None)


@pytest.mark.slow
def test_a_run_stops_between_the_views_that_it_traces(scene, tmp_path):
    lines = []
    with pytest.raises(KeyboardInterrupt):
        fit(
            _config(scene),
            out=tmp_path / "run",
            progress=lambda step, total, text: lines.append(text),
            stop=lambda: any("tracing" in line for line in lines),
        )
    assert len(lines) < 4 and all("tracing view" in line for line in lines)
