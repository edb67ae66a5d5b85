"""An H100 as a target of XLA's compiler: two packages and ptxas of CUDA suffice, without a GPU.

A process compiles for one target with the environment that `environment` returns. No kernel is
tuned, as that needs a GPU: tiles of matrix products, and what is padded for them, are defaults.
"""

import functools
import importlib.metadata
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jax.experimental import topologies

TARGET = """
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
"""Description of an NVIDIA H100 (a GpuTargetConfigProto of XLA)."""

PACKAGES = ("jax-cuda13-plugin", "jax-cuda13-pjrt")
"""The compiler for NVIDIA GPUs, in the version of jaxlib; extra `aot`."""

_CUDA = Path("/usr/local/cuda")


def cuda() -> Path | None:
    """Returns the folder of CUDA that holds ptxas, on `PATH` or at its usual place."""
    found = shutil.which("ptxas", path=os.pathsep.join([os.environ["PATH"], f"{_CUDA}/bin"]))
    return Path(found).resolve().parents[1] if found else None


def missing() -> str | None:
    """Returns what compiling for an H100 lacks in this environment, `None` if nothing."""
    for package in PACKAGES:
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            return f"{package} is not installed: pip install 'refref_jax[aot]'"
        if version != importlib.metadata.version("jaxlib"):
            return f"{package} {version} is not for jaxlib {importlib.metadata.version('jaxlib')}"
    return None if cuda() else "ptxas is missing, neither on PATH nor in /usr/local/cuda/bin"


def environment(
    *, dump: str, flags: Sequence[str] = (), folder: str = "", packages: Sequence[str] = ()
) -> dict[str, str]:
    """Returns the environment of a process that compiles for an H100.

    Args:
      dump: folder into which the compiler writes PTX and other text.
      flags: more flags of XLA.
      folder: folder of CUDA; by default the one that holds ptxas.
      packages: folders of packages that take precedence over the installed ones.
    """
    words = ["--xla_gpu_autotune_level=0", f"--xla_gpu_cuda_data_dir={folder or cuda()}"]
    words += [f"--xla_dump_to={dump}", *flags]
    # A program from the cache would leave no PTX.
    kept = {name: x for name, x in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    return kept | {
        "JAX_PLATFORMS": "cpu",
        "JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1",
        "PYTHONPATH": os.pathsep.join([*packages, os.environ.get("PYTHONPATH", "")]).strip(":"),
        "XLA_FLAGS": " ".join(words),
    }


@functools.cache  # Arrays of two topologies would be on different devices.
def _sharding() -> jax.sharding.SingleDeviceSharding:
    topology = topologies.get_topology_desc(platform="cuda", target_config=TARGET, topology="1x1x1")
    return jax.sharding.SingleDeviceSharding(topology.devices[0])


def placed(tree: Any) -> Any:
    """Returns the shapes of arrays, on an H100."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=_sharding()), tree
    )
