"""Parts of `accelerator_check` that compare results: with the CPU's, and of a run with itself.

Every program is the one that training calls. It runs where its arguments are; hits are searched
by packets of rays on a CPU, and ray by ray on an accelerator, so that two implementations are
compared. With REFREF_TRAVERSAL=warp, both devices run one kernel. Limits leave room for rounding:
on an H200, 1e-5 of the rays hit another triangle, and a gradient differs by 4e-4, or by 1e-6 with
products in highest precision.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.accelerator.measuring import (
    Context,
    Row,
    Run,
    Verdict,
    best_of,
    compile_steps,
    prepare_run,
    tracing_options,
)
from refref_jax.geometry import bvh
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths
from refref_jax.optics.path_tracing import Traced
from refref_jax.training import loop
from refref_jax.training.loop import TrainState

# The preset whose training is compared: a CPU takes its steps, too.
_PRESET = "tiny"

# Largest shares of rays that may differ, and the relative difference from which distances do.
_MOST_HITS, _MOST_PATHS, _DISTANCE = 1e-4, 1e-3, 1e-4

# Throughput that may be lost or gained by rounding.
_THROUGHPUT = 1e-4

# Largest relative difference of a gradient, by precision of matrix products, and of a loss after
# some steps. On a CPU, factors rounded as in TF32 change the gradient by 0.002, and parameters that
# change by 1e-6 change it by 5e-6.
_GRADIENT = {"default": 0.02, "highest": 1e-3}
_LOSS = 0.05

# Steps after which gradients are compared.
_TRAINED = 64


def single_operations(context: Context) -> Iterator[Row]:
    """Compares operations outside `jit`, which some versions got wrong (jax-ml/jax#40633)."""
    values = np.linspace(0.5, 2.0, 1 << 16, dtype=np.float32)
    key = jax.random.key(0)
    operations = {
        "square root": jnp.sqrt,
        "sum": jnp.sum,
        "sort": lambda x: jnp.sort(-x),
        "random numbers": lambda x: jax.random.uniform(jax.device_put(key, x.device), x.shape),
    }
    for name, operation in operations.items():
        mine, theirs = (
            np.asarray(operation(jax.device_put(values, each)), np.float64)
            for each in (context.device, context.cpu)
        )
        apart = float(np.max(np.abs(mine - theirs) / np.maximum(np.abs(theirs), 1e-6)))
        note = "beyond it, see jax-ml/jax#40633"
        yield limited(f"{name} outside jit, largest relative difference", apart, 1e-5, note)


def hits(context: Context) -> Iterator[Row]:
    """Compares the closest hits of camera rays and of rays from anywhere, and their rate."""
    run, count = prepare_run(context, _PRESET), context.sizes.rays
    rays = _some_rays(run, count)
    limits, nothing = np.full(count, np.inf, np.float32), np.full(count, bvh.NO_PRIMITIVE, np.int32)
    search = jax.jit(
        lambda tree, rays, limits, nothing: bvh.closest_hits(
            tree, rays, limits=limits, exclude_primitive=nothing
        )
    )
    on_cpu, here = (
        jax.device_put((run.scene.surfaces.bvh, rays, limits, nothing), device)
        for device in (context.cpu, context.device)
    )
    theirs, mine = jax.device_get(search(*on_cpu)), jax.device_get(search(*here))
    both = np.isfinite(mine.distances) & np.isfinite(theirs.distances)
    share = float(np.mean(mine.primitive_ids != theirs.primitive_ids))
    apart = np.abs(mine.distances[both] - theirs.distances[both]) / theirs.distances[both]
    yield Row("rays, half from cameras, half from random points", count)
    yield Row("rays that hit something", float(np.mean(np.isfinite(theirs.distances))))
    yield limited("rays with another triangle", share, _MOST_HITS, "expected: below 1e-5")
    missed = float(np.mean(np.isfinite(mine.distances) != np.isfinite(theirs.distances)))
    yield limited("rays that hit on one device only", missed, _MOST_HITS)
    # A ray along a surface may hit its next triangle, farther away.
    share = float(np.mean(apart > _DISTANCE))
    yield limited(f"hits whose distances differ by more than {_DISTANCE:g}", share, _MOST_HITS)
    yield Row("relative difference of distances, largest", float(np.max(apart)))
    seconds = best_of(functools.partial(search, *here))
    yield Row("rays cast per second", count / seconds / 1e6, "million")


def _some_rays(run: Run, count: int) -> Rays:
    """Returns camera rays, then rays from random points around the objects."""
    generator = np.random.default_rng(0)
    seen = run.setup.sampler.survey(count // 2).rays
    corners = np.asarray(run.scene.surfaces.bvh.triangles)
    corners = corners[np.all(np.isfinite(corners), axis=(1, 2))].reshape(-1, 3)
    shape = (count - count // 2, 3)
    origins = generator.uniform(corners.min(axis=0), corners.max(axis=0), shape)
    directions = generator.normal(size=shape)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return Rays(
        np.concatenate([seen.origins, np.float32(origins)]),
        np.concatenate([seen.directions, np.float32(directions)]),
        np.resize(seen.radii, count),
    )


def paths(context: Context) -> Iterator[Row]:
    """Compares the light paths of pre-traced batches."""
    run = prepare_run(context, _PRESET)
    theirs, mine = _traced(run, context.cpu), jax.device_get(run.pretraced.traced)
    counts, sums, ends = (
        [each(traced) for traced in (theirs, mine)] for each in (_counts, _sums, _ends)
    )
    same = counts[0] == counts[1]
    yield Row("rays", same.size)
    yield Row("light paths", int(np.sum(counts[1])))
    yield limited("rays with another number of paths", 1.0 - float(np.mean(same)), _MOST_PATHS)
    off = float(np.max(np.abs(sums[1] - 1.0)))
    yield limited(
        "throughput of a ray's paths plus dropped, largest difference from 1", off, _THROUGHPUT
    )
    off = float(np.abs(np.mean(mine.dropped) - np.mean(theirs.dropped)))
    yield limited("mean dropped throughput, difference", off, _THROUGHPUT)
    off = np.linalg.norm(ends[1] - ends[0], axis=-1)[same]
    share = float(np.mean(off > 1e-3))
    yield Row("mean direction in which a ray's light ends, median change", float(np.median(off)))
    yield limited("rays whose light ends elsewhere, by more than 0.001", share, _MOST_PATHS)


def _traced(run: Run, device: jax.Device) -> Traced:
    """Returns the paths of the first batches, traced on a device."""
    drawn = run.setup.sampler.draw(run.setup.sampler.numbers(0, run.batches))
    placed = jax.device_put((run.setup.scene, drawn.rays), device)
    return jax.device_get(loop.pretrace(*placed, **tracing_options(run.setup)))


def _per_ray(traced: Traced, values: np.ndarray) -> np.ndarray:
    """Returns the sum of the values `[batches, paths, channels]` of each ray's paths."""
    batches, rays = traced.dropped.shape[:2]
    filled = light_paths.exists(traced.paths)
    place = (np.arange(batches)[:, None] * rays + traced.paths.rays)[filled]
    total = np.zeros((batches * rays, values.shape[-1]))
    np.add.at(total, place, values[filled])
    return total


def _counts(traced: Traced) -> np.ndarray:
    return _per_ray(traced, np.ones((*traced.paths.rays.shape, 1)))[:, 0]


def _sums(traced: Traced) -> np.ndarray:
    return _per_ray(traced, traced.paths.throughput) + traced.dropped.reshape(-1, 3)


def _ends(traced: Traced) -> np.ndarray:
    """Returns the sum of the last directions of each ray's paths, weighted by throughput."""
    last = np.sum(np.isfinite(traced.paths.tau), axis=-1) - 1
    place = np.maximum(last, 0)[..., None, None]
    directions = np.take_along_axis(traced.paths.directions, place, axis=-2)[..., 0, :]
    return _per_ray(traced, directions * np.mean(traced.paths.throughput, axis=-1)[..., None])


def repeated_runs(context: Context) -> Iterator[Row]:
    """Trains twice on the device, and once on a CPU beside it, from one state and batches."""
    most = _LOSS if context.compares else 0.0
    note = "atomic additions have no order" if context.compares else "a CPU repeats itself exactly"
    (first, losses), (second, again) = (_train(context, context.device) for _ in range(2))
    yield Row("steps", context.steps)
    yield Row("loss after the first step", losses[0])
    verdict: Verdict = "ok" if losses[-1] < losses[0] else "problem"
    yield Row("loss after the last step", losses[-1], "", verdict, "must be lower")
    yield limited("two runs: relative difference of the losses", _apart(again, losses), most, note)
    apart = relative_distance(second.params, first.params)
    name = "two runs: relative difference of the parameters"
    yield Row(name, apart, note=note) if context.compares else limited(name, apart, most, note)
    if context.compares:
        _, theirs = _train(context, context.cpu)
        apart = _apart(losses, theirs)
        yield limited("relative difference of the losses to a CPU's", apart, _LOSS)


def _train(
    context: Context, device: jax.Device, most: int | None = None
) -> tuple[TrainState, list[float]]:
    """Takes steps on a device, and returns the last state on the host, and losses on the way.

    The pre-traced batches are used again and again. The losses are those of the first step and of
    the last step with each of these groups.
    """
    run, take = prepare_run(context, _PRESET), _steps_on(context, device)
    state, pretraced = jax.device_put((run.state, run.pretraced), device)
    losses, step, total = [], 0, min(context.steps, most or context.steps)
    while step < total:
        place = step % run.batches
        count = min(run.batches - place, total - step) if step else 1
        state, report = take(state, pretraced, np.int32(place), np.int32(place + count))
        losses.append(float(report.loss))
        step += count
    return jax.device_get(state), losses


def _steps_on(context: Context, device: jax.Device) -> Callable[..., Any]:
    """Returns the function that takes steps with the arrays of a device."""
    if device == context.device:
        return compile_steps(context, _PRESET).call
    return _uncompiled_steps(context)


def _uncompiled_steps(context: Context) -> Callable[..., Any]:
    setup = prepare_run(context, _PRESET).setup
    return functools.partial(loop.train_steps, config=setup.config, model=setup.model)


def _apart(losses: list[float], others: list[float]) -> float:
    """Returns the relative difference of the mean losses of two runs, after the first step."""
    mine, theirs = (np.mean(each[1:]) for each in (losses, others))
    return float(abs(mine - theirs) / theirs)


def gradients(context: Context) -> Iterator[Row]:
    """Compares the gradient of one step, after some training, at two precisions of products.

    From moments of 0, Adam's first moment after a step is a multiple of the gradient.
    """
    trained, _ = _train(context, context.device, _TRAINED)
    here = functools.partial(_gradient, context, trained)
    loss, expected = here(_steps_on(context, context.cpu), context.cpu)
    found = {"default": here(_steps_on(context, context.device), context.device)}
    with jax.default_matmul_precision("highest"):
        found["highest"] = here(_uncompiled_steps(context), context.device)
    for precision, (mine_loss, mine) in found.items():
        name, most = f"matrix products in {precision} precision: ", _GRADIENT[precision]
        off = abs(mine_loss - loss) / loss
        yield limited(f"{name}relative difference of the loss", off, most / 10.0)
        off = relative_distance(mine, expected)
        yield limited(f"{name}relative difference of the gradient", off, most)
        yield Row(f"{name}cosine of both gradients", _cosine(mine, expected))
        worst, off = most_different(mine, expected)
        yield Row(f"{name}largest relative difference of one array", off, note=worst)


def _gradient(
    context: Context, trained: TrainState, take: Callable[..., Any], device: jax.Device
) -> tuple[float, Any]:
    """Returns the loss of the first batch, and a multiple of its gradient, on the host."""
    run = prepare_run(context, _PRESET)
    adam = loop.optimizer(run.setup.config.schedule, run.setup.model)
    fresh = trained._replace(optimizer=jax.device_get(adam.init(trained.params)))
    state, pretraced = jax.device_put((fresh, run.pretraced), device)
    stepped, report = take(state, pretraced, np.int32(0), np.int32(1))
    return float(report.loss), jax.device_get(optax.tree_utils.tree_get(stepped.optimizer, "mu"))


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(np.float64(leaf)) for leaf in jax.tree.leaves(tree)])


def relative_distance(mine: Any, theirs: Any) -> float:
    """Returns the norm of the difference of two trees, relative to that of the second."""
    expected = _flat(theirs)
    return float(np.linalg.norm(_flat(mine) - expected) / np.linalg.norm(expected))


def _cosine(mine: Any, theirs: Any) -> float:
    a, b = _flat(mine), _flat(theirs)
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def most_different(mine: Any, theirs: Any) -> tuple[str, float]:
    """Returns the name and the relative difference of the array that differs most."""
    named = jax.tree_util.tree_leaves_with_path(theirs)
    off = {
        jax.tree_util.keystr(path, simple=True, separator="/"): relative_distance(x, y)
        for x, (path, y) in zip(jax.tree.leaves(mine), named, strict=True)
        if np.any(y)
    }
    name = max(off, key=lambda each: off[each])
    return name, off[name]


def limited(name: str, value: float, most: float, note: str = "") -> Row:
    """Returns a row whose value must not exceed a limit."""
    limit = f"at most {most:g}" if most else "must be 0"
    verdict: Verdict = "ok" if value <= most else "problem"
    return Row(name, float(value), "", verdict, "; ".join(filter(None, (limit, note))))
