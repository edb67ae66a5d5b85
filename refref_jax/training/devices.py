"""The devices that train one scene together.

A *mesh* is a row of devices, of one process or of several. Every device holds all parameters, and
an equal share of the light paths of every batch; what the paths sum to, and their gradients, are
summed over the devices. Without a mesh there is one device, and no sum.
"""

from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "devices"
"""Name of the mesh's only axis."""

# Seconds after which a process that does not answer is given up.
_PATIENCE = 100


def connect(*, coordinator: str, processes: int, process: int) -> None:
    """Makes this process one of several that train together; before anything touches a device.

    Args:
      coordinator: where the first process listens, as `host:port`.
      processes: how many there are.
      process: number of this one, from 0.

    Raises:
      ValueError: if they do not find each other.
    """
    try:
        jax.distributed.initialize(
            coordinator,
            processes,
            process,
            initialization_timeout=_PATIENCE,
            heartbeat_timeout_seconds=_PATIENCE,
            shutdown_timeout_seconds=_PATIENCE,
        )
    except RuntimeError as error:
        raise ValueError(
            f"The {processes} processes did not find each other at {coordinator} within "
            f"{_PATIENCE} s ({str(error).splitlines()[0]}). Start all of them, each with its own "
            "process number, and check that the first one's host and port can be reached."
        ) from error


def is_first() -> bool:
    """Returns whether this is the first process, which alone writes and speaks."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Waits until every process has come to this place.

    Args:
      what: a name for the place.
    """
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def any_process(flag: bool) -> bool:
    """Returns whether a flag is set in any process; all of them must ask."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def as_in_the_first(tree: Any) -> Any:
    """Returns the numbers that the first process has: rounding may differ between machines."""
    if jax.process_count() == 1:
        return tree
    return multihost_utils.broadcast_one_to_all(tree)


def row(count: int | None) -> Mesh | None:
    """Returns a mesh of so many devices of every process; `None` for one device altogether.

    Args:
      count: of each process; all of them if `None`.

    Raises:
      ValueError: if a process has fewer, or processes have different numbers.
    """
    by_process = [
        [device for device in jax.devices() if device.process_index == process]
        for process in range(jax.process_count())
    ]
    fewest, most = min(map(len, by_process)), max(map(len, by_process))
    if count is None and fewest < most:
        raise ValueError(
            f"Processes have {fewest} to {most} devices, but share paths evenly. Give a count of "
            f"devices up to {fewest}."
        )
    count = most if count is None else count
    if not 1 <= count <= fewest:
        raise ValueError(
            f"There {'is 1 device' if fewest == 1 else f'are {fewest} devices'} of kind "
            f"{jax.devices()[0].platform}, not {count}. Give 1 to {fewest}, or all."
        )
    chosen = [device for each in by_process for device in each[:count]]
    return None if len(chosen) == 1 else Mesh(chosen, (AXIS,))


def put_everywhere(tree: Any, *, mesh: Mesh | None) -> Any:
    """Returns a tree of arrays with every device of a mesh holding all of it.

    Args:
      tree: arrays of the host or of a device; the same in every process.
      mesh: the devices; if `None`, the arrays are on the usual one.
    """
    if mesh is None:
        return jax.device_put(tree)
    sharding = NamedSharding(mesh, PartitionSpec())

    def put(x: np.ndarray) -> jax.Array:
        return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])

    return jax.tree.map(put, jax.device_get(tree))
