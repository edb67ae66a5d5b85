"""`experiments.view` refuses mistakes before it compiles anything, and what is chosen is shown."""

import dataclasses
import subprocess
import sys

import jax
import numpy as np
import pytest

from experiments.viewer import layers, session
from experiments.viewer.session import Subject
from refref_jax.data import scene_folder
from refref_jax.optics.path_settings import STRAIGHT, TREE, capacity_factors
from refref_jax.render import Model, init_params
from tests.factories import scenes
from tests.factories.small_model import MODEL
from tests.processes.command import ROOT


def _subject(settings=TREE, frames=None):
    parts = scenes.build(scenes.ball(1.0, subdivisions=1), scenes.ball(0.5, subdivisions=1))
    model = Model(
        MODEL, settings, parts, jax.eval_shape(lambda: init_params(jax.random.key(0), MODEL))
    )
    return Subject("made", model, "nested", frames, ("glass", "bubble"), (36, 90), 4096)


def test_without_viser_it_says_what_to_install(tmp_path):
    (tmp_path / "config.json").write_text("{}")  # as the folder of a run has
    code = (
        "import runpy, sys\n"
        "sys.modules['viser'] = None\n"
        f"sys.argv = ['view', '--run={tmp_path}']\n"
        "runpy.run_module('experiments.view', run_name='__main__', alter_sys=True)"
    )
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "pip install -e '.[viewer]'" in result.stderr


def test_the_first_choice_is_the_model_as_it_was_trained():
    subject = _subject()
    choice = session.first_choice(subject)
    assert choice.layer == layers.RGB and choice.indices == (1.5, 1.5)
    model = session.chosen_model(subject, choice)
    assert model.settings is subject.model.settings and model.scene == subject.model.scene


def test_another_index_changes_arrays_and_nothing_that_is_compiled():
    subject = _subject()
    choice = dataclasses.replace(session.first_choice(subject), indices=(1.7, 1.2))
    model = session.chosen_model(subject, choice)
    assert model.settings == subject.model.settings
    np.testing.assert_array_equal(model.scene.interfaces.index_inside, np.float32([1.7, 1.2]))
    np.testing.assert_array_equal(model.scene.interfaces.index_outside, np.float32([1.0, 1.7]))
    before, after = (jax.tree.map(np.shape, x.scene) for x in (subject.model, model))
    assert before == after
    types = (jax.tree.map(lambda x: x.dtype, each.scene) for each in (subject.model, model))
    assert len({tuple(jax.tree.leaves(each)) for each in types}) == 1


def test_another_cut_and_other_bends_are_another_budget_with_room_for_them():
    subject = _subject()
    first = session.first_choice(subject)
    finer = session.chosen_model(
        subject, dataclasses.replace(first, min_throughput=0.005, max_bends=32)
    ).settings
    assert (finer.min_throughput, finer.max_bends) == (0.005, 32)
    paths = capacity_factors(finer).paths_per_ray
    assert paths == pytest.approx(2.0 * capacity_factors(TREE).paths_per_ray)
    straight = _subject(STRAIGHT)
    choice = session.first_choice(straight)
    assert session.chosen_model(straight, choice) is straight.model


def test_parts_have_the_names_of_their_meshes_where_these_are_known(ball_scene):
    assert session.part_names(ball_scene, 1) == ("ball_body_glass",)
    assert session.part_names(ball_scene, 2) == ("part 1", "part 2")
    assert session.part_names(None, 1) == ("part 1",)


def test_a_page_begins_at_the_first_test_view_or_beside_the_origin(ball_scene):
    frames = scene_folder.read_frames(ball_scene, "test")
    view = session.first_viewpoint(_subject(frames=frames))
    np.testing.assert_array_equal(view.pose, frames.cameras.poses[0])
    alone = session.first_viewpoint(_subject()).pose
    assert np.linalg.norm(alone[:, 3]) == pytest.approx(4.0)
    np.testing.assert_allclose(alone[:, 2], alone[:, 3] / 4.0, atol=1e-12)  # looks at the origin
