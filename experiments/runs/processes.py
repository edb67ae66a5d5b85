"""Devices and processes that train together.

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
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from absl import flags
from etils import epy

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from experiments.cli.flags import DeviceFlags

with epy.lazy_imports():
    from refref_jax.training import devices


def check(given: dict[str, Any]) -> bool:
    """Refuses flags by which several processes can not find each other.

    Args:
      given: values of `--coordinator`, `--processes` and `--process`.

    Raises:
      flags.ValidationError: if one is missing, wrong, or would have no effect.
    """
    where, count, number = given["coordinator"], given["processes"], given["process"]
    if count == 1 and (where is not None or number is not None):
        raise flags.ValidationError(
            "These are of several processes. Say how many with --processes, or leave them out."
        )
    if count > 1 and (where is None or not re.fullmatch(r"[^\s]+:\d+", where)):
        raise flags.ValidationError(
            "The processes have to find each other. Give all of them the same "
            "--coordinator=HOST:PORT, of the first one's machine."
        )
    if count > 1 and (number is None or number >= count):
        raise flags.ValidationError(f"Give this process --process with 0 to {count - 1}.")
    return True


def together(given: DeviceFlags) -> bool:
    """Returns whether several processes are to train together."""
    return given.processes.value > 1


def connect(given: DeviceFlags) -> None:
    """Finds the other processes, if there are any; before anything touches a device.

    Raises:
      ValueError: if they are not found.
    """
    if together(given):
        devices.connect(
            coordinator=given.coordinator.value,
            processes=given.processes.value,
            process=given.process.value,
        )


def mesh(given: DeviceFlags) -> Mesh | None:
    """Returns the devices that train together; `None` for one alone.

    Raises:
      ValueError: if there are not as many.
    """
    word = given.devices.value
    return devices.row(None if word == "all" else int(word))


@contextlib.contextmanager
def first_speaks() -> Iterator[None]:
    """Leaves what is printed to the first process, for as long as the context lasts."""
    if devices.is_first():
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
        yield
