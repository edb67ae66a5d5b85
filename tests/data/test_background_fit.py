"""The size of a background from depth maps: analytic ones, quantised ones, and rendered ones."""

import ast
import json
import re
import shutil

import numpy as np
import pytest

from refref_jax.data import background_fit, image_files, scene_properties
from refref_jax.data.background_fit import (
    fit_background,
    fit_size,
    fit_size_and_centre,
    sample_depths,
)
from refref_jax.data.scene_source import SceneWarning, expand, open_scene
from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras
from refref_jax.training.config import SceneConfig, TrainConfig
from refref_jax.training.resolve import read_facts, resolve
from refref_jax.training.run_folder import as_trained
from tests.factories.small_scenes import write_grey, write_scene
from tests.laws.expectations import scene_error
from tests.processes.command import ROOT, run_command

_SIZE = 48
_OBJECT = 1.4
_STEP = image_files.DEPTH_STEP
_ORIGIN = (0.0, 0.0, 0.0)


def find_bounds(scene, **given):
    return background_fit.find_bounds(scene, scene_properties.read(scene), **given)


def _views(frames, *, seed=0, distance=4.0):
    """Cameras at random places of a sphere, which look past its middle, rolled at random."""
    random = np.random.default_rng(seed)
    poses = []
    for _ in range(frames):
        rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        place = distance * rotation[:, 2] + random.uniform(-0.3, 0.3, 3)
        poses.append(np.column_stack([rotation, place]))
    return Cameras(np.array(poses), _SIZE, _SIZE, cameras.focal_length(_SIZE, 1.1656))


def _render(kind, size, seen, *, centre=(0.0, 0.0, 0.0), jitter=0.0):
    """Returns planar depths and masks of a ball in a cube or sphere, pixel by pixel."""
    random = np.random.default_rng(1)
    row, column = np.indices((_SIZE, _SIZE)) + 0.5
    depths, masks = [], []
    for pose in seen.poses:
        place = pose[:, 3]
        x, y = (
            (each + jitter * random.uniform(-0.5, 0.5, each.shape) - 0.5 * _SIZE) / seen.focal
            for each in (column, row)
        )
        towards = x[..., None] * pose[:, 0] - y[..., None] * pose[:, 1] - pose[:, 2]
        in_ball, near, _ = _through_sphere(place, towards, _OBJECT)
        if kind == "sphere":
            far = _through_sphere(place - np.array(centre), towards, size)[2]
        else:
            walls = [(sign * size - place + np.array(centre)) / towards for sign in (-1.0, 1.0)]
            far = np.min(np.maximum(*walls), axis=-1)
        depths.append(np.where(in_ball, near, far))
        masks.append(in_ball)
    return np.array(depths), np.array(masks)


def _through_sphere(place, towards, radius):
    """Returns whether rays meet a sphere around the origin, and both depths: the law of cosines."""
    length = np.linalg.norm(towards, axis=-1)
    middle = -(towards @ place) / length
    half_chord = radius**2 - place @ place + middle**2
    root = np.sqrt(np.maximum(half_chord, 0.0))
    return half_chord > 0.0, (middle - root) / length, (middle + root) / length


def _quantised(depths):
    """Stores depths as the data set does, and decodes them by its formula."""
    value = np.clip(np.round(255.0 * (1.0 - (depths - 1.0) / 10.5)), 0, 255)
    return 1.0 + 10.5 * (1.0 - value / 255.0)


@pytest.mark.parametrize(("kind", "size"), [("cube", 7.3), ("cube", 5.81), ("sphere", 6.47)])
@pytest.mark.parametrize("known_masks", [True, False])
def test_a_known_size_is_measured_from_float_depth(kind, size, known_masks):
    seen = _views(12)
    depths, masks = _render(kind, size, seen)
    samples = sample_depths(seen, depths, masks=masks if known_masks else None)
    for fit in (fit_size(kind, samples), fit_size_and_centre(kind, samples)):
        np.testing.assert_allclose(fit.size, size, rtol=1e-7)
        np.testing.assert_allclose(fit.centre, 0.0, atol=1e-6)
        assert fit.kind == kind and fit.agreement == 1.0 and fit.error < 1e-6


@pytest.mark.parametrize(("kind", "size"), [("cube", 7.3), ("cube", 8.9), ("sphere", 7.3)])
@pytest.mark.parametrize(
    ("known_masks", "jitter"),
    [
        (True, 1.0),
        (False, 0.0),
        pytest.param(True, 0.0, marks=pytest.mark.slow),
        pytest.param(False, 1.0, marks=pytest.mark.slow),
    ],
)
def test_8_bit_depth_gives_the_size_within_its_error(kind, size, known_masks, jitter):
    seen = _views(20)
    depths, masks = _render(kind, size, seen, jitter=jitter)
    stored = _quantised(depths)
    assert np.mean(stored >= 11.5) > (0.05 if kind == "cube" else -1.0)  # saturated
    samples = sample_depths(seen, stored, masks=masks if known_masks else None, step=_STEP)
    assert samples.depths.max() < 11.5
    fit = fit_size(kind, samples)
    assert abs(fit.size - size) < 0.0005 * size
    # Rays through other points of pixels (a 26th of a radian wide here) bend the cube's edges.
    assert jitter or abs(fit.size - size) < 5.0 * fit.error < 0.005 * size


@pytest.mark.slow
def test_the_standard_error_is_that_of_repeated_measurements():
    sizes, errors = [], []
    for seed in range(12):
        seen = _views(10, seed=seed)
        samples = sample_depths(seen, _quantised(_render("sphere", 7.0, seen)[0]), step=_STEP)
        fit = fit_size("sphere", samples)
        sizes.append(fit.size)
        errors.append(fit.error)
    assert 0.4 < np.std(sizes) / np.mean(errors) < 2.5


@pytest.mark.parametrize("kind", ["cube", "sphere"])
def test_a_centre_is_measured(kind):
    seen, centre = _views(20), (0.2, -0.1, 0.3)
    depths, masks = _render(kind, 6.0, seen, centre=centre)
    fit = fit_size_and_centre(
        kind, sample_depths(seen, _quantised(depths), masks=masks, step=_STEP)
    )
    np.testing.assert_allclose(fit.centre, centre, atol=0.005)
    assert abs(fit.size - 6.0) < 0.005 and 0.0 < max(fit.centre_error) < 0.005


def _seen_around(kind, size, centre, *, moved):
    """Returns cameras, depths and masks of a background around a centre.

    The ball that hides it is at the origin; the cameras are around the origin, or the centre.
    """
    seen = _views(20)
    if moved:
        seen = seen._replace(poses=seen.poses + np.pad(np.array(centre)[:, None], ((0, 0), (3, 0))))
    return seen, *_render(kind, size, seen, centre=centre)


@pytest.mark.parametrize("kind", ["cube", "sphere"])
@pytest.mark.parametrize(
    ("eight_bit", "known_masks"),
    [
        pytest.param(True, False, id="8 bit"),
        pytest.param(False, True, id="float, masks"),
        pytest.param(True, True, marks=pytest.mark.slow, id="8 bit, masks"),
        pytest.param(False, False, marks=pytest.mark.slow, id="float"),
    ],
)
@pytest.mark.parametrize(
    ("centre", "moved"),
    [
        pytest.param((0.05, 0.0, 0.0), False, marks=pytest.mark.slow),
        ((1.0, -2.0, 0.5), False),
        pytest.param((30.0, -20.0, 10.0), True, marks=pytest.mark.slow),
    ],
)
def test_a_background_is_where_the_depths_show_it(kind, eight_bit, known_masks, centre, moved):
    seen, depths, masks = _seen_around(kind, 6.5, centre, moved=moved)
    samples = sample_depths(
        seen,
        _quantised(depths) if eight_bit else depths,
        masks=masks if known_masks else None,
        step=_STEP if eight_bit else 0.0,
    )
    assert not eight_bit or samples.depths.max() < 11.5  # saturated values are left out
    fit = fit_background(kind, samples)
    tolerance = 1e-3 if eight_bit else 1e-5
    assert abs(fit.size - 6.5) < tolerance < 0.005 * 6.5
    np.testing.assert_allclose(fit.centre, centre, atol=tolerance)
    assert 0.0 < max(fit.centre_error) < tolerance
    assert re.fullmatch(r"6\.\d+ \+- \S+ around \((\S+ \+- \S+, ){2}\S+ \+- \S+\)", fit.describe())
    # A centre that is known is not fitted.
    known = fit_size(kind, samples, centre=centre)
    assert known.centre == centre and not any(known.centre_error)
    assert abs(known.size - 6.5) < tolerance


@pytest.mark.parametrize("kind", ["cube", "sphere"])
@pytest.mark.parametrize(("step", "jitter"), [(0.0, 0.0), (_STEP, 0.0), (_STEP, 1.0)])
def test_a_background_around_the_origin_stays_there(kind, step, jitter):
    seen = _views(20)
    depths, masks = _render(kind, 7.3, seen, jitter=jitter)
    samples = sample_depths(seen, _quantised(depths) if step else depths, masks=masks, step=step)
    fit = fit_background(kind, samples)
    assert fit == fit_size(kind, samples) and fit.centre == (0.0, 0.0, 0.0)
    assert " around " not in fit.describe()


def test_a_small_offset_that_8_bit_depth_hardly_shows_is_not_used():
    seen, depths, masks = _seen_around("cube", 6.5, (0.01, 0.0, 0.0), moved=False)
    stored = sample_depths(seen, _quantised(depths), masks=masks, step=_STEP)
    assert fit_background("cube", stored).centre == (0.0, 0.0, 0.0)
    exact = sample_depths(seen, depths, masks=masks)
    np.testing.assert_allclose(fit_background("cube", exact).centre, (0.01, 0.0, 0.0), atol=1e-5)
    # Within 0.1 % of the size it is never used.
    seen, depths, masks = _seen_around("cube", 6.5, (0.006, 0.0, 0.0), moved=False)
    exact = sample_depths(seen, depths, masks=masks)
    assert fit_background("cube", exact).centre == (0.0, 0.0, 0.0)


def test_a_background_that_leaves_cameras_outside_is_none():
    seen, depths, masks = _seen_around("sphere", 6.5, (2.0, 2.0, 2.0), moved=False)
    assert fit_background("sphere", sample_depths(seen, depths, masks=masks)) is None


def test_saturated_and_infinite_depths_and_margins_of_masks_are_left_out():
    seen = _views(1)
    depth = np.full((1, _SIZE, _SIZE), 5.0)
    depth[0, 0], depth[0, 1], depth[0, 2] = 1.0, 11.5, 11.5 - _STEP
    mask = np.zeros((1, _SIZE, _SIZE), bool)
    mask[0, 20, 20] = True
    samples = sample_depths(seen, depth, masks=mask, step=_STEP)
    assert len(samples.depths) == (_SIZE - 2) * _SIZE - 25
    assert set(np.round(samples.depths, 6)) == {5.0, np.round(11.5 - _STEP, 6)}
    depth[0, 3] = np.inf
    assert len(sample_depths(seen, depth).depths) == (_SIZE - 1) * _SIZE


def test_what_is_seen_beyond_holes_is_an_outlier():
    seen = _views(12)
    depths, masks = _render("cube", 7.3, seen)
    depths[:, ::9] = 40.0  # no wall there
    fit = fit_size("cube", sample_depths(seen, depths, masks=masks))
    np.testing.assert_allclose(fit.size, 7.3, rtol=1e-6)
    assert 0.85 < fit.agreement < 0.92


@pytest.mark.parametrize(("kind", "other"), [("cube", "sphere"), ("sphere", "cube")])
def test_another_shape_is_not_taken_for_the_background(kind, other):
    seen = _views(12)
    depths, masks = _render(kind, 7.3, seen)
    assert fit_size(other, sample_depths(seen, depths, masks=masks)) is None
    assert fit_size(other, sample_depths(seen, _quantised(depths), masks=masks, step=_STEP)) is None


def test_too_little_is_no_measurement():
    seen = _views(2)
    nothing = np.full((2, _SIZE, _SIZE), np.inf)
    few, near = nothing.copy(), nothing.copy()
    few[:, 0, :9] = 8.0
    near[:] = 0.5  # nearer to the origin than the cameras
    noise = np.random.default_rng(0).uniform(5.0, 11.0, nothing.shape)
    for depths in (nothing, few, near, noise):
        for kind in ("cube", "sphere"):
            assert fit_size(kind, sample_depths(seen, depths)) is None
            assert fit_size_and_centre(kind, sample_depths(seen, depths)) is None
            assert fit_background(kind, sample_depths(seen, depths)) is None


@pytest.mark.slow
def test_the_example_of_the_page_runs_and_gives_what_it_says(capsys, monkeypatch):
    page = (ROOT / "docs/data_formats.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (example,) = (block for block in blocks if "background_fit" in block)
    monkeypatch.chdir(ROOT)
    exec(example, {})
    first, second = capsys.readouterr().out.splitlines()
    assert first.removesuffix(" 1.0") in page
    np.testing.assert_allclose(ast.literal_eval(second), 0.0, atol=0.002)


@pytest.mark.parametrize("suffix", [".png", ".exr"])
@pytest.mark.parametrize("masks", [True, False])
def test_the_bundled_scene_is_measured(tmp_path, ball_scene, suffix, masks):
    scene = tmp_path / "cube_smcvx_ball"
    shutil.copytree(ball_scene, scene)
    (scene / "scene.json").unlink()
    transforms = json.loads((scene / "transforms_test.json").read_text())
    for frame in transforms["frames"]:
        frame["depth_file_path"] = frame["depth_file_path"].replace(".png", suffix)
        if not masks:
            del frame["mask_file_path"]
    (scene / "transforms_train.json").write_text(json.dumps(transforms))
    if suffix == ".png":
        for path in (scene / "depth").rglob("*.exr"):
            path.unlink()
    bounds = find_bounds(scene, space=None, radius=None)
    assert bounds.space == "bounded" and abs(bounds.size - 7.3) < 0.0005 * 7.3
    assert bounds.source.startswith("measured from depth maps: 7.30") and bounds.notes == ()


def _scene(tmp_path, name, kind, size, *, centre=(0.0, 0.0, 0.0)):
    """Writes a scene without scene.json whose 8-bit depth maps show a background."""
    seen = _views(10)
    depths, masks = _render(kind, size, seen, centre=centre)
    scene = write_scene(tmp_path / name, frames=1)
    path = scene / "transforms_train.json"
    record = json.loads(path.read_text())["frames"][0]
    frames = []
    for i, (depth, mask) in enumerate(zip(depths, masks, strict=True)):
        stem = f"train/r_{i:03d}"
        image_files.write_rgb(scene / f"{stem}.png", np.zeros((_SIZE, _SIZE, 3)))
        write_grey(scene / f"mask/{stem}.png", 255 * mask)
        write_grey(scene / f"depth/{stem}.png", np.round((11.5 - _quantised(depth)) / _STEP))
        named = {"file_path": f"./{stem}", "transform_matrix": [*seen.poses[i].tolist()]}
        named["transform_matrix"].append([0.0, 0.0, 0.0, 1.0])
        named |= {"mask_file_path": f"mask/{stem}.png", "depth_file_path": f"depth/{stem}.png"}
        frames.append(record | named)
    path.write_text(json.dumps({"camera_angle_x": 1.1656, "frames": frames}))
    return scene


def test_a_sphere_by_name_gets_its_measured_radius_in_training(tmp_path):
    scene = _scene(tmp_path, "sphere_smcvx_ball", "sphere", 6.7)
    config = TrainConfig().override(scene=str(scene), batch=64)
    made = resolve(config, read_facts(config.scene))
    assert made.config.scene.space == "spherical"
    assert abs(made.config.scene.radius - 6.7) < 0.0005 * 6.7
    assert made.model.config.space == "spherical"
    assert made.model.config.radius == made.config.scene.radius
    reason = made.reasons["radius"]
    assert reason.startswith("measured from depth maps: 6.") and " +- 0.00" in reason
    assert reason in made.describe().replace("\n    ", " ")
    # What is decided stays, and is not measured again.
    (scene / "depth/train/r_000.png").write_bytes(b"")
    bounds = find_bounds(scene, space="spherical", radius=made.config.scene.radius)
    assert bounds == ("spherical", None, "", (), _ORIGIN)


@pytest.mark.slow
def test_a_published_sphere_is_opened_with_what_its_layout_implies(tmp_path, monkeypatch):
    scene = _scene(tmp_path, "sphere_smcvx_ball", "sphere", 6.7)
    run_command("dataset.convert", f"--scene={scene}", "--to=parquet", f"--out={tmp_path / 'hf'}")
    monkeypatch.setenv("REFREF_HF", str(tmp_path / "hf"))
    monkeypatch.setenv("REFREF_CACHE", str(tmp_path / "cache"))
    (source,) = expand("hf:spherebg_*/*")
    with pytest.warns(SceneWarning, match="no meshes"):
        opened = open_scene(source)
    assert json.loads((opened / "scene.json").read_text()) == {"rule": "facing"}
    facts = read_facts(SceneConfig(path=str(opened)))
    assert facts.analysis.space == "spherical" and facts.source.startswith("measured from depth")
    assert abs(facts.half_extent - 6.7) < 0.0005 * 6.7


def test_what_is_stated_is_not_measured(tmp_path):
    scene = _scene(tmp_path, "sphere_smcvx_ball", "sphere", 6.7)
    config = SceneConfig(path=str(scene))
    assert find_bounds(scene, space=None, radius=5.0) == ("spherical", None, "", (), _ORIGIN)
    assert find_bounds(scene, space="unbounded", radius=None)[:3] == ("unbounded", None, "")
    space, size, _, (note,), centre = find_bounds(scene, space="bounded", radius=None)
    assert (space, size, centre) == ("bounded", None, _ORIGIN)
    assert note.startswith("warning: the depth maps show no cube") and "Set radius" in note
    (scene / "scene.json").write_text('{"background": {"type": "sphere", "radius": 7.0}}')
    assert find_bounds(scene, space=None, radius=None)[:3] == ("spherical", 7.0, "scene.json")
    (scene / "scene.json").write_text('{"background": {"type": "cube"}}')
    assert find_bounds(scene, space=None, radius=None).space == "bounded"
    (scene / "scene.json").write_text('{"background": {"type": "sphere"}}')
    facts = read_facts(config)
    assert facts.analysis.space == "spherical" and abs(facts.half_extent - 6.7) < 0.005
    (scene / "scene.json").write_text('{"background": {"type": "env"}}')
    assert read_facts(config).half_extent is None


def test_a_background_around_another_point_is_measured_there_in_training(tmp_path):
    scene = _scene(tmp_path, "cube_smcvx_ball", "cube", 6.0, centre=(0.0, 0.4, 0.0))
    config = TrainConfig().override(scene=str(scene), batch=64)
    facts = read_facts(config.scene)
    made = resolve(config, facts)
    assert abs(made.config.scene.radius - 6.0) < 0.005
    assert not any(note.startswith("warning") for note in facts.notes)
    np.testing.assert_allclose(made.config.scene.centre, (0.0, 0.4, 0.0), atol=0.002)
    assert made.model.config.centre == made.config.scene.centre == facts.centre
    assert made.reasons["centre"] == made.reasons["radius"] == facts.source
    assert re.search(r"[56]\.\d+ \+- \S+ around \(\S+ \+- \S+, 0\.4", facts.source)
    # Resolving again changes nothing, and measures nothing.
    again = resolve(made.config, read_facts(made.config.scene))
    assert (again.config, again.model) == (made.config, made.model)
    assert as_trained(TrainConfig(), made.model).scene.centre == made.config.scene.centre


def test_a_centre_that_is_stated_or_given_is_used(tmp_path):
    scene = _scene(tmp_path, "cube_smcvx_ball", "cube", 6.0, centre=(0.0, 0.4, 0.0))
    stated = {"background": {"type": "cube", "centre": [0.0, 0.4, 0.0]}}
    (scene / "scene.json").write_text(json.dumps(stated))
    found = find_bounds(scene, space=None, radius=None)
    assert found.centre == (0.0, 0.4, 0.0) and abs(found.size - 6.0) < 0.005
    assert " around " not in found.source
    # A size does not replace it, nor does another shape; an unbounded scene has no background.
    expected = ("bounded", None, "scene.json", (), (0.0, 0.4, 0.0))
    assert find_bounds(scene, space=None, radius=5.0) == expected
    assert find_bounds(scene, space="spherical", radius=5.0).centre == (0.0, 0.4, 0.0)
    assert find_bounds(scene, space="unbounded", radius=5.0).centre == _ORIGIN
    given = {"space": None, "radius": 5.0, "centre": (1.0, 2.0, 3.0)}
    assert find_bounds(scene, **given).centre == (1.0, 2.0, 3.0)
    stated["background"]["half_extent"] = 6.0
    (scene / "scene.json").write_text(json.dumps(stated))
    expected = ("bounded", 6.0, "scene.json", (), (0.0, 0.4, 0.0))
    assert find_bounds(scene, space=None, radius=None) == expected
    config = TrainConfig().override(scene=str(scene), batch=64, radius=5.0)
    made = resolve(config, read_facts(config.scene))
    assert made.model.config.centre == (0.0, 0.4, 0.0) and made.model.config.radius == 5.0
    assert made.reasons["centre"] == "scene.json" and "scene.json: centre=0.0,0.4,0.0" in (
        made.describe()
    )
    config = config.override(centre=(0.0, 0.0, 0.0))
    facts = read_facts(config.scene)
    assert resolve(config, facts).model.config.centre == _ORIGIN
    assert any("centre=(0.0, 0.0, 0.0) overrides scene.json" in note for note in facts.notes)
    with pytest.raises(ValueError, match=r"centre is .* Give three finite numbers"):
        config.override(centre=(0.0, np.inf, 0.0))


def test_without_depth_maps_there_is_the_usual_background(tmp_path):
    scene = _scene(tmp_path, "sphere_smcvx_ball", "sphere", 6.7)
    path = scene / "transforms_train.json"
    content = json.loads(path.read_text())
    shutil.copyfile(scene / "depth/train/r_000.png", scene / "depth/train/r_000.bak")
    image_files.write_exr(scene / "depth/train/r_000.exr", np.ones((_SIZE, _SIZE)))
    assert background_fit.read_samples(scene) is None  # of both formats
    for frame in content["frames"]:
        del frame["depth_file_path"]
    path.write_text(json.dumps(content))
    assert find_bounds(scene, space=None, radius=None) == ("bounded", None, "", (), _ORIGIN)
    config = TrainConfig().override(scene=str(scene), batch=64)
    made = resolve(config, read_facts(config.scene))
    assert made.config.scene.radius == 7.3
    assert made.reasons["radius"] == "the data set's usual background"


def test_a_broken_depth_map_is_reported(tmp_path):
    scene = _scene(tmp_path, "cube_smcvx_ball", "cube", 6.0)
    (scene / "depth/train/r_003.png").write_bytes(b"")
    with scene_error("r_003.png", "truncated"):
        find_bounds(scene, space=None, radius=None)
