"""Claim: the operations of a compiled training step explain its time.

    python -m benchmarks.step_kernels [--preset=paper] [--steps=20] [--most=30]

Runs training steps under JAX's profiler, and sums the time of each operation of the compiled
program. An operation is named by where it was written: the modules and functions of its scope,
with `transpose` for gradients. On a GPU, the rest of a step is spent between kernels; on a CPU, the
times of threads add up and may exceed the step. Asserts that three quarters of a step are found. On
a GPU whose kernels have no names, set `XLA_FLAGS=--xla_gpu_enable_command_buffer=`.
"""

import collections
import re
import tempfile
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from absl import app, flags

from experiments.accelerator import measuring

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of the model.")
_STEPS = flags.DEFINE_integer("steps", 20, "Steps to profile.", 1)
_MOST = flags.DEFINE_integer("most", 30, "Number of operations to print.", 1)

_LEAST_SHARE = 0.75

# An instruction of a compiled program, with what it was made from.
_MADE_FROM = re.compile(r'%?([\w.\-]+) = .*metadata=\{.*?op_name="([^"]+)"')

# Parts of a scope that every operation shares, or that say nothing.
_DULL = re.compile(r"^(jit\(.*\)|while|body|cond|closed_call|vmap\(\)|jvp\(\)|checkpoint|remat)$")


class _Operation(NamedTuple):
    """Time of an operation of the compiled program.

    Attributes:
      name: its name there.
      seconds: time of all its calls.
      calls: number of its calls.
    """

    name: str
    seconds: float
    calls: int


def main(arguments: list[str]) -> None:
    del arguments
    context = measuring.find_context(Path(_SCENE.value), max(_STEPS.value, 2))
    run = measuring.prepare_run(context, _PRESET.value)
    program = measuring.compile_steps(context, _PRESET.value)
    state, pretraced = jax.device_put((run.state, run.pretraced), context.device)
    count = min(_STEPS.value, run.batches)
    span = (pretraced, np.int32(0), np.int32(count))
    state, _ = jax.block_until_ready(program.call(state, *span))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            seconds, _ = measuring.seconds_of(lambda: program.call(state, *span))
        found = _operations(Path(folder))
    made_from = dict(_MADE_FROM.findall(program.call.as_text()))
    _show(found, made_from, seconds=seconds, steps=count)


def _operations(folder: Path) -> list[_Operation]:
    """Returns the operations of a profile, the longest first."""
    seconds, calls = collections.Counter(), collections.Counter()
    for file in folder.rglob("*.xplane.pb"):
        for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
            for line in plane.lines:
                for event in line.events:
                    name = dict(event.stats).get("hlo_op")
                    if name and not event.name.startswith("end: "):
                        seconds[name] += 1e-9 * event.duration_ns
                        calls[name] += 1
    return [_Operation(name, taken, calls[name]) for name, taken in seconds.most_common()]


def _show(
    found: list[_Operation], made_from: dict[str, str], *, seconds: float, steps: int
) -> None:
    total = sum(each.seconds for each in found)
    assert total >= _LEAST_SHARE * seconds, f"only {total / seconds:.0%} of the time is in kernels"
    print(f"device: {jax.devices()[0].device_kind}")
    print(f"a step: {1e3 * seconds / steps:.3f} ms, in kernels {1e3 * total / steps:.3f} ms")
    print("milliseconds a step,calls a step,operation,scope")
    for each in found[: _MOST.value]:
        scope = _short(made_from.get(each.name, ""))
        per_step = 1e3 * each.seconds / steps
        print(f"{per_step:.3f},{each.calls / steps:g},{each.name},{scope}")


def _short(scope: str) -> str:
    """Returns the telling parts of an operation's scope."""
    return "/".join(part for part in scope.split("/") if not _DULL.match(part))


if __name__ == "__main__":
    app.run(main)
