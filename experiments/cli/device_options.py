"""The options that say which devices, and which processes, train together.

On one machine `--devices=all` takes all of its accelerators. Several machines run the same command,
each as a process of its own that knows where the first one listens:

    python -m experiments.train ... --coordinator=HOST:PORT --processes=2 --process=0   # on HOST
    python -m experiments.train ... --coordinator=HOST:PORT --processes=2 --process=1

The scene is read by every process, and the run is written by the first: both folders must be in
the same place on all machines, which a file system that they share sees to.
"""

from __future__ import annotations

import contextlib
import os
import re
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import command_line
from experiments.cli.late_imports import late

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jax.sharding import Mesh

    from refref_jax.training import devices
else:
    devices = late("refref_jax.training.devices")

_DEVICES = flags.DEFINE_string(
    "devices",
    "1",
    "Devices that share the light paths of a batch: a number, or all; of each process.",
)
_COORDINATOR = flags.DEFINE_string(
    "coordinator", None, "Where the first of several processes listens, as HOST:PORT."
)
_PROCESSES = flags.DEFINE_integer("processes", 1, "Processes that train together.", 1)
_PROCESS = flags.DEFINE_integer("process", None, "Number of this process, from 0.", 0)
command_line.check(_DEVICES, lambda value: _number(value))


def together() -> bool:
    """Returns whether several processes are to train together."""
    return _PROCESSES.value > 1


def connect() -> None:
    """Finds the other processes, if there are any; before anything touches a device.

    Raises:
      ValueError: if options are missing or wrong, or the others are not found.
    """
    coordinator, process = _COORDINATOR.value, _PROCESS.value
    if not together():
        if coordinator is not None or process is not None:
            raise ValueError(
                "--coordinator and --process are of several processes. Say how many with "
                "--processes, or leave both out."
            )
        return
    if coordinator is None or not re.fullmatch(r"[^\s]+:\d+", coordinator):
        raise ValueError(
            f"--processes={_PROCESSES.value} have to find each other. Give all of them the same "
            "--coordinator=HOST:PORT, of the first one's machine."
        )
    if process is None or process >= _PROCESSES.value:
        raise ValueError(
            f"--processes={_PROCESSES.value} have a number each. Give this one --process with 0 to "
            f"{_PROCESSES.value - 1}."
        )
    devices.connect(coordinator=coordinator, processes=_PROCESSES.value, process=process)


def mesh() -> Mesh | None:
    """Returns the devices that train together; `None` for one alone.

    Raises:
      ValueError: if there are not as many.
    """
    return devices.row(_number(_DEVICES.value))


@contextlib.contextmanager
def first_speaks() -> Iterator[None]:
    """Leaves what is printed to the first process, for as long as the context lasts."""
    if devices.is_first():
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
        yield


def _number(word: str) -> int | None:
    """Returns how many devices a word means; `None` for all."""
    if word == "all":
        return None
    if not word.isdecimal():
        raise ValueError(f"--devices={word} is no number of devices. Give one, or all.")
    return int(word)
