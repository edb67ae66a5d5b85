"""Light through a body mends what its outlines can not tell."""

import numpy as np
import pytest

from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import make_mesh
from refref_jax.optics.scene import Scene
from refref_jax.reconstruct import refractive_index
from refref_jax.reconstruct.light_refinement import LightRefinement, refine_by_light
from refref_jax.reconstruct.mesh_distance import compare_meshes
from tests.factories import bodies, lit_scenes, scenes

pytestmark = [pytest.mark.loose, pytest.mark.computing]

_TRUE = 1.5


@pytest.fixture(scope="module")
def truth():
    return bodies.icosphere(3)


@pytest.fixture(scope="module")
def evidence():
    ball = scenes.build(scenes.ball(1.0, subdivisions=3))
    return lit_scenes.evidence(ball, count=2048, contrast=3.0)[0]


def _dented(mesh):
    """The ball with a broad bump of a fiftieth of its radius."""
    bump = 0.02 * np.exp(-np.sum((mesh.vertices - [0.0, 0.0, 1.0]) ** 2, axis=-1) / 0.3)
    return make_mesh(mesh.vertices * (1.0 + bump)[:, None], mesh.faces)


def _error(mesh, index, evidence):
    part = MeshPart("ball_glass", mesh.vertices, mesh.faces, index, "auto")
    interfaces = assemble_scene([part], [-1], rule="nested").interfaces
    surfaces = pack_meshes([mesh])
    found = refractive_index.errors_at_index(
        np.float32(index),
        evidence,
        Scene(surfaces, interfaces),
        part=0,
        config=lit_scenes.CONFIG,
    )
    return float(np.mean(found)), interfaces


@pytest.mark.slow
def test_a_bump_shrinks_and_the_index_comes_nearer(truth, evidence):
    dented = _dented(truth)
    # As near as the search for the index comes. From further away, shape makes up for the index.
    start = _TRUE + 0.002
    before, interfaces = _error(dented, start, evidence)
    settings = LightRefinement(steps=60, rays=1024, handles=48, stride=3e-4)
    seen = []
    found = refine_by_light(
        dented,
        start,
        interfaces,
        evidence,
        config=lit_scenes.CONFIG,
        settings=settings,
        progress=lambda step, error: seen.append((step, error)),
    )
    after, _ = _error(found.mesh, found.index, evidence)
    assert after < 0.4 * before
    assert abs(found.index - _TRUE) < 0.001
    better, worse = compare_meshes(found.mesh, truth), compare_meshes(dented, truth)
    assert better.normal_error < 0.9 * worse.normal_error
    assert better.chamfer < 0.9 * worse.chamfer
    assert [step for step, _ in seen] == list(range(1, 61)) and len(found.errors) == 60
    assert 0.0 < found.furthest < 60 * settings.stride * np.sqrt(3.0)


@pytest.mark.slow
def test_a_step_moves_no_handle_further_than_a_stride(truth, evidence):
    _, interfaces = _error(truth, _TRUE, evidence)
    settings = LightRefinement(steps=1, rays=64, handles=16, stride=1e-3, index_stride=1e-3)
    found = refine_by_light(
        truth, _TRUE, interfaces, evidence, config=lit_scenes.CONFIG, settings=settings
    )
    assert 0.0 < found.furthest <= 1e-3 * np.sqrt(3.0) * 1.01
    assert 0.0 < abs(found.index - _TRUE) <= 1.01e-3
    assert np.all(np.isfinite(found.mesh.vertices)) and np.all(np.isfinite(found.mesh.normals))
