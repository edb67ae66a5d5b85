"""The command's options, before and after anything is rendered."""

from tests.experiments.command import run_command


def test_mistakes_end_before_anything_is_made(tmp_path):
    out = tmp_path / "out"
    for options, said in [
        (("--blender=nowhere",), "make dataset-env"),
        (("--scenes=cube_smcvx_bal",), "cube_smcvx_ball"),
    ]:
        result = run_command("dataset.make", f"--out={out}", *options, fails=True)
        assert said in result.stderr and "Traceback" not in result.stderr
    assert not out.exists()
