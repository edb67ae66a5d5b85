"""Compiled programs that commands keep for each other."""

import os
import subprocess
import sys
import time

import pytest

from experiments.cli import program_cache

_PROGRAM = """
from experiments.cli import program_cache
program_cache.keep()
import jax
jax.block_until_ready(jax.jit(lambda x: x @ x.T)(jax.numpy.ones((4, 4))))
"""


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """Returns the user's cache folder, of a process that has not imported JAX."""
    for name in (*program_cache._CHOSEN, program_cache._LEAST_SECONDS):
        # Set first, so that what the function sets is undone.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "jax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_programs_are_kept_in_the_users_cache_folder_for_a_month(cache):
    program_cache.keep()
    (folder,) = (cache / "refref_jax").iterdir()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(folder)
    assert folder.stat().st_mode & 0o077 == 0
    now, files = time.time(), {days: folder / f"{days}-cache" for days in (1, 29, 31, 400)}
    for days, file in files.items():
        file.write_bytes(b"program")
        os.utime(file, (now, now - days * 24 * 3600))
    del os.environ["JAX_COMPILATION_CACHE_DIR"]
    program_cache.keep()
    assert {days for days, file in files.items() if file.exists()} == {1, 29}


@pytest.mark.parametrize("name", ["JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"])
def test_variables_of_jax_take_precedence(cache, monkeypatch, name):
    monkeypatch.setenv(name, "mine")
    program_cache.keep()
    assert os.environ[name] == "mine" and not list(cache.iterdir())


def test_a_folder_that_cannot_be_written_is_not_used(cache):
    (cache / "refref_jax").write_text("a file, not a folder")
    program_cache.keep()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_jax_writes_the_programs_that_it_compiles(cache):
    environment = os.environ | {program_cache._LEAST_SECONDS: "0"}
    subprocess.run([sys.executable, "-c", _PROGRAM], env=environment, check=True)
    assert list((cache / "refref_jax").glob("*/jit*-cache"))
