"""Connects devices and processes for data-parallel training.

On one machine `--devices=all` uses all accelerators. Several machines run the same command, each in
its own process, which connects to the first one:

    python -m experiments.train ... --coordinator=HOST:PORT --processes=2 --process=0   # on HOST
    python -m experiments.train ... --coordinator=HOST:PORT --processes=2 --process=1

Every process reads the scene, and process 0 writes the run. Both folders must have the same path on
all machines, as on a shared file system.
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
    """Rejects flags with which several processes cannot find each other.

    Args:
      given: values of `--coordinator`, `--processes` and `--process`.

    Raises:
      flags.ValidationError: if a flag is missing, invalid, or would have no effect.
    """
    where, count, number = given["coordinator"], given["processes"], given["process"]
    if count == 1 and (where is not None or number is not None):
        raise flags.ValidationError(
            "These flags require --processes > 1. Set --processes, or remove them."
        )
    if count > 1 and (where is None or not re.fullmatch(r"[^\s]+:\d+", where)):
        raise flags.ValidationError(
            "The processes cannot find each other. Pass the same --coordinator=HOST:PORT to all of "
            "them, with the host of process 0."
        )
    if count > 1 and (number is None or number >= count):
        raise flags.ValidationError(f"Pass --process between 0 and {count - 1} to this process.")
    return True


def together(given: DeviceFlags) -> bool:
    """Returns whether several processes train together."""
    return given.processes.value > 1


def connect(given: DeviceFlags) -> None:
    """Connects to the other processes, if any; must precede any use of a device.

    Raises:
      ValueError: if the connection fails.
    """
    if together(given):
        devices.connect(
            coordinator=given.coordinator.value,
            processes=given.processes.value,
            process=given.process.value,
        )


def mesh(given: DeviceFlags) -> Mesh | None:
    """Returns the devices that train together; `None` for a single device.

    Raises:
      ValueError: if there are too few devices.
    """
    word = given.devices.value
    return devices.row(None if word == "all" else int(word))


@contextlib.contextmanager
def first_speaks() -> Iterator[None]:
    """Suppresses the output of all processes but the first inside the context."""
    if devices.is_first():
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
        yield
