import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import path_tracing
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.media import AMBIENT
from refref_jax.optics.path_settings import PAPER, TREE, Detail, PathSettings, everything
from tests.factories import scenes

_CAPACITY = 256


@functools.partial(jax.jit, static_argnames=("settings", "detail"))
def _trace(scene, rays, *, settings=TREE, detail=None):
    return path_tracing.trace(scene, rays, settings=settings, capacity=_CAPACITY, detail=detail)


def _rays(count=40):
    rng = np.random.default_rng(3)
    origins = rng.normal(size=(count, 3))
    origins *= 4.0 / np.linalg.norm(origins, axis=-1, keepdims=True)
    return scenes.rays(origins, rng.normal(size=(count, 3)) * 0.5 - origins)


def _two_balls():
    """Two balls with a gap between them: light may leave one and enter the other."""
    return scenes.build(
        scenes.ball(0.6, subdivisions=2, centre=(0.8, 0.0, 0.0), name="left_glass"),
        scenes.ball(0.6, subdivisions=2, centre=(-0.8, 0.0, 0.0), name="right_water", index=1.33),
    )


def _slow_outside(paths, index):
    """Returns the indices of the segments of one path that run outside, and its last one."""
    bends = int(paths.num_bends[index])
    return [i for i in range(bends + 1) if paths.media[index, i] == AMBIENT or i == bends]


@pytest.mark.slow
def test_only_segments_outside_are_kept():
    whole = _trace(_two_balls(), _rays()).paths
    kept = _trace(_two_balls(), _rays(), detail=Detail("outside", 6)).paths
    np.testing.assert_array_equal(whole.num_bends, kept.num_bends)
    np.testing.assert_array_equal(whole.throughput, kept.throughput)
    seen = set()
    for index in range(_CAPACITY):
        wanted = _slow_outside(whole, index)
        seen.add(len(wanted))
        assert np.isfinite(kept.tau[index]).sum() == len(wanted)
        for place, segment in enumerate(wanted):
            for name in ("points", "directions", "tau", "ends", "media"):
                np.testing.assert_array_equal(
                    getattr(kept, name)[index, place], getattr(whole, name)[index, segment]
                )
    assert seen >= {1, 2, 3}


@pytest.mark.slow
def test_of_too_many_segments_the_first_and_the_last_ones_are_kept():
    whole = _trace(_two_balls(), _rays()).paths
    kept = _trace(_two_balls(), _rays(), detail=Detail("outside", 2)).paths
    for index in range(_CAPACITY):
        wanted = _slow_outside(whole, index)
        ends = wanted if len(wanted) < 2 else [wanted[0], wanted[-1]]
        got = kept.tau[index][np.isfinite(kept.tau[index])]
        np.testing.assert_array_equal(got, whole.tau[index][np.array(ends)])


@pytest.mark.parametrize("settings", [PAPER, TREE])
@pytest.mark.slow
def test_segments_end_where_the_next_ones_begin(settings):
    paths = _trace(
        _two_balls(), _rays(), settings=settings, detail=everything(settings.max_bends)
    ).paths
    used = np.isfinite(paths.tau)
    following = np.append(paths.tau[:, 1:], np.full((_CAPACITY, 1), np.inf), axis=1)
    np.testing.assert_array_equal(paths.ends[used], following[used])
    assert np.all(np.isinf(paths.ends[~used]))


@pytest.mark.slow
def test_meetings_and_passages_are_those_of_the_whole_path():
    """Tints and absorption are put on the paths afterwards, and come to what tracing puts on."""
    settings = PathSettings(
        max_bends=3, reflections="all"
    )  # no cut: colours do not change what is followed
    scene = _two_balls()
    tint = jnp.array([[0.9, 0.5, 0.7], [0.6, 0.95, 1.0]])
    absorption = jnp.array([[0.1, 0.0, 2.0], [0.3, 0.4, 0.0]])
    dyed = scene._replace(interfaces=scene.interfaces._replace(tint=tint, absorption=absorption))
    detail = Detail("outside", 4, tally="parts")
    white = _trace(scene, _rays(), settings=settings, detail=detail).paths
    coloured = _trace(dyed, _rays(), settings=settings).paths
    factor = np.exp(
        np.asarray(white.hit_counts) @ np.log(tint) - np.asarray(white.path_lengths) @ absorption
    )
    # A path that ran out of bends inside a body goes on through it, and is not dimmed there.
    np.testing.assert_allclose(white.throughput * factor, coloured.throughput, atol=2e-6)
    assert white.hit_counts.max() == 3.0 and white.path_lengths.max() > 1.0


@pytest.mark.slow
def test_nothing_is_tallied_unless_asked():
    paths = _trace(_two_balls(), _rays()).paths
    assert paths.hit_counts.shape == paths.path_lengths.shape == (_CAPACITY, 0)


@pytest.mark.slow
def test_a_promise_of_no_reentry_changes_casts_only():
    ball = scenes.build(scenes.ball(1.0, subdivisions=3))
    never = PathSettings(max_bends=24, reflections="all", min_throughput=0.02, reentry="impossible")
    a, b = (path_tracing.trace_ends(ball, _rays(), settings=settings) for settings in (TREE, never))

    def sorted_weights(traced):
        escaped = traced.ends.statuses == PathStatus.ESCAPED
        return np.sort(np.asarray(traced.ends.throughput)[np.asarray(escaped), 0])

    np.testing.assert_allclose(sorted_weights(a), sorted_weights(b), atol=1e-6)
    escaped = int(np.sum(a.ends.statuses == PathStatus.ESCAPED))
    assert int(a.casts) - int(b.casts) == escaped > 40


def test_a_detail_without_room_is_refused():
    with pytest.raises(ValueError, match="at least one segment"):
        Detail("outside", 0)
