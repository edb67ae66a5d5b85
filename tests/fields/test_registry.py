"""Kinds of field, and that one more is a module and a line of the registry."""

import dataclasses
import json
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax import configuration
from refref_jax.fields import hash_grid, nerfacto, registry
from refref_jax.fields.base import DensityConfig, FieldKind, FieldSize, Radiance, RadianceConfig
from refref_jax.optics.path_settings import STRAIGHT
from refref_jax.render import checkpoint_io
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import Model, init_params
from refref_jax.render.pixels import render_rays
from refref_jax.sampling.scene_bounds import Bounds
from refref_jax.training.config import FieldConfig
from refref_jax.training.presets import PRESETS, loss, override_model, samples_of
from tests.factories import scenes, small_model

_BOUNDS = Bounds(near=0.05, far=16.0, radius=7.3, space="bounded")


@dataclasses.dataclass(frozen=True)
class _FogConfig(RadianceConfig):
    colours: int = 3
    kind: Literal["fog"] = dataclasses.field(default="fog", kw_only=True)


@dataclasses.dataclass(frozen=True)
class _FogProposalConfig(DensityConfig):
    kind: Literal["fog"] = dataclasses.field(default="fog", kw_only=True)


def _fog_density(params, config, gaussians):
    return jnp.exp(params["density"])


_FOG = FieldKind(
    radiance_config=_FogConfig,
    init_radiance=lambda key, config: {"density": jnp.ones(()), "rgb": jnp.full(3, 0.25)},
    radiance=lambda params, config, gaussians, direction: Radiance(
        _fog_density(params, config, gaussians), params["rgb"]
    ),
    density_config=_FogProposalConfig,
    init_density=lambda key, config: {"density": jnp.zeros(())},
    density=_fog_density,
    sizes={
        "tiny": FieldSize(_FogConfig(), (_FogProposalConfig(),) * 3, (8, 6, 4, 2), 1, "cone", 0.0)
    },
    hash_decay=0.0,
)


@pytest.fixture
def fog(monkeypatch):
    """The line of the registry."""
    monkeypatch.setitem(registry.KINDS, "fog", _FOG)


@pytest.mark.slow
def test_a_third_kind_is_rendered_saved_and_sized(fog, tmp_path):
    model = PRESETS["tiny"].model(_BOUNDS, "field", field="fog")
    assert samples_of(model) == (8, 6, 4, 2)
    assert loss(model).blurs == (0.03, 0.003, 0.003) and loss(model).hash_decay == 0.0
    static = SavedModel(model, STRAIGHT)
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    checkpoint_io.save_scene(tmp_path, static, scene)
    assert checkpoint_io.read_static(tmp_path) == static
    params = jax.jit(lambda: init_params(jax.random.key(0), model))()
    assert hash_grid.tables(params) == []
    rays = jax.tree.map(jnp.asarray, small_model.sampler().survey(4).rays)
    seen = jax.jit(lambda rays: render_rays(Model(model, STRAIGHT, scene, params), rays))(rays)
    np.testing.assert_allclose(seen.linear, 0.25, rtol=1e-5)


def test_what_a_third_kind_has_not_is_refused(fog):
    with pytest.raises(ValueError, match=r"Field kind fog has no size paper\..* tiny"):
        PRESETS["paper"].model(_BOUNDS, "field", field="fog")
    model = PRESETS["tiny"].model(_BOUNDS, "field", field="fog")
    for options in (FieldConfig(log2_hashmap_size=12), FieldConfig(max_res=64)):
        with pytest.raises(ValueError, match="which field kind fog does not have"):
            override_model(model, options)
    with pytest.raises(ValueError, match=r"colour_network=skip .* unlike fog"):
        override_model(model, FieldConfig(colour_network="skip"))
    assert override_model(model, FieldConfig(precision="bfloat16")) != model


# --- the kinds there are ---


@pytest.mark.parametrize("name", registry.KINDS)
def test_configurations_know_their_kind(name):
    kind = registry.KINDS[name]
    assert set(kind.sizes) == set(PRESETS)
    for size in kind.sizes.values():
        assert type(size.field) is kind.radiance_config and size.field.kind == name
        assert {(type(each), each.kind) for each in size.proposals} == {(kind.density_config, name)}
        assert len(size.samples) == len(size.proposals) + 1


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", registry.KINDS)
def test_models_of_every_kind_and_size_survive_a_file(name, preset, tmp_path):
    static = SavedModel(PRESETS[preset].model(_BOUNDS, "clear", field=name), STRAIGHT)
    configuration.write(tmp_path / "model.json", static)
    assert checkpoint_io.read_static(tmp_path) == static


def _without_kind(value):
    if isinstance(value, dict):
        return {key: _without_kind(each) for key, each in value.items() if key != "kind"}
    return [_without_kind(each) for each in value] if isinstance(value, list) else value


def test_files_of_older_runs_mean_zipnerf(tmp_path):
    static = SavedModel(PRESETS["small"].model(_BOUNDS, "clear"), STRAIGHT)
    path = tmp_path / "model.json"
    configuration.write(path, static)
    content = json.loads(path.read_text())
    path.write_text(json.dumps(_without_kind(content)))
    assert json.loads(path.read_text()) != content
    assert checkpoint_io.read_static(tmp_path) == static


def test_files_of_older_runs_mean_the_origin(tmp_path):
    static = SavedModel(PRESETS["tiny"].model(_BOUNDS, "clear"), STRAIGHT)
    path = tmp_path / "model.json"
    configuration.write(path, static)
    content = json.loads(path.read_text())
    assert content["config"].pop("centre") == [0.0, 0.0, 0.0]
    path.write_text(json.dumps(content))
    assert checkpoint_io.read_static(tmp_path) == static
    content["config"]["centre"] = [1.0, 2.0, -3.0]
    path.write_text(json.dumps(content))
    assert checkpoint_io.read_static(tmp_path).config.centre == (1.0, 2.0, -3.0)


def test_files_of_older_runs_mean_the_middle_of_the_last_interval(tmp_path):
    static = SavedModel(PRESETS["tiny"].model(_BOUNDS, "clear"), STRAIGHT)
    path = tmp_path / "model.json"
    configuration.write(path, static)
    content = json.loads(path.read_text())
    assert content["config"].pop("last_sample") == "end"
    path.write_text(json.dumps(content))
    assert checkpoint_io.read_static(tmp_path).config.last_sample == "middle"


def test_a_kind_that_is_not_known_is_named(tmp_path):
    static = SavedModel(PRESETS["tiny"].model(_BOUNDS, "clear"), STRAIGHT)
    path = tmp_path / "model.json"
    configuration.write(path, static)
    path.write_text(path.read_text().replace('"zipnerf"', '"plenoxels"'))
    with pytest.raises(ValueError, match=r"kind is 'plenoxels', not one of zipnerf, nerfacto"):
        checkpoint_io.read_static(tmp_path)


def test_nerfacto_has_its_published_size():
    size = nerfacto.KIND.sizes["paper"]
    grid = size.field.grid
    assert (grid.levels, grid.base_res, grid.max_res, grid.hashmap_size) == (16, 16, 2048, 2**19)
    assert (grid.features, size.field.density_width, size.field.bottleneck) == (2, 64, 15)
    assert (size.field.colour_width, size.field.colour_depth) == (64, 2)
    assert [each.grid.max_res for each in size.proposals] == [128, 256]
    for each in size.proposals:
        assert (each.width, each.grid.levels, each.grid.hashmap_size) == (16, 5, 2**17)
        assert (each.grid.features, each.grid.base_res) == (2, 16)
    assert size.samples == (256, 96, 48) and size.multisamples == 1
