"""Sub-spaces along a path: integrated each by itself, decoded, and blended by their shares."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import msnerf, registry
from refref_jax.fields.base import Blend, SubSpaces
from refref_jax.fields.msnerf import MsnerfConfig, MsnerfParams, MsnerfProposalConfig
from refref_jax.optics.path_settings import STRAIGHT, TREE
from refref_jax.render import Model, render_ray, render_rays, volume_rendering
from refref_jax.render.model import BackdropConfig, Params, ProposalConfig, init_params, look_up
from refref_jax.render.volume_rendering import Jitter
from tests.factories import made_paths, scenes
from tests.factories.small_model import MODEL
from tests.laws import gradients

# Sums of a few products in float32.
_ROUNDING = 2e-6

_ONE = jnp.float32(1.0)


def _field(**changes):
    """Returns a small field with sub-spaces on the grid of the small model."""
    plain = MODEL.field
    made = MsnerfConfig(
        plain.grid,
        plain.density_width,
        plain.bottleneck,
        plain.colour_width,
        plain.colour_depth,
        sub_spaces=3,
        channels=4,
        decoder_width=5,
    )
    return dataclasses.replace(made, **changes)


_PROPOSALS = tuple(
    ProposalConfig(MsnerfProposalConfig(each.field.grid, each.field.width), each.samples)
    for each in MODEL.proposals
)
_CONFIG = dataclasses.replace(MODEL, field=_field(), proposals=_PROPOSALS)
_PLANTED = MsnerfParams(None, None)


def _bent():
    """Enters an object after 1 unit, and leaves it after another 1.5."""
    directions = [(0, 0, -1), (0.6, 0, -0.8), (0, 0, -1)]
    return made_paths.path([1.0, 1.5], directions, [0, 1, 0], origin=(0, 0, 2.5))


def _total(params, config, path, jitter, anneal):
    """Returns a number that depends on all that a path shows, and what it shows."""
    seen = volume_rendering.path_radiance(params, config, path, jitter, anneal)
    finite = seen.composite._replace(median=jnp.zeros(()))
    moments = sum(jnp.sum(jnp.square(each.weights)) for each in seen.histograms)
    return sum(map(jnp.sum, finite)) + moments, seen


_radiance = jax.jit(volume_rendering.path_radiance, static_argnums=1)
_slopes = jax.jit(jax.grad(_total, has_aux=True), static_argnums=1)


def _rendered(params, config, path=None, function=_radiance):
    path = jax.tree.map(jnp.asarray, _bent() if path is None else path)
    return function(params, config, path, Jitter(jnp.zeros(2), jnp.zeros(2)), _ONE)


def _anew(function):
    """Returns a compiled function that shares no program with others, as of another registry."""
    return jax.jit(lambda *arguments: function(*arguments), static_argnums=1)


def _trained(config=_CONFIG, size=0.6):
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: jnp.asarray(size * rng.normal(size=x.shape), jnp.float32), shapes)


# --- the numbers of the released functions ---


def _published():
    """Returns the input of the fixture: a decoder, densities and features of three intervals."""
    kernel = lambda o, rows, columns: np.sin(
        1.0 + o + 3.0 * np.arange(rows)[:, None] + np.arange(columns)
    )
    layers = {
        "Dense_0": (kernel(0, 2, 4), 0.1 * np.arange(4)),
        "Dense_1": (kernel(3, 4, 3), np.zeros(3)),
        "Dense_2": (kernel(1, 2, 4), 0.1 * np.arange(4)),
        "Dense_3": (kernel(2, 4, 1), np.zeros(1)),
    }
    decoder = {name: {"kernel": k, "bias": b} for name, (k, b) in layers.items()}
    i, k, c = np.arange(3.0)[:, None], np.arange(2.0), np.arange(2.0)
    density = 0.3 + 0.2 * i + 0.15 * k
    features = 0.1 * (1.0 + i)[..., None] * (1.0 + c) / (1.0 + k)[:, None]
    single = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)
    return single({"params": decoder}), single(SubSpaces(density, features))


_EDGES = jnp.array([0.0, 0.5, 1.2, 2.0], jnp.float32)


def _weigh(density):
    return volume_rendering.opaque_end(volume_rendering.alpha_weights(density, jnp.diff(_EDGES)))


def test_a_path_has_the_numbers_of_the_released_functions():
    """Those of `ms-nerf` at commit 253addc: its weights of one space at a time, and its decoder."""
    decoder, seen = _published()
    config = dataclasses.replace(
        _CONFIG, field=_field(sub_spaces=2, channels=2, decoder_width=4), space="unbounded"
    )
    params = Params((), MsnerfParams(None, decoder))

    @jax.jit
    def integrate(params, seen):
        each = jax.vmap(_weigh, in_axes=1, out_axes=1)(seen.density)
        return volume_rendering.integrate(params, config, seen, _EDGES, weigh=_weigh), each

    (weights, found), each = integrate(params, seen)
    expected = [[0.1392920, 0.2014838], [0.2541773, 0.2918993], [0.6065307, 0.5066170]]
    np.testing.assert_allclose(each, expected, atol=_ROUNDING)
    features = np.sum(np.asarray(each)[..., None] * np.asarray(seen.features), axis=0)
    np.testing.assert_allclose(
        features, [[0.2467239, 0.4934478], [0.1152567, 0.2305133]], atol=_ROUNDING
    )
    blend = jax.jit(msnerf.blend, static_argnums=1)(params.field, config.field, features)
    # Colours here may exceed [0, 1] by 0.001.
    colours = (np.asarray(blend.rgb) + 0.001) / 1.002
    expected = [[0.5327210, 0.5833203, 0.5578557], [0.5175976, 0.5520464, 0.5387632]]
    np.testing.assert_allclose(colours, expected, atol=_ROUNDING)
    np.testing.assert_allclose(blend.shares, [0.4931852, 0.5068148], atol=_ROUNDING)
    rgb = (np.asarray(found.rgb) + 0.001) / 1.002
    np.testing.assert_allclose(rgb, [0.5250562, 0.5674702, 0.5481793], atol=_ROUNDING)
    np.testing.assert_allclose(weights, [0.1708117, 0.2732954, 0.5558929], atol=_ROUNDING)
    np.testing.assert_allclose(found.median, 1.280437, atol=1e-5)
    # The released transmittance, which accumulates over the sub-spaces, would give another colour.
    assert np.max(np.abs(rgb - [0.6396196, 0.6863774, 0.6609048])) > 0.1


# --- what must hold ---


@pytest.fixture
def as_sub_space(monkeypatch):
    """Returns a function that makes a plain field one sub-space, with the identity as decoder."""

    def plant(config):
        kind = registry.KINDS[config.field.kind]

        def radiance(params, field, gaussians, direction):
            seen = kind.radiance(params, field, gaussians, direction)
            return SubSpaces(seen.density[None], seen.rgb[None])

        def blend(params, field, features):
            return Blend(features, jnp.ones(1))

        changed = kind._replace(radiance=radiance, blend=blend)
        monkeypatch.setitem(registry.KINDS, config.field.kind, changed)

    return plant


@pytest.mark.slow
@pytest.mark.parametrize("last_sample", ["middle", "end"])
def test_one_sub_space_equals_the_plain_field(as_sub_space, last_sample):
    config = dataclasses.replace(MODEL, last_sample=last_sample)
    params = _trained(config)
    plain = _rendered(params, config)
    as_sub_space(config)
    one = _rendered(params, config, function=_anew(volume_rendering.path_radiance))
    for expected, found in zip(jax.tree.leaves(plain), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def _permuted(params, order, config):
    """Returns parameters whose sub-spaces are in another order."""
    count, channels = config.field.sub_spaces, config.field.channels
    tree = jax.tree.map(np.array, params)
    layers = tree.field.sub_spaces["params"]
    rest = np.arange(count, count + config.field.bottleneck)
    of_density = np.concatenate([order, rest])
    of_features = (order[:, None] * channels + np.arange(channels)).reshape(-1)
    for name, columns in (("Dense_1", of_density), ("Dense_3", of_features)):
        layers[name]["kernel"] = layers[name]["kernel"][:, columns]
        layers[name]["bias"] = layers[name]["bias"][columns]
    return jax.tree.map(jnp.asarray, tree)


@pytest.mark.slow
def test_the_order_of_sub_spaces_does_not_matter():
    params = _trained()
    one = _rendered(params, _CONFIG)
    other = _rendered(_permuted(params, np.array([2, 0, 1]), _CONFIG), _CONFIG)
    for expected, found in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def _with_densities(params, raw):
    """Returns parameters with these outputs for the densities of the sub-spaces."""
    tree = jax.tree.map(np.array, params)
    layer = tree.field.sub_spaces["params"]["Dense_1"]
    layer["kernel"][:, : len(raw)] = 0.0
    layer["bias"][: len(raw)] = raw
    return jax.tree.map(jnp.asarray, tree)


@pytest.mark.parametrize("size", [1e-4, 0.6, 100.0])
@pytest.mark.parametrize(
    "raw", [(-1e10,) * 3, (1e10,) * 3, (-1e10, 1e10, 0.0), (0.0, 1e5, -1e5)], ids=str
)
def test_values_and_gradients_are_finite_for_any_densities(raw, size):
    params = _with_densities(_trained(size=size), raw)
    slopes, seen = _rendered(params, _CONFIG, function=_slopes)
    assert gradients.all_finite((slopes, seen))
    np.testing.assert_allclose(seen.composite.accumulation, 1.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(seen.histograms[-1].weights), 1.0, atol=1e-5)


@pytest.mark.slow
def test_without_density_a_path_shows_the_wall_behind():
    """Sub-spaces without density, and those that are opaque at the start, by closed forms."""
    config = dataclasses.replace(_CONFIG, last_sample="end")
    straight = made_paths.path([], [(0, 0, -1)], [0], origin=(0, 0, 3), segments=3)
    empty = _rendered(_with_densities(_trained(), (-1e10,) * 3), config, straight).composite
    np.testing.assert_allclose([empty.median, empty.mean], 3.0 + 7.5, rtol=1e-5)
    full = _rendered(_with_densities(_trained(), (1e10,) * 3), config, straight)
    np.testing.assert_allclose(full.histograms[-1].weights, [1.0, *[0.0] * 5], atol=1e-6)
    assert full.composite.median < empty.median


@pytest.fixture
def planted(monkeypatch):
    """Returns a function that renders the bent path before a backdrop, with given sub-spaces."""

    def render(densities, shares, colours):
        def radiance(params, field, gaussians, direction):
            return SubSpaces(jnp.float32(densities), jnp.float32(colours))

        monkeypatch.setattr(registry, "density", lambda params, field, gaussians: jnp.float32(1.0))
        monkeypatch.setattr(registry, "radiance", radiance)
        # Colours that do not depend on how much light there is.
        monkeypatch.setattr(
            registry,
            "blend",
            lambda params, field, features: Blend(jnp.float32(colours), jnp.float32(shares)),
        )
        config = dataclasses.replace(_CONFIG, backdrop=BackdropConfig(8, in_front="field"))
        function = _anew(volume_rendering.foreground_radiance)
        return _rendered(Params((None,), _PLANTED), config, function=function).composite

    return render


@pytest.mark.slow
def test_light_of_a_backdrop_passes_through_each_sub_space_by_itself(planted):
    densities, shares = np.array([0.0, 2.0, 1e6]), np.array([0.5, 0.3, 0.2])
    colours = np.array([[0.9, 0.1, 0.2], [0.2, 0.7, 0.1], [0.3, 0.3, 0.6]])
    stopped = 1.0 - np.exp(-densities * 1.5 / MODEL.radius)
    found = planted(densities, shares, colours)
    np.testing.assert_allclose(found.rgb, (shares * stopped) @ colours, atol=1e-5)
    np.testing.assert_allclose(found.accumulation, shares @ stopped, atol=1e-5)
    none = planted(np.zeros(3), shares, colours)
    np.testing.assert_array_equal(none.rgb, 0.0)
    assert none.accumulation == 0.0 and np.isinf(none.median)


# --- the rest of the renderer ---


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [STRAIGHT, TREE],
    ids=["straight", "tree"],
)
def test_it_renders_along_straight_and_bent_paths(settings):
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    rays = scenes.rays([[-4.0, 0.21, 0.33], [-4.0, 3.0, 0.0]], [1.0, 0.02, 0.01])

    def render(scene, params):
        return render_rays(Model(_CONFIG, settings, scene, params), rays)

    seen = jax.jit(render)(scene, _trained())
    assert gradients.all_finite(seen.rgb) and np.all(np.asarray(seen.linear) >= -0.0011)
    assert np.all(np.asarray(seen.linear) <= 1.0011) and np.std(seen.linear) > 0.0


@pytest.mark.slow
def test_an_opaque_surface_has_the_colour_of_the_blended_features():
    """One interval of weight 1, as the last of a path that ends there."""
    params = _trained()
    path = jax.tree.map(jnp.asarray, _bent())
    whole = volume_rendering.polylines.whole_path(path)._replace(stop=jnp.float32(2.0))
    found = volume_rendering._opaque_surface(params, _CONFIG, whole)
    assert found.shape == (3,) and np.all((found >= -0.001001) & (found <= 1.001001))


def test_a_point_alone_is_refused():
    params = _trained()
    with pytest.raises(ValueError, match=r"A point has no colour in fields of kind msnerf"):
        look_up(params, _CONFIG, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]), width=0.1)
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    ray = jax.tree.map(lambda x: x[0], scenes.rays([[-4.0, 0.2, 0.3]], [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"of kind msnerf\. Use render_rays"):
        render_ray(Model(_CONFIG, STRAIGHT, scene, params), ray)
