import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import density_field, radiance_field
from refref_jax.fields.radiance_field import Radiance
from refref_jax.geometry.rays import Rays
from refref_jax.optics.light_paths import straight
from refref_jax.render import pixels, transport
from refref_jax.render.model import init_params
from refref_jax.render.transport import Jitter
from refref_jax.sampling import warps
from tests import gradients, made_paths, reference_sampling
from tests.small_model import MODEL

# Sums of weights, and edges that are found by inverting a cumulative sum.
_SUMMATION = 5e-6

# Distances along a path of about 15, formed from those edges by the distance warp.
_DISTANCE = 1e-4

_SEGMENTS = 6

_FIELD = dataclasses.replace(MODEL, multisamples=6)
_CLEAR = dataclasses.replace(_FIELD, interior="clear")
_MODELS = {"field": _FIELD, "clear": _CLEAR}


@functools.cache
def _params(config):
    """Returns parameters as after training, so that the fields vary."""
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)


@functools.partial(jax.jit, static_argnames="config")
def _compiled(params, paths, jitter, anneal, *, config):
    return pixels.render_paths(params, config, paths, jitter, anneal=anneal)


def _render(config, paths, jitter=None, *, anneal=1.0, render=_compiled):
    jitter = pixels.no_jitter(config, paths.radii.shape[0]) if jitter is None else jitter
    return render(_params(config), paths, jitter, jnp.float32(anneal), config=config)


def _some_paths(count=4):
    """Returns paths with 0, 1, .. bends; those that are unused are padded."""
    return made_paths.stack(
        made_paths.random_path(seed, bends=seed, segments=_SEGMENTS) for seed in range(count)
    )


def _bent(*, media=(0, 1, 0)):
    """Returns a path that meets a slab at 3, leaves it at 5 and goes on through the scene."""
    return made_paths.path(
        [3.0, 2.0],
        [[0, 0, 1], [0.3, 0, 1], [0, -0.2, 1]],
        media,
        origin=(0.0, 0.0, -4.0),
        segments=_SEGMENTS,
    )


def _batch(*paths):
    return made_paths.stack(paths)


def _tree_item(tree, index):
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


# --- what a record holds ---


def test_rounds_counts_the_final_one():
    assert transport.rounds(MODEL) == 2
    assert transport.rounds(dataclasses.replace(MODEL, proposals=MODEL.proposals * 3)) == 4


def test_warp_is_that_of_the_scene():
    assert transport.warp(MODEL) == (MODEL.near, MODEL.far, MODEL.radius)


@pytest.mark.parametrize("interior", _MODELS)
def test_histograms_are_sorted_and_hold_all_light(interior):
    config = _MODELS[interior]
    seen = _render(config, _some_paths())
    assert len(seen.histograms) == transport.rounds(config)
    samples = [*(proposal.samples for proposal in config.proposals), config.samples]
    for histogram, count in zip(seen.histograms, samples, strict=True):
        edges, weights = (np.asarray(x) for x in histogram)
        assert edges.shape == (4, count + 1) and weights.shape == (4, count)
        assert (edges >= 0.0).all() and (edges <= 1.0).all()
        assert (np.diff(edges, axis=-1) >= 0.0).all() and (weights >= 0.0).all()
        np.testing.assert_allclose(weights.sum(axis=-1), 1.0, rtol=_SUMMATION)
    np.testing.assert_allclose(seen.composite.accumulation, 1.0, rtol=_SUMMATION)
    distances = np.stack([seen.composite.median, seen.composite.mean])
    assert np.isfinite(distances).all() and (distances >= config.near).all()


def test_the_first_round_is_even():
    edges = _render(_FIELD, _some_paths()).histograms[0].edges
    expected = np.linspace(0.0, 1.0, _FIELD.proposals[0].samples + 1)
    np.testing.assert_allclose(edges, np.broadcast_to(expected, edges.shape), atol=_SUMMATION)


def test_rendering_without_jitter_is_deterministic():
    for a, b in zip(
        *(jax.tree.leaves(_render(_FIELD, _some_paths())) for _ in range(2)), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_paths_do_not_see_each_other():
    paths = _some_paths()
    order = np.array([2, 0, 3, 1])
    shuffled = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[order]), paths)
    seen, seen_shuffled = _render(_FIELD, paths), _render(_FIELD, shuffled)
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(seen_shuffled), strict=True):
        np.testing.assert_allclose(np.asarray(a)[order], b, atol=_SUMMATION)


@pytest.mark.parametrize("interior", _MODELS)
def test_rendering_many_paths_is_a_loop(interior):
    config = _MODELS[interior]
    paths = _some_paths()
    together = _render(config, paths)
    one = jax.jit(lambda path: _one(config, path))
    for index in range(4):
        alone = one(jax.tree.map(jnp.asarray, _tree_item(paths, index)))
        assert jax.tree.structure(alone) == jax.tree.structure(together)
        for a, b in zip(
            jax.tree.leaves(_tree_item(together, index)), jax.tree.leaves(alone), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=_DISTANCE, atol=_SUMMATION)


def _one(config, path):
    jitter = Jitter(*(jnp.zeros(transport.rounds(config)) for _ in range(2)))
    return transport.path_radiance(_params(config), config, path, jitter, jnp.float32(1.0))


# --- the inside of objects ---


def _coordinates(config, edges):
    """Returns the distances at which a final interval has its edges."""
    return np.asarray(warps.to_distance(transport.warp(config), jnp.asarray(edges)), np.float64)


def _walk(path, t, *, interior):
    return reference_sampling.walk_polyline(
        path.points,
        path.directions,
        path.tau,
        path.media,
        int(path.bends),
        t,
        skip_inside=interior == "clear",
    )


def test_a_clear_interior_is_never_sampled():
    seen = _render(_CLEAR, _some_paths())
    assert np.asarray(seen.outside).all()


def test_a_field_interior_is_sampled_and_marked():
    paths = _batch(_bent(), _bent(media=(0, 0, 0)))
    outside = np.asarray(_render(_FIELD, paths).outside)
    assert not outside[0].all() and outside[1].all()


@pytest.mark.parametrize("interior", _MODELS)
def test_intervals_are_marked_by_where_their_middle_lies(interior):
    config = _MODELS[interior]
    paths = _some_paths()
    seen = _render(config, paths)
    t = _coordinates(config, seen.histograms[-1].edges)
    for index in range(4):
        path = _tree_item(paths, index)
        for sample, (start, end) in enumerate(itertools.pairwise(t[index])):
            *_, outside = _walk(path, 0.5 * (start + end), interior=interior)
            assert seen.outside[index, sample] == outside


def test_both_interiors_agree_on_a_path_that_stays_outside():
    paths = _batch(_bent(media=(0, 0, 0)), made_paths.random_path(0, bends=0, segments=_SEGMENTS))
    for a, b in zip(
        jax.tree.leaves(_render(_FIELD, paths)),
        jax.tree.leaves(_render(_CLEAR, paths)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=_DISTANCE, atol=_SUMMATION)


def test_an_interface_between_equal_indices_changes_nothing():
    """A ray that goes straight on through its knots sees what a straight ray sees."""
    direction = [0.2, -0.1, 1.0]
    knotted = made_paths.path(
        [1.0, 2.5, 0.5], [direction] * 4, [0] * 4, origin=(0.3, 0.0, -4.0), segments=_SEGMENTS
    )
    plain = made_paths.path([], [direction], [0], origin=(0.3, 0.0, -4.0), segments=_SEGMENTS)
    seen = _render(_FIELD, _batch(knotted, plain))
    for leaf in jax.tree.leaves(seen):
        np.testing.assert_allclose(leaf[0], leaf[1], rtol=_DISTANCE, atol=_DISTANCE)


def test_a_straight_path_needs_no_padding():
    rays = Rays(jnp.array([[0.3, 0.0, -4.0]]), jnp.array([[0.0, 0.6, 0.8]]), jnp.array([1e-3]))
    padded = made_paths.path(
        [], [[0.0, 0.6, 0.8]], [0], origin=(0.3, 0.0, -4.0), segments=_SEGMENTS
    )
    for a, b in zip(
        jax.tree.leaves(_render(_FIELD, straight(rays))),
        jax.tree.leaves(_render(_FIELD, _batch(padded))),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=_DISTANCE, atol=_SUMMATION)


# --- planted fields ---


def _world(gaussians):
    """Returns the mean position of an interval in world units."""
    return (2.0 * jnp.mean(gaussians.positions, axis=0) - 1.0) * MODEL.radius


@pytest.fixture
def plant(monkeypatch):
    """Replaces the fields by a function of a world position, and colour by one of a direction."""

    def plant_(density, rgb=lambda position, direction: jnp.ones(3)):
        def see(params, config, gaussians, direction):
            position = _world(gaussians)
            return Radiance(density(position), rgb(position, direction))

        monkeypatch.setattr(density_field, "density", lambda params, config, g: density(_world(g)))
        monkeypatch.setattr(radiance_field, "radiance", see)

        # A function of its own, because the fields are looked up when it is traced.
        def render(params, paths, jitter, anneal, *, config):
            return jax.jit(lambda *x: pixels.render_paths(params, config, *x[:2], anneal=x[2]))(
                paths, jitter, anneal
            )

        return render

    return plant_


def _fine(interior):
    """Returns a model with enough samples to find a wall."""
    rounds = tuple(dataclasses.replace(MODEL.proposals[0], samples=32) for _ in range(2))
    return dataclasses.replace(_MODELS[interior], proposals=rounds, samples=32)


def _arc_at_z(path, z):
    """Returns the arc length at which the last segment of a path reaches a plane."""
    last = int(path.bends)
    start, direction = np.asarray(path.points[last]), np.asarray(path.directions[last])
    return float(path.tau[last]) + (z - start[2]) / direction[2]


_WALL = 4.5


@pytest.mark.parametrize("interior", _MODELS)
def test_a_wall_behind_an_object_is_found_at_its_arc_length(plant, interior):
    render = plant(lambda position: jnp.where(position[2] > _WALL, 1e5, 0.0))
    config, path = _fine(interior), _bent()
    seen = _render(config, _batch(path), render=render)
    t = _coordinates(config, seen.histograms[-1].edges[0])
    holding = int(np.argmax(seen.histograms[-1].weights[0]))
    width = t[holding + 1] - t[holding]
    assert width < 0.1
    np.testing.assert_allclose(seen.composite.median[0], _arc_at_z(path, _WALL), atol=width)
    np.testing.assert_allclose(seen.composite.mean[0], _arc_at_z(path, _WALL), atol=width)


@pytest.mark.parametrize(("interior", "expected"), [("field", 4.0), ("clear", None)])
def test_what_is_inside_an_object_is_seen_by_the_field_interior_only(plant, interior, expected):
    # A body from z = -0.05 on hides in the slab, which ends at z = 0.92.
    def density(position):
        hidden = (position[2] > -0.05) & (position[2] < 0.8)
        return jnp.where(hidden | (position[2] > _WALL), 1e5, 0.0)

    path = _bent()
    seen = _render(_fine(interior), _batch(path), render=plant(density))
    if expected is None:
        expected = _arc_at_z(path, _WALL)
    np.testing.assert_allclose(seen.composite.median[0], expected, atol=0.1)


def test_a_wall_in_front_of_an_object_is_found_alike(plant):
    render = plant(lambda position: jnp.where(position[2] > -2.0, 1e5, 0.0))
    for interior in _MODELS:
        seen = _render(_fine(interior), _batch(_bent()), render=render)
        np.testing.assert_allclose(seen.composite.median[0], 2.0, atol=0.1)


@pytest.mark.parametrize("interior", _MODELS)
def test_colour_is_asked_with_the_direction_at_the_middle_of_an_interval(plant, interior):
    render = plant(lambda position: jnp.float32(1.0), lambda position, direction: direction)
    config = _MODELS[interior]
    paths = _some_paths()
    seen = _render(config, paths, render=render)
    t = _coordinates(config, seen.histograms[-1].edges)
    for index in range(4):
        path = _tree_item(paths, index)
        middles = 0.5 * (t[index, 1:] + t[index, :-1])
        directions = np.array([_walk(path, x, interior=interior)[1] for x in middles])
        expected = np.asarray(seen.histograms[-1].weights[index]) @ directions
        np.testing.assert_allclose(seen.composite.rgb[index], expected, atol=_SUMMATION)


def test_weights_follow_from_densities_and_lengths(plant):
    # 0.8 per scene radius everywhere, and an opaque end.
    render = plant(lambda position: jnp.float32(0.8))
    seen = _render(_FIELD, _some_paths(), render=render)
    for histogram in seen.histograms:
        t = _coordinates(_FIELD, histogram.edges)
        for index in range(4):
            lengths = np.diff(t[index]) / _FIELD.radius
            expected = reference_sampling.alpha_weights(np.full(lengths.size, 0.8), lengths)
            expected[-1] = 1.0 - expected[:-1].sum()
            np.testing.assert_allclose(histogram.weights[index], expected, atol=_SUMMATION)


def test_an_empty_scene_shows_its_far_end(plant):
    render = plant(lambda position: jnp.float32(0.0), lambda position, direction: position)
    path = made_paths.path([], [[0, 0, 1]], [0])
    seen = _render(_FIELD, _batch(path), render=render)
    weights = np.asarray(seen.histograms[-1].weights[0])
    np.testing.assert_array_equal(weights, np.eye(_FIELD.samples)[-1])
    start, end = _coordinates(_FIELD, seen.histograms[-1].edges[0])[-2:]
    np.testing.assert_allclose(seen.composite.median[0], 0.5 * (start + end), rtol=_DISTANCE)


def test_samples_gather_where_light_comes_from(plant):
    render = plant(lambda position: jnp.where(position[2] > _WALL, 1e5, 0.0))
    trusting, even = (
        _render(_fine("field"), _batch(_bent()), render=render, anneal=anneal)
        for anneal in (1.0, 0.0)
    )
    wall = _arc_at_z(_bent(), _WALL)

    def near(seen):
        t = _coordinates(_FIELD, seen.histograms[-1].edges[0])
        return np.sum(abs(0.5 * (t[1:] + t[:-1]) - wall) < 0.5)

    assert near(trusting) > 3 * near(even)


# --- annealing and jitter ---

_PLAIN = dataclasses.replace(_FIELD, dilation=0.0, proposals=_FIELD.proposals * 2)


def test_no_trust_in_proposals_means_even_samples():
    seen = _render(_PLAIN, _some_paths(), anneal=0.0)
    for histogram in seen.histograms:
        count = histogram.weights.shape[-1]
        expected = np.broadcast_to(np.linspace(0.0, 1.0, count + 1), histogram.edges.shape)
        np.testing.assert_allclose(histogram.edges, expected, atol=_SUMMATION)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("offset", [-0.5, -0.2, 0.4999])
def test_jitter_moves_samples_by_at_most_a_stratum(level, offset):
    paths = _some_paths()
    offsets = np.zeros((4, 3), np.float32)
    offsets[:, level] = offset
    jitter = Jitter(jnp.asarray(offsets), jnp.zeros((4, 3)))
    still = _render(_PLAIN, paths, anneal=0.0).histograms[level].edges
    moved = _render(_PLAIN, paths, jitter, anneal=0.0).histograms[level].edges
    stratum = 1.0 / (still.shape[-1] - 1)
    shift = (np.asarray(moved) - np.asarray(still)) / stratum
    np.testing.assert_allclose(shift[:, 1:-1], offset, atol=1e-4)
    assert (abs(shift) <= 0.5 + 1e-4).all() and (np.diff(moved, axis=-1) > 0.0).all()
    assert (np.asarray(moved) >= 0.0).all() and (np.asarray(moved) <= 1.0).all()


def test_jitter_of_trusted_samples_keeps_them_within_their_quantiles():
    paths = _some_paths()
    jitter = Jitter(jnp.full((4, 3), 0.3), jnp.zeros((4, 3)))
    moved = _render(_PLAIN, paths, jitter)
    before, after = moved.histograms[0], moved.histograms[1]
    for edges, weights, drawn in zip(before.edges, before.weights, after.edges, strict=True):
        cdf = reference_sampling.cumulative(weights)
        u = (np.arange(8) + 0.8) / 8.0
        expected = reference_sampling.sample_edges(u, edges, weights)
        np.testing.assert_allclose(drawn, expected, atol=1e-5)
        assert cdf[-1] == 1.0


def test_rotation_moves_no_interval():
    paths = _some_paths()
    turned = Jitter(jnp.zeros((4, 2)), jnp.full((4, 2), 1.0))
    still, moved = _render(_FIELD, paths), _render(_FIELD, paths, turned)
    np.testing.assert_array_equal(still.histograms[0].edges, moved.histograms[0].edges)
    assert not np.array_equal(still.histograms[0].weights, moved.histograms[0].weights)


# --- gradients ---


def test_colour_teaches_the_radiance_field_only():
    @jax.jit
    @jax.grad
    def slope(params):
        jitter = pixels.no_jitter(_FIELD, 4)
        seen = pixels.render_paths(params, _FIELD, _some_paths(), jitter, anneal=jnp.float32(1.0))
        return jnp.sum(seen.composite.rgb)

    by_proposals, by_field = slope(_params(_FIELD))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(by_proposals))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(by_field))
    assert gradients.all_finite(by_field)


def test_a_scene_of_one_radius_is_measured_in_radii(plant):
    """Density is per scene radius: a scene twice the size looks the same."""
    path = made_paths.path([2.0], [[0, 0, 1], [0.2, 0, 1]], [0, 0], radius=0.0)
    large = made_paths.path([4.0], [[0, 0, 1], [0.2, 0, 1]], [0, 0], radius=0.0)
    doubled = dataclasses.replace(
        _FIELD, radius=2.0 * _FIELD.radius, near=2.0 * _FIELD.near, far=2.0 * _FIELD.far
    )
    render = plant(lambda position: jnp.float32(0.8))
    small_seen = _render(_FIELD, _batch(path), render=render)
    large_seen = _render(doubled, _batch(large), render=render)
    for a, b in zip(small_seen.histograms, large_seen.histograms, strict=True):
        np.testing.assert_allclose(a.weights, b.weights, atol=_SUMMATION)
    np.testing.assert_allclose(
        2.0 * small_seen.composite.median, large_seen.composite.median, rtol=_DISTANCE
    )
    assert math.isfinite(float(small_seen.composite.mean[0]))
