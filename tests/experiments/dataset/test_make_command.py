"""The command's options, before and after anything is rendered."""

import pytest

from experiments.dataset import blender_meshes
from tests.processes.command import run_command


def test_mistakes_end_before_anything_is_made(tmp_path):
    out = tmp_path / "out"
    for options, said in [
        (("--blender=nowhere",), "make dataset-env"),
        (("--scenes=cube_smcvx_bal",), "cube_smcvx_ball"),
        (("--out=",), "flag --out=: Give a path to write to."),
    ]:
        result = run_command("dataset.make", f"--out={out}", *options, fails=True)
        assert said in result.stderr and "Traceback" not in result.stderr
    assert not out.exists()


def test_a_monkey_that_is_there_is_kept_and_one_that_can_not_be_made_is_told(tmp_path):
    path = tmp_path / "build" / "monkey.npz"
    with pytest.raises(ValueError, match=r"monkey's mesh .*make dataset-env"):
        blender_meshes.export_monkey(path, blender="/bin/false")
    path.write_bytes(b"kept")
    blender_meshes.export_monkey(path, blender="/bin/false")
    assert path.read_bytes() == b"kept"
