"""Corners, patches, and cameras that are refined by what they see beside an object."""

import json

import numpy as np
import pytest
import scipy.ndimage

from experiments.cameras import bundle, corners, refined_scene, refinement
from experiments.cameras.bundle import Prior
from refref_jax.data import SceneError, image_files, scene_folder
from tests.factories import painted_room
from tests.processes.command import run_command

_SIZE, _FOCAL = 112, 80.0


def _picture(values):
    return corners.prepare(np.rint(np.stack([255.0 * values] * 3, -1)).astype(np.uint8))


def _blobs(shift=(0.0, 0.0)):
    """Returns a smooth image, moved by a part of a pixel."""
    x, y = np.meshgrid(np.arange(64) - shift[0], np.arange(64) - shift[1])
    return 0.5 + 0.2 * np.sin(0.55 * x) * np.cos(0.47 * y) + 0.15 * np.sin(0.31 * (x + y) + 1.0)


def test_the_corner_of_a_chessboard_is_where_its_edges_meet():
    # Edges between pixels 31 and 32: the corner is at 32.
    board = np.where((np.indices((64, 64)) // 32).sum(0) % 2, 0.8, 0.2)
    found = corners.find_corners(_picture(board), np.ones((64, 64), bool), most=10)
    assert np.abs(found.places - 32.0).max(axis=1).min() < 0.2
    none = corners.find_corners(_picture(board), np.zeros((64, 64), bool), most=10)
    assert none.places.shape == (0, 2)


def test_patches_are_found_to_a_hundredth_of_a_pixel_whatever_their_light():
    first, second = _picture(_blobs()), _picture(0.1 + 0.7 * _blobs((0.63, -0.41)))
    places = np.array([[20.0, 30.0], [41.5, 22.0], [33.0, 44.0]])
    found, alike = corners.align_patches(first, second, places, places)
    assert alike.all()
    np.testing.assert_allclose(found - places, [[0.63, -0.41]] * 3, atol=0.012)


def test_turned_patches_are_found():
    turned = scipy.ndimage.rotate(_blobs(), 4.0, reshape=False, mode="nearest")
    middle = np.array([[32.0, 32.0]])
    found, alike = corners.align_patches(_picture(_blobs()), _picture(turned), middle, middle)
    assert alike.all()
    np.testing.assert_allclose(found, middle, atol=0.02)


def test_patches_that_differ_are_not_found():
    noise = np.random.default_rng(0).random((64, 64))
    places = np.array([[30.0, 30.0]])
    assert not corners.align_patches(_picture(_blobs()), _picture(noise), places, places)[1].any()


def test_pairs_prefer_each_other():
    likeness = np.array([[0.95, 0.2, 0.1], [0.3, 0.9, 0.89], [0.99, 0.1, 0.2]])
    pairs = corners.pair_up(likeness, np.ones((3, 3), bool), least=0.8)
    # The second has two that are nearly as good; the first is not the first choice of its choice.
    assert pairs.tolist() == [[2, 0]]
    possible = np.ones((3, 3), bool)
    possible[2, 0] = possible[1, 2] = False
    assert corners.pair_up(likeness, possible, least=0.8).tolist() == [[0, 0], [1, 1]]
    assert corners.pair_up(np.zeros((0, 3)), np.zeros((0, 3), bool), least=0.8).shape == (0, 2)


def test_points_lie_on_their_epipolar_lines():
    views = painted_room.views(4, size=_SIZE, focal=_FOCAL)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (7, 3))
    first, second = (bundle.project(views, points, np.full(7, view))[0] for view in (0, 2))
    off = refinement.off_line(views, 0, 2, first, second)
    assert np.abs(np.diag(off)).max() < 1e-9
    assert np.median(off[~np.eye(7, dtype=bool)]) > 1.0


@pytest.fixture(scope="module")
def room():
    views = painted_room.views(10, size=_SIZE, focal=_FOCAL)
    return views, painted_room.photographs(views, size=_SIZE)


def _wrong(views):
    errors = np.random.default_rng(5).normal(0.0, 1.0, (len(views.poses), 6))
    return bundle.corrected(views.poses, errors * np.repeat([0.004, 0.01], 3))


def _left(poses, true):
    aligned = bundle.moved(poses, bundle.similarity(poses, true))
    change = bundle.correction_between(true, aligned)
    return np.linalg.norm(change[:, :3], axis=1).mean(), np.linalg.norm(
        change[:, 3:], axis=1
    ).mean()


def test_cameras_in_a_painted_room_find_their_poses(room):
    views, photos = room
    given = views._replace(poses=_wrong(views))
    refined = refinement.refine(given, photos, prior=Prior(0.006, 0.015))
    before, after = _left(given.poses, views.poses), _left(refined.poses, views.poses)
    assert before[0] > 0.003 and before[1] > 0.008
    assert after[0] < 0.2 * before[0] and after[1] < 0.2 * before[1]
    # The gauge is that of the given poses.
    back = bundle.similarity(refined.poses, given.poses)
    assert back.scale == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(back.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(back.shift, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        bundle.corrected(given.poses, refined.corrections), refined.poses, atol=1e-12
    )


@pytest.mark.slow
def test_a_view_of_nothing_keeps_its_pose_and_a_scene_of_nothing_is_refused(room):
    views, photos = room
    blank = [photo._replace(image=np.full_like(photo.image, 90)) for photo in photos]
    told = []
    refined = refinement.refine(
        views, [*blank[:1], *photos[1:]], prior=Prior(0.006, 0.015), report=told.append
    )
    assert refined.sightings[0] == 0
    np.testing.assert_array_equal(refined.poses[0], views.poses[0])
    assert "warning: 1 views show fewer than" in told[-1]
    with pytest.raises(ValueError, match="textured things"):
        refinement.refine(views, blank, prior=Prior(0.006, 0.015))
    draw = np.random.default_rng(0)
    noise = [
        photo._replace(image=draw.integers(0, 256, photo.image.shape).astype(np.uint8))
        for photo in photos
    ]
    with pytest.raises(ValueError, match="textured things"):
        refinement.refine(views, noise, prior=Prior(0.006, 0.015))
    one = views._replace(poses=np.repeat(views.poses[:1], len(views.poses), axis=0))
    with pytest.raises(ValueError, match="All cameras are at one place"):
        refinement.refine(one, photos, prior=Prior(0.006, 0.015))


@pytest.fixture
def scene(tmp_path, room):
    views, photos = room
    folder, poses = tmp_path / "scene", _wrong(views)
    splits = {"train": range(1, 10), "test": range(1)}
    for split, numbers in splits.items():
        frames = []
        for number, view in enumerate(numbers):
            names = scene_folder.plain(split, number)
            for name in (f"{names.image}.png", names.mask):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
            image_files.write_png(folder / f"{names.image}.png", photos[view].image)
            image_files.write_mask(folder / names.mask, photos[view].mask)
            pose = [*poses[view].tolist(), [0.0, 0.0, 0.0, 1.0]]
            record = scene_folder.frame_record(names, pose, masked=True, deep=False)
            frames.append(record | {"source": f"DSC_{view}"})
        angle = 2.0 * np.arctan(0.5 * _SIZE / _FOCAL)
        scene_folder.write_transforms(folder, split, {"camera_angle_x": angle, "frames": frames})
    return folder


def test_the_command_writes_a_scene_with_other_poses(scene, tmp_path, room):
    out = tmp_path / "refined"
    said = run_command("refine_cameras", f"--scene={scene}", f"--out={out}").stdout
    assert "Turned:" in said and f"train --scene={out}" in said
    order = [*range(1, 10), 0]
    true = room[0].poses[order]
    before, after = refined_scene.read(scene), refined_scene.read(out)
    assert _left(after.views.poses, true)[0] < 0.2 * _left(before.views.poses, true)[0]
    assert before.names == after.names and before.names[-1] == ("test", "r_000")
    record = json.loads((out / refined_scene.RECORD).read_text())
    assert [view["split"] for view in record["views"]] == ["train"] * 9 + ["test"]
    given = np.array([view["given"] for view in record["views"]])[:, :3]
    np.testing.assert_array_equal(given, before.views.poses)
    frame = json.loads((out / "transforms_test.json").read_text())["frames"][0]
    assert frame["source"] == "DSC_0"
    again = run_command("refine_cameras", f"--scene={scene}", f"--out={out}", fails=True)
    assert "nothing is overwritten" in again.stderr


def test_copies_inside_the_scene_and_scenes_of_two_views_are_refused(scene):
    with pytest.raises(SceneError, match="next to it"):
        refined_scene.check_place(scene, scene / "refined")
    path = scene / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"] = content["frames"][:1]
    path.write_text(json.dumps(content))
    with pytest.raises(SceneError, match="has 2 views"):
        refined_scene.read(scene)
