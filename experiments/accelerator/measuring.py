"""What the parts of `accelerator_check` share: rows of the report, devices, runs, and timing."""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.optics.media import Scene
from refref_jax.render.model import path_detail
from refref_jax.training import fit, loop
from refref_jax.training.config import TrainConfig, require
from refref_jax.training.loop import PretracedBatches, TrainState
from refref_jax.training.resolve import Resolved

Verdict = Literal["ok", "problem", "failed", "-"]
"""Whether a value is as expected; `failed` if there is none, `-` if nothing is expected."""

NOT_REPORTED = "not reported"

# Largest number of timed calls, and the seconds after which no other one begins.
_MOST_CALLS, _PATIENCE = 5, 2.0

# Copies in a call, so that the launch does not count.
_COPIES = 8

_Result = Any


class Row(NamedTuple):
    """One line of the report.

    Attributes:
      name: quantity.
      value: number or words.
      unit: unit of the number.
      verdict: whether the value is as expected.
      note: limit, expectation or explanation.
    """

    name: str
    value: float | str
    unit: str = ""
    verdict: Verdict = "-"
    note: str = ""


class Sizes(NamedTuple):
    """Sizes of arrays, by kind of device.

    Attributes:
      copied: number of floats of the copy that measures bandwidth.
      lookups: number of rows that are read and added to.
      rays: number of rays whose closest hits are compared.
      views: number of views whose backdrop is solved for.
      cells: its number of cells per side of a face.
    """

    copied: int
    lookups: int
    rays: int
    views: int
    cells: int


_OF_A_CPU = Sizes(copied=1 << 24, lookups=1 << 20, rays=1 << 17, views=4, cells=128)
_OF_AN_ACCELERATOR = Sizes(copied=1 << 27, lookups=1 << 25, rays=1 << 20, views=16, cells=384)


class Context(NamedTuple):
    """What the parts check.

    Attributes:
      device: device that is checked.
      cpu: device whose results are compared with; the same one if there is no accelerator.
      scene: folder of the scene.
      steps: number of training steps of the repeated runs.
    """

    device: jax.Device
    cpu: jax.Device
    scene: Path
    steps: int

    @property
    def compares(self) -> bool:
        """Whether there is an accelerator to compare with the CPU."""
        return self.device.platform != "cpu"

    @property
    def sizes(self) -> Sizes:
        """The sizes of arrays for this device."""
        return _OF_AN_ACCELERATOR if self.compares else _OF_A_CPU


def find_context(scene: Path, steps: int) -> Context:
    """Returns the default device and the CPU beside it.

    Raises:
      ValueError: if JAX may not use the CPU.
    """
    try:
        cpu = jax.devices("cpu")[0]
    except RuntimeError as error:
        raise ValueError(
            "JAX_PLATFORMS excludes the CPU, whose results are compared with. Add cpu at its end, "
            "as in JAX_PLATFORMS=cuda,cpu, or unset it."
        ) from error
    return Context(jax.devices()[0], cpu, scene, steps)


class Compiled(NamedTuple):
    """A program, compiled for one device.

    Attributes:
      call: the program; it takes arrays only.
      seconds: seconds of compiling.
      bytes: bytes that the compiler counts as read and written, loops once; `None` if it does not.
      memory: bytes of arguments, results and temporaries together, by the compiler's count; `None`
        if it does not count them.
    """

    call: Callable[..., Any]
    seconds: float
    bytes: float | None
    memory: int | None


def compiled(function: Any, *arguments: Any, **static: Any) -> Compiled:
    """Compiles a jitted function for its arguments, which are on the device."""
    begun = time.perf_counter()
    program = function.lower(*arguments, **static).compile()
    taken = time.perf_counter() - begun
    costs, memory = program.cost_analysis(), program.memory_analysis()
    total = None
    if memory is not None:
        total = memory.argument_size_in_bytes + memory.temp_size_in_bytes
        total += memory.output_size_in_bytes - memory.alias_size_in_bytes
    return Compiled(program, taken, (costs or {}).get("bytes accessed"), total)


class Run(NamedTuple):
    """A training run before its first step, and its first pre-traced batches.

    Attributes:
      resolved: complete configuration.
      scene: surfaces and interfaces of the objects.
      setup: constant part of the run.
      tracing: program that traces the first batches, for the device that is checked.
      pretraced: light paths and colours of the first batches, on that device.
      state: initial state, on the host.
      seconds: seconds that all of this took.
    """

    resolved: Resolved
    scene: Scene
    setup: loop.Setup
    tracing: Compiled
    pretraced: PretracedBatches
    state: TrainState
    seconds: float

    @property
    def batches(self) -> int:
        """Number of pre-traced batches."""
        return require(self.setup.config.schedule.pretraced_batches)

    @property
    def batch(self) -> int:
        """Number of rays per step."""
        return require(self.setup.config.schedule.batch)


# One at a time: that of `paper` takes a gigabyte of the device's memory.
@functools.lru_cache(maxsize=1)
def prepare_run(context: Context, preset: str) -> Run:
    """Returns a run with fields of a preset along the path tree."""
    begun = time.perf_counter()
    asked = TrainConfig().override(
        scene=str(context.scene),
        preset=preset,
        steps=context.steps,
        paths="tree",
        far_field="field",
    )
    resolved, objects = fit.prepare(asked, report=lambda line: None)
    config, model = resolved.config, resolved.model
    sampler = fit.read_pixels(config, context.scene)
    setup = loop.set_up(config, model.config, model.settings, objects, sampler)
    batches = require(config.schedule.pretraced_batches)
    drawn = sampler.draw(sampler.numbers(0, batches))
    placed = jax.device_put((setup.scene, drawn.rays), context.device)
    tracing = compiled(loop.pretrace, *placed, **tracing_options(setup))
    order = np.arange(batches, dtype=np.int32)
    pretraced = PretracedBatches(tracing.call(*placed), drawn.rgb, order)
    pretraced = jax.block_until_ready(jax.device_put(pretraced, context.device))
    state = jax.device_get(loop.init_state(config.seed, model.config, config.schedule))
    taken = time.perf_counter() - begun
    return Run(resolved, objects, setup, tracing, pretraced, state, taken)


def tracing_options(setup: loop.Setup) -> dict[str, Any]:
    """Returns the static arguments with which a run calls `loop.pretrace`."""
    detail = path_detail(setup.model, setup.settings)
    return {"settings": setup.settings, "capacity": setup.capacity, "detail": detail}


@functools.lru_cache(maxsize=1)
def compile_steps(context: Context, preset: str) -> Compiled:
    """Compiles training steps of a preset for the device that is checked."""
    run = prepare_run(context, preset)
    state, pretraced = jax.device_put((run.state, run.pretraced), context.device)
    static = {"config": run.setup.config, "model": run.setup.model}
    return compiled(loop.train_steps, state, pretraced, np.int32(0), np.int32(1), **static)


def seconds_of(function: Callable[[], _Result]) -> tuple[float, _Result]:
    """Returns the seconds until a result is there, and the result."""
    begun = time.perf_counter()
    result = jax.block_until_ready(function())
    return time.perf_counter() - begun, result


def best_of(function: Callable[[], _Result]) -> float:
    """Returns the seconds of the fastest of several calls; the first counts only if it is slow."""
    first, _ = seconds_of(function)
    taken, spent = [first] if first > _PATIENCE else [], first
    while not taken or (len(taken) < _MOST_CALLS and spent < _PATIENCE):
        taken.append(seconds_of(function)[0])
        spent += taken[-1]
    return min(taken)


@functools.cache
def copy_speed(device: jax.Device, floats: int) -> float:
    """Returns the bytes per second that a copy reads and writes."""
    values = jax.device_put(np.ones(floats, np.float32), device)
    repeat = functools.partial(jax.lax.fori_loop, 0, _COPIES, lambda _, x: x + jnp.float32(1.0))
    copy = jax.jit(repeat)
    return _COPIES * 2 * values.nbytes / best_of(lambda: copy(values))


def gigabytes(count: float | None) -> float | str:
    """Returns a number of bytes in GB, if there is one."""
    return NOT_REPORTED if count is None else count / 1e9


def peak_memory(device: jax.Device) -> float | str:
    """Returns the peak of the memory in use since the start, in GB; CPUs do not report it."""
    return gigabytes((device.memory_stats() or {}).get("peak_bytes_in_use"))
