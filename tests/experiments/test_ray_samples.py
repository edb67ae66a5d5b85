"""Samples and weights along one ray: where they are, and how they are drawn."""

import dataclasses

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.figures import ray_samples
from experiments.figures.ray_samples import Panel, RaySamples
from experiments.runs import view_numbers
from refref_jax.geometry import cameras
from refref_jax.optics.path_settings import PAPER
from refref_jax.render import Model, init_params
from refref_jax.render.model import BackdropConfig
from tests.factories import scenes
from tests.factories.small_model import CAMERAS, MODEL
from tests.processes.command import ROOT, TINY, run_command

pytestmark = pytest.mark.loose

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"


def _model(**changes):
    config = dataclasses.replace(MODEL, **changes)
    params = jax.jit(lambda: init_params(jax.random.PRNGKey(3), config))()
    return Model(config, PAPER, scenes.build(scenes.ball(subdivisions=3)), params)


def _ray(height):
    return jax.tree.map(lambda x: x[0], scenes.rays([[-4.0, 0.0, height]], [1.0, 0.0, 0.0]))


@pytest.mark.slow
def test_samples_are_along_the_bent_path_and_know_what_is_inside():
    found = ray_samples.sample_ray(_model(), _ray(0.5))
    assert found.edges.shape == (MODEL.samples + 1,) and np.all(np.diff(found.edges) >= 0.0)
    assert found.weights.shape == found.outside.shape == (MODEL.samples,)
    assert found.weights.sum() == pytest.approx(1.0, abs=1e-5)
    # Snell's law by hand: the unit ball is met at a height of sin(a) = 0.5; the chord inside is
    # 2 cos(b) with sin(b) = 0.5 / 1.5. The mesh is an inscribed polyhedron.
    (passage,) = found.objects
    start, chord = 4.0 - np.cos(np.pi / 6.0), 2.0 * np.sqrt(1.0 - 1.0 / 9.0)
    assert passage == pytest.approx([start, start + chord], abs=0.03)
    middles = 0.5 * (found.edges[1:] + found.edges[:-1])
    inside = (middles > passage[0]) & (middles < passage[1])
    np.testing.assert_array_equal(~found.outside, inside)


@pytest.mark.slow
def test_the_path_is_the_heaviest_and_some_rays_and_models_have_nothing_inside():
    # At the rim more is reflected than at the middle, but less than half.
    assert ray_samples.sample_ray(_model(), _ray(0.9)).objects.shape == (1, 2)
    with pytest.raises(ValueError, match="enters no object"):
        ray_samples.sample_ray(_model(), _ray(1.5))
    with pytest.raises(ValueError, match="interior is clear, so it has no samples inside"):
        ray_samples.sample_ray(_model(interior="clear"), _ray(0.5))
    with pytest.raises(ValueError, match="far field is a backdrop"):
        ray_samples.sample_ray(_model(backdrop=BackdropConfig(8, in_front="field")), _ray(0.5))


def test_a_pixel_is_a_column_and_a_row():
    assert view_numbers.parse_pixel(None) is None
    assert view_numbers.parse_pixel("12, 3") == (12, 3)
    for text in ("12", "1,2,3", "a,2", "-1,2", ""):
        with pytest.raises(ValueError, match="is not a column and a row"):
            view_numbers.parse_pixel(text)
    ray = ray_samples.pixel_ray(CAMERAS, 1, 12, 3)
    expected = jax.tree.map(lambda x: jnp.asarray(x)[3, 12], cameras.image_rays(CAMERAS, 1))
    np.testing.assert_allclose(ray.directions, expected.directions)


@pytest.mark.slow
def test_a_column_is_drawn_for_each_run(tmp_path):
    edges = np.array([0.0, 2.0, 3.0, 4.0, 9.0])
    outside = np.array([True, False, False, True])
    panels = [
        Panel(title, RaySamples(edges, np.array(weights), outside, np.array([[2.0, 4.0]])))
        for title, weights in (("all", [0.0, 0.0, 0.01, 0.99]), ("outside", [0.0, 0.2, 0.2, 0.6]))
    ]
    drawn = []
    for i, shown in enumerate((panels, panels[:1])):
        ray_samples.write(tmp_path / f"{i}.jpg", shown)
        drawn.append(iio.imread(tmp_path / f"{i}.jpg"))
        assert drawn[-1].min() < 64 and drawn[-1].max() > 240 and drawn[-1].std() > 10.0
    assert drawn[0].shape[0] == drawn[1].shape[0] and drawn[0].shape[1] == 2 * drawn[1].shape[1]
    # Both share their axes, so that the weights inside differ: the columns are not the same.
    half = drawn[0].shape[1] // 2
    assert np.mean(np.abs(drawn[0][:, :half].astype(float) - drawn[0][:, half:])) > 1.0


@pytest.mark.slow
def test_the_command_draws_two_runs_along_a_pixel(tmp_path):
    runs = [tmp_path / name for name in ("everywhere", "outside")]
    for run in runs:
        given = ("--paths=paper", "--interior=field", f"--distortion={run.name}")
        run_command("train", f"--scene={_SCENE}", f"--out={run}", *TINY, *given)
    words = [f"--scene={_SCENE}", "--figure=samples", f"--out={tmp_path / 'figures'}"]
    told = run_command("glass_figures", *words, f"--runs={runs[0]},{runs[1]}", "--pixel=64,60")
    path = tmp_path / "figures" / "glass_samples.jpg"
    assert str(path) in told.stdout and iio.imread(path).shape[1] > 1000
    assert [file.name for file in path.parent.glob("*.jpg")] == [path.name]
    for given, message in (
        ((f"--runs={runs[0]}", "--pixel=500,2"), "--pixel=500,2 is outside the image"),
        ((f"--runs={runs[0]}", "--pixel=0,0"), "enters no object"),
    ):
        refused = run_command("glass_figures", *words, "--overwrite", *given, fails=True)
        assert message in refused.stderr and "Traceback" not in refused.stderr
