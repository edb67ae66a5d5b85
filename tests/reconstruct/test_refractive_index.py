"""The index of refraction: found by descent, from anywhere, with an honest error bar."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.reconstruct import ReconstructionError, refractive_index
from refref_jax.reconstruct.refractive_index import (
    IndexSearch,
    descend,
    estimate_index,
    most_looks,
    scatter_of_bottoms,
)
from tests.factories import lit_scenes, scenes

# None of the rungs is the truth.
_TRUE = 1.473


@pytest.fixture(scope="module")
def ball():
    return scenes.build(scenes.ball(1.0, index=_TRUE, subdivisions=4))


@pytest.fixture(scope="module")
def seen(ball):
    return lit_scenes.evidence(ball)


@pytest.mark.slow
def test_errors_vanish_at_the_truth_alone(ball, seen):
    evidence, _ = seen

    def mean(index):
        found = refractive_index.errors_at_index(
            np.float32(index), evidence, ball, part=0, config=lit_scenes.CONFIG
        )
        assert np.all(np.isfinite(found)) and np.all(np.asarray(found) >= 0.0)
        return float(jnp.mean(found))

    assert mean(_TRUE) < 2e-3
    assert min(mean(_TRUE - 0.02), mean(_TRUE + 0.02)) > 3.0 * mean(_TRUE)


@pytest.mark.parametrize("index", [1.01, 1.3, 1.6, 2.8])
@pytest.mark.slow
def test_the_slope_is_that_of_the_errors(ball, seen, index):
    evidence, _ = seen
    given = {"part": 0, "config": lit_scenes.CONFIG}
    found = refractive_index.slope_at_index(np.float32(index), evidence, ball, **given)
    assert np.isfinite(found.slope)
    one, other = (
        float(jnp.mean(refractive_index.errors_at_index(np.float32(at), evidence, ball, **given)))
        for at in (index - 2e-3, index + 2e-3)
    )
    # The field's own kinks, and rays that change triangle, make differences coarse.
    assert float(found.slope) == pytest.approx((other - one) / 4e-3, rel=0.5, abs=0.1)


@pytest.mark.parametrize("start", [None, 1.2, 2.0])
@pytest.mark.slow
def test_the_index_is_found_from_any_start(ball, seen, start):
    evidence, views = seen
    looks = []
    search = IndexSearch(spacing=0.1, descents=2)
    found = estimate_index(
        evidence,
        ball,
        views,
        part=0,
        config=lit_scenes.CONFIG,
        search=search,
        start=start,
        progress=lambda done, total: looks.append((done, total)),
    )
    assert found.index == pytest.approx(_TRUE, abs=2e-3)
    assert 0.0 < found.deviation < 5e-3
    assert found.error == min(way.errors[-1] for way in found.descents)
    assert len(found.descents) == 2 + (start is not None)
    assert start is None or start in [way.indices[0] for way in found.descents]
    assert [done for done, _ in looks] == list(range(1, len(looks) + 1))
    assert len(looks) <= looks[0][1] == most_looks(search, start=start)


@pytest.mark.slow
def test_no_pixels_and_no_light_are_refused(ball, seen):
    evidence, views = seen
    nothing = jax.tree.map(lambda x: x[:0], evidence.rays)
    with pytest.raises(ReconstructionError, match="No pixel sees the object"):
        estimate_index(
            evidence._replace(rays=nothing, rgb=evidence.rgb[:0]),
            ball,
            views[:0],
            part=0,
            config=lit_scenes.CONFIG,
        )
    with pytest.raises(ReconstructionError, match="No error of a pixel is finite"):
        estimate_index(
            evidence._replace(rgb=evidence.rgb * jnp.nan),
            ball,
            views,
            part=0,
            config=lit_scenes.CONFIG,
            search=IndexSearch(spacing=0.5),
        )


def _valley(bottom):
    return lambda at: (abs(at - bottom), math.copysign(1.0, at - bottom))


@pytest.mark.parametrize("start", [1.2, 1.47, 2.0])
def test_a_descent_ends_in_the_valley_and_never_climbs(start):
    way = descend(_valley(1.4733), start, IndexSearch())
    assert way.indices[0] == start and way.indices[-1] == pytest.approx(1.4733, abs=5e-4)
    assert np.all(np.diff(way.errors) < 0.0)


@pytest.mark.parametrize(
    ("start", "ends"), [(0.5, 1.01), (9.0, 2.8)], ids=["below the ladder", "above it"]
)
def test_a_start_beyond_what_is_believed_is_moved(start, ends):
    flat = descend(lambda at: (1.0, 0.0), start, IndexSearch())
    assert flat.indices == (ends,)


@pytest.mark.parametrize("slope", [math.nan, math.inf])
def test_a_descent_stops_where_there_is_no_slope(slope):
    assert descend(lambda at: (1.0, slope), 1.5, IndexSearch()).indices == (1.5,)


def test_the_scatter_of_known_parabolas():
    # Ten views whose bottoms lie 1e-3 apart: the standard error of their mean.
    bottoms = 1e-3 * np.arange(10)
    rows = [np.repeat((at - bottoms) ** 2, 5) for at in (-0.01, 0.0, 0.01)]
    found = scatter_of_bottoms(np.stack(rows), np.repeat(np.arange(10), 5), 0.01)
    assert found == pytest.approx(bottoms.std(ddof=1) / np.sqrt(10.0), rel=1e-6)


@pytest.mark.parametrize("curvature", [0.0, -1.0])
def test_no_valley_has_no_error_bar(curvature):
    rows = np.stack([np.full(20, curvature * at**2) for at in (-0.01, 0.0, 0.01)])
    assert scatter_of_bottoms(rows, np.arange(20), 0.01) == math.inf


def test_one_view_has_no_error_bar():
    rows = np.stack([np.full(20, at**2) for at in (-0.01, 0.0, 0.01)])
    assert scatter_of_bottoms(rows, np.zeros(20, np.int64), 0.01) == math.inf


@pytest.mark.parametrize(
    "wrong", [{"lowest": 0.9}, {"highest": 3.5}, {"spacing": 0.0}, {"descents": 0}]
)
def test_a_wrong_search_is_refused(wrong):
    with pytest.raises(ReconstructionError):
        dataclasses.replace(IndexSearch(), **wrong)
