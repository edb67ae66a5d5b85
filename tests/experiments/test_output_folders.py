"""Results are whole or not there, and only what a command noted as its own is replaced."""

import errno
import json
import os

import pytest

from experiments.cli import outputs

pytestmark = pytest.mark.loose

_WRITES = ("rgb", "metrics.json")


def _fresh(out, *, writes=_WRITES, overwrite=False):
    return outputs.fresh(out, module=__name__, writes=writes, overwrite=overwrite)


def _write(out, names, *, writes=_WRITES, overwrite):
    with _fresh(out, writes=writes, overwrite=overwrite) as draft:
        for name in names:
            (draft / name).parent.mkdir(exist_ok=True)
            (draft / name).write_text("new")


def _noted(out):
    return json.loads((out / outputs.NOTE).read_text())["files"]


def _files(folder):
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_a_folder_is_tried_before_and_nothing_is_left_of_it(tmp_path, monkeypatch):
    outputs.check_folder(tmp_path / "a" / "b")
    outputs.check_folder(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"--out=.*file/x cannot be written to .Not a directory"):
        outputs.check_folder(tmp_path / "file" / "x")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ValueError, match=r"--out=.* cannot be written to .Permission denied"):
        outputs.check_folder(tmp_path)
    assert _files(tmp_path) == {"file"} and len(list(tmp_path.iterdir())) == 1


def test_what_is_written_appears_with_a_note(tmp_path):
    out = tmp_path / "a" / "out"
    _write(out, ["rgb/0.png", "metrics.json"], overwrite=False)
    assert _files(tmp_path / "a") == {"out/rgb/0.png", "out/metrics.json", "out/command.json"}
    assert json.loads((out / outputs.NOTE).read_text()) == {
        "command": __name__,
        "options": {},
        "files": ["metrics.json", "rgb/0.png"],
    }


def test_only_what_was_noted_is_replaced(tmp_path):
    out = tmp_path / "out"
    _write(out, ["rgb/0.png", "rgb/1.png", "metrics.json"], overwrite=False)
    (out / "rgb" / "mine.txt").write_text("mine")
    (out / "notes").mkdir()
    with pytest.raises(ValueError, match="Use --overwrite to replace them"):
        _write(out, ["rgb/0.png"], overwrite=False)
    _write(out, ["rgb/0.png"], overwrite=True)
    assert _files(out) == {"rgb/0.png", "rgb/mine.txt", "command.json"}
    assert (out / "notes").is_dir()
    (out / "metrics.json").write_text("mine")  # is told before the work
    with pytest.raises(ValueError, match=r"out/metrics.json was not written by this command"):
        outputs.replaceable(out, module=__name__, writes=_WRITES, overwrite=True)
    # A note of files that are gone is no obstacle.
    (out / "rgb" / "0.png").unlink()
    (out / "rgb" / "mine.txt").unlink()
    (out / "rgb").rmdir()
    (out / "metrics.json").unlink()
    _write(out, ["metrics.json"], overwrite=False)
    assert _noted(out) == ["metrics.json"]


def test_nothing_of_others_is_replaced_even_if_asked(tmp_path):
    out = tmp_path / "out"
    (out / "rgb").mkdir(parents=True)
    (out / "rgb" / "0.png").write_text("mine")
    with pytest.raises(ValueError, match="not written by this command"):
        _write(out, ["rgb/0.png"], overwrite=True)
    # A note of another command, or one that points elsewhere, is not ours.
    for note in (
        {"command": "other", "options": {}, "files": ["rgb/0.png"]},
        {"command": __name__, "options": {}, "files": ["../secret"]},
        {"command": __name__, "options": {}, "files": [str(tmp_path / "secret")]},
        ["no record"],
    ):
        (out / outputs.NOTE).write_text(json.dumps(note))
        with pytest.raises(ValueError, match="not written by this command"):
            _write(out, ["rgb/0.png"], overwrite=True)
    assert (out / "rgb" / "0.png").read_text() == "mine"
    assert _files(tmp_path) == {"out/rgb/0.png", "out/command.json"}


def test_a_file_that_came_meanwhile_stays(tmp_path):
    out = tmp_path / "out"
    with (
        pytest.raises(ValueError, match="not written by this command"),
        _fresh(out, overwrite=True) as draft,
    ):
        (draft / "metrics.json").write_text("new")
        (out / "metrics.json").write_text("mine")
    assert _files(tmp_path) == {"out/metrics.json"}
    assert (out / "metrics.json").read_text() == "mine"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interruption_leaves_what_was_there(tmp_path, error):
    out = tmp_path / "out"
    _write(out, ["metrics.json"], overwrite=False)
    before = (out / outputs.NOTE).read_bytes()
    with pytest.raises(error), _fresh(out, overwrite=True) as draft:
        (draft / "rgb").mkdir()
        (draft / "rgb" / "0.png").write_text("half")
        raise error
    assert _files(tmp_path) == {"out/metrics.json", "out/command.json"}
    assert (out / outputs.NOTE).read_bytes() == before
    with pytest.raises(error), outputs.fresh_file(out / "x", overwrite=False) as path:
        path.write_text("half")
        raise error
    assert not (out / "x").exists() and _files(out) == {"metrics.json", "command.json"}
    (tmp_path / "there").mkdir()
    for name in ("made", "there"):
        with pytest.raises(error), _fresh(tmp_path / name) as draft:
            (draft / "metrics.json").write_text("half")
            raise error
    assert {path.name for path in tmp_path.iterdir()} == {"out", "there"}  # no empty folder


def test_two_calls_at_once_do_not_share_a_folder(tmp_path):
    out = tmp_path / "out"
    with _fresh(out) as draft:
        (draft / "metrics.json").write_text("first")
        with pytest.raises(ValueError, match="Another process works in"):
            _write(out, ["metrics.json"], overwrite=True)
    assert (out / "metrics.json").read_text() == "first"
    _write(out, ["metrics.json"], overwrite=True)


def test_who_waited_for_another_looks_again(tmp_path, monkeypatch):
    out, hold = tmp_path / "out", outputs.atomic_files.hold

    def hold_after_another(folder):
        monkeypatch.setattr(outputs.atomic_files, "hold", hold)
        _write(out, ["metrics.json"], overwrite=False)
        return hold(folder)

    monkeypatch.setattr(outputs.atomic_files, "hold", hold_after_another)
    with pytest.raises(ValueError, match="Use --overwrite"), _fresh(out):
        raise AssertionError("worked in vain")
    assert _files(out) == {"metrics.json", "command.json"}


def test_a_product_of_its_own_is_added_or_replaced_alone(tmp_path):
    out = tmp_path / "out"
    _write(out, ["fan.jpg"], writes=["fan.jpg"], overwrite=False)
    _write(out, ["tree.jpg"], writes=["tree.jpg"], overwrite=False)
    (out / "fan.jpg").write_text("old")
    (out / "tree.jpg").write_text("old")
    with pytest.raises(ValueError, match=r"\(tree.jpg, \.\.\.\). Use --overwrite"):
        _write(out, ["tree.jpg"], writes=["tree.jpg"], overwrite=False)
    _write(out, ["tree.jpg"], writes=["tree.jpg"], overwrite=True)
    assert (out / "fan.jpg").read_text() == "old" and (out / "tree.jpg").read_text() == "new"
    assert _noted(out) == ["fan.jpg", "tree.jpg"]


def test_who_is_stopped_while_files_are_moved_owns_all_of_them(tmp_path, monkeypatch):
    out, replace = tmp_path / "out", os.replace
    _write(out, ["rgb/0.png", "metrics.json"], overwrite=False)

    def replace_one(source, target):
        replace(source, target)
        if target.parent.name == "rgb":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "replace", replace_one)
        _write(out, ["rgb/1.png", "rgb/2.png"], overwrite=True)
    # Nothing old is gone, and all of it can be replaced.
    assert {"rgb/0.png", "metrics.json", "command.json"} < _files(out) and len(_files(out)) == 4
    _write(out, ["rgb/1.png", "rgb/2.png"], overwrite=True)
    assert _files(out) == {"rgb/1.png", "rgb/2.png", "command.json"}
    assert _noted(out) == ["rgb/1.png", "rgb/2.png"]


@pytest.mark.parametrize("moved", [1, 2])  # the note, or the first result too
def test_who_is_killed_while_the_first_files_are_moved_can_be_repeated(
    tmp_path, monkeypatch, moved
):
    out, replace, count = tmp_path / "out", os.replace, 0

    def replace_some(source, target):
        nonlocal count
        replace(source, target)
        count += 1
        if count == moved:
            raise KeyboardInterrupt

    names = ["rgb/0.png", "rgb/1.png", "metrics.json"]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "replace", replace_some)
        # Who is killed tidies nothing up.
        patch.setattr(outputs.shutil, "rmtree", lambda *folders, **options: None)
        _write(out, names, overwrite=False)
    assert (out / ".unfinished").is_dir() and len(_files(out) & set(names)) == moved - 1
    _write(out, names, overwrite=True)
    assert _files(out) == {*names, "command.json"} and _noted(out) == sorted(names)
    assert not (out / ".unfinished").exists()


def test_the_folder_may_be_a_mount(tmp_path, monkeypatch):
    out, replace = tmp_path / "out", os.replace
    out.mkdir()

    def replace_within(source, target):
        if out in source.parents and out in target.parents:
            replace(source, target)
        else:
            raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "replace", replace_within)
    _write(out, ["rgb/0.png", "metrics.json"], overwrite=False)
    assert _files(out) == {"rgb/0.png", "metrics.json", "command.json"}


def test_files_and_folders_are_not_taken_for_each_other(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="is a file, not a folder"):
        _write(tmp_path / "file", [], overwrite=True)
    with pytest.raises(ValueError, match="is a folder, not a file"):
        outputs.check_file(tmp_path / "folder", overwrite=True)
    with pytest.raises(ValueError, match="--overwrite to replace it"):
        outputs.check_file(tmp_path / "file", overwrite=False)
    with outputs.fresh_file(tmp_path / "file", overwrite=True) as path:
        path.write_text("new")
    assert (tmp_path / "file").read_text() == "new"
