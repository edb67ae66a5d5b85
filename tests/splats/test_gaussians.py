"""Projection against gsplat, matrices in float64, finite differences and closed forms."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields.hash_grid import spherical_harmonics
from refref_jax.geometry import cameras
from refref_jax.splats import gaussians as splats
from refref_jax.splats import images
from refref_jax.splats.gaussians import Gaussians, Projected, View
from refref_jax.splats.rasterizer import Grid
from tests.factories import made_splats
from tests.laws import gradients
from tests.oracles import reference_splats

_SIZE = {"width": made_splats.WIDTH, "height": made_splats.HEIGHT}


@pytest.fixture(scope="module")
def recorded():
    with np.load(Path(__file__).parent / "gsplat.npz") as file:
        return dict(file)


def _as_recorded(recorded, dtype=np.float64):
    """Returns the recorded Gaussians, opaque and grey, and their view."""
    count = len(recorded["means"])
    values = Gaussians(
        recorded["means"],
        recorded["quaternions"],
        np.log(recorded["scales"]),
        np.full(count, 40.0),
        np.zeros((count, 3)),
        np.zeros((count, 15, 3)),
    )
    turn = recorded["view"][:3, :3]
    view = View(turn, -turn.T @ recorded["view"][:3, 3], recorded["focal"])
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), (values, view))


_project_all = jax.jit(splats.project_all, static_argnames=("kernel", "width", "height"))


def _projected(values, view, kernel="classic", **changes):
    return _project_all(values, view, kernel=kernel, **(_SIZE | changes))


@pytest.mark.slow
def test_projection_is_that_of_gsplat(recorded):
    with jax.enable_x64(True):
        values, view = _as_recorded(recorded)
        found = jax.device_get(_projected(values, view))
        thinner = jax.device_get(_projected(values, view, "mip"))
    visible = (recorded["radii"] > 0).all(-1)
    np.testing.assert_array_equal((found.radii > 0).all(-1), visible)
    assert 20 < visible.sum() < len(visible)
    for ours, theirs in [
        (found.means, "means2d"),
        (found.conics, "conics"),
        (found.depths, "depths"),
        (thinner.opacities, "compensations"),
    ]:
        np.testing.assert_allclose(ours[visible], recorded[theirs][visible], rtol=1e-9)
    # Ours end where an opacity of 1 falls to 1/255, 0.04 % nearer.
    larger = recorded["radii"][visible] - found.radii[visible]
    assert np.all((larger == 0) | (larger == 1)) and np.mean(larger) < 0.02


@pytest.mark.slow
def test_lists_are_those_of_gsplat(recorded):
    values, view = _as_recorded(recorded, np.float32)
    found = _projected(values, view)._replace(radii=jnp.float32(recorded["radii"]))
    grid = Grid(*recorded["size"].tolist(), int(recorded["tile"]))

    @jax.jit
    def listed(found):
        return images.make_lists(found, grid, capacity=2000), images.count_entries(found, grid)

    lists, count = listed(found)
    total = int(lists.total)
    assert total == recorded["counts"].sum() == int(count)
    np.testing.assert_array_equal(lists.offsets[:-1], recorded["offsets"])
    np.testing.assert_array_equal(lists.entries[:total], recorded["owners"])


def test_colours_are_those_of_gsplat(recorded):
    """Its basis has the other sign at odd indices."""
    signs = (-1.0) ** np.arange(16)
    coefficients = recorded["harmonics"] * signs[:, None]
    directions = recorded["directions"]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    seen = made_splats.one((0, 0, 1))

    def one(direction, coefficient):
        value = jax.tree.map(lambda x: x[0], seen)
        value = value._replace(colours=coefficient[0], harmonics=coefficient[1:])
        return splats.colour(value, direction, 3)

    found = jax.jit(jax.vmap(one))(jnp.float32(directions), jnp.float32(coefficients))
    np.testing.assert_allclose(found, np.maximum(recorded["colours"] + 0.5, 0.0), atol=2e-6)
    basis = jax.jit(spherical_harmonics)(jnp.float32([0.36, 0.48, 0.8]))
    assert float(basis[1] * signs[1]) == pytest.approx(-0.234529, abs=1e-6)


def test_projection_by_hand():
    """Numbers of gsplat for three Gaussians, to six decimals."""
    parts = [
        made_splats.one((0, 0, 2)),
        made_splats.one((0.2, -0.1, 2.5), scale=(0.05, 0.2, 0.1), quaternion=(0.9, 0.1, -0.2, 0.3)),
        made_splats.one((-0.3, 0.25, 1.6), scale=(0.3, 0.1, 0.02), quaternion=(1, 1, -1, 1)),
    ]
    values = made_splats.joined(*parts)
    values = values._replace(logits=jnp.full(3, 20.0))
    found = _projected(values, made_splats.AHEAD, width=16, height=16)
    np.testing.assert_allclose(found.means, [(8, 8), (9.6, 7.2), (4.25, 11.125)], rtol=1e-6)
    conics = [(0.769231, 0, 0.769231), (1.222540, 0.682598, 0.880295)]
    np.testing.assert_allclose(found.conics[:2], conics, atol=2e-6)
    np.testing.assert_allclose(found.conics[2], (0.472499, 0.275796, 1.577768), atol=2e-6)
    np.testing.assert_array_equal(found.radii, [(4, 4), (4, 5), (6, 3)])
    thinner = _projected(values, made_splats.AHEAD, "mip", width=16, height=16)
    np.testing.assert_allclose(thinner.opacities, [0.769231, 0.651208, 0.667210], atol=2e-6)


@pytest.mark.slow
def test_projection_is_that_of_matrices():
    values, view = made_splats.gaussians(40), made_splats.view()
    found = jax.device_get(_projected(values, view))
    seen = np.flatnonzero(found.radii[:, 0] > 0)
    assert len(seen) > 20
    for i in seen:
        scales = np.exp(np.float64(values.log_scales[i]))
        turn, position = (np.float64(x) for x in (view.rotation, view.position))
        mean, quaternion = np.float64(values.means[i]), np.float64(values.quaternions[i])
        centre, covariance, _, depth = reference_splats.project(
            mean, quaternion, scales, (turn, position), made_splats.FOCAL, *_SIZE.values()
        )
        inverse = np.linalg.inv(covariance)
        np.testing.assert_allclose(found.means[i], centre, rtol=1e-4, atol=1e-4)
        expected = inverse[0, 0], inverse[0, 1], inverse[1, 1]
        np.testing.assert_allclose(found.conics[i], expected, rtol=1e-4, atol=1e-5)
        assert found.depths[i] == pytest.approx(depth, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["classic", "mip"])
def test_derivatives_are_those_of_differences(kernel):
    def smooth(*leaves):
        found = splats.project_all(Gaussians(*leaves), view, **_SIZE, kernel=kernel)
        return found._replace(radii=jnp.zeros(()))

    with jax.enable_x64(True):
        values = jax.tree.map(jnp.float64, made_splats.gaussians(3, seed=4))
        values = values._replace(logits=jnp.full(3, 2.0), means=0.3 * values.means)
        view = jax.tree.map(jnp.float64, made_splats.view())
        assert np.all(_projected(values, view, kernel).radii > 0)
        gradients.assert_numerical(smooth, *values, modes=("rev",))


_EXTREMES = {
    "at the camera": {"mean": (0, 0, 0)},
    "behind": {"mean": (0, 0, -1)},
    "almost at the camera": {"mean": (0.3, 0.1, 1e-6)},
    "just in front": {"mean": (0.001, 0, 0.0101)},
    "beside the image": {"mean": (40, 0, 1)},
    "no size": {"mean": (0, 0, 1), "scale": 0.0},
    "flat": {"mean": (0, 0, 1), "scale": (0.1, 0.1, 0.0)},
    "huge": {"mean": (0, 0, 1), "scale": 1e6},
    "no rotation": {"mean": (0, 0, 1), "quaternion": (0, 0, 0, 0)},
    "opaque": {"mean": (0, 0, 1), "opacity": 1.0},
    "transparent": {"mean": (0, 0, 1), "opacity": 0.0},
    "far": {"mean": (0, 0, 1e6)},
}


@functools.partial(jax.jit, static_argnames="kernel")
@functools.partial(jax.grad, has_aux=True)
def _slopes_of_all(values, *, kernel):
    """Returns the slopes of the sum of all that is projected, and what is projected."""
    found = splats.project_all(values, made_splats.AHEAD, width=16, height=16, kernel=kernel)
    return sum(map(jnp.sum, found)), found


@pytest.mark.parametrize("name", _EXTREMES)
@pytest.mark.parametrize("kernel", ["classic", "mip"])
def test_projection_is_finite_and_so_are_its_derivatives(name, kernel):
    slopes, found = _slopes_of_all(made_splats.one(**_EXTREMES[name]), kernel=kernel)
    assert gradients.all_finite(found) and gradients.all_finite(slopes)
    if not found.radii[0, 0]:
        assert not any(np.any(leaf) for leaf in jax.tree.leaves((found, slopes)))


@pytest.mark.slow
def test_views_look_as_the_cameras_do():
    seen = cameras.orbit(3, distance=4.0, elevation=0.3, size=16, angle_x=1.2)
    views, points = splats.views_of(seen), np.random.default_rng(0).normal(size=(20, 3))
    for i in range(3):
        view = View(*(jnp.asarray(x[i]) for x in views))
        values = made_splats.joined(*(made_splats.one(point, opacity=0.9) for point in points))
        found = _projected(values, view, width=16, height=16)
        expected = cameras.project(points, seen.poses[i], seen)
        visible = np.asarray(found.radii[:, 0] > 0)
        assert visible.sum() > 10
        np.testing.assert_allclose(found.means[visible], expected.pixels[visible], atol=1e-4)
        np.testing.assert_allclose(found.depths[visible], expected.depths[visible], rtol=1e-5)


@pytest.mark.slow
def test_harmonics_above_the_degree_are_left_out():
    value = jax.tree.map(lambda x: x[0], made_splats.gaussians(1))
    value = value._replace(harmonics=jnp.abs(value.harmonics) + 0.1, colours=jnp.full(3, 5.0))
    direction = jnp.float32([0.6, 0.48, 0.64])
    colour = jax.jit(splats.colour)
    seen = [np.asarray(colour(value, direction, jnp.float32(d))) for d in range(4)]
    basis = np.asarray(jax.jit(spherical_harmonics)(direction))[1:, None]
    basis = basis * np.asarray(value.harmonics)
    for degree, count in enumerate((0, 3, 8, 15)):
        expected = 0.5 + 5.0 * splats.CONSTANT + basis[:count].sum(axis=0)
        np.testing.assert_allclose(seen[degree], expected, rtol=1e-5)


@pytest.mark.slow
def test_records_of_no_gaussians_are_empty():
    none = splats.blank(0)
    found = splats.project_all(none, made_splats.AHEAD, width=16, height=16, kernel="mip")
    assert found.means.shape == (0, 2) and isinstance(found, Projected)
