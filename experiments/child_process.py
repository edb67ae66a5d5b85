"""Runs a command of `experiments` in a process of its own."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

# ru_maxrss is in KiB, but in bytes on macOS.
_RSS_UNIT = 1.0 if sys.platform == "darwin" else 1024.0
_MIB = 2.0**20


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
    written = log.stat().st_size if log.exists() else 0
    start = time.monotonic()
    with log.open("a", encoding="utf-8") as file:
        print(f"$ python -m experiments.{name} {' '.join(options)}", file=file, flush=True)
        process = subprocess.Popen(
            [sys.executable, "-m", f"experiments.{name}", *options],
            stdout=file,
            stderr=subprocess.STDOUT,
        )
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        reason = _complaint(log.read_bytes()[written:].decode("utf-8"), process.returncode)
        raise RunFailedError(f"experiments.{name}: {reason} (all of it: {log})")
    return time.monotonic() - start, usage.ru_maxrss * _RSS_UNIT / _MIB


def _complaint(printed: str, code: int) -> str:
    """Returns the last line that tells an error, or what else a command ended with."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    told = [line for line in lines if re.search(r"(^e|E)rror: ", line)]
    if told:
        return told[-1]
    return f"killed by {signal.Signals(-code).name}" if code < 0 else lines[-1]
