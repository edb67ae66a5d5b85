"""The command that takes over masks, as a user calls it."""

import pytest

from refref_jax.data import scene_folder
from tests.factories.small_scenes import edit_transforms, without_masks, write_scene
from tests.processes.command import run_command

pytestmark = pytest.mark.loose


def test_masks_from_a_folder(tmp_path):
    scene, masks = write_scene(tmp_path / "own"), tmp_path / "masks"
    expected = scene_folder.read_masks(scene_folder.read_frames(scene, "train"))
    (scene / "mask").rename(masks)
    edit_transforms(scene, without_masks)
    options = (f"--scene={scene}", f"--masks={masks}", f"--out={tmp_path / 'copy'}")
    result = run_command("import_masks", *options)
    assert "Masks: 2" in result.stdout
    copied = scene_folder.read_masks(scene_folder.read_frames(tmp_path / "copy", "train"))
    assert (copied == expected).all()
    again = run_command("import_masks", *options, fails=True)
    assert "nothing is overwritten" in again.stderr and "Traceback" not in again.stderr
    (masks / "train" / "r_001.png").unlink()
    options = (*options[:2], f"--out={tmp_path / 'other'}")
    missing = run_command("import_masks", *options, fails=True)
    assert "There is no mask of" in missing.stderr and "r_001.png" in missing.stderr
    assert not (tmp_path / "other").exists()
