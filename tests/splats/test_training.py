"""The loss, the moves and relocations of Gaussians, their start, and the loop."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax import metrics
from refref_jax.geometry.cameras import orbit
from refref_jax.sampling.scene_bounds import Domain
from refref_jax.splats import gaussians as splats
from refref_jax.splats import images, training
from tests.factories import made_splats
from tests.laws import expectations, gradients

pytestmark = pytest.mark.loose

_CAMERAS = orbit(4, distance=4.0, elevation=0.3, size=24, angle_x=1.1656)
_DOMAIN = Domain(7.3, "bounded")


def _targets():
    """Returns four images of smooth colours."""
    frame, row, column = np.indices((4, 24, 24))
    return np.stack([row * 10, column * 10, 60 * frame], axis=-1).astype(np.uint8)


def _setup(**changes):
    given = {"seed": 3, "steps": 60, "kernel": "mip", "centre": (0.0, 0.0, 0.0)} | changes
    return training.set_up(_CAMERAS, _targets(), **given)


def _begun(count=200):
    return training.init_state(splats.start(0, count, _CAMERAS, _DOMAIN))


def _last(setup, state, until, every=(5,)):
    *_, last = training.run_steps(setup, state, until, every=every)
    return last


@pytest.mark.slow
def test_the_similarity_is_that_of_the_metric():
    draw = np.random.default_rng(0)
    target = draw.uniform(size=(30, 21, 3)).astype(np.float32)
    noisy = np.clip(target + 0.1 * draw.normal(size=target.shape), 0, 1).astype(np.float32)
    with jax.enable_x64(True):
        exact = float(metrics.ssim(jnp.float64(noisy), jnp.float64(target)))
    noisy, target = jnp.asarray(noisy), jnp.asarray(target)
    found, slopes = jax.jit(jax.value_and_grad(training.similarity))(noisy, target)
    assert float(found) == pytest.approx(exact, abs=2e-5) and 0.5 < exact < 0.99
    assert gradients.all_finite(slopes) and np.any(slopes)
    assert float(training.similarity(target, target)) == pytest.approx(1.0, abs=1e-6)
    gradients.assert_numerical(training.similarity, noisy[:12, :11], target[:12, :11], rtol=1e-3)


def test_images_smaller_than_the_window_are_refused():
    with pytest.raises(ValueError, match="24 x 8 pixels, but the loss of Gaussian splats needs 11"):
        training.set_up(
            _CAMERAS, _targets()[:, :8], seed=0, steps=1, kernel="mip", centre=(0.0, 0.0, 0.0)
        )


@pytest.mark.parametrize("count", [1, 2, 3, 10, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_opacity_and_scale_of_a_shared_place_are_those_of_the_paper(count, opacity):
    new, factor = training.shared(jnp.float32(opacity), jnp.int32(count))
    expected = 1.0 - (1.0 - opacity) ** (1.0 / count)
    assert float(new) == pytest.approx(expected, rel=1e-4)
    total = sum(
        math.comb(i - 1, k) * (-1.0) ** k * expected ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, count + 1)
        for k in range(i)
    )
    assert float(factor) == pytest.approx(opacity / total, rel=2e-3)
    if count == 1:
        assert float(factor) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [0.4, 0.8])
def test_a_relocation_preserves_the_image(opacity):
    """One opaque Gaussian and two transparent ones, which move to it."""
    alone = made_splats.one((0, 0, 2), scale=0.3, opacity=opacity)
    dead = [made_splats.one((0.4, 0.1 * n, 2), opacity=0.001) for n in range(2)]
    values = made_splats.joined(alone, *dead)
    moments = training.init_state(values).moments
    relocate = jax.jit(training.relocate)
    after, _, count = relocate(jax.random.key(0), values, moments)
    assert int(count) == 2
    np.testing.assert_allclose(after.means, np.tile([[0, 0, 2]], (3, 1)))
    grid = images.grid_of(24, 24)
    blend = jax.jit(functools.partial(images.blend, grid=grid, capacity=500, kernel="classic"))
    first, second = (blend(each, made_splats.AHEAD)[0] for each in (values, after))
    assert first.transmittance.min() < 1.0 - 0.9 * opacity
    difference = np.abs(np.asarray(first.transmittance - second.transmittance))
    assert difference.mean() < 1e-2
    assert difference[11:13, 11:13].max() < 1e-2


@pytest.mark.parametrize("count", [2, 5, 20])
@pytest.mark.parametrize("opacity", [0.3, 0.9])
def test_sharing_preserves_the_opacity_along_a_line(count, opacity):
    """The definition of the scale: the opacity of the many has the integral of that of the one."""
    new, factor = (float(x) for x in training.shared(jnp.float32(opacity), jnp.int32(count)))
    place = np.linspace(-8.0, 8.0, 20_001)
    one = opacity * np.exp(-0.5 * place**2)
    many = 1.0 - (1.0 - new * np.exp(-0.5 * (place / factor) ** 2)) ** count
    assert many.max() == pytest.approx(one.max(), rel=1e-4)
    assert many.sum() == pytest.approx(one.sum(), rel=1e-2)


@pytest.mark.slow
def test_draws_have_their_chances_and_none_is_impossible():
    count = 300_000
    chances = jnp.where(jnp.arange(count) % 3 == 0, 0.0, jnp.linspace(0.1, 1.0, count))
    drawn = np.asarray(jax.jit(training._draw)(jax.random.key(2), chances))
    assert drawn.shape == (count,) and np.all(drawn % 3 > 0)
    # Tenths of the indices; four standard deviations of the least of them are 2.4 %.
    found = np.bincount(drawn * 10 // count, minlength=10) / count
    share = np.asarray(chances, np.float64).reshape(10, -1).sum(1) / float(chances.sum())
    np.testing.assert_allclose(found, share, rtol=0.025)
    for impossible in (jnp.zeros(5), jnp.zeros(5).at[3].set(1e-30)):
        few = np.asarray(training._draw(jax.random.key(0), impossible))
        assert np.all((few >= 0) & (few < 5)) and (impossible.sum() == 0 or np.all(few == 3))


def test_relocations_hold_no_number_for_each_pair():
    _, values, moments = jax.eval_shape(lambda: _begun(20_000))
    compiled = jax.jit(training.relocate).lower(jax.random.key(0), values, moments).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 2**27


@pytest.mark.slow
def test_a_relocation_resets_the_moments_of_those_that_share_a_place():
    values = made_splats.gaussians(50)
    logits = values.logits.at[:10].set(-8.0).at[10:].set(jnp.linspace(-2.0, 3.0, 40))
    values = values._replace(logits=logits)
    begun = training.init_state(values).moments
    moments = begun._replace(mu=jax.tree.map(lambda x: x + 1.0, begun.mu))
    after, kept, count = jax.jit(training.relocate)(jax.random.key(1), values, moments)
    assert int(count) == 10
    source = np.array([np.argmin(np.abs(values.means - x[None]).sum(-1)) for x in after.means])
    assert np.all(source[:10] >= 10) and np.all(source[10:] == np.arange(10, 50))
    changed = np.isin(np.arange(50), [*range(10), *source[:10]])
    for leaf in jax.tree.leaves(kept.mu):
        assert not np.any(np.asarray(leaf)[changed]) and np.all(np.asarray(leaf)[~changed] == 1.0)
    assert np.all((after.logits < values.logits[source])[changed])
    for ours, theirs in zip(after, values, strict=True):
        np.testing.assert_array_equal(np.asarray(ours)[~changed], np.asarray(theirs)[~changed])
    # Without any that is opaque, nothing moves.
    faint = values._replace(logits=jnp.full(50, -8.0))
    same, _, none = jax.jit(training.relocate)(jax.random.key(1), faint, moments)
    assert int(none) == 0
    expectations.assert_same(same, faint)


def test_moves_are_along_the_own_axes_and_limited():
    count = 400
    values = made_splats.gaussians(count)
    needle = jnp.log(jnp.tile(jnp.float32([[0.2, 1e-4, 1e-4]]), (count, 1)))
    values = values._replace(log_scales=needle, logits=jnp.full(count, -9.0))
    turn = jnp.tile(jnp.float32([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]]), (count, 1))
    values = values._replace(quaternions=turn)
    move = jax.jit(functools.partial(training.moved, jax.random.key(0)))
    by = np.asarray(move(values, rate=jnp.float32(1e-4)).means - values.means)
    # A quarter turn about z takes the long axis from x to y.
    assert np.abs(by[:, 0]).max() < 1e-3 and by[:, 1].std() > 0.05
    assert np.abs(by).max() <= 0.1 + 1e-6
    still = values._replace(logits=jnp.full(count, 3.0))
    np.testing.assert_array_equal(move(still, rate=jnp.float32(1e-4)).means, still.means)


@pytest.mark.parametrize("space", ["bounded", "spherical", "unbounded"])
def test_gaussians_start_on_the_background_and_around_the_centre(space):
    centre = (1.0, -2.0, 0.5)
    cameras = _CAMERAS._replace(poses=_CAMERAS.poses + np.eye(3, 4, 3)[None] * 0.0)
    cameras = cameras._replace(poses=cameras.poses.copy())
    cameras.poses[:, :, 3] += centre
    made = splats.start(5, 1000, cameras, Domain(7.3, space, centre))
    away = np.asarray(made.means) - centre
    behind, inside = away[:700], away[700:]
    reach = {"bounded": 7.3, "spherical": 7.3, "unbounded": 1000.0}[space]
    length = np.abs(behind).max(axis=1) if space == "bounded" else np.linalg.norm(behind, axis=1)
    np.testing.assert_allclose(length, reach, rtol=1e-4)
    assert np.all(np.abs(behind.mean(axis=0)) < 0.1 * reach)
    radii = np.linalg.norm(inside, axis=1)
    assert radii.max() < 2.001 and np.median(radii) == pytest.approx(2.0 * 0.5 ** (1 / 3), abs=0.1)
    assert np.all(made.logits == 0.0) and not np.any(made.harmonics)
    distances = np.linalg.norm(away[:, None] - away[None], axis=-1)
    nearest = np.sort(distances, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(np.exp(made.log_scales[:, 0]), 0.5 * nearest, rtol=1e-3)
    expectations.assert_same(made, splats.start(5, 1000, cameras, Domain(7.3, space, centre)))
    assert not np.array_equal(made.means, splats.start(6, 1000, cameras, _DOMAIN).means)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_gaussians_start_too(count):
    made = splats.start(0, count, _CAMERAS, _DOMAIN)
    assert gradients.all_finite(made) and made.means.shape == (count, 3)


def test_every_image_is_used_once_before_any_again():
    order = training.order_of(7, 5, range(20))
    assert all(sorted(order[n : n + 5]) == [0, 1, 2, 3, 4] for n in range(0, 20, 5))
    np.testing.assert_array_equal(training.order_of(7, 5, range(8, 13)), order[8:13])
    assert not np.array_equal(order, training.order_of(8, 5, range(20)))


@pytest.mark.slow
@pytest.mark.longest
def test_steps_lower_the_loss_and_neither_periods_nor_a_stop_change_them(monkeypatch):
    monkeypatch.setattr(training, "_PERIOD", 10)
    setup, begun = _setup(), _begun()
    losses = [float(report.loss) for _, report in training.run_steps(setup, begun, 60, every=(5,))]
    assert len(losses) == 12 and np.mean(losses[-4:]) < 0.9 * np.mean(losses[:4])
    whole, report = _last(setup, begun, 60)
    assert int(whole.step) == 60 and np.isfinite(report.psnr) and int(report.entries) > 0
    halfway, _ = _last(setup, begun, 25, every=(5, 7))
    resumed = training.State(*jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), halfway))
    expectations.assert_same(_last(setup, resumed, 60)[0], whole)
    other = _last(_setup(seed=4), begun, 5)[0].gaussians
    assert not np.array_equal(other.means, _last(setup, begun, 5)[0].gaussians.means)


@pytest.mark.slow
def test_a_capacity_that_is_too_small_is_found_and_the_steps_repeated(monkeypatch):
    setup, begun = _setup(), _begun()
    whole, _ = _last(setup, begun, 10)
    asked = []

    def small(entries, usual=images.capacity_for):
        asked.append(entries)
        return 40 if len(asked) == 1 else usual(entries)

    monkeypatch.setattr(images, "capacity_for", small)
    again, report = _last(setup, begun, 10)
    assert len(asked) == 2 and asked[1] >= int(report.entries) > 40
    expectations.assert_same(again, whole)


def test_far_gaussians_learn_in_proportion_to_their_distance():
    """The same picture a hundred times as far away and as large takes steps as much larger."""
    near = splats.start(0, 100, _CAMERAS, Domain(7.3, "spherical"))
    setup = _setup()
    static = training._Static(
        images.grid_of(24, 24), 5000, "mip", 60, 3, setup.extent, (0.0, 0.0, 0.0)
    )
    far = near._replace(means=100.0 * near.means)
    reach = [np.asarray(training._reach(each, static)) for each in (near, far)]
    length = np.linalg.norm(near.means, axis=1) / setup.extent
    np.testing.assert_allclose(reach[0], np.maximum(length, 1.0), rtol=1e-5)
    np.testing.assert_allclose(reach[1], np.maximum(100.0 * length, 1.0), rtol=1e-5)
