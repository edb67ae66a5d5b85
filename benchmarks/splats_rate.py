"""Claim: an image of 20,000 Gaussians and its derivative take at most 80 ms of a CPU core.

    python -m benchmarks.splats_rate [--rounds=N] [--any_speed]

The scene is as large as those of the data set: 80 % of the Gaussians are on the faces of a cube
with a half edge of 7.3, the others inside, and the camera is 4 from its centre. An image is 200 x
200 pixels: projection, lists of tiles and blending (`forward`), and the derivative of a loss with
respect to all parameters in addition (`both`). Both are compiled; times are CPU times, not wall
times, of which the smallest of all rounds is taken, since other programs can only add to it. The
number of entries is that of all lists of tiles, and of pairs that of entries times the pixels of a
tile, many of which end before their last entry. Larger cases are only measured.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from refref_jax.geometry.cameras import focal_length
from refref_jax.splats import gaussians as splats
from refref_jax.splats import images
from refref_jax.splats.gaussians import Gaussians, View

_ROUNDS = flags.DEFINE_integer("rounds", 15, "Timed repeats of every case.")
_ANY_SPEED = flags.DEFINE_bool("any_speed", False, "Assert nothing about the speed.")

_LIMIT = 80.0

# Cameras of the data set: field of view in radians, distance from the centre, and the room.
_ANGLE, _DISTANCE, _ROOM = 1.16566, 4.0, 7.3
_ON_WALLS = 0.8


class _Case(NamedTuple):
    """An image: its edge in pixels, the number of Gaussians, and their mean size."""

    edge: int
    count: int
    size: float


_CASES = (
    _Case(200, 20_000, 0.05),
    _Case(200, 20_000, 0.12),
    _Case(200, 50_000, 0.05),
    _Case(100, 20_000, 0.05),
    _Case(400, 50_000, 0.05),
)


def _scene(case: _Case) -> Gaussians:
    draw, count = np.random.default_rng(0), case.count
    behind = int(_ON_WALLS * count)
    means = draw.uniform(-_ROOM, _ROOM, (count, 3))
    means[behind:] *= 0.2
    side = draw.choice([-_ROOM, _ROOM], behind)
    means[np.arange(behind), draw.integers(0, 3, behind)] = side
    values = (
        means,
        draw.normal(size=(count, 4)),
        np.log(case.size * draw.uniform(0.5, 1.5, (count, 3))),
        draw.normal(size=count) + 1.0,
        draw.normal(size=(count, 3)),
        0.1 * draw.normal(size=(count, splats.HARMONICS, 3)),
    )
    return Gaussians(*(jnp.asarray(value, jnp.float32) for value in values))


def _seconds(function: Callable[[], Any]) -> float:
    """Returns the least CPU time of a function."""
    jax.block_until_ready(function())
    times = []
    for _ in range(_ROUNDS.value):
        begun = time.process_time()
        jax.block_until_ready(function())
        times.append(time.process_time() - begun)
    return min(times)


def _measure(case: _Case) -> tuple[int, int, int, float, float]:
    """Returns visible Gaussians, entries, pairs, and the milliseconds of an image and of both."""
    edge = case.edge
    view = View(jnp.eye(3), jnp.float32([0.0, 0.0, -_DISTANCE]), focal_length(edge, _ANGLE))
    view = view._replace(focal=jnp.float32(view.focal))
    scene, grid = _scene(case), images.grid_of(edge, edge)
    target = jnp.asarray(np.random.default_rng(1).uniform(size=(edge, edge, 3)), jnp.float32)
    found = splats.project_all(scene, view, width=edge, height=edge, kernel="mip")
    entries = int(images.count_entries(found, grid))
    blend = functools.partial(
        images.blend, grid=grid, capacity=images.capacity_for(1.2 * entries), kernel="mip"
    )

    def loss(scene: Gaussians, view: View) -> jax.Array:
        return jnp.mean(jnp.abs(blend(scene, view)[0].colours - target))

    forward, both = jax.jit(blend), jax.jit(jax.value_and_grad(loss))
    visible = int(jnp.sum(found.radii[:, 0] > 0))
    times = [1e3 * _seconds(functools.partial(each, scene, view)) for each in (forward, both)]
    return visible, entries, entries * grid.tile**2, times[0], times[1]


def main(arguments: list[str]) -> None:
    del arguments
    print("edge,gaussians,size,visible,entries,pairs,forward_ms,both_ms")
    found = {}
    for case in _CASES:
        visible, entries, pairs, forward, found[case] = _measure(case)
        row = [case.edge, case.count, case.size, visible, entries, pairs]
        print(*row, f"{forward:.1f}", f"{found[case]:.1f}", sep=",", flush=True)
    if not _ANY_SPEED.value:
        assert found[_CASES[0]] <= _LIMIT, f"{found[_CASES[0]]:.1f} ms"


if __name__ == "__main__":
    app.run(main)
