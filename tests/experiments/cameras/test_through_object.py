"""Poses are refined by light that an object of known place bends, and by light beside it."""

import json
import shutil

import numpy as np
import pytest

from experiments.cameras import bundle, refined_scene, through_object
from experiments.cameras.bundle import Prior, Views
from experiments.cameras.refinement import Photo
from experiments.r3f import alignment
from refref_jax.data import scene_folder
from refref_jax.geometry.cameras import Cameras, orbit, pixel_rays
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import gauss_newton, photometry
from tests.factories import bodies, vessels
from tests.processes.command import run_command

pytestmark = pytest.mark.computing

_SIZE, _FOCAL = 48, 60.0


@pytest.fixture(scope="module")
def surface():
    return vessels.smooth_backdrop()


@pytest.fixture(scope="module")
def traced():
    mesh = bodies.icosphere(4)
    mesh = mesh._replace(normals=mesh.vertices[mesh.faces])  # smooth: it is a unit sphere
    model = alignment.PlacedObject([mesh], nested([1.5], [NO_PARENT]))
    return gauss_newton.traced_object(model.pose(model.start()))


@pytest.fixture(scope="module")
def views():
    poses = orbit(5, distance=4.0, elevation=0.4, size=_SIZE, angle_x=0.8).poses
    return Views(np.float64(poses), np.full(5, _FOCAL), np.full((5, 2), _SIZE / 2))


@pytest.fixture(scope="module")
def photos(views, surface, traced):
    row, column = (x.ravel() for x in np.indices((_SIZE, _SIZE)))
    found = []
    for pose in views.poses:
        camera = Cameras(np.float32(pose[None]), _SIZE, _SIZE, _FOCAL)
        rays = pixel_rays(camera, np.zeros(row.size, np.int64), row, column)
        seen = photometry.encode(photometry.predict(traced, surface, rays).linear)
        image = np.round(255.0 * seen).astype(np.uint8).reshape(_SIZE, _SIZE, 3)
        found.append(Photo(image, np.hypot(row - 23.5, column - 23.5).reshape(_SIZE, _SIZE) < 15.0))
    return found


def _wrong(views, *, seed=0):
    drawn = np.random.default_rng(seed).normal(0.0, [1e-3] * 3 + [5e-3] * 3, (5, 6))
    return views._replace(poses=bundle.corrected(views.poses, drawn))


def _left(poses, views):
    away = bundle.correction_between(views.poses, poses)
    return np.linalg.norm(away[:, :3], axis=1).mean(), np.linalg.norm(away[:, 3:], axis=1).mean()


_PRIOR = Prior(0.01, 0.04)


@pytest.mark.slow
def test_poses_come_back(views, photos, surface, traced, monkeypatch):
    monkeypatch.setattr(through_object, "_PIXELS", 400)
    wrong, told = _wrong(views), []
    found = through_object.refine(
        wrong, photos, traced, surface, prior=_PRIOR, progress=lambda *x: told.append(x)
    )
    assert told == [(step, through_object.STEPS) for step in range(through_object.STEPS + 1)]
    for before, after in zip(_left(wrong.poses, views), _left(found.poses, views), strict=True):
        assert after < 0.2 * before
    assert np.all(found.after < 0.6 * found.before)
    corrected = bundle.corrected(wrong.poses, found.corrections)
    np.testing.assert_allclose(corrected, found.poses, atol=1e-12)
    assert "5, of which 5 are explained better" in found.describe()


@pytest.mark.slow
def test_views_that_nothing_explains_stay_as_they_are(views, photos, surface, traced, monkeypatch):
    monkeypatch.setattr(through_object, "_PIXELS", 200)
    noise = np.random.default_rng(0).integers(256, size=(_SIZE, _SIZE, 3), dtype=np.uint8)
    some = [photo._replace(image=noise) if i == 1 else photo for i, photo in enumerate(photos)]
    some[2] = photos[2]._replace(mask=None)  # unknown, or empty: all pixels are drawn alike
    some[3] = photos[3]._replace(mask=np.zeros((_SIZE, _SIZE), bool))
    wrong = _wrong(views)
    found = through_object.refine(wrong, some, traced, surface, prior=Prior(1e-4, 5e-4))
    assert np.all(np.isfinite(found.poses)) and found.after[1] <= found.before[1]
    assert np.all(found.after[[2, 3]] < found.before[[2, 3]])
    assert np.abs(found.corrections[1]).max() < 5e-3


@pytest.mark.slow
def test_judges_are_other_pixels_and_a_camera_may_be_in_the_middle(
    photos, views, surface, traced, monkeypatch
):
    monkeypatch.setattr(through_object, "_PIXELS", 100)
    fitted, judges = through_object._sample(photos, np.random.default_rng(0))
    for view in range(len(photos)):
        pairs = (zip(x.row[view], x.column[view], strict=True) for x in (fitted, judges))
        assert not set.intersection(*map(set, pairs))
    middle = views.poses.copy()
    middle[0, :, 3] = middle[1:, :, 3].mean(axis=0)
    found = through_object.refine(
        views._replace(poses=middle), photos, traced, surface, prior=_PRIOR
    )
    assert np.all(np.isfinite(found.poses)) and np.all(np.isfinite(found.after))
    one = views._replace(poses=np.repeat(views.poses[:1], 5, axis=0))
    with pytest.raises(ValueError, match="at one place"):
        through_object.refine(one, photos, traced, surface, prior=_PRIOR)


@pytest.mark.slow
def test_the_command_refines_through_an_aligned_object(ball_scene, tmp_path):
    scene = shutil.copytree(ball_scene, tmp_path / "ball")
    before = refined_scene.read(scene)
    drawn = np.random.default_rng(0).normal(0.0, [4e-4] * 3 + [3e-3] * 3, (len(before.photos), 6))
    wrong, start = bundle.corrected(before.views.poses, drawn), 0
    for split in dict.fromkeys(split for split, _ in before.names):
        path = scene / scene_folder.TRANSFORMS.format(split)
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            frame["transform_matrix"] = [*wrong[start].tolist(), [0.0, 0.0, 0.0, 1.0]]
            start += 1
        path.write_text(json.dumps(content))
    aligned, out = tmp_path / "aligned", tmp_path / "refined"
    run_command("align", f"--scene={scene}", f"--out={aligned}")
    options = f"--scene={scene}", f"--reconstruction={aligned}", f"--out={out}"
    said = run_command("refine_cameras", *options).stdout
    assert "explained better" in said
    after = refined_scene.read(out)
    change = bundle.similarity(after.views.poses, before.views.poses)
    left = bundle.correction_between(before.views.poses, bundle.moved(after.views.poses, change))
    for part in (slice(3), slice(3, 6)):
        before, after = (np.linalg.norm(x[:, part], axis=1).mean() for x in (drawn, left))
        assert after < 0.6 * before
    record = json.loads((out / refined_scene.RECORD).read_text())
    assert record["error_srgb"] > 0.0
    assert {"error_before_srgb", "error_after_srgb"} <= record["views"][0].keys()
