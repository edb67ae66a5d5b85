import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid
from refref_jax.optics.light_paths import PathStatus
from refref_jax.render import pixels, volume_rendering
from refref_jax.render.model import init_params
from refref_jax.render.volume_rendering import Jitter
from refref_jax.training import objective
from tests.factories import made_paths
from tests.factories.small_model import MODEL
from tests.laws import gradients
from tests.oracles import reference_sampling

# Colours of a few float32 products, sums and one power.
_COLOUR = 1e-5

_SEGMENTS = 4
_RAYS = 3
_CLEAR = dataclasses.replace(
    MODEL, interior="clear", multisamples=6, space="unbounded", radius=2.0, far=1e3
)


@functools.cache
def _params(config, spread=1.0):
    """Returns parameters as after training, so that the fields vary."""
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(0)
    draw = lambda x: jnp.asarray(spread * rng.normal(size=x.shape), jnp.float32)
    return jax.tree.map(draw, shapes)


@functools.partial(jax.jit, static_argnames="config")
def _compiled(params, paths, jitter, *, config):
    return pixels.render_pixels(
        params, config, paths, jitter, rays=_RAYS, anneal=jnp.ones_like(paths.radii[0])
    )


def _render(paths, jitter=None, *, config=MODEL):
    jitter = pixels.no_jitter(config, paths.radii.shape[0]) if jitter is None else jitter
    return _compiled(_params(config), paths, jitter, config=config)


def _paths():
    """Returns six paths: three of ray 0, one of ray 1, none of ray 2, and two empty slots."""
    owners = [0, 1, 0, 0, 0, 0]
    weights = [[0.5, 0.4, 0.3], [1.0, 1.0, 1.0], [0.2, 0.3, 0.1], [0.1, 0.0, 0.6], [0.0] * 3] * 2
    statuses = [PathStatus.ESCAPED] * 4 + [PathStatus.EMPTY] * 2
    items = []
    for slot, (owner, status) in enumerate(zip(owners, statuses, strict=True)):
        path = made_paths.random_path(slot, bends=slot % 4, segments=_SEGMENTS)
        share = weights[slot] if status != PathStatus.EMPTY else [0.0] * 3
        items.append(
            path._replace(
                rays=jnp.int32(owner),
                throughput=jnp.asarray(share, jnp.float32),
                statuses=jnp.int32(status),
            )
        )
    return made_paths.stack(items)


def _encoded(linear):
    return np.array([reference_sampling.linear_to_srgb(x) for x in linear])


def test_the_paths_of_a_ray_are_blended_by_their_weights_in_linear_space():
    paths = _paths()
    seen = _render(paths)
    weights, rgb = (np.asarray(x, np.float64) for x in (paths.throughput, seen.paths.composite.rgb))
    expected = weights[0] * rgb[0] + weights[2] * rgb[2] + weights[3] * rgb[3]
    np.testing.assert_allclose(seen.rgb[0], _encoded(expected), atol=_COLOUR)
    np.testing.assert_allclose(seen.rgb[1], _encoded(rgb[1]), atol=_COLOUR)
    # The paths differ, so a blend of the encoded colours would show.
    wrong = sum(weights[i] * _encoded(rgb[i]) for i in (0, 2, 3))
    assert abs(np.asarray(seen.rgb[0]) - wrong).max() > 100.0 * _COLOUR


def test_a_ray_without_paths_is_black():
    np.testing.assert_array_equal(_render(_paths()).rgb[2], np.zeros(3))


def test_empty_slots_have_no_effect():
    paths = _paths()
    empty = np.asarray(paths.statuses) == PathStatus.EMPTY
    garbage = paths._replace(
        points=jnp.where(empty[:, None, None], 7.0, paths.points),
        directions=jnp.where(empty[:, None, None], 0.0, paths.directions),
        tau=jnp.where(empty[:, None], jnp.array([[0.0] + [jnp.inf] * (_SEGMENTS - 1)]), paths.tau),
        radii=jnp.where(empty, 0.0, paths.radii),
        rays=jnp.where(empty, 1, paths.rays),
    )
    np.testing.assert_array_equal(_render(garbage).rgb, _render(paths).rgb)


def test_colours_are_not_clipped():
    paths = _paths()
    bright = paths._replace(throughput=10.0 * paths.throughput)
    assert (_render(bright).rgb[1] > 1.0).any()
    dark = _render(paths._replace(throughput=-1.0 * paths.throughput)).rgb[1]
    np.testing.assert_allclose(dark, -12.92 * _render(paths).paths.composite.rgb[1], atol=_COLOUR)


def test_no_jitter_is_zero():
    jitter = pixels.no_jitter(MODEL, 5)
    for part in jitter:
        np.testing.assert_array_equal(part, np.zeros((5, volume_rendering.levels(MODEL))))


def test_random_jitter_fills_its_ranges():
    offsets, rotations = (np.asarray(x) for x in _draw(0, 2000))
    assert offsets.shape == rotations.shape == (2000, volume_rendering.levels(MODEL))
    assert (offsets >= -0.5).all() and (offsets < 0.5).all()
    assert (rotations >= 0.0).all() and (rotations <= 2.0 * np.pi).all()
    # Mean and deviation of a uniform distribution, five standard errors wide.
    np.testing.assert_allclose(offsets.mean(), 0.0, atol=5.0 * offsets.std() / 4000**0.5)
    np.testing.assert_allclose(offsets.std(), 12.0**-0.5, rtol=0.05)
    np.testing.assert_allclose(rotations.std(), 2.0 * np.pi * 12.0**-0.5, rtol=0.05)
    correlation = np.corrcoef(offsets.ravel(), rotations.ravel())[0, 1]
    assert abs(correlation) < 5.0 / 4000**0.5


@functools.partial(jax.jit, static_argnums=1)
def _draw(seed, paths):
    return pixels.random_jitter(jax.random.key(seed), MODEL, jnp.arange(paths, dtype=jnp.int32))


def test_random_jitter_follows_its_key():
    first, same, other = (_draw(seed, 6) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.offsets, same.offsets)
    assert not np.array_equal(first.offsets, other.offsets)


def test_the_jitter_of_a_slot_knows_nothing_of_the_others():
    whole = _draw(3, 12)
    key, some = jax.random.key(3), jnp.asarray([7, 2, 11], jnp.int32)
    part = jax.jit(lambda slots: pixels.random_jitter(key, MODEL, slots))(some)
    for each, of_all in zip(part, whole, strict=True):
        np.testing.assert_array_equal(each, np.asarray(of_all)[[7, 2, 11]])


_LOSSES = ("colour", "interlevel", "distortion", "hash decay")


@jax.jit
def _loss_gradients(params, paths, jitter):
    """Returns the gradients of each loss of a training step, stacked."""

    def each(params):
        seen = pixels.render_pixels(
            params, _CLEAR, paths, jitter, rays=_RAYS, anneal=jnp.float32(0.7)
        )
        *proposals, final = seen.paths.histograms
        target = jnp.full_like(seen.rgb, 0.3)
        interlevel = jax.vmap(lambda a, b: objective.interlevel(a, b, blur=0.01))
        return jnp.stack(
            [
                objective.mean_squared_error(seen.rgb, target),
                sum(jnp.mean(interlevel(final, proposal)) for proposal in proposals),
                jnp.mean(jax.vmap(objective.distortion)(final, seen.paths.outside)),
                objective.hash_decay(hash_grid.tables(params)),
            ]
        )

    return each(params), jax.jacrev(each)(params)


def _hard_paths():
    """Returns paths at the edges: no length, no direction, very long, very far, no width."""
    paths = _paths()
    start = made_paths.path(
        [0.0, 1e-6, 1e6],
        [[0, 0, 1], [0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [0, 1, 0, 1],
        radius=0.0,
        status=PathStatus.OUT_OF_BENDS,
    )
    far = made_paths.path([0.5], [[0, 0, 1], [1, 0, 0]], [1, 0], origin=(1e6, 0, 0), segments=4)
    nowhere = start._replace(directions=jnp.zeros((_SEGMENTS, 3)))
    hard = made_paths.stack([start, far, nowhere])
    return jax.tree.map(
        lambda a, b: jnp.asarray(np.concatenate([np.asarray(a)[:3], np.asarray(b)])), paths, hard
    )


@pytest.mark.slow
@pytest.mark.parametrize("spread", [1e-4, 1.0, 100.0])
def test_gradients_of_all_losses_are_finite_everywhere(spread):
    for paths in (_paths(), _hard_paths()):
        jitter = Jitter(*(jnp.asarray(np.full((6, 2), x), jnp.float32) for x in (-0.5, 3.0)))
        got = _loss_gradients(_params(_CLEAR, spread), paths, jitter)
        assert gradients.all_finite(got)


@pytest.mark.slow
def test_every_loss_teaches_what_it_is_meant_to():
    jitter = pixels.no_jitter(_CLEAR, 6)
    _, slopes = _loss_gradients(_params(_CLEAR), _paths(), jitter)

    def taught(tree, loss):
        return [bool(np.any(np.asarray(leaf)[loss])) for leaf in jax.tree.leaves(tree)]

    colour, interlevel, distortion, decay = range(len(_LOSSES))
    assert all(taught(slopes.field, colour)) and not any(taught(slopes.proposals, colour))
    assert all(taught(slopes.proposals, interlevel)) and not any(taught(slopes.field, interlevel))
    assert any(taught(slopes.field, distortion)) and not any(taught(slopes.proposals, distortion))
    assert sum(taught(slopes, decay)) == len(hash_grid.tables(_params(_CLEAR))) == 4
