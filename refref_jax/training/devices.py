"""Distributes the training of one scene over several devices and processes.

A *mesh* is a row of devices, of one process or of several. Every device holds all parameters, and
an equal share of the light paths of every batch; the sums over paths, and their gradients, are
summed over the devices. Without a mesh there is one device, and no such sum. This is one of the
modules that call `jax.jit`.
"""

import contextlib
import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

AXIS = "devices"
"""Name of the mesh's only axis."""

# Timeout for a process that does not answer, seconds.
_PATIENCE = 100

# Fewest bytes that a step takes for each sample of a path: a fifth of what the leanest preset takes
# on a CPU, four fifths on a GPU (benchmarks/results/compiled_programs.csv).
_LEAST_BYTES = 200


def connect(*, coordinator: str, processes: int, process: int) -> None:
    """Connects this process to others that train together; must be called before devices are used.

    From then on, programs for CPUs run one after the other in this process, even if it fails.

    Args:
      coordinator: address at which the first process listens, as `host:port`.
      processes: number of processes.
      process: number of this process, from 0.

    Raises:
      ValueError: if the processes cannot connect.
    """
    # Programs that do not depend on each other would run at once, and their sums over processes
    # would mix: Gloo has one channel.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
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


def free_memory() -> int | None:
    """Returns the bytes of memory that the first device has left; `None` if that is unknown.

    On a CPU, the limits of the process and of its control group (Linux) count, too.
    """
    stats = jax.local_devices()[0].memory_stats()
    if stats is not None:
        limit = int(stats.get("bytes_limit", 0))
        return max(0, limit - int(stats.get("bytes_in_use", 0))) if limit else None
    system, own = _read_sizes("/proc/meminfo"), _read_sizes("/proc/self/status")
    if "MemAvailable" not in system or "VmData" not in own:
        return None
    found = [system["MemAvailable"] + system.get("SwapFree", 0)]
    with contextlib.suppress(OSError, ValueError):
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text())
        found.append(limit - own.get("RssAnon", 0))
    with contextlib.suppress(ImportError):
        import resource

        for kind, used in ((resource.RLIMIT_DATA, "VmData"), (resource.RLIMIT_AS, "VmSize")):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY:
                found.append(limit - own[used])
    return max(0, min(found))


def check_memory(batch: int, samples: int) -> None:
    """Refuses steps that cannot fit into memory, before they are compiled.

    Args:
      batch: number of rays of a step.
      samples: number of samples of a step on one device.

    Raises:
      ValueError: if a lower bound of what they take is more than there is.
    """
    free, least = free_memory(), samples * _LEAST_BYTES
    if free is not None and least > free:
        raise ValueError(
            f"A step of batch={batch} rays takes at least {least / 2**30:.1f} GiB, but "
            f"{free / 2**30:.1f} GiB of memory are free. Lower batch to "
            f"{max(1, batch * free // least)} or less, or samples_per_ray."
        )


def _read_sizes(path: str) -> dict[str, int]:
    """Returns the sizes in bytes of a file of the kernel, which states them in KiB."""
    try:
        rows = [line.split() for line in Path(path).read_text().splitlines()]
    except OSError:
        return {}
    return {row[0].rstrip(":"): 1024 * int(row[1]) for row in rows if row[-1:] == ["kB"]}


def is_first() -> bool:
    """Returns whether this is the first process, which does all I/O."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Waits until every process has reached this call.

    Args:
      what: name of the barrier.
    """
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def any_process(flag: bool) -> bool:
    """Returns whether a flag is set in any process; all of them must call this."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def in_all(check: Callable[[], None]) -> None:
    """Runs a check, which must raise in all processes if it raises in one; others would wait.

    Raises:
      ValueError: if it fails in this or in another process.
      OSError: if it fails so in this process.
    """
    failed: ValueError | OSError | None = None
    try:
        check()
    except (ValueError, OSError) as error:
        failed = error
    if any_process(failed is not None):
        raise failed or ValueError("Another process has stopped; its own message says why.")


def as_in_the_first(tree: Any) -> Any:
    """Returns the values of the first process; those of others may differ by rounding."""
    if jax.process_count() == 1:
        return tree
    return multihost_utils.broadcast_one_to_all(tree)


def row(count: int | None) -> Mesh | None:
    """Returns a mesh of `count` devices of every process; `None` for a single device in total.

    Args:
      count: number of devices of each process; all if `None`.

    Raises:
      ValueError: if a process has fewer, or, without a count, if processes have different numbers.
    """
    by_process = [
        [device for device in jax.devices() if device.process_index == process]
        for process in range(jax.process_count())
    ]
    fewest, most = min(map(len, by_process)), max(map(len, by_process))
    if count is None and fewest < most:
        raise ValueError(
            f"Processes have {fewest} to {most} devices, but paths are shared evenly. Give a count "
            f"up to {fewest}."
        )
    count = most if count is None else count
    if not 1 <= count <= fewest:
        raise ValueError(
            f"There {'is 1 device' if fewest == 1 else f'are {fewest} devices'} of kind "
            f"{jax.devices()[0].platform}, not {count}. Give "
            f"{'1' if fewest == 1 else f'1 to {fewest}'}, or use all."
        )
    chosen = [device for each in by_process for device in each[:count]]
    return None if len(chosen) == 1 else Mesh(chosen, (AXIS,))


def put_everywhere(tree: Any, *, mesh: Mesh | None) -> Any:
    """Returns a tree of arrays with every device of a mesh holding all of it.

    Args:
      tree: arrays of the host or of a device; the same in every process.
      mesh: devices of the mesh; if `None`, the arrays are placed on the default device.
    """
    if mesh is None:
        return jax.device_put(tree)
    sharding = NamedSharding(mesh, PartitionSpec())

    def put(x: np.ndarray) -> jax.Array:
        return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])

    return jax.tree.map(put, jax.device_get(tree))


def concatenated(groups: Iterable[Any], *, count: int) -> Any:
    """Concatenates groups of arrays along their first axis, with their sharding.

    Each group is written to its place before the next one is made, so that memory holds the result
    and one group.

    Args:
      groups: pytrees of the same structure and shapes; at least one.
      count: number of rows of the result; further rows of the last group are cut off.
    """
    result, first = None, 0
    for group in groups:
        size = jax.tree.leaves(group)[0].shape[0]
        if result is None:
            result = jax.tree.map(functools.partial(_zeros, -(-count // size) * size), group)
        result = _with_group(result, group, np.int32(first))
        first += size
    return jax.tree.map(lambda x: x[:count], result)


def _zeros(rows: int, like: jax.Array) -> np.ndarray | jax.Array:
    zeros = np.zeros((rows, *like.shape[1:]), like.dtype)
    if not like.committed:  # bound to a device, they would be arguments of another program
        return zeros
    # A transfer to the devices of several processes would compare their values first.
    return jax.make_array_from_callback(zeros.shape, like.sharding, lambda index: zeros[index])


@functools.partial(jax.jit, donate_argnums=0)
def _with_group(result: Any, group: Any, first: Array) -> Any:
    put = functools.partial(jax.lax.dynamic_update_slice_in_dim, start_index=first, axis=0)
    return jax.tree.map(put, result, group)
