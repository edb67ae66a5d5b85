"""Trains Gaussians at a fixed number: the loss, Adam, and the relocation of transparent ones.

A step renders one training image in front of a random colour, and takes a step of Adam with a
learning rate for each kind of parameter. Then every mean is moved at random, the more the less
opaque its Gaussian is. From time to time, Gaussians that have become transparent are relocated to
opaque ones, drawn in proportion to opacity: those that share a place are made smaller and less
opaque, so that the image stays the same. Their number is constant, so all shapes are.

An environment is far away, which the published constants are not made for. Therefore learning
rates of means and the loss of scales are relative to the distance from the centre, or to that of
the cameras if they are farther, and a random move is at most half as long as the Gaussian's largest
axis.

Everything random depends on the seed and the number of the step alone, so that a resumed run
continues as the uninterrupted one; on a CPU, bit for bit. The capacity of the lists grows if a step
needs it, and this step is repeated, so results do not depend on the capacity.

Sources: Kheradmand et al., 3D Gaussian Splatting as Markov Chain Monte Carlo (2024), with the
constants of gsplat 1.5.3; Kerbl et al. (2023) for the loss. This is one of the modules that call
`jax.jit`.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, UInt, UInt8

from refref_jax import numerics
from refref_jax.choices import Position, SplatFilter
from refref_jax.geometry.cameras import Cameras
from refref_jax.splats import gaussians as splats
from refref_jax.splats import images
from refref_jax.splats.gaussians import Gaussians, View
from refref_jax.splats.rasterizer import Grid

# Weights of the loss: structural similarity, opacities, and scales.
_BY_SIMILARITY, _BY_OPACITY, _BY_SCALE = 0.2, 0.01, 0.01

# Window of SSIM: its size and standard deviation in pixels, and the constants of its quotient.
_WINDOW, _DEVIATION, _FLOORS = 11, 1.5, (0.01**2, 0.03**2)

# Learning rates; that of means is for scenes whose cameras are at distance 1 / 1.1, and decays to a
# hundredth.
_RATES = Gaussians(1.6e-4, 1e-3, 5e-3, 5e-2, 2.5e-3, 1.25e-4)  # type: ignore[arg-type]
_DECAY, _EXTENT, _EPSILON = 0.01, 1.1, 1e-15

# Opacity below which a Gaussian is transparent; slope and size of the random moves.
_TRANSPARENT, _SLOPE, _MOVE = 0.005, 100.0, 5e5

# Steps between relocations, and shares of the steps at which they begin, at the latest after 500,
# and end; the share of the steps after which the harmonics have one degree more.
_PERIOD, _BEGIN, _LATEST, _END, _DEGREE = 100, 0.12, 500, 0.8, 1.0 / 7.0

# Number that distinguishes the random numbers of a relocation from those of a step.
_RELOCATION = 1

# Most Gaussians that may share a place.
_MOST_SHARING = 51

# Room of the lists in proportion to the entries of the initial Gaussians.
_SPARE = 1.2


class Report(NamedTuple):
    """What a step measured.

    Attributes:
      loss: the loss.
      psnr: PSNR of the image that it rendered, dB.
      entries: number of entries of its lists of tiles.
      relocated: number of Gaussians that the last relocation moved; 0 after a resumption.
    """

    loss: Float[Array, ""]
    psnr: Float[Array, ""]
    entries: Int[Array, ""]
    relocated: Int[Array, ""]


class State(NamedTuple):
    """State of a training.

    Attributes:
      step: number of steps taken.
      gaussians: the Gaussians.
      moments: state of Adam.
    """

    step: Int[Array, ""]
    gaussians: Gaussians
    moments: optax.OptState


class Setup(NamedTuple):
    """The constant part of a training.

    Attributes:
      views: views of the training images.
      targets: training images, 8-bit sRGB.
      seed: seed of the order of the images and of all random numbers.
      steps: number of steps of the whole training.
      kernel: treatment of opacity, see `gaussians.project`.
      extent: distance of the farthest camera from the centre, times 1.1, world units.
      centre: centre of the scene, world units.
    """

    views: View
    targets: UInt8[Array, "views h w 3"]
    seed: int
    steps: int
    kernel: SplatFilter
    extent: float
    centre: Position


class _Static(NamedTuple):
    """What a compiled program depends on.

    Attributes:
      grid: tiles of the images.
      capacity: capacity of the lists.
      kernel: treatment of opacity.
      steps: number of steps of the whole training.
      seed: seed of all random numbers.
      extent: unit of distances, as in `Setup`.
      centre: centre of the scene, world units.
    """

    grid: Grid
    capacity: int
    kernel: SplatFilter
    steps: int
    seed: int
    extent: float
    centre: Position


def set_up(
    cameras: Cameras,
    targets: UInt8[np.ndarray, "views h w 3"],
    *,
    seed: int,
    steps: int,
    kernel: SplatFilter,
    centre: Position,
) -> Setup:
    """Moves the training images to the device.

    Args:
      cameras: their cameras.
      targets: training images, 8-bit sRGB, at least 11 x 11 pixels.
      seed: seed of the training.
      steps: number of steps of the whole training.
      kernel: treatment of opacity, see `gaussians.project`.
      centre: centre of the scene, world units.

    Raises:
      ValueError: if the images are smaller than the window of SSIM.
    """
    height, width = targets.shape[1:3]
    if min(height, width) < _WINDOW:
        raise ValueError(
            f"Images are {width} x {height} pixels, but the loss of Gaussian splats needs "
            f"{_WINDOW} x {_WINDOW}. Use larger images, or another field."
        )
    views, kept = jax.device_put((splats.views_of(cameras), targets))
    extent = _EXTENT * splats.extent(cameras, centre)
    return Setup(views, kept, seed, steps, kernel, extent, centre)


def init_state(gaussians: Gaussians) -> State:
    """Returns the state before the first step."""
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    return State(jnp.zeros((), jnp.int32), gaussians, _adam().init(gaussians))


def _adam() -> optax.GradientTransformation:
    return optax.scale_by_adam(eps=_EPSILON)


def similarity(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the structural similarity of `metrics.ssim`, by products with two band matrices.

    On a CPU, its derivative takes a twentieth of the time of convolutions. In single precision, it
    is for losses only.
    """
    height, width, _ = rendered.shape

    def blur(x: Float[Array, "h w 3"]) -> Float[Array, "rows columns 3"]:
        x = jnp.moveaxis(x, -1, 0)
        across = numerics.product(x, _band(width).T[None])
        return jnp.moveaxis(numerics.product(_band(height)[None], across), 0, -1)

    mean_a, mean_b = blur(rendered), blur(target)
    square_a, square_b, both = mean_a * mean_a, mean_b * mean_b, mean_a * mean_b
    variances = blur(rendered * rendered) - square_a + blur(target * target) - square_b
    covariance = blur(rendered * target) - both
    above = (2.0 * both + _FLOORS[0]) * (2.0 * covariance + _FLOORS[1])
    return jnp.mean(above / ((square_a + square_b + _FLOORS[0]) * (variances + _FLOORS[1])))


def _band(size: int) -> Float[Array, "windows size"]:
    """Returns the matrix that averages all windows of a line of pixels."""
    place = jnp.arange(_WINDOW, dtype=jnp.float32) - (_WINDOW - 1) / 2.0
    weights = jnp.exp(-0.5 * jnp.square(place / _DEVIATION))
    weights = weights / jnp.sum(weights)
    shift = jnp.arange(size)[None] - jnp.arange(size - _WINDOW + 1)[:, None]
    inside = (shift >= 0) & (shift < _WINDOW)
    return jnp.where(inside, weights[jnp.clip(shift, 0, _WINDOW - 1)], 0.0)


def measure(
    gaussians: Gaussians,
    view: View,
    target: Float[Array, "h w 3"],
    background: Float[Array, "3"],
    degree: Float[Array, ""],
    *,
    static: _Static,
) -> tuple[Float[Array, ""], Report]:
    """Returns the loss of one image, and its report.

    Args:
      gaussians: the Gaussians.
      view: view of the image.
      target: the image, sRGB.
      background: colour behind the Gaussians, sRGB.
      degree: largest degree of the harmonics.
      static: constants of the training.
    """
    grid, capacity, kernel = static.grid, static.capacity, static.kernel
    seen, entries = images.blend(
        gaussians, view, grid=grid, capacity=capacity, kernel=kernel, degree=degree
    )
    rendered = seen.colours + seen.transmittance[..., None] * background[None, None]
    colours = jnp.mean(jnp.abs(rendered - target))
    opacities = jnp.mean(jax.nn.sigmoid(gaussians.logits))
    scales = jnp.exp(gaussians.log_scales) / (static.extent * _reach(gaussians, static)[:, None])
    loss = (1.0 - _BY_SIMILARITY) * colours
    loss += _BY_SIMILARITY * (1.0 - similarity(rendered, target))
    loss += _BY_OPACITY * opacities + _BY_SCALE * jnp.mean(scales)
    error = jnp.mean(jnp.square(jnp.clip(rendered, 0.0, 1.0) - target))
    return loss, Report(loss, -10.0 * jnp.log10(error), entries, jnp.int32(0))


def _reach(gaussians: Gaussians, static: _Static) -> Float[Array, " gaussians"]:
    """Returns the distance of each mean from the centre, in units of the extent; 1 if nearer."""
    centre = jnp.asarray(static.centre, gaussians.means.dtype)
    away = numerics.length(jax.lax.stop_gradient(gaussians.means) - centre[None])
    return jnp.maximum(away / static.extent, 1.0)


@functools.partial(jax.jit, static_argnames="static")
def _take_steps(
    state: State,
    views: View,
    targets: UInt8[Array, "views h w 3"],
    order: Int[Array, " steps"],
    last: Int[Array, ""],
    *,
    static: _Static,
) -> tuple[State, Report, Int[Array, ""]]:
    """Takes the first `last` steps with the images in `order`.

    Returns:
      The state, the report of the last step, and the largest number of entries of all steps.
    """

    def one(
        place: Int[Array, ""], carry: tuple[State, Report, Int[Array, ""]]
    ) -> tuple[State, Report, Int[Array, ""]]:
        state, _, most = carry
        number = order[place]
        view = jax.tree.map(lambda x: x[number], views)
        state, report = _step(state, view, targets[number], static=static)
        return state, report, jnp.maximum(most, report.entries)

    nothing = jnp.zeros(()), jnp.zeros(()), jnp.int32(0), jnp.int32(0)
    return jax.lax.fori_loop(0, last, one, (state, Report(*nothing), jnp.int32(0)))


def _step(
    state: State,
    view: View,
    image: UInt8[Array, "h w 3"],
    *,
    static: _Static,
) -> tuple[State, Report]:
    """Takes one step."""
    key = jax.random.fold_in(jax.random.key(static.seed), state.step)
    background_key, move_key = jax.random.split(key)
    progress = state.step.astype(jnp.float32) / static.steps
    degree = jnp.minimum(jnp.floor(progress / _DEGREE), 3.0)
    target = image.astype(jnp.float32) / 255.0
    background = jax.random.uniform(background_key, (3,))
    slopes, report = jax.grad(measure, has_aux=True)(
        state.gaussians, view, target, background, degree, static=static
    )
    updates, moments = _adam().update(slopes, state.moments)
    rate = _RATES.means * static.extent * _DECAY**progress
    rates = _RATES._replace(means=rate * _reach(state.gaussians, static)[:, None])
    gaussians = jax.tree.map(lambda x, u, r: x - r * u, state.gaussians, updates, rates)
    gaussians = moved(move_key, gaussians, rate=rate)
    return State(state.step + 1, gaussians, moments), report


def moved(key: Array, gaussians: Gaussians, *, rate: Float[Array, ""]) -> Gaussians:
    """Moves means at random by their covariance, the less the more opaque they are.

    A move is at most half of the largest axis: the published one has the unit of a length cubed.

    Args:
      key: random key.
      gaussians: the Gaussians.
      rate: learning rate of means.
    """
    opacity = jax.nn.sigmoid(gaussians.logits)
    size = rate * _MOVE * jax.nn.sigmoid(_SLOPE * (_TRANSPARENT - opacity))
    draw = jax.random.normal(key, gaussians.means.shape) * size[:, None]
    scales = jnp.exp(gaussians.log_scales)

    def by_covariance(
        quaternion: Float[Array, "4"], scale: Float[Array, "3"], draw: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        axes = splats.rotation(quaternion) * scale[None]
        along = axes[0] * draw[0] + axes[1] * draw[1] + axes[2] * draw[2]
        return jnp.stack([numerics.dot(axes[i], along) for i in range(3)])

    moves = jax.vmap(by_covariance)(gaussians.quaternions, scales, draw)
    most = 0.5 * numerics.largest_component(scales)
    length = numerics.length(moves)
    share = jnp.minimum(1.0, numerics.safe_divide(most, length))
    return gaussians._replace(means=gaussians.means + moves * share[:, None])


@jax.jit
def _relocate(state: State, seed: UInt[Array, ""]) -> tuple[State, Int[Array, ""]]:
    """Relocates Gaussians after a step, and returns their number."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), state.step), _RELOCATION)
    gaussians, moments, count = relocate(key, state.gaussians, state.moments)
    return State(state.step, gaussians, moments), count


def _is_due(step: int, steps: int) -> bool:
    """Returns whether Gaussians are relocated after a step."""
    begin = min(_LATEST, math.ceil(_BEGIN * steps))
    return begin <= step <= _END * steps and step % _PERIOD == 0


def relocate(
    key: Array, gaussians: Gaussians, moments: optax.OptState
) -> tuple[Gaussians, optax.OptState, Int[Array, ""]]:
    """Moves transparent Gaussians to opaque ones, drawn in proportion to opacity.

    Args:
      key: random key.
      gaussians: the Gaussians.
      moments: state of Adam, which is reset for all that share a place.

    Returns:
      The Gaussians, the moments, and the number of those that were moved.
    """
    count = gaussians.logits.size
    opacity = jax.nn.sigmoid(gaussians.logits)
    dead = (opacity <= _TRANSPARENT) & jnp.any(opacity > _TRANSPARENT)
    own = jnp.arange(count, dtype=jnp.int32)
    drawn = _draw(key, jnp.where(dead, 0.0, opacity))
    source = jnp.where(dead, drawn, own)
    arrivals = jnp.zeros(count, jnp.int32).at[drawn].add(dead.astype(jnp.int32))
    sharing = jnp.clip(arrivals[source] + 1, 1, _MOST_SHARING)
    changed = dead | (arrivals > 0)
    new_opacity, factor = shared(opacity[source], sharing)
    found = jax.tree.map(lambda x: x[source], gaussians)
    new_opacity = jnp.maximum(new_opacity, _TRANSPARENT)
    found = found._replace(
        logits=jnp.log(new_opacity) - jnp.log1p(-new_opacity),
        log_scales=found.log_scales + jnp.log(factor)[:, None],
    )

    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(changed.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

    gaussians = jax.tree.map(chosen, found, gaussians)
    moments = moments._replace(
        **{
            name: jax.tree.map(lambda x: chosen(jnp.zeros_like(x), x), getattr(moments, name))
            for name in ("mu", "nu")
        }
    )
    return gaussians, moments, jnp.sum(dead, dtype=jnp.int32)


def _draw(key: Array, chances: Float[Array, " n"]) -> Int[Array, " n"]:
    """Returns as many indices as there are chances, drawn in proportion to them.

    None has the chance 0, unless all have. `jax.random.categorical` would hold a number for each
    pair of Gaussians. In single precision, a cumulative sum may fall from one entry to the next,
    so that `jax.random.choice` returns some of chance 0, if there are many.
    """
    possible_first = jnp.argsort(chances <= 0.0).astype(jnp.int32)
    cumulative = jnp.cumsum(chances[possible_first])
    draws = cumulative[-1] * (1.0 - jax.random.uniform(key, chances.shape))
    last = jnp.maximum(jnp.sum(chances > 0.0) - 1, 0)
    return possible_first[jnp.minimum(jnp.searchsorted(cumulative, draws), last)]


def shared(
    opacity: Float[Array, "*shape"], count: Int[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Returns opacity and relative scale of Gaussians that replace one at the same place.

    Args:
      opacity: opacity of the one, in `(0, 1)`.
      count: number of those that replace it, 1 to 51.

    Source: Kheradmand et al. (2024), equation 9: `o' = 1 - (1 - o)^(1/n)`, and the scales are
    multiplied by `o / sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k + 1)`. By the
    sum over `i`, the binomials add up to `C(n, k + 1)`.
    """
    held = jnp.minimum(opacity, 1.0 - 1e-6)
    new = -jnp.expm1(jnp.log1p(-held) / count.astype(held.dtype))
    terms = jnp.arange(1, _MOST_SHARING + 1, dtype=held.dtype)
    signed = _signed_binomials(held.dtype)[count]
    powers = new[..., None] ** terms.reshape((1,) * new.ndim + (-1,))
    return new, held / jnp.sum(signed * powers, axis=-1)


def _signed_binomials(dtype: jnp.dtype) -> Float[Array, "counts terms"]:
    """Returns `(-1)^(k - 1) C(n, k) / sqrt(k)` for `n` in 0 to 51 and `k` in 1 to 51."""
    rows = [
        [(-1.0) ** (k - 1) * math.comb(n, k) / math.sqrt(k) for k in range(1, _MOST_SHARING + 1)]
        for n in range(_MOST_SHARING + 1)
    ]
    return jnp.asarray(rows, dtype)


def order_of(seed: int, count: int, steps: Sequence[int]) -> Int[np.ndarray, " steps"]:
    """Returns the image of each step: all images once, in random order, then all again.

    Args:
      seed: seed of the training.
      count: number of training images.
      steps: numbers of the steps, from 0.
    """
    rounds = {
        each: np.random.default_rng((seed, each)).permutation(count)
        for each in {step // count for step in steps}
    }
    return np.array([rounds[step // count][step % count] for step in steps], np.int32)


def run_steps(
    setup: Setup, state: State, until: int, *, every: Sequence[int]
) -> Iterator[tuple[State, Report]]:
    """Takes all steps up to `until`, and yields the state and the report at regular steps.

    Args:
      setup: constant part of the training.
      state: initial state.
      until: number of the last step.
      every: periods; the state is yielded at the multiples of each of these numbers, and at the
        end.
    """
    count, height, width, _ = setup.targets.shape
    grid = images.grid_of(width, height)
    entries = survey(setup, state.gaussians, grid)
    rest = setup.kernel, setup.steps, setup.seed, setup.extent, setup.centre
    static = _Static(grid, images.capacity_for(_SPARE * entries), *rest)
    step, longest = int(state.step), min(every)
    relocated: Array | np.int32 = np.int32(0)
    while step < until:
        last = min(until, *(step + period - step % period for period in (*every, _PERIOD)))
        order = np.zeros(longest, np.int32)
        order[: last - step] = order_of(setup.seed, count, range(step, last))
        while True:
            following, report, most = _take_steps(
                *(state, setup.views, setup.targets, order, np.int32(last - step)), static=static
            )
            if int(most) <= static.capacity:
                break
            static = static._replace(capacity=images.capacity_for(_SPARE * int(most)))
        state, step = following, last
        if _is_due(step, setup.steps):
            state, relocated = _relocate(state, np.uint32(setup.seed))
        yield state, report._replace(relocated=relocated)


def survey(setup: Setup, gaussians: Gaussians, grid: Grid) -> int:
    """Returns the largest number of entries of the lists of all training images."""
    count = setup.targets.shape[0]
    views = (jax.tree.map(lambda x, n=n: x[n], setup.views) for n in range(count))
    kernel = setup.kernel
    found = [images.survey(gaussians, view, grid=grid, kernel=kernel) for view in views]
    return max(int(each) for each in found)
