"""The presets: every one makes a model, and they grow."""

import dataclasses
import json

import pytest

from refref_jax.geometry.cameras import orbit
from refref_jax.sampling.scene_bounds import Bounds, bounds, contracted
from refref_jax.training.presets import PRESETS, loss

pytestmark = pytest.mark.loose

_BOUNDS = Bounds(near=0.05, far=16.0, radius=7.3, space="bounded")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_makes_a_model_of_its_scene(name):
    preset = PRESETS[name]
    model = preset.model(_BOUNDS, "clear")
    assert model.interior == "clear" and model.radius == 7.3
    assert len(loss(model).blurs) == len(model.proposals)
    assert preset.schedule.warmup < preset.schedule.steps and preset.schedule.end > 0.0
    json.dumps(dataclasses.asdict(model))


@pytest.mark.parametrize("space", ["bounded", "spherical", "unbounded"])
def test_space_is_contracted_around_the_centre_of_the_background(space):
    moved = dataclasses.replace(_BOUNDS, space=space, centre=(5.0, -3.0, 2.0))
    assert contracted(moved, radius=None).centre == moved.centre


def _rays_of_a_pool(name):
    schedule = PRESETS[name].schedule
    return schedule.batch * schedule.pretraced_batches


def test_best_samples_as_the_paper_does_and_sees_through_bends():
    best, paper = (PRESETS[name].model(_BOUNDS, "field") for name in ("best", "paper"))
    assert best.footprint == "differential" and paper.footprint == "cone"
    assert [p.samples for p in best.proposals] == [p.samples for p in paper.proposals]
    # As many rays are traced at once.
    assert _rays_of_a_pool("best") == 131_072
    assert _rays_of_a_pool("paper") == 131_072


def test_bounds_reach_the_far_wall():
    cameras = orbit(4, distance=4.0, elevation=0.3, size=8, angle_x=1.0)
    cube = bounds(cameras, space="bounded", radius=2.0)
    sphere = bounds(cameras, space="spherical", radius=2.0)
    assert (cube.radius, sphere.radius, sphere.space) == (2.0, 2.0, "spherical")
    assert cube.far == pytest.approx(4.0 + 2.0 * 3.0**0.5) and sphere.far == pytest.approx(6.0)


def test_bounds_move_with_the_cameras():
    around = [
        orbit(4, distance=4.0, elevation=0.3, size=8, angle_x=1.0, centre=centre)
        for centre in ((0.0, 0.0, 0.0), (5.0, -3.0, 2.0))
    ]
    for space in ("bounded", "spherical", "unbounded"):
        usual = bounds(around[0], space=space, radius=None)
        moved = bounds(around[1], space=space, radius=None, centre=(5.0, -3.0, 2.0))
        assert (moved.far, moved.radius) == pytest.approx((usual.far, usual.radius))
        assert (usual.centre, moved.centre) == ((0.0, 0.0, 0.0), (5.0, -3.0, 2.0))
        assert PRESETS["tiny"].model(moved, "clear").centre == moved.centre
