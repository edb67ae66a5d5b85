"""Claim: tracing paths takes at most a quarter of a training step along the path tree.

    python -m benchmarks.step_profile [--scene=FOLDER] [--preset=tiny] [--paths=tree] [--rounds=N]

Times a step and its parts in turn, in one process: shares hold when the machine's speed drifts.
Parts are compiled separately, so they need not add up to the step. Tracing is that of a newly
pre-traced batches; `step_cost` claims the share if paths are cached. Reading from and adding to
the tables of hash grids is bound by memory: it is compared with the device's copy speed.
"""

import functools
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from absl import app, flags

from benchmarks.training_setup import pretrace, set_up_training
from refref_jax.fields import hash_grid, registry
from refref_jax.fields.hash_grid import HashGridConfig, MultisampledGrid
from refref_jax.render import pixels
from refref_jax.render.model import ModelConfig
from refref_jax.render.volume_rendering import Histogram
from refref_jax.sampling import stepfun
from refref_jax.sampling.polylines import Gaussians
from refref_jax.training import loop, objective
from refref_jax.training.loop import optimizer

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of the model.")
_PATHS = flags.DEFINE_enum("paths", "tree", ["straight", "paper", "tree"], "Light paths.")
_ROUNDS = flags.DEFINE_integer("rounds", 8, "How often everything is timed.")

_LIMIT = 0.25

_COPIED = 1 << 26
"""Number of floats in the copy that measures memory speed: larger than any cache."""


class _Points(NamedTuple):
    """Field queries of one step.

    Attributes:
      rounds: Gaussians `[paths, samples, multisamples]` of each proposal level and of the final
        level.
      directions: view directions of the final level.
    """

    rounds: list[Gaussians]
    directions: jax.Array


def _chords(config: ModelConfig, paths: int) -> _Points:
    """Returns points along random chords of the unit cube, as scattered in memory as a step's."""
    rng = np.random.default_rng(0)
    first, last = rng.uniform(size=(2, paths, 1, 3))
    counts = [*(proposal.samples for proposal in config.proposals), config.samples]
    rounds = []
    for count in counts:
        along = np.sort(rng.uniform(size=(paths, count * config.multisamples, 1)), axis=1)
        shape = (paths, count, config.multisamples)
        positions = jnp.asarray((first + along * (last - first)).reshape(*shape, 3), jnp.float32)
        rounds.append(Gaussians(positions, jnp.full(shape, 1e-3)))
    return _Points(rounds, jnp.ones((paths, config.samples, 3)) / np.sqrt(3.0))


def _grids(config: ModelConfig) -> list[HashGridConfig]:
    return [*(proposal.field.grid for proposal in config.proposals), config.field.grid]


def _features(params: list, config: ModelConfig, points: _Points) -> list[jax.Array]:
    """Returns the features of all levels; `params` are those of the grids alone."""

    def one_round(params: dict, grid: HashGridConfig, gaussians: Gaussians) -> jax.Array:
        features = functools.partial(MultisampledGrid(grid).apply, {"params": params})
        return jax.vmap(jax.vmap(features))(gaussians)

    return list(map(one_round, params, _grids(config), points.rounds))


def _seen(params: tuple, config: ModelConfig, points: _Points) -> list[jax.Array]:
    """Returns the outputs of the fields of all levels."""
    found = []
    for field, proposal, gaussians in zip(
        params.proposals, config.proposals, points.rounds[:-1], strict=True
    ):
        density = functools.partial(registry.density, field, proposal.field)
        found.append(jax.vmap(jax.vmap(density))(gaussians))
    radiance = functools.partial(registry.radiance, params.field, config.field)
    return [*found, *jax.vmap(jax.vmap(radiance))(points.rounds[-1], points.directions)]


def _loss(params: tuple, setup: loop.Setup, pretraced: tuple) -> jax.Array:
    """Returns a step's loss on the first pre-traced batch."""
    model, config = setup.model, setup.config
    traced, rgb = jax.tree.map(lambda x: x[0], pretraced)
    slots = jnp.arange(traced.paths.radii.shape[0])
    jitter = pixels.random_jitter(jax.random.key(0), model, slots)
    seen = pixels.render_pixels(
        params, model, traced.paths, jitter, rays=rgb.shape[0], anneal=jnp.ones(())
    )
    total = objective.mean_squared_error(seen.rgb, rgb.astype(jnp.float32) / 255.0)
    total += objective.hash_decay(hash_grid.tables(params))
    *proposals, final = seen.paths.histograms
    total += jnp.mean(jax.vmap(objective.distortion)(final, seen.paths.outside))
    for proposal, blur in zip(proposals, config.losses.blurs, strict=True):
        total += _interlevel(final, proposal, blur)
    return total


def _interlevel(final: Histogram, proposal: Histogram, blur: float) -> jax.Array:
    return jnp.mean(jax.vmap(lambda a, b: objective.interlevel(a, b, blur=blur))(final, proposal))


def _sampling(weights: list[jax.Array], blurs: tuple[float, ...]) -> jax.Array:
    """Draws each level from the previous one, and compares all with the last."""
    paths, count = weights[0].shape
    edges = [jnp.broadcast_to(jnp.linspace(0.0, 1.0, count + 1), (paths, count + 1))]
    for before, after in itertools.pairwise(weights):
        strata = jnp.broadcast_to(jnp.linspace(0.01, 0.99, after.shape[1]), after.shape)
        edges.append(stepfun.sample_intervals(strata, edges[-1], jax.lax.stop_gradient(before)))
    *proposals, final = map(Histogram, edges, weights)
    return sum(_interlevel(final, p, blur) for p, blur in zip(proposals, blurs, strict=True))


class _Profile:
    """A step and its parts, each a function without arguments that blocks until it is done."""

    def __init__(self, scene: Path, *, preset: str, paths: str) -> None:
        self.setup, self._state = set_up_training(scene, preset=preset, paths=paths)
        self._pretraced_after = pretrace(self.setup)
        self._params = jax.tree.map(jnp.copy, self._state.params)
        self._points = _chords(self.setup.model, self._pretraced_after.traced.paths.radii.shape[1])
        self._adam = self._prepare_adam()
        self.parts = {"step": self._pool_of_steps, "tracing": self._trace, "Adam": self._adam}
        self.parts |= self._prepare_render() | self._prepare_fields() | self._prepare_sampling()

    def milliseconds(self) -> dict[str, float]:
        """Times every part once; a step and its tracing are means over the pre-traced batches."""
        taken = {}
        for name, part in self.parts.items():
            begin = time.perf_counter()
            part()
            steps = (
                self.setup.config.schedule.pretraced_batches if name in ("step", "tracing") else 1
            )
            taken[name] = 1e3 * (time.perf_counter() - begin) / steps
        return taken

    def row_bytes(self) -> int:
        """Returns the bytes of all rows of tables that one step reads."""
        grids, rounds = _grids(self.setup.model), self._points.rounds
        points = [gaussians.scales.size for gaussians in rounds]
        return sum(
            n * grid.levels * 8 * grid.features * 4 for n, grid in zip(points, grids, strict=True)
        )

    def _pool_of_steps(self) -> None:
        until = int(self._state.step) + self.setup.config.schedule.pretraced_batches
        for state, _ in loop.run_steps(self.setup, self._state, until):
            self._state = state
        jax.block_until_ready(self._state)

    def _trace(self) -> None:
        jax.block_until_ready(pretrace(self.setup))

    def _prepare_adam(self) -> Callable[[], None]:
        rule = optimizer(self.setup.config.schedule, self.setup.model)
        slopes = jax.tree.map(jnp.ones_like, self._params)

        def update(held: tuple, slopes: tuple) -> tuple:
            params, moments = held
            updates, moments = rule.update(slopes, moments, params)
            return optax.apply_updates(params, updates), moments

        compiled = jax.jit(update, donate_argnums=0)
        params = jax.tree.map(jnp.copy, self._params)
        held = [(params, rule.init(params))]

        def run() -> None:
            held[0] = jax.block_until_ready(compiled(held[0], slopes))

        return run

    def _prepare_render(self) -> dict[str, Callable[[], None]]:

        def loss(params: tuple, pretraced: tuple) -> jax.Array:
            return _loss(params, self.setup, pretraced)

        return {
            "forward": _compiled(loss, self._params, self._pretraced_after),
            "forward and backward": _compiled(jax.grad(loss), self._params, self._pretraced_after),
        }

    def _prepare_fields(self) -> dict[str, Callable[[], None]]:
        model, points = self.setup.model, self._points
        fields = [*self._params.proposals, self._params.field]
        grids = [field["params"]["MultisampledGrid_0"] for field in fields]

        def total(params: tuple, points: _Points) -> jax.Array:
            return sum(map(jnp.sum, _seen(params, model, points)))

        def features(grids: list, points: _Points) -> list[jax.Array]:
            return _features(grids, model, points)

        def scatter(grids: list, points: _Points, slopes: list) -> tuple:
            return jax.vjp(lambda x: features(x, points), grids)[1](slopes)

        slopes = jax.tree.map(jnp.ones_like, jax.eval_shape(features, grids, points))
        return {
            "fields, both ways": _compiled(jax.grad(total), self._params, points),
            "gathers": _compiled(features, grids, points),
            "scatter-adds": _compiled(scatter, grids, points, slopes),
        }

    def _prepare_sampling(self) -> dict[str, Callable[[], None]]:
        rng = np.random.default_rng(1)
        shapes = [gaussians.scales.shape[:2] for gaussians in self._points.rounds]
        weights = [jnp.asarray(rng.uniform(size=x) / x[1], jnp.float32) for x in shapes]
        blurs = self.setup.config.losses.blurs
        return {"sampling": _compiled(jax.grad(lambda x: _sampling(x, blurs)), weights)}


def _compiled(function: Callable, *arguments: object) -> Callable[[], None]:
    compiled = jax.jit(function)

    def run() -> None:
        jax.block_until_ready(compiled(*arguments))

    return run


def _copy_speed() -> float:
    """Returns the bytes per second that a copy reads and writes."""
    values = jnp.ones(_COPIED)
    copy = _compiled(lambda x: x + 1.0, values)
    taken = []
    for _ in range(6):
        begin = time.perf_counter()
        copy()
        taken.append(time.perf_counter() - begin)
    return 2 * 4 * _COPIED / np.median(taken[1:])


def main(arguments: list[str]) -> None:
    del arguments
    profile = _Profile(Path(_SCENE.value), preset=_PRESET.value, paths=_PATHS.value)
    profile.milliseconds()  # compiles
    rounds = [profile.milliseconds() for _ in range(_ROUNDS.value)]
    taken = {name: np.array([x[name] for x in rounds]) for name in rounds[0]}
    taken["networks"] = taken["fields, both ways"] - taken["gathers"] - taken["scatter-adds"]
    for name, times in taken.items():
        share = np.median(times / taken["step"])
        print(f"{name:20s} {np.median(times):8.2f} ms  {100 * share:5.1f} % of a step")
    rays = profile.setup.config.schedule.batch / np.median(taken["step"])
    copied, moved = _copy_speed(), profile.row_bytes()
    print(f"{rays:.1f} thousand rays a second; a copy moves {copied / 1e9:.1f} GB/s")
    for name, passes in (("gathers", 1), ("scatter-adds", 2)):
        speed = passes * moved / (1e-3 * np.median(taken[name]))
        print(f"{name}: {speed / 1e9:.1f} GB/s, {speed / copied:.2f} of a copy")
    share = np.median(taken["tracing"] / taken["step"])
    assert share <= _LIMIT, f"tracing takes {share:.2f} of a step, more than {_LIMIT}"


if __name__ == "__main__":
    app.run(main)
