"""Runs a command of `experiments` in a process of its own.

The command stops, and saves what it has, when this process ends, however that ends: its standard
input is a pipe from here, which closes then; see `app.run`. It is in a session of its own, so
that Ctrl-C, a terminal that is closed, and what is sent to the group of this process reach it
through this process alone.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.cli import app

# ru_maxrss is in KiB, but in bytes on macOS.
_RSS_UNIT = 1.0 if sys.platform == "darwin" else 1024.0
_MIB = 2.0**20

# Seconds between two looks at a command.
_POLL = 0.05

_ROOT = Path(__file__).resolve().parents[2]

# Of all threads: the commands that they wait for.
_running: set[subprocess.Popen[bytes]] = set()
_lock = threading.Lock()
_stopping = threading.Event()


class RunFailedError(Exception):
    """A training or evaluation ended with an error; the text is its last line and where to read."""


def run(name: str, *options: str, log: Path) -> tuple[float, float]:
    """Runs a command and returns its seconds and the peak of its memory in MiB.

    If this process is interrupted, the command is asked to stop, and may save before it does.

    Args:
      name: of the command in `experiments`.
      options: of it.
      log: file that what it prints is added to.

    Raises:
      RunFailedError: if it ends with an error, or is killed.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    with log.open("a", encoding="utf-8") as file:
        print(f"$ {app.shell(name, *options)}", file=file, flush=True)
        written = file.tell()
        process = _start(
            command_line(name, options),
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=_environment(),
            start_new_session=True,
        )
        try:
            status, usage = _wait(process)
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            raise
        finally:
            with _lock:
                _running.discard(process)
            process.stdin.close()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        reason = _complaint(log.read_bytes()[written:].decode("utf-8"), process.returncode)
        raise RunFailedError(f"experiments.{name}: {reason} (all of it: {log})")
    return time.monotonic() - start, usage.ru_maxrss * _RSS_UNIT / _MIB


def command_line(name: str, options: Sequence[str]) -> list[str]:
    """Returns what runs a command of `experiments`."""
    return [sys.executable, "-m", f"experiments.{name}", *options]


@contextlib.contextmanager
def stopping() -> Iterator[None]:
    """Asks all commands that threads of this process wait for to stop; in the context none starts.

    Each may save before it ends, and its thread is told that it failed.
    """
    with _lock:
        _stopping.set()
        for process in _running:
            with contextlib.suppress(ProcessLookupError):
                # Not by `process`, which might take the status that its thread waits for.
                os.kill(process.pid, signal.SIGTERM)
    try:
        yield
    finally:
        _stopping.clear()


def _start(words: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    with _lock:
        if _stopping.is_set():
            raise RunFailedError("stopped before it began")
        process = subprocess.Popen(words, **options)
        _running.add(process)
    return process


def _wait(process: subprocess.Popen[bytes]) -> tuple[int, Any]:
    """Returns how a process ended, and what it used.

    A wait that blocks would not notice the interruption of a task of Ray, which is no signal.
    """
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            return status, usage
        time.sleep(_POLL)


def _environment() -> dict[str, str]:
    """Returns the environment of a command, which finds these modules wherever it is started."""
    paths = [str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {app.STOP_WITH_INPUT: "1", "PYTHONPATH": os.pathsep.join(paths)}


def _complaint(printed: str, code: int) -> str:
    """Returns the last line that tells an error, or what else a command ended with."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    told = [line for line in lines if re.search(r"(^e|E)rror: ", line)]
    if told:
        return told[-1]
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return lines[-1] if lines else f"ended with status {code}, and printed nothing"
