"""Claim: with the flag that commands set, no scatter-add compares and swaps on an NVIDIA GPU.

    pip install --no-deps --target=FOLDER jax-cuda13-plugin==VERSION jax-cuda13-pjrt==VERSION
    python -m benchmarks.gpu_scatter_adds --packages=FOLDER,FOLDER [--cuda=FOLDER]

Sums into rows of 1, 2 and 4 floats, like those of the hash grids, are compiled for an H100, which
need not be there. The table has the atomic instructions of the PTX, by the version of jaxlib, with
and without the flag. A folder may also have another version of jax and jaxlib than the installed
one. Asserted is that `compilation` knows which versions need the flag. ptxas, a program of CUDA, is
needed.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from absl import app, flags

from benchmarks.ahead_of_time import hopper
from refref_jax.compilation import ATOMICS_FLAG

_PACKAGES = flags.DEFINE_list("packages", [], "Folders of packages with the plugin for CUDA 13.")
_CUDA = flags.DEFINE_string("cuda", "", "Folder of CUDA; by default that of ptxas.")

_COMPILE = """
import jax, jaxlib, jax.numpy as jnp
from benchmarks.ahead_of_time.hopper import placed

shape = lambda *size, of: placed(jax.ShapeDtypeStruct(size, of))
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
        if ("cas" in found) != (version in ATOMICS_FLAG.versions):
            wrong.append(f"{version} without the flag: {found}")
        if version in ATOMICS_FLAG.versions:
            _, found = _compiled(folder, ATOMICS_FLAG.text)
            print(f"| {version} | `{ATOMICS_FLAG.text}` | {found} |", flush=True)
            wrong += [f"{version} with the flag: {found}"] if "cas" in found else []
    assert not wrong, "; ".join(wrong)


def _compiled(folder: str, flag: str) -> tuple[str, str]:
    """Compiles in a process of its own, and returns the version and the atomic instructions."""
    with tempfile.TemporaryDirectory() as dump:
        answer = subprocess.run(
            [sys.executable, "-c", _COMPILE],
            env=hopper.environment(dump=dump, flags=[flag], folder=_CUDA.value, packages=[folder]),
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
        )
        assert answer.returncode == 0, answer.stderr[-2000:]
        ptx = "".join(path.read_text() for path in Path(dump).glob("*.ptx"))
    found = sorted(set(re.findall(r"\batom\.[\w.:]*", ptx)))
    return answer.stdout.split()[-1], ", ".join(f"`{each}`" for each in found)


if __name__ == "__main__":
    app.run(main)
