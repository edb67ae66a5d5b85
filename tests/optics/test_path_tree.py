"""All branches of light: closed forms, conservation, and lists that are too small."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from refref_jax.optics import media, path_tracing, path_tree, wavefront
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import PAPER, PATH_PRESETS, TREE, PathSettings, capacities
from tests.factories import scenes

pytestmark = pytest.mark.longest

_GLASS = 0.04
"""Fresnel's R of glass head-on."""


@functools.partial(jax.jit, static_argnames=("settings", "block"))
def _trace_ends(scene, rays, *, settings, block=8192):
    return path_tracing.trace_ends(scene, rays, settings=settings, block=block)


def _ends(scene, rays, **options):
    traced = jax.tree.map(np.asarray, _trace_ends(scene, rays, **options))
    there = traced.ends.statuses != PathStatus.EMPTY
    return jax.tree.map(lambda x: x[there], traced.ends), traced


def _generous(settings):
    """Returns a budget with room for the paths of few rays, all of which meet glass."""
    return dataclasses.replace(
        settings, live_per_ray=50.0, segments_per_ray=90.0, paths_per_ray=50.0
    )


@functools.cache
def _ball():
    return scenes.build(scenes.ball(1.0))


def _slab(**changes):
    part = scenes.box((20.0, 20.0, 0.5), index=1.5)._replace(**changes)
    return scenes.build(part)


def _down():
    return scenes.rays([0.3, 0.2, 3.0], [0.0, 0.0, -1.0])


def _towards_a_ball(count=64):
    generator = np.random.default_rng(1)
    targets = generator.uniform(-0.7, 0.7, (count, 3))
    return scenes.rays([-4.0, 0.0, 0.0], targets + np.array([4.0, 0.0, 0.0]))


def _sums(ends, traced):
    sums = traced.dropped.copy()
    np.add.at(sums, ends.rays, ends.throughput)
    return sums


def test_a_slab_sends_light_both_ways_by_the_geometric_series():
    # One ray has more paths than the mean ray of an image.
    ends, traced = _ends(_slab(), _down(), settings=_generous(PathSettings(5, "all")))
    r, t = _GLASS, 1.0 - _GLASS
    # Out by the top: at once, after 1 and after 3 inner reflections; by the bottom: after 0 and 2.
    escaped = ends.statuses == PathStatus.ESCAPED
    up = np.sort(ends.throughput[escaped & (ends.directions[:, 2] > 0), 0])
    down = np.sort(ends.throughput[escaped & (ends.directions[:, 2] < 0), 0])
    np.testing.assert_allclose(up, [t * t * r**3, t * t * r, r], rtol=1e-4)
    np.testing.assert_allclose(down, [t * t * r * r, t * t], rtol=1e-4)
    trapped = ends.throughput[ends.statuses == PathStatus.OUT_OF_BENDS, 0]
    np.testing.assert_allclose(trapped, [t * r**4], rtol=1e-4)
    assert traced.casts == 11
    np.testing.assert_allclose(_sums(ends, traced), 1.0, atol=1e-6)


@pytest.mark.slow
def test_the_throughput_of_black_truncated_paths_is_dropped():
    kept, _ = _ends(_slab(), _down(), settings=_generous(PathSettings(5, "all")))
    ends, traced = _ends(
        _slab(), _down(), settings=_generous(PathSettings(5, "all", truncated_paths="black"))
    )
    r, t = _GLASS, 1.0 - _GLASS
    trapped = ends.statuses == PathStatus.OUT_OF_BENDS
    assert trapped.sum() == 1 and not ends.throughput[trapped].any()
    np.testing.assert_array_equal(ends.throughput[~trapped], kept.throughput[~trapped])
    np.testing.assert_allclose(traced.dropped, t * r**4, rtol=1e-4)
    np.testing.assert_allclose(_sums(ends, traced), 1.0, atol=1e-6)


_CUT = PathSettings(5, "all", min_throughput=0.039)


@pytest.mark.slow
def test_a_cut_branch_leaves_its_share_to_its_sibling():
    ends, traced = _ends(_slab(), _down(), settings=_CUT)
    # The inner reflection, 0.96 * 0.04, is below the cut: what enters leaves below, whole.
    np.testing.assert_allclose(np.sort(ends.throughput[:, 0]), [0.04, 0.96], atol=1e-6)
    assert traced.casts == 4
    # The first one too, of a slab that reflects 0.0383.
    ends, _ = _ends(_slab(index=1.487), _down(), settings=_CUT)
    np.testing.assert_array_equal(ends.throughput, 1.0)


@pytest.mark.slow
def test_where_both_branches_are_below_the_cut_the_stronger_one_takes_all():
    ends, _ = _ends(_slab(tint=(0.04, 0.03, 0.02)), _down(), settings=_CUT)
    np.testing.assert_allclose(ends.throughput, [[0.0016, 0.0009, 0.0004]], rtol=1e-5)
    assert ends.directions[0, 2] < 0.0


def test_the_tint_colours_every_crossing_and_every_reflection():
    tint = np.array([0.5, 0.8, 0.95])
    ends, _ = _ends(_slab(tint=tuple(tint)), _down(), settings=_generous(PathSettings(5, "all")))
    r, t = _GLASS, 1.0 - _GLASS
    expected = {1: r * tint, 2: t * t * tint**2, 3: t * t * r * tint**3}
    for bends, weight in expected.items():
        escaped = (ends.num_bends == bends) & (ends.statuses == PathStatus.ESCAPED)
        np.testing.assert_allclose(ends.throughput[escaped], weight[None], rtol=1e-4)


def test_absorption_takes_light_by_the_length_of_the_way_inside():
    absorption = np.array([0.0, 1.0, 3.0])
    sines = np.array([0.0, 0.6, -0.6, 0.3])
    towards = np.stack([sines, 0.0 * sines, -np.sqrt(1.0 - sines**2)], axis=-1)
    rays = scenes.rays([0.0, 0.0, 3.0], towards)
    slab = _slab(absorption=tuple(absorption))
    ends, _ = _ends(slab, rays, settings=PathSettings(10, "none"))
    lengths = 0.5 / np.sqrt(1.0 - (sines / 1.5) ** 2)
    assert sorted(ends.rays) == [0, 1, 2, 3]
    expected = np.exp(-lengths[ends.rays, None] * absorption)
    np.testing.assert_allclose(ends.throughput, expected, rtol=1e-5)


def test_an_opaque_tint_leaves_no_path():
    ends, traced = _ends(
        _slab(tint=(0.0, 0.0, 0.0)), _down(), settings=_generous(PathSettings(5, "all"))
    )
    assert len(ends.rays) == 0
    assert np.all(traced.dropped == 0.0)


@pytest.mark.slow
def test_a_total_reflection_may_end_the_path():
    scene = scenes.build(scenes.right_prism())
    rays = scenes.rays([-2.0, 0.1, 0.3], [1.0, 0.0, 0.0])
    settings = PathSettings(10, "none", total_reflection="ended")
    ends, _ = _ends(scene, rays, settings=settings)
    assert ends.statuses[0] == PathStatus.TOTALLY_REFLECTED
    np.testing.assert_allclose(ends.directions[0], [1.0, 0.0, 0.0], atol=1e-6)
    followed, _ = _ends(scene, rays, settings=PathSettings(10, "none"))
    assert followed.statuses[0] == PathStatus.ESCAPED
    np.testing.assert_allclose(followed.directions[0], [0.0, 0.0, -1.0], atol=1e-6)


@pytest.mark.slow
def test_the_papers_ablations_differ_from_its_budget_in_one_thing_each():
    changed = {
        name: {
            field.name
            for field in dataclasses.fields(PathSettings)
            if getattr(PATH_PRESETS[name], field.name) != getattr(PAPER, field.name)
        }
        for name in ("paper_no_reflection", "paper_no_tir")
    }
    assert changed == {
        "paper_no_reflection": {"reflections"},
        "paper_no_tir": {"total_reflection"},
    }
    rays = scenes.rays([-2.0, 0.1, 0.3], [1.0, 0.0, 0.0])
    followed = {
        name: _ends(scenes.build(scenes.right_prism()), rays, settings=PATH_PRESETS[name])[0]
        for name in ("paper", *changed)
    }
    count = {name: len(ends.rays) for name, ends in followed.items()}
    assert count == {"paper": 2, "paper_no_reflection": 1, "paper_no_tir": 2}
    main = {
        name: ends.directions[np.argmax(ends.throughput[:, 0])] for name, ends in followed.items()
    }
    np.testing.assert_allclose(main["paper"], [0.0, 0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(main["paper_no_reflection"], [0.0, 0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(main["paper_no_tir"], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(followed["paper_no_reflection"].throughput, 1.0, atol=1e-6)


@pytest.mark.slow
def test_light_that_goes_round_inside_a_ball_ends_by_its_budget():
    # As many rays as others send into the ball: one program.
    inside = scenes.rays(np.tile([0.98, 0.0, 0.0], (64, 1)), [0.0, 1.0, 0.0])
    ends, traced = _ends(_ball(), inside, settings=_generous(TREE))
    assert ends.statuses.tolist() == 64 * [PathStatus.OUT_OF_BENDS]
    np.testing.assert_array_equal(ends.num_bends, TREE.max_bends)
    assert traced.casts == 64 * (TREE.max_bends + 1)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(PAPER, marks=pytest.mark.slow),
        TREE,
        pytest.param(PathSettings(6, "all"), marks=pytest.mark.slow),
        pytest.param(PathSettings(6, "all", min_throughput=0.3), marks=pytest.mark.slow),
    ],
)
def test_untinted_light_is_conserved(settings):
    ends, traced = _ends(_ball(), _towards_a_ball(), settings=_generous(settings))
    np.testing.assert_array_equal(traced.dropped, 0.0)
    np.testing.assert_allclose(_sums(ends, traced), 1.0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "short_of",
    [
        "live_per_ray",
        "segments_per_ray",
        "paths_per_ray",
    ],
)
def test_a_list_that_is_too_small_drops_the_least_light_and_returns_it(short_of):
    generous = _generous(PathSettings(6, "all"))
    scarce = dataclasses.replace(generous, **{short_of: 1.5})
    scene, rays = _ball(), _towards_a_ball()
    full, nothing_lost = _ends(scene, rays, settings=generous)
    ends, traced = _ends(scene, rays, settings=scarce)
    assert np.all(nothing_lost.dropped == 0.0)
    assert traced.dropped.max() > 0.0
    np.testing.assert_allclose(_sums(ends, traced), 1.0, atol=1e-5)
    if short_of == "paths_per_ray":
        assert len(ends.rays) == capacities(scarce, 64).paths
        strongest = np.sort(full.throughput[:, 0])[::-1][: len(ends.rays)]
        np.testing.assert_allclose(np.sort(ends.throughput[:, 0])[::-1], strongest, rtol=1e-5)


def _by_ray(ends):
    order = np.lexsort((ends.directions[:, 0], -ends.throughput[:, 0], ends.rays))
    return jax.tree.map(lambda x: x[order], ends)


@pytest.mark.parametrize("block", [1, 7, 64])
@pytest.mark.slow
def test_the_block_of_a_round_changes_nothing(block):
    scene = scenes.build(scenes.box((1.0, 1.2, 1.4)))
    rays = _towards_a_ball(32)
    expected, all_at_once = _ends(scene, rays, settings=TREE)
    found, in_blocks = _ends(scene, rays, settings=TREE, block=block)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), _by_ray(found), _by_ray(expected)
    )
    assert in_blocks.casts == all_at_once.casts


@pytest.mark.slow
def test_accelerators_cast_all_rays_at_once_into_lists_of_the_same_size(monkeypatch):
    # Of a CPU, two blocks of 16.
    monkeypatch.setattr(wavefront, "_BLOCK_ON_CPU", 16)
    scene, rays = scenes.build(scenes.box((1.0, 1.2, 1.4))), _towards_a_ball(32)
    settings = dataclasses.replace(TREE, max_bends=2)
    inside = np.broadcast_to(np.asarray(media.empty_interior_list(scene.interfaces)), (32, 0))
    kind = wavefront._Kind(settings, "cone")
    trees = [
        jax.jit(functools.partial(follow, kind=kind))(scene, rays, inside)
        for follow in (wavefront._at_once, wavefront._in_cached_blocks)
    ]
    once, in_blocks = trees
    assert jax.tree.map(np.shape, once) == jax.tree.map(np.shape, in_blocks)
    assert once.casts == in_blocks.casts and once.ends.count == in_blocks.ends.count
    found = [np.sort(tree.ends.items.throughput[: tree.ends.count, 0]) for tree in trees]
    np.testing.assert_allclose(*found, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("segments_per_ray", [2.0, 90.0])
def test_last_segments_are_the_same_if_others_are_not_stored(segments_per_ray):
    scene, rays = scenes.build(scenes.box((1.0, 1.2, 1.4))), _towards_a_ball(32)
    settings = dataclasses.replace(_generous(TREE), max_bends=4, segments_per_ray=segments_per_ray)
    inside = np.broadcast_to(np.asarray(media.empty_interior_list(scene.interfaces)), (32, 0))
    found = []
    for segments in ("all", "last"):
        follow = functools.partial(wavefront.follow, settings=settings, segments=segments)
        tree = jax.jit(follow)(scene, rays, inside)
        ends = path_tree.listed(tree, capacities(settings, 32).paths)
        found.append((path_tree.last_segments(tree.segments.items, ends), tree.dropped, tree.casts))
        assert (tree.segments.items is not None) == (segments == "all")
    there = found[0][0].statuses != PathStatus.EMPTY
    assert (found[0][1].max() > 0.0) == (segments_per_ray < 90.0)
    for one, other in zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True):
        assert np.all(np.isfinite(other))
        pick = there if len(one.shape) and len(one) == len(there) else ...
        np.testing.assert_array_equal(one[pick], other[pick])


@pytest.mark.slow
def test_a_stack_holds_as_many_rays_as_there_can_be():
    scene, rays = scenes.build(scenes.box((1.0, 1.2, 1.4))), _towards_a_ball(16)
    settings = dataclasses.replace(_generous(TREE), max_bends=6, min_throughput=0.0)
    assert wavefront._capacities(settings, 16, 1).live == 16 + 2 * 6
    assert wavefront._capacities(settings, 16, 16).live == 16 + 2 * 16 * 6
    assert wavefront._capacities(settings, 16, 512).live == capacities(settings, 16).live
    for block in (1, 4):
        ends, traced = _ends(scene, rays, settings=settings, block=block)
        assert len(ends.rays) > 16 * 6 and np.all(traced.dropped == 0.0)


@pytest.mark.slow
def test_ends_are_the_last_segments_of_the_paths():
    scene, rays = _ball(), _towards_a_ball()
    ends, _ = _ends(scene, rays, settings=TREE)
    trace = functools.partial(path_tracing.trace, settings=TREE, capacity=len(ends.rays))
    paths = jax.tree.map(np.asarray, jax.jit(trace)(scene, rays).paths)
    each = np.arange(len(paths.num_bends))
    lines = ends._replace(
        origins=paths.points[each, paths.num_bends],
        directions=paths.directions[each, paths.num_bends],
        tau=paths.tau[each, paths.num_bends],
        media=paths.media[each, paths.num_bends],
        rays=paths.rays,
        throughput=paths.throughput,
        num_bends=paths.num_bends,
        statuses=paths.statuses,
    )
    jax.tree.map(np.testing.assert_array_equal, _by_ray(lines), _by_ray(ends))


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_no_wall_of_a_ten_thousandth_of_its_body_is_skipped(size):
    body = scenes.box((2.0 * size, 2.0 * size, 2e-4 * size))
    angles = np.radians([0.0, 30.0, 60.0, 85.0])
    directions = np.stack([np.sin(angles), 0.1 * np.sin(angles), -np.cos(angles)], axis=-1)
    rays = scenes.rays(-3.0 * size * directions, directions)
    ends, _ = _ends(scenes.build(body), rays, settings=PathSettings(10, "none"))
    np.testing.assert_array_equal(ends.num_bends, 2)
    np.testing.assert_array_equal(ends.statuses, PathStatus.ESCAPED)
    np.testing.assert_allclose(ends.directions, rays.directions, atol=2e-6)


def test_budgets_refuse_what_makes_no_sense():
    for options, reason in [
        ({"max_bends": -1}, "max_bends"),
        ({"min_throughput": 1.0}, "min_throughput"),
        ({"min_throughput": -0.1}, "min_throughput"),
        ({"min_throughput": float("nan")}, "min_throughput"),
        ({"paths_per_ray": 0.5}, "paths_per_ray"),
        ({"live_per_ray": float("inf")}, "live_per_ray"),
    ]:
        with pytest.raises(ValueError, match=reason):
            PathSettings(**{"max_bends": 3, "reflections": "all", **options})


def test_nothing_is_nan_for_rays_that_meet_nothing_or_start_on_a_surface():
    scene = scenes.build(scenes.box())
    rays = scenes.rays(
        [[0.5, 0.1, 0.2], [0.5, 0.5, 0.5], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        [[1.0, 0.0, 0.0], [-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
    )
    with jax.debug_nans(True):
        ends, traced = _ends(scene, rays, settings=TREE)
    np.testing.assert_allclose(_sums(ends, traced), 1.0, atol=1e-5)
    assert all(np.all(np.isfinite(x)) for x in (ends.origins, ends.directions, ends.tau))
