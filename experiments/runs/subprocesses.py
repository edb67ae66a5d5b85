"""Runs a command of `experiments` in a separate process.

The command stops and saves its state when this process ends, for whatever reason: its standard
input is a pipe from this process, which is closed then; see `app.run`. It runs in its own session,
so that Ctrl-C, the closing of a terminal, and signals to the process group reach it only through
this process.
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

# Signals that end a process that finds no memory.
_NO_MEMORY = (signal.SIGABRT, signal.SIGKILL)

# Seconds between two polls of a command.
_POLL = 0.05

_ROOT = Path(__file__).resolve().parents[2]

# Running commands of all threads.
_running: set[subprocess.Popen[bytes]] = set()
_lock = threading.Lock()
_stopping = threading.Event()


class RunFailedError(Exception):
    """A training or evaluation failed; the text is its last line and the path of its log."""


def run(name: str, *options: str, log: Path) -> tuple[float, float]:
    """Runs a command and returns its duration in seconds and its peak memory in MiB.

    If this process is interrupted, the command is stopped gracefully and may save its state.

    Args:
      name: name of the command in `experiments`.
      options: flags of the command.
      log: file to which the output is appended.

    Raises:
      RunFailedError: if the command fails or is killed.
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
    """Returns the command line that runs a command of `experiments`."""
    return [sys.executable, "-m", f"experiments.{name}", *options]


@contextlib.contextmanager
def stopping() -> Iterator[None]:
    """Stops all commands that threads of this process wait for; inside the context none starts.

    Each may save its state, and its thread receives an error.
    """
    with _lock:
        _stopping.set()
        for process in _running:
            with contextlib.suppress(ProcessLookupError):
                # Not by `process`, whose thread may need the exit status.
                os.kill(process.pid, signal.SIGTERM)
    try:
        yield
    finally:
        _stopping.clear()


def _start(words: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    with _lock:
        if _stopping.is_set():
            raise RunFailedError("stopped before it started")
        process = subprocess.Popen(words, **options)
        _running.add(process)
    return process


def _wait(process: subprocess.Popen[bytes]) -> tuple[int, Any]:
    """Returns the exit status of a process and its resource usage.

    It polls, because a blocking wait would ignore the cancellation of a Ray task, which is not a
    signal.
    """
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            return status, usage
        time.sleep(_POLL)


def _environment() -> dict[str, str]:
    """Returns an environment in which a command can import these modules from any folder."""
    paths = [str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {app.STOP_WITH_INPUT: "1", "PYTHONPATH": os.pathsep.join(paths)}


def _complaint(printed: str, code: int) -> str:
    """Returns the last line with an error, or a description of the exit status."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"(^e|E)rror: ", line)]
    if errors:
        return errors[-1]
    if code < 0:
        told = f"killed by {signal.Signals(-code).name}"
        return f"{told}, as when memory runs out: lower --batch" if -code in _NO_MEMORY else told
    return lines[-1] if lines else f"ended with status {code}, and printed nothing"
