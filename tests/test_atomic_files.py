"""Files and folders are there whole or not at all, and a folder has one process at a time."""

import os
import subprocess
import sys

import pytest

from refref_jax import atomic_files


class _KilledError(Exception):
    pass


_HOLD = """
import sys, time
from pathlib import Path
from refref_jax import atomic_files
with atomic_files.hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_run_is_held_once_and_free_afterwards(tmp_path):
    with (
        atomic_files.hold(tmp_path),
        pytest.raises(ValueError, match="Another process"),
        atomic_files.hold(tmp_path),
    ):
        raise AssertionError("held twice")
    with atomic_files.hold(tmp_path):
        pass


def test_a_killed_process_holds_nothing(tmp_path):
    command = [sys.executable, "-c", _HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="Another process"), atomic_files.hold(tmp_path):
            raise AssertionError("held twice")
        process.kill()
    with atomic_files.hold(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_target_appears_when_it_is_whole(tmp_path):
    target = tmp_path / "folder"
    for content in ("old", "new"):
        with atomic_files.written_folder(target) as folder:
            (folder / content).write_text(content)
            assert not (target / content).exists()
    assert [path.name for path in target.iterdir()] == ["new"]
    with pytest.raises(_KilledError), atomic_files.written_folder(target) as folder:
        (folder / "half").write_text("")
        raise _KilledError
    assert [path.name for path in target.iterdir()] == ["new"]
    with pytest.raises(_KilledError), atomic_files.written_file(tmp_path / "file") as path:
        path.write_text("half")
        raise _KilledError
    assert not (tmp_path / "file").exists()


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    target, synced, fsync = tmp_path / "file", [], os.fsync

    def watched(descriptor):
        synced.append(target.exists())
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    for stop, times in (("process", 0), ("machine", 1)):
        with atomic_files.written_file(target, survives=stop) as draft:
            draft.write_text("whole")
        assert target.read_text() == "whole" and synced == [False] * times
        target.unlink()
    assert not list(tmp_path.iterdir())


def test_a_new_folder_replaces_nothing(tmp_path):
    target = tmp_path / "made" / "folder"
    with pytest.raises(OSError), atomic_files.new_folder(target) as later:
        with atomic_files.new_folder(target) as first:
            assert later != first and not target.exists()
            (first / "whole").write_text("first")
        (later / "whole").write_text("later")
    assert (target / "whole").read_text() == "first"
    assert list(target.parent.iterdir()) == [target]
