import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.render import learned_media
from refref_jax.render.learned_media import LearnedTints
from tests.factories import made_paths
from tests.laws import gradients

_RADIUS = 7.3


def _paths(hit_counts, path_lengths):
    plain = made_paths.stack([made_paths.path([], [[0, 0, 1]], [0])] * len(hit_counts))
    return plain._replace(
        hit_counts=jnp.asarray(hit_counts, jnp.float32),
        path_lengths=jnp.asarray(path_lengths, jnp.float32),
    )


def test_parts_begin_nearly_clear():
    begun = learned_media.init(3)
    assert np.all(np.asarray(learned_media.tints(begun)) > 0.95)
    assert np.all(np.asarray(learned_media.absorptions(begun, _RADIUS)) < 0.01)


def test_light_is_dimmed_at_every_meeting_and_along_every_passage():
    made = LearnedTints(
        jnp.array([[0.3, -1.0, 2.0], [0.0, 1.0, -4.0]]), jnp.array([[1.0, 0, 2]] * 2)
    )
    hit_counts, path_lengths = [[0, 0], [2, 0], [1, 3]], [[0, 0], [0.5, 0], [1.5, 2.0]]
    dimmed = learned_media.attenuate(
        made, _paths(hit_counts, path_lengths), radius=_RADIUS
    ).throughput
    tint, absorption = (
        np.asarray(learned_media.tints(made)),
        np.asarray(learned_media.absorptions(made, _RADIUS)),
    )
    for n, lengths, got in zip(hit_counts, path_lengths, dimmed, strict=True):
        expected = np.prod(tint ** np.array(n)[:, None], axis=0)
        expected *= np.exp(-np.array(lengths) @ absorption)
        np.testing.assert_allclose(got, expected, rtol=2e-6)


def test_optical_density_by_hand():
    made = LearnedTints(jnp.log(jnp.expm1(jnp.array([[0.5, 1.0, 1.5]]))), jnp.full((1, 3), -200.0))
    np.testing.assert_allclose(learned_media.optical_density(made), 1.0, rtol=1e-6)
    assert learned_media.optical_density(None) == 0.0


def test_without_dyes_paths_stay_as_they_are():
    paths = _paths([[1.0]], [[2.0]])
    assert learned_media.attenuate(None, paths, radius=_RADIUS) is paths


@pytest.mark.parametrize("raw", [-200.0, -30.0, -3.0, 0.0, 5.0, 200.0])
def test_tints_are_factors_with_finite_gradients(raw):
    made = LearnedTints(*[jnp.full((1, 3), raw)] * 2)
    tint = np.asarray(learned_media.tints(made))
    assert np.all((tint >= 0.0) & (tint <= 1.0))

    def light(made):
        return jnp.sum(
            learned_media.attenuate(made, _paths([[24.0]], [[1e3]]), radius=_RADIUS).throughput
        )

    assert gradients.all_finite(jax.grad(light)(made))


def test_dye_check_grads():
    paths = _paths([[1.0, 2.0], [0.0, 3.0]], [[0.5, 0.0], [1.0, 2.0]])

    def light(density, absorption):
        wide = paths._replace(
            throughput=paths.throughput.astype(density.dtype),
            hit_counts=paths.hit_counts.astype(density.dtype),
            path_lengths=paths.path_lengths.astype(density.dtype),
        )
        return learned_media.attenuate(
            LearnedTints(density, absorption), wide, radius=_RADIUS
        ).throughput

    rng = np.random.default_rng(0)
    gradients.assert_numerical(light, *rng.normal(size=(2, 2, 3)))
