"""The edges of training: batches of light paths, parameters and models that test its numerics.

Every batch has the same shapes, and so has every set of parameters of a model: one compiled program
takes a training step on any of them.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.optics.light_paths import PathStatus, RayDifferential
from refref_jax.optics.path_tracing import Traced
from refref_jax.render.model import init_params
from tests.factories import made_paths, small_model

RAYS = 3
PATHS = 8
SEGMENTS = 4
PARTS = 2

_GRID = HashGridConfig(levels=1, base_res=16, max_res=16, hashmap_size=1 << 10, features=2)

# An infinity for all purposes that is still a number; the largest density asked for.
_HUGE = 1e10

_WIDE = 1e6

_RADIUS = small_model.MODEL.radius


def model(*, precision="float32", **changes):
    """Returns a small model with some of its fields changed."""
    plain = dataclasses.replace(small_model.MODEL, **changes)
    # Of one level, hashed: the levels are all alike, and each takes its time to compile.
    changed = {"precision": precision, "grid": _GRID}
    proposals = tuple(
        dataclasses.replace(each, field=dataclasses.replace(each.field, **changed))
        for each in plain.proposals
    )
    field = dataclasses.replace(plain.field, **changed)
    return dataclasses.replace(plain, proposals=proposals, field=field)


def batches(config):
    """Returns the batches by name."""
    ordinary = [made_paths.random_path(i, bends=i % SEGMENTS, segments=SEGMENTS) for i in range(6)]
    straight = [_straight([0.0, 0.0, 4.0], [i - 2.5, 1.0, -4.0]) for i in range(6)]
    made = {
        "ordinary": ordinary,
        "no weight": [path._replace(throughput=jnp.zeros(3)) for path in ordinary],
        "never leaving": [_never_leaving(i) for i in range(6)],
        "all missed": straight,
        "all hit": [made_paths.random_path(i, bends=3, segments=SEGMENTS) for i in range(6)],
        "all empty": [],
        "no length": [_without_length(), *(_leaving_at_once(face) for face in (1.0, -1.0))],
        "far away": [_straight([1e6, 0.0, 0.0], [-1.0, 1e-6, 0.0])] * 2 + [_long()],
        "all absorbed": [_tallied(path, 25.0, _WIDE) for path in ordinary],
    }
    found = {name: _batch(config, paths) for name, paths in made.items()}
    if config.footprint == "differential":
        found["wide"] = _widened(found["ordinary"])
    return found


def stack(named):
    """Returns the paths of named batches as a pool has them."""
    paths = made_paths.stack(named.values())
    return Traced(paths, jnp.zeros((len(named), RAYS, 3)))


def parameters(config):
    """Returns parameters by name, as NumPy arrays, of a model."""
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(0)
    draw = lambda size: jax.tree.map(
        lambda x: (size * rng.normal(size=x.shape)).astype(np.float32), shapes
    )
    trained = draw(0.5)
    return {
        "faint": draw(1e-4),
        "trained": trained,
        "wild": draw(100.0),
        "no density": _with_density(trained, -_HUGE),
        "solid": _with_density(trained, _HUGE),
        "solid in places": _steepened(trained),
        "white": with_colour(trained, 100.0),
        "black": with_colour(trained, -100.0),
        "clear parts": _with_dyes(trained, -_HUGE),
        "black parts": _with_dyes(trained, _HUGE),
    }


def with_colour(params, raw):
    """Returns parameters whose field has one colour, before the sigmoid."""
    return _changed(params, colour=lambda kernel, bias: (0.0 * kernel, np.full_like(bias, raw)))


def colour_bias(tree):
    """Returns the leaf of a tree of parameters that moves the colour of the whole field."""
    (layer,) = (layer for layer in _layers(tree.field) if layer["bias"].shape == (3,))
    return np.asarray(layer["bias"])


def _batch(config, paths):
    empty = _empty()
    slots = [path._replace(rays=jnp.int32(i % RAYS)) for i, path in enumerate(paths)]
    slots += [empty] * (PATHS - len(slots))
    return made_paths.stack([_detailed(config, path) for path in slots])


def _detailed(config, path):
    """Gives a path what a model asks of it: derivatives across the pixel, tallies of parts."""
    if config.footprint == "differential":
        ones = jnp.full((SEGMENTS, 2, 3), path.radii)
        path = path._replace(differentials=RayDifferential(0.1 * ones, ones))
    if not config.learned_tints:
        return path._replace(hit_counts=jnp.zeros(0), path_lengths=jnp.zeros(0))
    return path if path.hit_counts.size else _tallied(path, 1.0, 0.5)


def _tallied(path, hit_counts, passage):
    return path._replace(
        hit_counts=jnp.full(PARTS, hit_counts), path_lengths=jnp.full(PARTS, passage)
    )


def _straight(origin, direction):
    return made_paths.path(
        [], [direction], [0], origin=origin, segments=SEGMENTS, status=PathStatus.MISSED
    )


def _never_leaving(seed):
    """Returns a path that is still inside an object when its bends are spent."""
    path = made_paths.random_path(seed, bends=3, segments=SEGMENTS, media=[0, 1, 1, 1])
    return path._replace(statuses=jnp.int32(PathStatus.OUT_OF_BENDS))


def _without_length():
    """Returns a path of which two segments have no length, and none has width."""
    turns = [[0, 0, 1], [0, 0, -1], [0, 1, 0], [1, 0, 0]]
    return made_paths.path([0.0, 1e-6, 0.0], turns, [0, 1, 0, 1], radius=0.0)


def _leaving_at_once(face):
    """Returns a path from a face of the cube, outwards: it is in the scene for no length at all."""
    return _straight([face * _RADIUS, 0.0, 0.0], [face, 0.0, 0.0])


def _long():
    return made_paths.path(
        [_WIDE], [[0, 0, 1], [1, 0, 0]], [0, 1], origin=(0, 0, -_WIDE), segments=SEGMENTS
    )


def _empty():
    """Returns a slot without a path, with no sense in what is not looked at."""
    path = made_paths.path([], [[0, 0, 1]], [0], segments=SEGMENTS, throughput=(0.0, 0.0, 0.0))
    return path._replace(
        points=jnp.full((SEGMENTS, 3), 7.0),
        directions=jnp.zeros((SEGMENTS, 3)),
        radii=jnp.zeros(()),
        statuses=jnp.int32(PathStatus.EMPTY),
    )


def _widened(paths):
    """Returns paths with derivatives as large as tracing lets them grow, of either sign."""
    signs = jnp.asarray(
        np.random.default_rng(0).choice([-_WIDE, _WIDE], paths.differentials.points.shape)
    )
    wide = signs.astype(jnp.float32)
    return paths._replace(differentials=RayDifferential(wide, wide[..., ::-1]))


def _with_density(params, raw):
    def moved(kernel, bias):
        return kernel, np.concatenate([np.full_like(bias[:1], raw), bias[1:]])

    return _changed(params, density=moved)


def _steepened(params):
    """Returns parameters whose densities lie anywhere between 0 and huge ones."""

    def steeper(kernel, bias):
        return np.concatenate([_HUGE * kernel[:, :1], kernel[:, 1:]], axis=1), bias

    return _changed(params, density=steeper)


def _with_dyes(params, raw):
    return params._replace(tints=jax.tree.map(lambda x: np.full_like(x, raw), params.tints))


def _changed(params, *, density=None, colour=None):
    """Changes the last layers of all networks: kernel and bias of density, or of colour."""
    params = jax.tree.map(np.copy, params)
    layers = [layer for tree in (*params.proposals, params.field) for layer in _layers(tree)]
    for layer in layers:
        outputs = layer["bias"].shape[0]
        change = {1: density, 1 + small_model.MODEL.field.bottleneck: density, 3: colour}
        if (changed := change.get(outputs)) is not None:
            layer["kernel"], layer["bias"] = changed(layer["kernel"], layer["bias"])
    return params


def _layers(tree):
    """Yields the dense layers of a network's parameters."""
    if "kernel" in tree:
        yield tree
    else:
        for branch in tree.values():
            if isinstance(branch, dict):
                yield from _layers(branch)
