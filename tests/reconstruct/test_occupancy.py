import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.geometry.triangle_meshes import volume
from refref_jax.reconstruct import ReconstructionError, occupancy, occupancy_field
from refref_jax.reconstruct.grids import Box, find_isosurface
from refref_jax.reconstruct.mesh_distance import compare_meshes
from refref_jax.reconstruct.occupancy import OccupancyTrainingConfig
from refref_jax.reconstruct.occupancy_field import OccupancyFieldConfig
from tests.factories import bodies
from tests.laws import gradients

_FIELD = OccupancyFieldConfig(
    grid=HashGridConfig(levels=2, base_res=4, max_res=16, hashmap_size=1 << 13, features=2),
    width=16,
)
_SMALL = OccupancyTrainingConfig(field=_FIELD, steps=200, batch=512, scan=16, surface=64)
_BRIEF = dataclasses.replace(_SMALL, steps=10)
_BOX = Box(np.array([-1.2, -1.5, -1.1]), np.array([1.3, 1.4, 1.2]))
_BALL = 4.0 / 3.0 * np.pi


@functools.cache
def _initial():
    return jax.jit(lambda: occupancy_field.init(jax.random.key(0), _FIELD))()


@functools.cache
def _ball_views():
    cameras = bodies.cameras_around(24, size=48)
    return bodies.masks_of(bodies.ball, cameras), cameras


def _fit(masks, cameras, *, config=_SMALL, box=_BOX, **options):
    # Optax mixes integers and floats. All fits of a configuration compile once.
    with jax.numpy_dtype_promotion("standard"):
        return occupancy.fit(masks, cameras, config=config, resolution=32, box=box, **options)


@functools.cache
def _fitted():
    reports = []
    grid = _fit(*_ball_views(), progress=lambda done, report: reports.append((done, report)))
    return grid, reports


def test_an_untrained_field_is_a_ball():
    params = _initial()
    points = jax.random.uniform(jax.random.key(1), (50, 3))
    signed = jax.vmap(occupancy_field.signed, in_axes=(None, None, 0))
    found = jax.jit(signed, static_argnums=1)(params, _FIELD, points)
    expected = np.linalg.norm(np.asarray(points) - 0.5, axis=1) - 0.4
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_slope_of_a_ball_points_outwards():
    params = _initial()
    at = jnp.asarray([0.8, 0.5, 0.9])
    slope_at = jax.jit(occupancy_field.slope, static_argnums=1, static_argnames="step")
    for step in (0.02, 0.002):
        slope = slope_at(params, _FIELD, at, step=step)
        # The sphere's second derivative there is at most 2.
        np.testing.assert_allclose(slope, [0.6, 0.0, 0.8], atol=2.0 * step)


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1))
def _slopes(params, at):
    return occupancy_field.signed(params, _FIELD, at)


@pytest.mark.parametrize("at", [(0.5, 0.5, 0.5), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_gradients_of_the_field_are_finite_in_the_middle_and_at_corners(at):
    assert gradients.all_finite(_slopes(_initial(), jnp.asarray(at)))


def test_configurations_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="Choose a radius"):
        OccupancyFieldConfig(start=0.7)
    with pytest.raises(ValueError, match="must be at least 1"):
        OccupancyTrainingConfig(steps=0)
    with pytest.raises(ValueError, match="softness and rate must be above 0"):
        OccupancyTrainingConfig(softness=(1.0, 0.0))
    with pytest.raises(ValueError, match="between 1 and batch"):
        OccupancyTrainingConfig(batch=16, surface=17)


# --- training ---


@pytest.mark.slow
def test_a_small_ball_is_found_to_half_a_pixel():
    grid, _ = _fitted()
    mesh = find_isosurface(grid)
    pixel = 3.0 / _ball_views()[1].focal
    found = compare_meshes(mesh, bodies.icosphere(4), samples=2000)
    size = 2.0 * np.sqrt(3.0)
    assert found.chamfer * size < 0.5 * pixel
    assert found.normal_error < 8.0
    assert volume(*mesh[:2]) == pytest.approx(_BALL, rel=0.06)


@pytest.mark.slow
def test_the_grid_is_a_distance_near_the_surface_and_negative_inside():
    grid, _ = _fitted()
    points = grid.low + grid.spacing * np.moveaxis(np.indices(grid.values.shape), 0, -1)
    truth = bodies.ball(points)
    clear = np.abs(truth) > 0.15
    assert np.array_equal(grid.values[clear] < 0.0, truth[clear] < 0.0)
    near = np.abs(truth) < 0.1
    assert np.mean(np.abs(grid.values[near] - truth[near])) < 0.04
    assert np.all(grid.values[[0, -1]] > 0.0) and np.all(grid.values[:, :, [0, -1]] > 0.0)


@pytest.mark.slow
def test_progress_is_reported_and_made():
    _, reports = _fitted()
    assert [done for done, _ in reports] == [100, 200]
    first, last = (report for _, report in reports)
    assert all(np.isfinite(value) for value in last)
    assert 0.0 <= last.wrong < 0.1 and last.loss < first.loss


@pytest.mark.slow
def test_the_same_seed_gives_the_same_grid_and_another_one_another():
    first, _ = _fitted()
    np.testing.assert_array_equal(first.values, _fit(*_ball_views(), seed=0).values)
    assert not np.array_equal(first.values, _fit(*_ball_views(), seed=1).values)


@pytest.mark.slow
def test_one_view_and_one_without_an_outline_are_taken():
    masks, cameras = _ball_views()
    cameras = cameras._replace(poses=cameras.poses[:1])
    for seen in (masks[:1], np.ones_like(masks[:1])):
        grid = _fit(seen, cameras)
        assert np.all(np.isfinite(grid.values)) and np.any(grid.values < 0.0)


@pytest.mark.slow
def test_the_grid_covers_the_box():
    grid = _fit(*_ball_views(), config=_BRIEF)
    high = grid.low + grid.spacing * (np.array(grid.values.shape) - 1)
    assert np.all(grid.low < _BOX.low) and np.all(high > _BOX.high)
    assert max(grid.values.shape) == 33


def test_a_box_is_found_from_the_masks_though_one_is_wrong():
    masks, cameras = _ball_views()
    wrong = masks.copy()
    wrong[5] = np.roll(wrong[5], 20, axis=1)
    for seen in (masks, wrong):
        low, high = occupancy.search_box(seen, cameras)
        assert np.all(low < -1.0) and np.all(high > 1.0)
        assert np.all(low > -1.6) and np.all(high < 1.6)


def test_errors_say_what_to_do():
    masks, cameras = _ball_views()
    with pytest.raises(ReconstructionError, match="There are no masks"):
        _fit(masks[:0], cameras._replace(poses=cameras.poses[:0]))
    with pytest.raises(ReconstructionError, match="masks are empty"):
        _fit(masks & (np.arange(24) != 1)[:, None, None], cameras)
    alone = cameras._replace(poses=cameras.poses[:1])
    behind = 2.0 * alone.poses[0, :, 3]
    with pytest.raises(ReconstructionError, match=r"No ray of 1 views hits the box .* Check"):
        _fit(masks[:1], alone, box=Box(behind - 0.5, behind + 0.5))


@pytest.mark.slow
def test_an_empty_field_is_not_handed_on(monkeypatch):
    outside = lambda params, positions, *, config: jnp.ones(len(positions))
    monkeypatch.setattr(occupancy, "field_values", outside)
    with pytest.raises(ReconstructionError, match="The field is empty after 10 steps on 24 masks"):
        _fit(*_ball_views(), config=_BRIEF)
