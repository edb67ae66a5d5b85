"""Results are whole or not there, and only what a command noted as its own is replaced."""

import json

import pytest

from experiments import command_line, output_folders

_WRITES = ("rgb", "metrics.json")


@pytest.fixture(autouse=True)
def options(monkeypatch):
    monkeypatch.setattr(command_line, "resolved", lambda module: {"chunk": 4096, "step": None})


def _write(out, names, *, overwrite):
    with output_folders.fresh(out, module=__name__, writes=_WRITES, overwrite=overwrite) as draft:
        for name in names:
            (draft / name).parent.mkdir(exist_ok=True)
            (draft / name).write_text("new")


def _files(folder):
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_what_is_written_appears_with_a_note(tmp_path):
    out = tmp_path / "a" / "out"
    _write(out, ["rgb/0.png", "metrics.json"], overwrite=False)
    assert _files(tmp_path / "a") == {"out/rgb/0.png", "out/metrics.json", "out/command.json"}
    assert json.loads((out / output_folders.NOTE).read_text()) == {
        "command": __name__,
        "options": {"chunk": 4096, "step": None},
        "files": ["metrics.json", "rgb/0.png"],
    }


def test_only_what_was_noted_is_replaced(tmp_path):
    out = tmp_path / "out"
    _write(out, ["rgb/0.png", "rgb/1.png", "metrics.json"], overwrite=False)
    (out / "rgb" / "mine.txt").write_text("mine")
    (out / "notes").mkdir()
    with pytest.raises(ValueError, match="Give --overwrite to replace them"):
        _write(out, ["rgb/0.png"], overwrite=False)
    _write(out, ["rgb/0.png"], overwrite=True)
    assert _files(out) == {"rgb/0.png", "rgb/mine.txt", "command.json"}
    assert (out / "notes").is_dir()


def test_nothing_of_others_is_replaced_even_if_asked(tmp_path):
    out = tmp_path / "out"
    (out / "rgb").mkdir(parents=True)
    (out / "rgb" / "0.png").write_text("mine")
    with pytest.raises(ValueError, match="not of this command"):
        _write(out, ["rgb/0.png"], overwrite=True)
    # A note of another command, or one that points elsewhere, is not ours.
    for note in (
        {"command": "other", "options": {}, "files": ["rgb/0.png"]},
        {"command": __name__, "options": {}, "files": ["../secret"]},
        {"command": __name__, "options": {}, "files": [str(tmp_path / "secret")]},
        ["no record"],
    ):
        (out / output_folders.NOTE).write_text(json.dumps(note))
        with pytest.raises(ValueError, match="not of this command"):
            _write(out, ["rgb/0.png"], overwrite=True)
    assert (out / "rgb" / "0.png").read_text() == "mine"
    assert _files(tmp_path) == {"out/rgb/0.png", "out/command.json"}


def test_a_file_that_came_meanwhile_stays(tmp_path):
    out = tmp_path / "out"
    with (
        pytest.raises(ValueError, match="not of this command"),
        output_folders.fresh(out, module=__name__, writes=_WRITES, overwrite=True) as draft,
    ):
        (draft / "metrics.json").write_text("new")
        out.mkdir()
        (out / "metrics.json").write_text("mine")
    assert _files(tmp_path) == {"out/metrics.json"}
    assert (out / "metrics.json").read_text() == "mine"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interruption_leaves_what_was_there(tmp_path, error):
    out = tmp_path / "out"
    _write(out, ["metrics.json"], overwrite=False)
    before = (out / output_folders.NOTE).read_bytes()
    with (
        pytest.raises(error),
        output_folders.fresh(out, module=__name__, writes=_WRITES, overwrite=True) as draft,
    ):
        (draft / "rgb").mkdir()
        (draft / "rgb" / "0.png").write_text("half")
        raise error
    assert _files(tmp_path) == {"out/metrics.json", "out/command.json"}
    assert (out / output_folders.NOTE).read_bytes() == before
    with pytest.raises(error), output_folders.fresh_file(out / "x", overwrite=False) as path:
        path.write_text("half")
        raise error
    assert not (out / "x").exists() and _files(out) == {"metrics.json", "command.json"}


def test_files_and_folders_are_not_taken_for_each_other(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="is a file, and a folder is needed"):
        _write(tmp_path / "file", [], overwrite=True)
    with pytest.raises(ValueError, match="is a folder, and a file"):
        output_folders.check_file(tmp_path / "folder", overwrite=True)
    with pytest.raises(ValueError, match="--overwrite to replace it"):
        output_folders.check_file(tmp_path / "file", overwrite=False)
    with output_folders.fresh_file(tmp_path / "file", overwrite=True) as path:
        path.write_text("new")
    assert (tmp_path / "file").read_text() == "new"
