import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.surfaces import SurfacePoint
from refref_jax.optics import interface_rules, media, path_step
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import AMBIENT
from refref_jax.optics.path_settings import PathSettings

_GLASS = jax.tree.map(jnp.asarray, interface_rules.nested([1.5], [NO_PARENT]))


_interact = jax.jit(path_step.interact)


def _meet(direction, shading=(0.0, 0.0, 1.0)):
    """Meets a glass surface z = 0 that faces up; the shading normal may lean."""
    shading = np.asarray(shading) / np.linalg.norm(shading)
    point = SurfacePoint(
        position=jnp.zeros(3),
        geometric_normal=jnp.array([0.0, 0.0, 1.0]),
        shading_normal=jnp.asarray(shading, jnp.float32),
        part=jnp.int32(0),
        scale=jnp.float32(1.0),
    )
    unit = np.asarray(direction) / np.linalg.norm(direction)
    nowhere = media.empty_interior_list(_GLASS)
    return _interact(point, _GLASS, nowhere, jnp.asarray(unit, jnp.float32))


def test_entering_glass():
    met = _meet([0.0, 0.0, -1.0])
    np.testing.assert_allclose(met.transmitted, [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(met.reflected, [0, 0, 1], atol=1e-6)
    assert met.reflectance == pytest.approx(0.04, abs=1e-6)
    assert (int(met.sides.medium_near), int(met.sides.medium_far)) == (AMBIENT, 1)
    assert met.restart_transmitted[2] < 0.0 < met.restart_reflected[2]


def test_leaving_glass():
    met = _meet([0.3, 0.0, 1.0])
    assert (int(met.sides.medium_near), int(met.sides.medium_far)) == (1, AMBIENT)
    sine = 1.5 * 0.3 / np.hypot(0.3, 1.0)
    np.testing.assert_allclose(met.transmitted, [sine, 0, np.sqrt(1 - sine**2)], atol=1e-6)
    assert met.restart_reflected[2] < 0.0 < met.restart_transmitted[2]


def test_total_reflection_has_no_other_branch():
    met = _meet([1.0, 0.0, 0.5])
    assert met.total
    assert met.reflectance == 1.0
    np.testing.assert_allclose(met.reflected, np.array([1.0, 0.0, -0.5]) / np.hypot(1.0, 0.5))
    assert met.restart_reflected[2] < 0.0
    assert np.all(np.isfinite(met.transmitted))


@pytest.mark.parametrize("lean", [0.0, 0.1, -0.1, 1.0, -1.0, 10.0])
@pytest.mark.parametrize("slope", [-1.0, -0.1, -1e-3, -1e-6, 1e-6, 1e-3, 0.1, 1.0])
def test_no_ray_leaves_on_the_wrong_side_however_the_shading_normal_leans(lean, slope):
    met = _meet([1.0, 0.0, slope], shading=(lean, 0.0, 1.0))
    incident = -np.sign(slope)
    assert np.sign(met.reflected[2]) == incident
    assert met.total or np.sign(met.transmitted[2]) == -incident
    for unit in (met.reflected,) if met.total else (met.reflected, met.transmitted):
        assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-6)
    assert 0.0 <= met.reflectance <= 1.0


@pytest.mark.parametrize("degrees", [7.0, 9.0, 11.0])
def test_a_ray_that_would_cross_the_triangle_is_turned_as_little_as_needed(degrees):
    incident = np.array([1.0, 0.3, -0.2]) / np.linalg.norm([1.0, 0.3, -0.2])
    shading = np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
    mirrored = incident - 2.0 * (incident @ shading) * shading
    assert incident @ shading < 0.0 and mirrored[2] < 0.0
    turned = mirrored * [1.0, 1.0, -0.01]
    met = _meet(incident, shading=shading)
    np.testing.assert_allclose(met.reflected, turned / np.linalg.norm(turned), atol=1e-6)


def test_a_shading_normal_that_points_away_from_the_ray_is_not_used():
    flat, leaning = _meet([1.0, 0.3, -0.2]), _meet([1.0, 0.3, -0.2], shading=(0.3, 0.0, 1.0))
    np.testing.assert_array_equal(flat.reflected, leaning.reflected)
    np.testing.assert_array_equal(flat.transmitted, leaning.transmitted)


@jax.jit
@jax.grad
def _slope_of_turned(shading):
    point = SurfacePoint(
        position=jnp.zeros(3),
        geometric_normal=jnp.array([0.0, 0.0, 1.0]),
        shading_normal=shading,
        part=jnp.int32(0),
        scale=jnp.float32(1.0),
    )
    direction = jnp.array([1.0, 0.0, -0.2]) / np.hypot(1.0, 0.2)
    nowhere = media.empty_interior_list(_GLASS)
    met = path_step.interact(point, _GLASS, nowhere, direction)
    return jnp.sum(met.reflected * jnp.array([1.0, 2.0, 3.0])) + met.transmitted[2]


@pytest.mark.parametrize("degrees", [0.0, 7.0, 11.3])
def test_slopes_are_finite_where_a_ray_is_turned(degrees):
    lean = np.radians(degrees)
    slope = _slope_of_turned(jnp.array([np.sin(lean), 0.0, np.cos(lean)], jnp.float32))
    assert np.all(np.isfinite(slope))


@jax.jit
def _leave(index, slope, lean):
    """Leaves glass of an index; returns both directions, and derivatives of the reflected one."""
    nowhere = media.empty_interior_list(_GLASS)
    point = SurfacePoint(
        position=jnp.zeros(3),
        geometric_normal=jnp.array([0.0, 0.0, 1.0]),
        shading_normal=jnp.zeros(3),
        part=jnp.int32(0),
        scale=jnp.float32(1.0),
    )

    def directions(index, slope, lean):
        glass = _GLASS._replace(index_inside=index[None])
        shading = jnp.stack([jnp.sin(lean), jnp.zeros_like(lean), jnp.cos(lean)])
        incident = jnp.stack([jnp.cos(slope), jnp.zeros_like(slope), jnp.sin(slope)])
        met = path_step.interact(point._replace(shading_normal=shading), glass, nowhere, incident)
        followed = jnp.where(met.total, met.reflected, met.transmitted)
        return followed, (met.reflected, met.transmitted, met.total)

    return jax.jacrev(directions, argnums=(0, 1, 2), has_aux=True)(index, slope, lean)


@pytest.mark.parametrize("index", [1.5, 2.4, 4.0])
def test_total_reflection_is_finite_for_high_indices_and_leaning_normals(index):
    slopes, leans = np.meshgrid(np.radians(np.arange(1, 90, 3)), np.radians(np.arange(-60, 61, 3)))
    each = jax.vmap(_leave, in_axes=(None, 0, 0))
    arrays = [jax.device_put(x.ravel().astype(np.float32)) for x in (slopes, leans)]
    slope, (reflected, transmitted, total) = each(jax.device_put(np.float32(index)), *arrays)
    assert 0.1 < np.mean(total) < 1.0
    for found in (*slope, reflected, transmitted):
        assert np.all(np.isfinite(found))
    for unit in (reflected, transmitted):
        np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1.0, atol=2e-6)


def test_the_shading_normal_bends_the_ray():
    flat, leaning = _meet([0.2, 0.0, -1.0]), _meet([0.2, 0.0, -1.0], shading=(0.1, 0.0, 1.0))
    assert np.linalg.norm(flat.transmitted - leaning.transmitted) > 0.02


def _shares(reflectance, *, total=False, first=True, strength=1.0, **options):
    settings = PathSettings(max_bends=8, **options)
    found = path_step.shares(
        settings,
        reflectance=jnp.float32(reflectance),
        total=jnp.asarray(total),
        first=jnp.asarray(first),
        strength=jnp.float32(strength),
    )
    return [float(share) for share in found]


@pytest.mark.parametrize("reflections", ["all", "first", "none"])
def test_a_total_reflection_takes_all_light_under_any_settings(reflections):
    assert _shares(1.0, total=True, first=False, reflections=reflections) == [1.0, 0.0]


@pytest.mark.parametrize(
    ("reflections", "first", "expected"),
    [("all", False, 0.25), ("first", True, 0.25), ("first", False, 0.0), ("none", True, 0.0)],
)
def test_a_reflection_that_is_not_followed_leaves_its_share(reflections, first, expected):
    assert _shares(0.25, first=first, reflections=reflections) == [expected, 1.0 - expected]


@pytest.mark.parametrize(
    ("reflectance", "strength", "expected"),
    [(0.25, 1.0, 0.25), (0.25, 0.3, 0.0), (0.75, 1.0, 0.75), (0.75, 0.3, 1.0)],
)
def test_below_the_threshold_the_stronger_branch_takes_all(reflectance, strength, expected):
    found = _shares(reflectance, strength=strength, reflections="all", min_throughput=0.1)
    assert found == [expected, 1.0 - expected]


def test_light_that_a_facet_sends_to_the_wrong_side_is_hidden():
    """It is not turned into light that leaves, as that of a leaning shading normal is."""
    rough = _GLASS._replace(alpha=jnp.array([0.5], jnp.float32))
    point = SurfacePoint(
        position=jnp.zeros(3),
        geometric_normal=jnp.array([0.0, 0.0, 1.0]),
        shading_normal=jnp.array([0.0, 0.0, 1.0]),
        part=jnp.int32(0),
        scale=jnp.float32(1.0),
    )
    nowhere = media.empty_interior_list(rough)
    hidden = 0
    for slope in np.linspace(-2.0, 2.0, 21):
        direction = jnp.array([1.0, 0.0, -0.3]) / np.hypot(1.0, 0.3)
        met = _interact(point, rough, nowhere, direction, tilt=jnp.array([slope, 0.0], jnp.float32))
        assert met.reflected[2] > 0.0 > met.transmitted[2] or met.total
        hidden += bool(met.unmasked[0] == 0.0)
    assert 0 < hidden < 21
