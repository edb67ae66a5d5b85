"""Inputs that are wrong by a known amount, and the error that costs a decibel."""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import sensitivity
from benchmarks.sensitivity import Trial
from benchmarks.wrong_inputs import ERRORS, Inputs
from refref_jax.data import scene_folder, scene_properties
from refref_jax.data.scene_assembly import shaded_mesh
from tests.factories import scenes

_BUNDLED = Path(__file__).parents[2] / "experiments" / "data" / "cube_smcvx_ball"


@pytest.fixture(scope="module")
def inputs():
    return Inputs(
        (scenes.ball(1.0, subdivisions=4),),
        scene_folder.read_frames(_BUNDLED, "test"),
        scene_properties.read(_BUNDLED),
    )


def _perturbed(inputs, wrong, amount, seed=0):
    return ERRORS[wrong].perturb(inputs, amount, np.random.default_rng(seed))


def _degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1.0, 1.0)))


def test_errors_have_the_amount_that_their_unit_says(inputs):
    ball = inputs.parts[0]
    diagonal = 2.0 * math.sqrt(3.0)
    assert _perturbed(inputs, "index", 0.01).parts[0].index == pytest.approx(ball.index + 0.01)
    radii = np.linalg.norm(_perturbed(inputs, "vertices", 1.0).parts[0].vertices, axis=1)
    assert np.sqrt(np.mean((radii - 1.0) ** 2)) == pytest.approx(0.01 * diagonal, rel=0.4)
    tilted = _perturbed(inputs, "normals", 3.0).parts[0]
    np.testing.assert_array_equal(tilted.vertices, ball.vertices)
    tilt = _degrees(tilted.normals, shaded_mesh(ball).normals)
    assert np.sqrt(np.mean(tilt**2)) == pytest.approx(3.0, rel=0.4)
    larger = _perturbed(inputs, "size of the object", 3.0).parts[0].vertices
    np.testing.assert_allclose(larger, 1.03 * ball.vertices, atol=1e-6)
    moved = _perturbed(inputs, "place of the object", 1.0).parts[0].vertices - ball.vertices
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.01 * diagonal, rtol=1e-5)
    extent = inputs.properties.background.extent
    wrong = _perturbed(inputs, "size of the background", 3.0).properties.background
    assert wrong.extent == pytest.approx(1.03 * extent) and wrong.faces


def test_turned_objects_and_cameras_are_turned_by_degrees(inputs):
    ball, poses = inputs.parts[0], inputs.frames.cameras.poses
    turned = _perturbed(inputs, "rotation of the object", 10.0).parts[0].vertices
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=1e-5)
    assert np.max(_degrees(turned, ball.vertices)) == pytest.approx(10.0, abs=0.1)
    aimed = _perturbed(inputs, "rotation of the cameras", 3.0).frames.cameras.poses
    np.testing.assert_array_equal(aimed[:, :, 3], poses[:, :, 3])
    change = np.einsum("nji,njk->nik", poses[:, :, :3], aimed[:, :, :3])
    angles = np.degrees(np.arccos(0.5 * (np.trace(change, axis1=1, axis2=2) - 1.0)))
    np.testing.assert_allclose(angles, 3.0, atol=1e-3)
    away = _perturbed(inputs, "place of the cameras", 1.0).frames.cameras.poses - poses
    share = np.linalg.norm(away[:, :, 3], axis=1) / np.linalg.norm(poses[:, :, 3], axis=1)
    np.testing.assert_allclose(share, 0.01, rtol=0.05)


def test_right_inputs_stay_as_they_are(inputs):
    before = inputs.frames.cameras.poses.copy()
    for wrong, error in ERRORS.items():
        _perturbed(inputs, wrong, error.amounts[-1])
    np.testing.assert_array_equal(inputs.frames.cameras.poses, before)


@pytest.mark.parametrize(
    ("lost", "expected"),
    [
        ([0.0, 0.5, 2.0], 1.0 * (3.0 / 1.0) ** (1.0 / 3.0)),
        ([2.0, 4.0, 8.0], 0.5 * 0.1),
        ([0.1, 0.2, 0.3], math.inf),
    ],
)
def test_the_error_of_a_decibel_is_between_its_neighbours(lost, expected):
    right = Trial("ball", "tree", "index", "", 0.0, 30.0)
    errors = zip((0.1, 1.0, 3.0), lost, strict=True)
    curve = [right, *(right._replace(error=e, psnr_masked=30.0 - x) for e, x in errors)]
    assert sensitivity.cost_of_a_decibel(curve) == pytest.approx(expected)
