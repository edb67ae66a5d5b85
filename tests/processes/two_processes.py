"""Meets another process, and prints what they agree on as JSON.

python -m tests.processes.two_processes COORDINATOR PROCESSES PROCESS
"""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from refref_jax.training import devices


def main(coordinator, processes, process):
    devices.connect(coordinator=coordinator, processes=int(processes), process=int(process))
    mesh = devices.row(1)
    values = devices.put_everywhere(np.arange(6, dtype=np.float32), mesh=mesh)
    add = jax.shard_map(
        lambda x: jax.lax.psum(jnp.sum(x), devices.AXIS),
        mesh=mesh,
        in_specs=PartitionSpec(),
        out_specs=PartitionSpec(),
        check_vma=False,
    )
    number = jax.process_index()
    agreed = devices.as_in_the_first(np.array([1.5, 3.0]) + number)
    devices.wait_for_all("the end")
    found = {
        "first": devices.is_first(),
        "devices": mesh.size,
        "any": [devices.any_process(number == 1), devices.any_process(False)],
        "agreed": np.asarray(agreed).tolist(),
        "summed": float(jax.jit(add)(values)),
    }
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
