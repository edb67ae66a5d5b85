"""The command's options, before and after anything is rendered."""

import pytest

from experiments.dataset import blender_meshes


def test_a_monkey_that_is_there_is_kept_and_one_that_can_not_be_made_is_told(tmp_path):
    path = tmp_path / "build" / "monkey.npz"
    with pytest.raises(ValueError, match=r"monkey's mesh .*make dataset-env"):
        blender_meshes.export_monkey(path, blender="/bin/false")
    path.write_bytes(b"kept")
    blender_meshes.export_monkey(path, blender="/bin/false")
    assert path.read_bytes() == b"kept"
