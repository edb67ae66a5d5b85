"""From a capture to a model: what each command is asked, and that finished steps are kept."""

import pytest

from experiments.cli import app
from experiments.runs import capture_steps, subprocesses
from experiments.runs.capture_steps import Options

pytestmark = pytest.mark.loose

_RESULTS = {
    "import_capture": "imported/scene.json",
    "refine_cameras": "refined/scene.json",
    "reconstruct": "object/report.md",
    "train": "model/run.json",
    "evaluate": "model/eval/test/metrics.json",
}


@pytest.fixture
def called(monkeypatch, tmp_path):
    """Replaces the commands by ones that make their results; returns what they were asked."""
    calls = []

    def run(name, *options, log):
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a", encoding="utf-8") as file:
            file.write(f"$ {app.shell(name, *options)}\n")
        calls.append((name, dict(each[2:].split("=", 1) for each in options if "=" in each)))
        made = tmp_path / _RESULTS[name]
        made.parent.mkdir(parents=True, exist_ok=True)
        made.touch()

    monkeypatch.setattr(subprocesses, "run", run)
    return calls


def _run(out, **options):
    steps = capture_steps.steps(out / "capture", out, Options(**options))
    capture_steps.run(list(steps), out)


def test_each_step_reads_what_the_step_before_has_made(called, tmp_path, capsys):
    _run(tmp_path, mask_folder="masks", steps=30)
    assert [name for name, _ in called] == list(_RESULTS)
    options = dict(called)
    assert options["import_capture"]["source"] == str(tmp_path / "capture")
    assert options["import_capture"]["mask_folder"] == "masks"
    assert options["refine_cameras"]["scene"] == options["import_capture"]["out"]
    assert options["reconstruct"]["scene"] == options["refine_cameras"]["out"]
    assert options["train"]["scene"] == options["refine_cameras"]["out"]
    assert options["train"]["reconstruction"] == options["reconstruct"]["out"]
    assert (options["train"]["steps"], options["train"]["exposure"]) == ("30", "per_image")
    assert options["evaluate"]["run"] == options["train"]["out"]
    called.clear()
    _run(tmp_path, mask_folder="masks", steps=30)
    assert not called and capsys.readouterr().out.count("done before") == 5


def test_meshes_take_the_place_of_a_reconstruction(called, tmp_path):
    _run(tmp_path, meshes="scans", refine=False)
    assert [name for name, _ in called] == ["import_capture", "train", "evaluate"]
    assert "reconstruction" not in called[1][1]
    assert called[1][1]["scene"] == str(tmp_path / "imported")


@pytest.mark.parametrize(("brightest", "asked"), [(1.0, None), (2.0, "2")])
def test_light_above_white_is_asked_for_only_if_it_is_wanted(called, tmp_path, brightest, asked):
    _run(tmp_path, brightest=brightest)
    assert dict(called)["train"].get("brightest") == asked


def test_other_options_than_before_are_refused_before_anything_runs(called, tmp_path):
    _run(tmp_path, steps=30)
    called.clear()
    (tmp_path / _RESULTS["evaluate"]).unlink()
    with pytest.raises(ValueError, match=r"begun with other options.*--steps=30"):
        _run(tmp_path, steps=40)
    assert not called


def test_a_finished_step_of_an_earlier_version_is_kept(called, tmp_path):
    _run(tmp_path)
    log = tmp_path / "logs" / "reconstruct.txt"
    log.write_text(log.read_text().replace(" --exposure=per_image", ""))
    called.clear()
    _run(tmp_path)
    assert not called
    (tmp_path / _RESULTS["reconstruct"]).unlink()
    with pytest.raises(ValueError, match="begun with other options"):
        _run(tmp_path)


def test_a_step_that_fails_ends_in_one_line(tmp_path, monkeypatch):
    def run(name, *options, log):
        raise subprocesses.RunFailedError(f"experiments.{name}: error: no image")

    monkeypatch.setattr(subprocesses, "run", run)
    with pytest.raises(ValueError, match=r"^experiments\.import_capture: error: no image$"):
        _run(tmp_path)
