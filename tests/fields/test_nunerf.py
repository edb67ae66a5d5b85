"""NU-NeRF's colour against its formula in NumPy; opacity and losses are those of NeuS."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.special

from refref_jax.fields import neus, nunerf, registry
from refref_jax.fields.base import shape_of
from refref_jax.fields.hash_grid import HashGridConfig, spherical_harmonics
from refref_jax.fields.nunerf import Material
from refref_jax.sampling.polylines import Gaussians
from tests.factories.small_model import initial_field
from tests.laws import gradients

_GRID = HashGridConfig(levels=2, base_res=3, max_res=10, hashmap_size=256, features=2)
_CONFIG = nunerf.NunerfConfig(
    _GRID,
    density_width=8,
    bottleneck=4,
    colour_width=8,
    colour_depth=1,
    around=_GRID,
    octaves=3,
    light_width=8,
    light_depth=2,
)

_TOWARDS = jnp.array([0.36, 0.48, 0.8], jnp.float32)

_DIFFUSE, _MIRRORED, _REFRACTED = np.array(
    [[0.9, 0.3, 0.1], [0.2, 0.6, 1.0], [0.05, 0.5, 0.7]], np.float32
)


def _trained(config=_CONFIG, *, seed=1, size=0.6):
    """Returns parameters as after training: large entries, and biases that are not 0."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: np.float32(rng.normal(0.0, size, x.shape)), initial_field(config))


@functools.partial(jax.jit, static_argnums=1)
def _see(params, config, point):
    return registry.radiance(params, config, _at(point), _TOWARDS)


def _at(point):
    place = jnp.asarray(point, jnp.float32)
    return Gaussians(place[None], jnp.zeros_like(place[:1]))


def _combined(cosine, *, transmission, metallic=0.0):
    material = Material(_DIFFUSE, np.float32(metallic), np.float32(transmission))
    material = Material(*map(jnp.asarray, material))
    lights = jnp.asarray(_MIRRORED), jnp.asarray(_REFRACTED)
    return np.asarray(nunerf.combine(material, *lights, jnp.float32(cosine)))


# --- the split in closed form ---


def test_clear_glass_reflects_four_percent_head_on_and_everything_at_grazing_incidence():
    head_on = _combined(1.0, transmission=1.0)
    np.testing.assert_allclose(head_on, 0.04 * _MIRRORED + 0.96 * _REFRACTED, rtol=1e-6)
    for cosine in (0.0, -0.3, -1.0):
        np.testing.assert_allclose(_combined(cosine, transmission=1.0), _MIRRORED, rtol=1e-6)
    oblique = 0.04 + 0.96 * 0.5**5
    expected = oblique * _MIRRORED + (1.0 - oblique) * _REFRACTED
    np.testing.assert_allclose(_combined(0.5, transmission=1.0), expected, rtol=1e-6)


@pytest.mark.parametrize(("metallic", "head_on"), [(0.0, 0.04), (0.5, 0.52), (1.0, 1.0)])
def test_without_transmission_nothing_is_seen_through_the_surface(metallic, head_on):
    for cosine in (1.0, 0.7, 0.2):
        shine = head_on + (1.0 - head_on) * (1.0 - cosine) ** 5
        expected = (1.0 - shine) * _DIFFUSE + shine * _MIRRORED
        found = _combined(cosine, transmission=0.0, metallic=metallic)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_colour_is_linear_in_the_transmission():
    ends = [_combined(0.4, transmission=t, metallic=0.3) for t in (0.0, 1.0)]
    for share in (0.25, 0.8):
        found = _combined(0.4, transmission=share, metallic=0.3)
        np.testing.assert_allclose(found, (1.0 - share) * ends[0] + share * ends[1], rtol=1e-6)


def test_schlick_is_close_to_fresnel_for_glass():
    """Unpolarised light onto an index of 1.5, by Fresnel's equations."""
    cosines = np.linspace(0.0, 1.0, 201)
    refracted = np.sqrt(1.0 - (1.0 - cosines**2) / 1.5**2)
    crossed = (cosines - 1.5 * refracted) / (cosines + 1.5 * refracted)
    parallel = (1.5 * cosines - refracted) / (1.5 * cosines + refracted)
    exact = 0.5 * (crossed**2 + parallel**2)
    found = np.asarray(jax.vmap(lambda c: nunerf.schlick(c, nunerf.GLASS))(jnp.asarray(cosines)))
    assert np.abs(found - exact).max() < 0.04
    np.testing.assert_allclose(found[[0, -1]], exact[[0, -1]], atol=1e-6)


# --- the networks ---


def _in_numpy(point, weights, octaves=3):
    """Returns the colour by the formulas, in float64, and the number of layers that it took."""
    x, n, d = (np.asarray(a, np.float64) for a in (point.position, point.normal, point.direction))
    layers = iter(range(len(weights)))

    def dense(values):
        layer = weights[f"Dense_{next(layers)}"]
        return values @ np.float64(layer["kernel"]) + np.float64(layer["bias"])

    def light(values):
        for _ in range(2):
            values = np.maximum(dense(values), 0.0)
        return scipy.special.expit(dense(values))

    def encoded(v):
        return [v, *(f(2.0**k * v) for f in (np.sin, np.cos) for k in range(octaves))]

    hidden = np.maximum(dense(np.concatenate([point.features, x, n])), 0.0)
    *diffuse, metallic, transmission = scipy.special.expit(dense(hidden))
    r = d - 2.0 * (d @ n) * n
    mirrored = light(np.concatenate([*encoded(x), spherical_harmonics(jnp.asarray(r))]))
    refracted = light(np.concatenate([*encoded(x), *encoded(d)]))
    fall = (1.0 - np.clip(-d @ n, 0.0, 1.0)) ** 5
    shine, clear = (f + (1.0 - f) * fall for f in (0.04 + 0.96 * metallic, 0.04))
    opaque = (1.0 - shine) * np.asarray(diffuse) + shine * mirrored
    through = clear * mirrored + (1.0 - clear) * refracted
    return (1.0 - transmission) * opaque + transmission * through, next(layers, None)


@pytest.mark.slow
def test_colours_are_those_of_the_formulas_in_numpy():
    rng = np.random.default_rng(2)
    module, found = _Alone(_CONFIG), []
    points = [
        neus.Visible(features, 0.5 * x, n / np.linalg.norm(n), d / np.linalg.norm(d))
        for features, x, n, d in zip(*(rng.normal(size=(6, k)) for k in (4, 3, 3, 3)), strict=True)
    ]
    points = [neus.Visible(*map(jnp.float32, each)) for each in points]
    initial = module.init(jax.random.key(0), points[0])
    params = jax.tree.map(lambda w: jnp.float32(0.7 * rng.normal(size=w.shape)), initial)
    see = jax.jit(module.apply)
    for point in points:
        wanted, left = _in_numpy(point, params["params"])
        assert left is None
        found.append(see(params, point))
        np.testing.assert_allclose(found[-1], wanted, atol=2e-5)
    assert np.ptp(found, axis=0).min() > 0.05  # the points differ


class _Alone(nn.Module):
    """The colour alone."""

    config: nunerf.NunerfConfig

    @nn.compact
    def __call__(self, point):
        return nunerf.split(point, self.config)


@pytest.mark.slow
def test_surface_opacity_and_losses_are_those_of_neus():
    ours, theirs = nunerf.KIND, neus.KIND
    assert ours.depth is theirs.depth
    assert (ours.eikonal, ours.curvature, ours.hash_decay) == (0.1, 0.0, theirs.hash_decay)
    names = {each.name for each in dataclasses.fields(neus.NeusConfig)} - {"kind"}
    plain = neus.NeusConfig(**{name: getattr(_CONFIG, name) for name in names})
    params, other = _trained(), _trained(plain)
    shared = {name: params.surface["params"][name] for name in ("Dense_0", "Dense_1", "grid")}
    other = other._replace(
        surface={"params": other.surface["params"] | shared}, around=params.around
    )
    for point in ([0.5, 0.6, 0.45], [0.95, 0.5, 0.5]):
        seen, same = (
            _see(*each, jnp.asarray(point)) for each in ((params, _CONFIG), (other, plain))
        )
        for name in ("signed", "slope", "curvature", "within", "density"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(same, name))
        equal = np.array_equal(seen.rgb, same.rgb)
        assert equal != bool(seen.within)  # beyond the ball, the field around is the same


def test_sizes_are_those_of_neus_with_a_split_colour():
    for name, size in nunerf.KIND.sizes.items():
        theirs = neus.KIND.sizes[name]
        shape = shape_of(size.field)
        assert {key: shape[key] for key in shape_of(theirs.field)} == shape_of(theirs.field)
        assert (size.samples, size.footprint) == (theirs.samples, theirs.footprint)
        assert size.field.octaves == 6


@pytest.mark.parametrize("wrong", ["octaves", "light_width", "light_depth"])
def test_networks_without_layers_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{wrong}=0"):
        dataclasses.replace(_CONFIG, **{wrong: 0})


# --- extremes ---


def test_colours_at_the_extremes_are_finite_with_their_gradients():
    """A tangent view, one from inside, and no normal, which has no direction to mirror."""

    def seen(material, lights, normal, direction):
        cosine = -jnp.dot(normal, direction)
        return jnp.sum(nunerf.combine(Material(*material), *lights, cosine))

    slopes = jax.jit(jax.value_and_grad(seen, argnums=(0, 1, 2)))
    up, lights = jnp.array([0.0, 0.0, 1.0]), (jnp.asarray(_MIRRORED), jnp.asarray(_REFRACTED))
    for transmission in (0.0, 1.0):
        material = jnp.asarray(_DIFFUSE), jnp.float32(1.0), jnp.float32(transmission)
        for normal in (up, jnp.array([1.0, 0.0, 0.0]), -up, jnp.zeros(3)):
            assert gradients.all_finite(slopes(material, lights, normal, -up)), normal


@pytest.mark.slow
def test_fields_are_finite_with_their_gradients_where_the_slope_is_zero():
    """Exactly so in the middle of the initial ball, whose signed value is a distance."""
    initial = initial_field(_CONFIG)

    def seen(params, point):
        found = registry.radiance(params, _CONFIG, _at(point), _TOWARDS)
        return jnp.sum(found.rgb), found.slope

    slopes = jax.jit(jax.grad(seen, has_aux=True))
    assert np.array_equal(slopes(initial, jnp.full(3, 0.5))[1], np.zeros(3))
    for params in (initial, _trained(), _trained(size=30.0)):
        for point in ([0.5, 0.5, 0.5], [0.55, 0.6, 0.5], [0.0, 1.0, 0.3]):
            assert gradients.all_finite(slopes(params, jnp.asarray(point))), point


def test_gradients_of_the_split_are_numerical():
    def seen(diffuse, metallic, transmission, mirrored, refracted, cosine):
        material = Material(diffuse, metallic, transmission)
        return nunerf.combine(material, mirrored, refracted, cosine)

    gradients.assert_numerical(seen, _DIFFUSE, 0.3, 0.6, _MIRRORED, _REFRACTED, 0.4)


# --- what the split is for ---


@pytest.mark.slow
@pytest.mark.loose
def test_a_view_that_the_surface_does_not_explain_is_memorised():
    """Colours of a place that depend on the direction alone: a few steps halve the error thrice."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(256, 3))
    direction = jnp.float32(direction / np.linalg.norm(direction, axis=-1, keepdims=True))
    point = jnp.float32(0.5 + rng.uniform(-0.02, 0.02, size=(256, 3)) + np.array([0.12, 0.0, 0.0]))
    wanted = 0.5 + 0.4 * jnp.sin(3.0 * direction)
    params = initial_field(_CONFIG)
    optimiser = optax.adam(1e-2)

    def loss(params):
        seen = jax.vmap(lambda x, d: registry.radiance(params, _CONFIG, _at(x), d).rgb)
        return jnp.mean(jnp.square(seen(point, direction) - wanted))

    @jax.jit
    def train(params):
        def step(carry, _):
            params, state = carry
            value, slope = jax.value_and_grad(loss)(params)
            change, state = optimiser.update(slope, state)
            return (optax.apply_updates(params, change), state), value

        return jax.lax.scan(step, (params, optimiser.init(params)), length=150)[1]

    losses = train(params)
    assert losses[-1] < losses[0] / 8.0
