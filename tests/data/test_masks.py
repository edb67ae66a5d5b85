import numpy as np
import pytest

from refref_jax.data import SceneError, scene_folder
from refref_jax.data.image_files import well_inside, well_outside
from refref_jax.data.scene_folder import add_masks
from tests.factories.small_scenes import HEIGHT, WIDTH, edit_transforms, without_masks, write_scene


@pytest.fixture
def scene(tmp_path):
    scene = write_scene(tmp_path / "own")
    edit_transforms(scene, without_masks)
    return scene


def _one_pixel(image):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[3, int(image.stem[-1])] = True
    return mask


def _contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def test_the_copy_has_the_masks_and_all_else(scene, tmp_path):
    before = _contents(scene)
    assert add_masks(scene, tmp_path / "new" / "copy", _one_pixel) == 2
    frames = scene_folder.read_frames(tmp_path / "new" / "copy", "train")
    expected = [_one_pixel(image) for image in frames.images]
    np.testing.assert_array_equal(scene_folder.read_masks(frames), expected)
    assert _contents(scene) == before
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["copy"]
    np.testing.assert_array_equal(
        scene_folder.read_images(frames),
        scene_folder.read_images(scene_folder.read_frames(scene, "train")),
    )


def test_the_model_sees_each_image_once(scene, tmp_path):
    seen = []
    add_masks(scene, tmp_path / "copy", lambda image: seen.append(image) or _one_pixel(image))
    assert seen == [scene / "train" / "r_000.png", scene / "train" / "r_001.png"]


def test_masks_of_before_are_replaced_in_the_copy_alone(tmp_path):
    scene = write_scene(tmp_path / "own")
    old = scene_folder.read_masks(scene_folder.read_frames(scene, "train"))
    add_masks(scene, tmp_path / "copy", _one_pixel)
    copied = scene_folder.read_masks(scene_folder.read_frames(tmp_path / "copy", "train"))
    kept = scene_folder.read_masks(scene_folder.read_frames(scene, "train"))
    np.testing.assert_array_equal(kept, old)
    assert copied[0, 3, 0] and not copied[0, 1, 2]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros((HEIGHT, WIDTH), bool), "None of the 2 masks of .* marks the object"),
        (np.ones((HEIGHT, WIDTH)), "Compare the model's output with a threshold"),
        (np.ones((WIDTH, HEIGHT), bool), "resize it to the image"),
    ],
)
def test_masks_that_will_not_do_leave_nothing_behind(scene, tmp_path, answer, message):
    with pytest.raises(SceneError, match=message):
        add_masks(scene, tmp_path / "copy", lambda image: answer)
    assert [path.name for path in tmp_path.iterdir()] == ["own"]


def test_nothing_is_overwritten(scene, tmp_path):
    (tmp_path / "copy").mkdir()
    with pytest.raises(SceneError, match=r"nothing is overwritten\. Give a new folder"):
        add_masks(scene, tmp_path / "copy", _one_pixel)
    with pytest.raises(SceneError, match="is inside the scene"):
        add_masks(scene, scene / "copy", _one_pixel)
    with pytest.raises(SceneError, match=r"transforms_train\.json does not exist"):
        add_masks(tmp_path / "copy", tmp_path / "other", _one_pixel)


@pytest.mark.parametrize("name", ["../elsewhere/r_000", "/elsewhere/r_000"])
def test_images_outside_of_the_scene_are_refused(scene, tmp_path, name):
    edit_transforms(scene, lambda content: content["frames"][0].update(file_path=name))
    with pytest.raises(SceneError, match="is not in the scene's folder"):
        add_masks(scene, tmp_path / "copy", _one_pixel)


def _masks():
    masks = np.zeros((2, 9, 9), bool)
    masks[0, 2:7, 2:7] = True
    return masks


def test_margins_by_hand():
    inside, outside = well_inside(_masks(), margin=1), well_outside(_masks(), margin=2)
    expected = np.zeros((9, 9), bool)
    expected[3:6, 3:6] = True
    np.testing.assert_array_equal(inside[0], expected)
    # Two pixels around a square of five leave nothing of nine.
    assert not outside[0].any()
    assert not inside[1].any() and outside[1].all()


def test_a_mask_at_the_rim_of_the_image_has_no_inside_there():
    assert well_inside(np.ones((1, 5, 5), bool), margin=1).sum() == 9


@pytest.mark.parametrize("margin", [0, 1, 2])
def test_inside_and_outside_never_meet(margin):
    masks = np.random.default_rng(0).uniform(size=(3, 16, 16)) < 0.3
    inside, outside = well_inside(masks, margin=margin), well_outside(masks, margin=margin)
    assert not np.any(inside & ~masks) and not np.any(outside & masks)
    if margin == 0:
        np.testing.assert_array_equal(inside, masks)
        np.testing.assert_array_equal(outside, ~masks)
