import dataclasses
import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import registry
from refref_jax.fields.base import Radiance
from refref_jax.optics.light_paths import Stop
from refref_jax.render import pixels, volume_rendering
from refref_jax.render.model import Params, init_params, look_up
from refref_jax.render.volume_rendering import Jitter
from refref_jax.sampling import polylines, scene_bounds
from tests.factories import made_paths
from tests.factories.small_model import MODEL
from tests.oracles import reference_sampling

# Sums of weights, and edges that are found by inverting a cumulative sum.
_SUMMATION = 5e-6

# Distances along a path of about 15, formed from those edges by the distance warp.
_DISTANCE = 1e-4

_SEGMENTS = 6

_FIELD = dataclasses.replace(MODEL, multisamples=6, dilation=0.0)
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


def _render(config, paths, jitter=None, *, anneal=1.0):
    jitter = pixels.no_jitter(config, paths.radii.shape[0]) if jitter is None else jitter
    return _compiled(_params(config), paths, jitter, jnp.float32(anneal), config=config)


def _some_paths(count=4):
    """Returns paths with 0, 1, .. bends; those that are unused are padded."""
    return made_paths.stack(
        made_paths.random_path(seed, bends=seed, segments=_SEGMENTS) for seed in range(count)
    )


def _straight_paths():
    """Returns paths without interfaces, at which edges would snap."""
    return made_paths.stack(
        made_paths.random_path(seed, bends=0, segments=_SEGMENTS) for seed in range(4)
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
    """Returns a batch of four paths, the last one repeated: all batches compile as one."""
    return made_paths.stack([*paths, *[paths[-1]] * (4 - len(paths))])


def _tree_item(tree, index):
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


# --- what a record holds ---


def test_rounds_counts_the_final_one():
    assert volume_rendering.levels(MODEL) == 2
    assert volume_rendering.levels(dataclasses.replace(MODEL, proposals=MODEL.proposals * 3)) == 4


def _warp(config, path):
    shape = polylines.outside_path if config.interior == "clear" else polylines.whole_path
    return volume_rendering.distance_warp(config, shape(jax.tree.map(jnp.asarray, path)))


@pytest.mark.parametrize("interior", _MODELS)
@pytest.mark.parametrize(("space", "order"), [("bounded", np.inf), ("spherical", 2)])
def test_a_path_ends_on_the_bounds_of_a_scene(interior, space, order):
    warp = _warp(dataclasses.replace(_MODELS[interior], space=space), _bent())
    assert (warp.near, warp.unit) == (MODEL.near, MODEL.radius)
    end = _walk(_bent(), float(warp.far), interior=interior)[0]
    np.testing.assert_allclose(np.linalg.norm(end, order), MODEL.radius, rtol=_SUMMATION)


@pytest.mark.parametrize("space", ["bounded", "spherical"])
def test_a_camera_farther_out_than_all_of_training_sees_the_far_wall(space):
    config = dataclasses.replace(_FIELD, space=space)
    towards, origin = (0.0, 0.0, 1.0), (0.0, 0.0, -3.0 * MODEL.far)
    path = made_paths.path([], [towards], [0], origin=origin, segments=_SEGMENTS)
    expected = 3.0 * MODEL.far + MODEL.radius
    np.testing.assert_allclose(_warp(config, path).far, expected, rtol=_SUMMATION)


def test_a_path_that_is_turned_around_again_and_again_still_reaches_the_walls():
    path = made_paths.path([5.0, 5.0, 5.0], [[0, 0, 1], [0, 0, -1]] * 2, [0, 1, 1, 0])
    warp = _warp(_FIELD, path)
    assert float(warp.far) == 27.5 > MODEL.far
    end = _walk(path, float(warp.far), interior="field")[0]
    np.testing.assert_allclose(end, [0.0, 0.0, -MODEL.radius], atol=_DISTANCE)


@pytest.mark.parametrize("interior", _MODELS)
def test_a_path_ends_on_an_opaque_surface_inside_the_glass(interior):
    made = made_paths.path([2.0], [(0, 0, -1), (0, 0.6, -0.8)], [0, 1], origin=(0, 0, 3))
    stopped = made._replace(stop=Stop(jnp.float32(2.75), None))
    warp = _warp(_MODELS[interior], stopped)
    end = _walk(made, float(warp.far), interior=interior)[0]
    np.testing.assert_allclose(end, [0.0, 0.45, 0.4], atol=_DISTANCE)
    free = _warp(_MODELS[interior], made._replace(stop=Stop(jnp.float32(jnp.inf), None)))
    assert float(free.far) == float(_warp(_MODELS[interior], made).far) > float(warp.far)


@functools.partial(jax.jit, static_argnums=(1, 2))
def _first_samples(path, config, count):
    line = polylines.whole_path(path)
    still = Jitter(jnp.float32(0.0), jnp.float32(0.0))
    warp = volume_rendering.distance_warp(config, line)
    return volume_rendering.sample(
        config, line, warp, [], count, jitter=still, anneal=jnp.float32(1.0)
    )


def test_samples_reach_from_the_near_to_the_far_plane():
    config = dataclasses.replace(_FIELD, space="unbounded", near=0.5, far=150.0, radius=10.0)
    path = jax.tree.map(jnp.asarray, _tree_item(_straight_paths(), 0))
    t = _first_samples(path, config, 9).t
    np.testing.assert_allclose([t[0], t[-1]], [0.5, 150.0], rtol=_DISTANCE)
    # Zip-NeRF's power transformation in units of 10, where it is linear up to about 1.
    s = [1.0 - (1.0 + x / 12.5) ** -1.5 for x in (0.5, float(t[4]), 150.0)]
    np.testing.assert_allclose((s[1] - s[0]) / (s[2] - s[0]), 4.0 / 9.0, rtol=1e-3)


def test_a_path_of_an_unbounded_scene_ends_far_away():
    config = dataclasses.replace(_FIELD, space="unbounded", far=1000.0)
    path = _bent()
    assert float(_warp(config, path).far) == 1000.0 + float(path.tau[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("origin", "direction", "far"),
    [
        ((0.0, 0.0, 9.0), (0.0, 0.0, 1.0), MODEL.far),  # starts and stays outside the walls
        ((0.0, 0.0, -9.0), (0.0, 0.0, 1.0), 9.0 + MODEL.radius),  # past the far distance
        ((0.0, 0.0, MODEL.radius), (0.0, 0.0, 1.0), 0.0575),  # starts on a wall
    ],
)
def test_a_path_always_has_room_for_samples(origin, direction, far):
    path = made_paths.path([], [direction], [0], origin=origin, segments=_SEGMENTS)
    np.testing.assert_allclose(_warp(_FIELD, path).far, far, rtol=_SUMMATION)
    for leaf in jax.tree.leaves(_render(_FIELD, _batch(path))):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
@pytest.mark.parametrize("interior", _MODELS)
def test_histograms_are_sorted_and_hold_all_light(interior):
    config = _MODELS[interior]
    seen = _render(config, _some_paths())
    assert len(seen.histograms) == volume_rendering.levels(config)
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


@pytest.mark.slow
@pytest.mark.parametrize("some", [(1,), (0, 2, 3)])
def test_rendering_many_paths_is_a_loop(some):
    paths = _some_paths()
    together = _render(_CLEAR, paths)
    one = jax.jit(functools.partial(_one, _CLEAR))
    for index in some:
        alone = one(jax.tree.map(jnp.asarray, _tree_item(paths, index)))
        assert jax.tree.structure(alone) == jax.tree.structure(together)
        for a, b in zip(
            jax.tree.leaves(_tree_item(together, index)), jax.tree.leaves(alone), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=_DISTANCE, atol=_SUMMATION)


def _one(config, path):
    jitter = Jitter(*(jnp.zeros(volume_rendering.levels(config)) for _ in range(2)))
    return volume_rendering.path_radiance(_params(config), config, path, jitter, jnp.float32(1.0))


# --- the inside of objects ---


def _coordinates(config, path, edges):
    """Returns the distances at which the intervals of a path have their edges."""
    return np.asarray(scene_bounds.to_distance(_warp(config, path), jnp.asarray(edges)), np.float64)


def _walk(path, t, *, interior):
    return reference_sampling.walk_polyline(
        path.points,
        path.directions,
        path.tau,
        path.media,
        int(path.num_bends),
        t,
        skip_inside=interior == "clear",
    )


@pytest.mark.slow
@pytest.mark.parametrize("interior", _MODELS)
def test_intervals_are_marked_by_where_their_middle_lies(interior):
    config = _MODELS[interior]
    paths = _some_paths()
    seen = _render(config, paths)
    for index in range(4):
        path = _tree_item(paths, index)
        t = _coordinates(config, path, seen.histograms[-1].edges[index])
        for sample, (start, end) in enumerate(itertools.pairwise(t)):
            *_, outside = _walk(path, 0.5 * (start + end), interior=interior)
            assert seen.outside[index, sample] == outside


@pytest.mark.parametrize("interior", _MODELS)
def test_no_interval_straddles_an_interface(interior):
    config, path = _MODELS[interior], _bent()
    seen = _render(config, _batch(path))
    # The distances at which the path enters and leaves, and where it leaves if the inside has none.
    for knot in (3.0, 5.0) if interior == "field" else (3.0,):
        for histogram in seen.histograms if interior == "clear" else seen.histograms[:-1]:
            # The few edges of the last round may all be drawn by the other interface.
            edges = _coordinates(config, path, histogram.edges[0])
            assert np.min(np.abs(edges - knot)) < _DISTANCE


# --- planted fields ---


class Scene(NamedTuple):
    """A scene of slabs across z, in place of the parameters of a field.

    Attributes:
      fog: density everywhere.
      wall: where an opaque half-space begins.
      hidden: where an opaque slab begins and ends.
    """

    fog: float = 0.0
    wall: float = np.inf
    hidden: tuple[float, float] = (np.inf, np.inf)


def _planted_density(scene, config, gaussians):
    """Returns the mean density at the multisamples, as a field averages their features."""
    del config
    z = (2.0 * gaussians.positions[:, 2] - 1.0) * MODEL.radius
    opaque = (z > scene.wall) | ((z > scene.hidden[0]) & (z < scene.hidden[1]))
    return jnp.mean(scene.fog + jnp.where(opaque, 1e5, 0.0))


def _planted_radiance(scene, config, gaussians, direction):
    """Returns the direction as the colour."""
    return Radiance(_planted_density(scene, config, gaussians), direction)


# Compiled apart from the real fields, which are looked up when it is traced.
_compiled_planted = jax.jit(
    lambda params, paths, jitter, anneal, config: pixels.render_paths(
        params, config, paths, jitter, anneal=anneal
    ),
    static_argnames="config",
)


@pytest.fixture
def plant(monkeypatch):
    """Returns a function that renders paths through a planted scene."""
    monkeypatch.setattr(registry, "density", _planted_density)
    monkeypatch.setattr(registry, "radiance", _planted_radiance)

    def render(scene, interior, *paths, anneal=1.0):
        config, paths = _fine(interior), _batch(*paths)
        scene = jax.tree.map(jnp.float32, scene)
        params = Params(proposals=(scene,) * len(config.proposals), field=scene)
        jitter = pixels.no_jitter(config, 4)
        return _compiled_planted(params, paths, jitter, jnp.float32(anneal), config=config)

    return render


def _fine(interior):
    """Returns a model with enough samples to find a wall."""
    rounds = (dataclasses.replace(MODEL.proposals[0], samples=64),)
    return dataclasses.replace(_MODELS[interior], proposals=rounds, samples=32, dilation=0.5)


def _arc_at_z(path, z):
    """Returns the arc length at which the last segment of a path reaches a plane."""
    last = int(path.num_bends)
    start, direction = np.asarray(path.points[last]), np.asarray(path.directions[last])
    return float(path.tau[last]) + (z - start[2]) / direction[2]


_WALL = 4.5


@pytest.mark.slow
@pytest.mark.parametrize("interior", _MODELS)
def test_a_wall_behind_an_object_is_found_at_its_arc_length(plant, interior):
    path = _bent()
    seen = plant(Scene(wall=_WALL), interior, path)
    t = _coordinates(_fine(interior), path, seen.histograms[-1].edges[0])
    holding = int(np.argmax(seen.histograms[-1].weights[0]))
    width = t[holding + 1] - t[holding]
    assert width < 0.1
    np.testing.assert_allclose(seen.composite.median[0], _arc_at_z(path, _WALL), atol=width)
    np.testing.assert_allclose(seen.composite.mean[0], _arc_at_z(path, _WALL), atol=width)


@pytest.mark.slow
def test_what_hides_in_an_object_is_seen_by_the_field_interior_only(plant):
    # The object reaches from z = -1 to 0.92.
    path, scene = _bent(), Scene(wall=_WALL, hidden=(-0.05, 0.8))
    inside = 3.0 + 0.95 / float(path.directions[1, 2])
    for interior, expected in [("field", inside), ("clear", _arc_at_z(path, _WALL))]:
        seen = plant(scene, interior, path)
        np.testing.assert_allclose(seen.composite.median[0], expected, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("interior", _MODELS)
def test_colour_is_asked_with_the_direction_at_the_middle_of_an_interval(plant, interior):
    paths = [_tree_item(_some_paths(), index) for index in range(4)]
    seen = plant(Scene(fog=1.0), interior, *paths)
    for index, path in enumerate(paths):
        t = _coordinates(_fine(interior), path, seen.histograms[-1].edges[index])
        middles = 0.5 * (t[1:] + t[:-1])
        directions = np.array([_walk(path, x, interior=interior)[1] for x in middles])
        expected = np.asarray(seen.histograms[-1].weights[index]) @ directions
        np.testing.assert_allclose(seen.composite.rgb[index], expected, atol=_SUMMATION)


def test_weights_follow_from_densities_and_lengths(plant):
    # 0.8 per scene radius everywhere, and an opaque end.
    seen = plant(Scene(fog=0.8), "field", _bent())
    for histogram in seen.histograms:
        t = _coordinates(_FIELD, _bent(), histogram.edges[0])
        lengths = np.diff(t) / _FIELD.radius
        expected = reference_sampling.alpha_weights(np.full(lengths.size, 0.8), lengths)
        expected[-1] = 1.0 - expected[:-1].sum()
        np.testing.assert_allclose(histogram.weights[0], expected, atol=_SUMMATION)


def test_an_empty_scene_shows_its_far_end(plant):
    seen = plant(Scene(), "field", _bent())
    weights = np.asarray(seen.histograms[-1].weights[0])
    np.testing.assert_array_equal(weights, np.eye(weights.size)[-1])
    start, end = _coordinates(_FIELD, _bent(), seen.histograms[-1].edges[0])[-2:]
    np.testing.assert_allclose(seen.composite.median[0], 0.5 * (start + end), rtol=_DISTANCE)
    np.testing.assert_allclose(seen.composite.rgb[0], _bent().directions[2], atol=_SUMMATION)


# --- annealing and jitter ---


def _jitter(offsets, rotations=None):
    rotations = np.zeros_like(offsets) if rotations is None else rotations
    return Jitter(*(jnp.asarray(x, jnp.float32) for x in (offsets, rotations)))


def test_no_trust_in_proposals_means_even_samples():
    seen = _render(_FIELD, _straight_paths(), anneal=0.0)
    for histogram in seen.histograms:
        count = histogram.weights.shape[-1]
        expected = np.broadcast_to(np.linspace(0.0, 1.0, count + 1), histogram.edges.shape)
        np.testing.assert_allclose(histogram.edges, expected, atol=_SUMMATION)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("offset", [-0.5, -0.2, 0.4999])
def test_jitter_moves_samples_by_at_most_a_stratum(level, offset):
    paths = _straight_paths()
    offsets = np.zeros((4, 2), np.float32)
    offsets[:, level] = offset
    jitter = _jitter(offsets)
    still = _render(_FIELD, paths, anneal=0.0).histograms[level].edges
    moved = _render(_FIELD, paths, jitter, anneal=0.0).histograms[level].edges
    stratum = 1.0 / (still.shape[-1] - 1)
    shift = (np.asarray(moved) - np.asarray(still)) / stratum
    np.testing.assert_allclose(shift[:, 1:-1], offset, atol=1e-4)
    assert (abs(shift) <= 0.5 + 1e-4).all() and (np.diff(moved, axis=-1) > 0.0).all()
    assert (np.asarray(moved) >= 0.0).all() and (np.asarray(moved) <= 1.0).all()


@pytest.mark.parametrize("offset", [-0.5, -0.2, 0.4999])
def test_jitter_never_cuts_a_path_short(offset):
    jitter = _jitter(np.full((4, 2), offset))
    edges = np.asarray(_render(_FIELD, _straight_paths(), jitter).histograms[0].edges)
    assert (edges[:, 0] == 0.0).all() and (edges[:, -1] == 1.0).all()


def test_jitter_of_trusted_samples_keeps_them_within_their_quantiles():
    paths = _straight_paths()
    jitter = _jitter(np.full((4, 2), 0.3))
    moved = _render(_FIELD, paths, jitter)
    before, after = moved.histograms[0], moved.histograms[1]
    for edges, weights, drawn in zip(before.edges, before.weights, after.edges, strict=True):
        u = (np.arange(_FIELD.samples) + 0.8) / _FIELD.samples
        expected = reference_sampling.sample_intervals(u, edges, weights)
        np.testing.assert_allclose(drawn, expected, atol=1e-5)


def test_rotation_moves_no_interval():
    paths = _straight_paths()
    turned = _jitter(np.zeros((4, 2)), np.ones((4, 2)))
    still, moved = _render(_FIELD, paths), _render(_FIELD, paths, turned)
    np.testing.assert_array_equal(still.histograms[0].edges, moved.histograms[0].edges)
    assert not np.array_equal(still.histograms[0].weights, moved.histograms[0].weights)


# --- scenes around another centre ---


_each_space = pytest.mark.parametrize(
    "space",
    [
        *(pytest.param(space, marks=pytest.mark.slow) for space in ("bounded", "spherical")),
        "unbounded",
    ],
)


@pytest.mark.slow
@_each_space
def test_a_model_that_is_moved_with_its_paths_gives_the_same(space):
    centre = np.array([4.0, -2.0, 8.0], np.float32)
    usual = dataclasses.replace(_FIELD, space=space)
    moved = dataclasses.replace(usual, centre=tuple(centre.tolist()))
    paths = _some_paths()
    away = paths._replace(points=paths.points + np.broadcast_to(centre, paths.points.shape))
    for old, new in zip(
        jax.tree.leaves(_render(usual, paths)), jax.tree.leaves(_render(moved, away)), strict=True
    ):
        # Points near 8 are rounded to 1e-6, and the finest cells of the grids are 1 wide.
        np.testing.assert_allclose(new, old, rtol=1e-4, atol=1e-4)
    assert not np.allclose(
        _render(moved, paths).composite.rgb, _render(usual, paths).composite.rgb, atol=1e-2
    )


@pytest.mark.slow
@_each_space
def test_samples_gradients_and_lookups_of_a_moved_model_are_the_same(space):
    centre = np.array([4.0, -2.0, 8.0], np.float32)
    usual = dataclasses.replace(_FIELD, space=space)
    moved = dataclasses.replace(usual, centre=tuple(centre.tolist()))
    results = []
    for config, shift in ((usual, np.zeros(3, np.float32)), (moved, centre)):
        path = jax.tree.map(jnp.asarray, _bent())
        path = path._replace(points=path.points + np.broadcast_to(shift, path.points.shape))
        found = _first_samples(path, config, 8)

        def density(params, config=config, shift=shift):
            point, towards = jnp.array([1.0, 2.0, -3.0]) + shift, jnp.array([0.0, 0.0, 1.0])
            return look_up(params, config, point, towards, width=0.1).density

        value, gradient = jax.jit(jax.value_and_grad(density))(_params(usual))
        results.append((found.gaussians, found.t, gradient.field, value))
    for old, new in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-4, atol=1e-5)


def test_a_centre_is_finite():
    with pytest.raises(ValueError, match=r"centre is .*inf.* Give three finite numbers"):
        dataclasses.replace(MODEL, centre=(0.0, float("inf"), 0.0))
