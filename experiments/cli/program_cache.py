"""Keeps compiled programs on disk: a command need not compile again what an earlier one compiled.

Programs are kept in `refref_jax/` of the user's cache folder (`XDG_CACHE_HOME`, or `~/.cache`), by
JAX's own cache, for a month. JAX's variables take precedence: `JAX_COMPILATION_CACHE_DIR` is the
folder to use instead, and `JAX_ENABLE_COMPILATION_CACHE=false` keeps nothing.
"""

import hashlib
import os
import platform
import sys
import time
from pathlib import Path

_FOLDER = "JAX_COMPILATION_CACHE_DIR"
_LEAST_SECONDS = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
_CHOSEN = (_FOLDER, "JAX_ENABLE_COMPILATION_CACHE")

# Programs that took less time to compile are not kept.
_WORTH_KEEPING = 0.3

_DAYS = 30


def keep() -> None:
    """Lets JAX keep compiled programs, if the folder can be written; before JAX is imported."""
    if any(name in os.environ for name in _CHOSEN) or "jax" in sys.modules:
        return
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "refref_jax" / _processor()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for program in folder.iterdir():
            if program.stat().st_mtime < time.time() - _DAYS * 24 * 3600:
                program.unlink()
    except OSError:  # as on a read-only disk, or as another command removes the same program
        pass
    if folder.is_dir() and os.access(folder, os.W_OK):
        os.environ[_FOLDER] = str(folder)
        os.environ.setdefault(_LEAST_SECONDS, str(_WORTH_KEEPING))


def _processor() -> str:
    """Returns a name for the kind of processor: homes are shared, but programs fit one kind."""
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(errors="replace").splitlines() if facts.is_file() else []
    kinds = {line for line in lines if line.startswith(("flags", "Features", "model name"))}
    text = "\n".join((platform.machine(), platform.processor(), *sorted(kinds)))
    return hashlib.sha256(text.encode()).hexdigest()[:12]
