"""Parts of `accelerator_check` that measure: the environment, memory, and programs by preset.

Times are those of the fastest of several calls; compiling is timed apart. Bytes are the compiler's
count for the program of this device, in which a loop of unknown length counts once: for training
steps this is one step, for tracing it is too little. On a CPU it leaves out the native loops over
hash tables.
"""

import functools
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.accelerator.measuring import (
    NOT_REPORTED,
    Compiled,
    Context,
    Row,
    Verdict,
    best_of,
    compile_steps,
    copy_speed,
    gigabytes,
    peak_memory,
    prepare_run,
    seconds_of,
)
from refref_jax import compilation
from refref_jax.data import scene_folder
from refref_jax.geometry.cameras import image_rays
from refref_jax.render import images
from refref_jax.render.model import Model
from refref_jax.training import backdrop_equations, backdrop_solver, fit
from refref_jax.training.config import TrainConfig

_PACKAGES = (
    *("jax", "jaxlib", "jax-cuda12-plugin", "jax-cuda13-plugin", "warp-lang"),
    *("flax", "optax", "numpy"),
)

# Environment variables of JAX that change programs or memory; others may name files.
_VARIABLES = (
    *("XLA_FLAGS", "JAX_PLATFORMS", "JAX_DEFAULT_MATMUL_PRECISION", "JAX_ENABLE_X64"),
    *("XLA_PYTHON_CLIENT_PREALLOCATE", "XLA_PYTHON_CLIENT_MEM_FRACTION"),
    *("XLA_PYTHON_CLIENT_ALLOCATOR", "CUDA_VISIBLE_DEVICES", "REFREF_TRAVERSAL"),
)

# Rows and features of a large table and of a contended one: the coarsest level of a hash grid.
_TABLES = {"2^21 x 4": (1 << 21, 4), "4,913 x 1": (17**3, 1)}

# A scatter-add that takes longer than this many gathers compares and swaps.
_MOST_GATHERS = 50.0

# Times the counted bytes would take at the speed of a copy, within which a step is as expected.
# Small steps are bound by the launches of their kernels: those of `tiny`, 0.63 ms on an H200.
_MOST_COPIES, _SMALL_STEP = 6.0, 1e9

# Milliseconds per step: measured, or estimated from programs compiled for an H100, before any run.
_EXPECTED = {
    "steps": {"tiny": "0.63 on an H200", "paper": "12 to 15 estimated for an H200"},
    "tracing": {"tiny": "0.61 on an H200", "paper": "1.1 on an H200"},
}

# PSNR of the pixels that a backdrop is fitted to, dB; on a CPU it is 29.7 with few cells and views,
# 37.0 with 384 and 8.
_LEAST_PSNR = 25.0


def environment(context: Context) -> Iterator[Row]:
    """Reports the device and versions, and whether one of them is known to be slow."""
    device = context.device
    yield Row("device", f"{device.device_kind} ({device.platform})")
    yield Row("devices", len(jax.devices()))
    limit = (device.memory_stats() or {}).get("bytes_limit")
    yield Row("memory that JAX may use", gigabytes(limit), "GB")
    yield Row("driver", _driver() or NOT_REPORTED)
    yield Row("platform", " ".join(device.client.platform_version.split()))
    yield Row("CPU", f"{_processor()}, {os.cpu_count()} cores")
    yield Row("system", f"{platform.system()} {platform.machine()}")
    yield Row("Python", platform.python_version())
    for package in _PACKAGES:
        try:
            yield Row(package, importlib.metadata.version(package))
        except importlib.metadata.PackageNotFoundError:
            continue
    for name in _VARIABLES:
        if name in os.environ:
            yield Row(name, os.environ[name] or "empty")
    missing = compilation.missing_flags()
    known = "; ".join(each.problem for each in missing) or "none known"
    note = f"add to XLA_FLAGS: {' '.join(each.text for each in missing)}" if missing else ""
    yield Row("slow parts of this version", known, "", "problem" if missing else "ok", note)


def _driver() -> str | None:
    """Returns the version of the NVIDIA driver, if there is one."""
    question = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(question, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.splitlines()[0].strip() if answer.stdout else None


def _processor() -> str:
    """Returns the name of the CPU."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def memory(context: Context) -> Iterator[Row]:
    """Measures the bandwidth of a copy, and rates of random reads of rows and additions to them."""
    sizes = context.sizes
    copied = copy_speed(context.device, sizes.copied)
    yield Row("copy, reading and writing", copied / 1e9, "GB/s")
    generator = np.random.default_rng(0)
    for name, (rows, features) in _TABLES.items():
        index = generator.integers(rows, size=sizes.lookups, dtype=np.int32)
        table = np.zeros((rows, features), np.float32)
        table, index = jax.device_put((table, index), context.device)
        reading = best_of(functools.partial(_gather, table, index))
        yield Row(f"gather, rows of {name}", sizes.lookups / reading / 1e9, "billion/s")
        adding = best_of(functools.partial(_add, table, index))
        verdict: Verdict = "-"
        if context.compares:
            verdict = "ok" if adding <= _MOST_GATHERS * reading else "problem"
        yield Row(f"scatter-add, rows of {name}", sizes.lookups / adding / 1e9, "billion/s")
        yield Row(
            f"scatter-add over gather, time, {name}",
            adding / reading,
            "",
            verdict,
            f"at most {_MOST_GATHERS:g} on an accelerator; hundreds if it compares and swaps",
        )


@jax.jit
def _gather(table: jax.Array, index: jax.Array) -> jax.Array:
    # The sum keeps the result in registers, as the fields do.
    return jnp.sum(table.at[index].get(mode="promise_in_bounds"))


@jax.jit
def _add(table: jax.Array, index: jax.Array) -> jax.Array:
    added = jnp.broadcast_to(index[:, None].astype(table.dtype), (index.size, table.shape[1]))
    return jnp.zeros_like(table).at[index].add(added, mode="promise_in_bounds")


def setting_up(context: Context, preset: str) -> Iterator[Row]:
    """Reports the time that a run takes before its first step."""
    run = prepare_run(context, preset)
    yield Row("reading, checking and surveying the scene, compiling, tracing", run.seconds, "s")
    yield Row("light paths per ray, with empty slots", run.setup.capacity / run.batch)


def tracing(context: Context, preset: str) -> Iterator[Row]:
    """Times the pre-tracing of batches."""
    run = prepare_run(context, preset)
    rays = run.setup.sampler.draw(run.setup.sampler.numbers(0, run.batches)).rays
    placed = jax.device_put((run.setup.scene, rays), context.device)
    seconds = best_of(lambda: run.tracing.call(*placed))
    yield Row(f"{run.batches} batches of {run.batch:,} rays", 1e3 * seconds, "ms")
    expected = _expected(context, "tracing", preset)
    yield Row("time per step", 1e3 * seconds / run.batches, "ms", note=expected)
    yield Row("rays per second", run.batches * run.batch / seconds / 1e6, "million")
    yield from _program(run.tracing, context)


def steps(context: Context, preset: str) -> Iterator[Row]:
    """Times training steps without tracing, and compares them with the bytes they move."""
    run, program = prepare_run(context, preset), compile_steps(context, preset)
    held, pretraced = jax.device_put((run.state, run.pretraced), context.device)
    count = min(run.batches, context.steps)

    def take() -> jax.Array:
        nonlocal held
        held, report = program.call(held, pretraced, np.int32(0), np.int32(count))
        return report.loss

    seconds = best_of(take) / count
    expected = _expected(context, "steps", preset)
    yield Row(f"a step of {run.batch:,} rays", 1e3 * seconds, "ms", note=expected)
    yield Row("rays per second, without tracing", run.batch / seconds / 1e3, "thousand")
    yield from _program(program, context)
    yield Row("bytes of a step, counted by the compiler", gigabytes(program.bytes), "GB")
    if program.bytes is None:
        return
    copied = copy_speed(context.device, context.sizes.copied)
    yield Row("these bytes over the time of a step", program.bytes / seconds / 1e9, "GB/s")
    times, verdict = seconds * copied / program.bytes, "-"
    if context.compares and program.bytes > _SMALL_STEP:
        verdict = "ok" if times <= _MOST_COPIES else "problem"
    note = f"at most {_MOST_COPIES:g} on an accelerator, for more than {_SMALL_STEP / 1e9:g} GB"
    yield Row("time of a step over that of copying these bytes", times, "", verdict, note)


def rendering(context: Context, preset: str) -> Iterator[Row]:
    """Times the rendering of an image of the scene by an untrained model."""
    run = prepare_run(context, preset)
    setup = run.setup
    params = jax.device_put(run.state.params, context.device)
    model = Model(setup.model, setup.settings, setup.scene, params)
    cameras = scene_folder.read_frames(context.scene, "test").cameras
    rays = image_rays(cameras, 0)
    first, _ = seconds_of(lambda: images.render_image(model, rays))
    seconds = best_of(lambda: images.render_image(model, rays))
    yield Row(f"an image of {cameras.width} x {cameras.height} rays", 1e3 * seconds, "ms")
    yield Row("rays per second", rays.radii.size / seconds / 1e3, "thousand")
    yield Row("compiling", max(0.0, first - seconds), "s")
    yield from _peak(context)


def backdrop(context: Context) -> Iterator[Row]:
    """Times the solver of a backdrop: tracing some views, then a round of iterations."""
    asked = TrainConfig().override(scene=str(context.scene), far_field="backdrop", paths="tree")
    resolved, objects = fit.prepare(asked, report=lambda line: None)
    frames = scene_folder.read_frames(context.scene, "train")
    views, cells = context.sizes.views, context.sizes.cells
    domain = resolved.model.config.domain

    def trace() -> tuple[backdrop_equations.Block, ...]:
        return backdrop_equations.read(
            objects,
            frames.cameras._replace(poses=frames.cameras.poses[:views]),
            scene_folder.read_images(frames._replace(images=frames.images[:views])),
            settings=resolved.model.settings,
            domain=domain,
            resolution=cells,
        )

    def solve() -> backdrop_solver.Progress:
        shape = {"space": domain.space, "resolution": cells}
        rounds = {"iterations": backdrop_solver.ROUND, "thinned_rounds": 0}
        *_, last = backdrop_solver.solve(blocks, **shape, **rounds)
        return last

    first, blocks = seconds_of(trace)
    taken = best_of(trace)
    yield Row("reading and tracing a view", 1e3 * taken / views, "ms")
    yield Row("compiling tracing", max(0.0, first - taken), "s")
    first, solved = seconds_of(solve)
    taken = best_of(solve)
    name = f"an iteration, {views} views, {cells} cells per side"
    yield Row(name, 1e3 * taken / backdrop_solver.ROUND, "ms")
    yield Row("compiling the solver", max(0.0, first - taken), "s")
    verdict: Verdict = "ok" if solved.fitted > _LEAST_PSNR else "problem"
    note = f"at least {_LEAST_PSNR:g}"
    yield Row("PSNR of the fitted pixels", solved.fitted, "dB", verdict, note)
    yield from _peak(context)


def _program(program: Compiled, context: Context) -> Iterator[Row]:
    """Reports the costs of a program that are not its time."""
    yield Row("compiling", program.seconds, "s")
    yield Row("memory, counted by the compiler", gigabytes(program.memory), "GB")
    yield from _peak(context)


def _peak(context: Context) -> Iterator[Row]:
    yield Row("peak memory since the start", peak_memory(context.device), "GB")


def _expected(context: Context, kind: str, preset: str) -> str:
    """Returns the time of this program on another GPU, for comparison."""
    on_gpu = context.device.platform in ("gpu", "cuda")
    return _EXPECTED[kind].get(preset, "") if on_gpu else ""
