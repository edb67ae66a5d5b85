"""Claim: with the flag that commands set, no scatter-add compares and swaps on an NVIDIA GPU.

    pip install --no-deps --target=FOLDER jax-cuda13-plugin==VERSION jax-cuda13-pjrt==VERSION
    python -m benchmarks.gpu_scatter_adds --packages=FOLDER,FOLDER [--cuda=FOLDER]

Sums into rows of 1, 2 and 4 floats, like those of the hash grids, are compiled for an H100, which
need not be there. The table has the atomic instructions of the PTX, by the version of jaxlib, with
and without the flag. A folder may also have another version of jax and jaxlib than the installed
one. Asserted is that `compilation` knows which versions need the flag. ptxas, a program of CUDA, is
needed.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from absl import app, flags

from refref_jax.compilation import ATOMICS_FLAG, SLOW_ATOMICS

_PACKAGES = flags.DEFINE_list("packages", [], "Folders of packages with the plugin for CUDA 13.")
_CUDA = flags.DEFINE_string("cuda", "/usr/local/cuda", "Folder of CUDA.")

_H100 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 threads_per_core_limit: 2048
  shared_memory_per_block: 49152 shared_memory_per_core: 233472
  shared_memory_per_block_optin: 232448 core_count: 132 fpus_per_core: 128
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98
  device_memory_size: 84929347584 cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 12 }
runtime_version { major: 13 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""

_COMPILE = """
import sys
import jax, jaxlib, jax.numpy as jnp
from jax.experimental import topologies

topology = topologies.get_topology_desc(
    platform="cuda", target_config=sys.argv[1], topology="1x1x1"
)
where = jax.sharding.SingleDeviceSharding(topology.devices[0])
shape = lambda *size, of: jax.ShapeDtypeStruct(size, of, sharding=where)
add = jax.jit(lambda table, at, values: table.at[at].add(values))
for width in (1, 2, 4):
    table, values = shape(4913, width, of=jnp.float32), shape(100_000, width, of=jnp.float32)
    add.lower(table, shape(100_000, of=jnp.int32), values).compile()
print("version", jaxlib.__version__)
"""


def main(arguments: list[str]) -> None:
    del arguments
    if not _PACKAGES.value:
        raise app.UsageError("Give --packages: the compiler for GPUs is not part of jaxlib.")
    print("| jaxlib | flag | atomic instructions |\n|---|---|---|", flush=True)
    wrong = []
    for folder in _PACKAGES.value:
        version, found = _compiled(folder, "")
        print(f"| {version} | none | {found} |", flush=True)
        if ("cas" in found) != (version in SLOW_ATOMICS):
            wrong.append(f"{version} without the flag: {found}")
        if version in SLOW_ATOMICS:
            _, found = _compiled(folder, ATOMICS_FLAG)
            print(f"| {version} | `{ATOMICS_FLAG}` | {found} |", flush=True)
            wrong += [f"{version} with the flag: {found}"] if "cas" in found else []
    assert not wrong, "; ".join(wrong)


def _compiled(folder: str, flag: str) -> tuple[str, str]:
    """Compiles in a process of its own, and returns the version and the atomic instructions."""
    with tempfile.TemporaryDirectory() as dump:
        words = ["--xla_gpu_autotune_level=0", f"--xla_gpu_cuda_data_dir={_CUDA.value}"]
        words += [f"--xla_dump_to={dump}", flag]
        settings = {
            "JAX_PLATFORMS": "cpu",
            "JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1",
            "PYTHONPATH": folder,
            "XLA_FLAGS": " ".join(words).strip(),
        }
        answer = subprocess.run(
            [sys.executable, "-c", _COMPILE, _H100],
            env=os.environ | settings,
            capture_output=True,
            text=True,
        )
        assert answer.returncode == 0, answer.stderr[-2000:]
        ptx = "".join(path.read_text() for path in Path(dump).glob("*.ptx"))
    found = sorted(set(re.findall(r"\batom\.[\w.:]*", ptx)))
    return answer.stdout.split()[-1], ", ".join(f"`{each}`" for each in found)


if __name__ == "__main__":
    app.run(main)
