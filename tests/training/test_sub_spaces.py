"""A field with sub-spaces is trained, written, read and named like any other."""

import json

import jax
import numpy as np
import pytest

from refref_jax.fields.msnerf import MsnerfParams
from refref_jax.geometry.cameras import image_rays
from refref_jax.render import checkpoint_io
from refref_jax.render.images import render_image
from refref_jax.training import fit, run_folder
from refref_jax.training.config import TrainConfig
from tests.factories.small_model import CAMERAS
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"


_PERIODS = fit.Periods(log=1)


def _config(**changes):
    small = {"samples_per_ray": (12, 8), "log2_hashmap_size": 10, "max_res": 64, "batch": 128}
    given = {"paths": "straight", "field": "msnerf", "sub_spaces": 2, "steps": 60, **changes}
    return TrainConfig().override(scene=str(_SCENE), pretraced_batches=4, **small, **given)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model, and the folder of its run."""
    run = tmp_path_factory.mktemp("msnerf") / "run"
    made = fit.fit(_config(), out=run, periods=_PERIODS, report=lambda line: None)
    return made, run


@pytest.mark.slow
def test_some_steps_lower_the_loss(trained):
    lines = run_folder.read_metrics(trained[1])
    losses = [line["loss"] for line in lines]
    assert len(losses) == 60 and np.mean(losses[-10:]) < 0.7 * np.mean(losses[:3])
    assert all(np.isfinite([line["interlevel"], line["distortion"]]).all() for line in lines)


@pytest.mark.slow
def test_a_checkpoint_is_read_as_it_was_written(trained):
    made, run = trained
    read = checkpoint_io.load_model(run)
    assert (read.config, read.settings) == (made.config, made.settings)
    assert read.config.field.kind == "msnerf" and read.config.field.sub_spaces == 2
    assert isinstance(read.params.field, MsnerfParams)
    for ours, theirs in zip(*map(jax.tree.leaves, (made.params, read.params)), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    image = render_image(read, jax.tree.map(lambda x: x[:4, :4], image_rays(CAMERAS, 0)))
    assert np.all(np.isfinite(image.rgb)) and np.all(image.distance > 0.0)


@pytest.mark.slow
def test_commands_name_the_kind_of_field(trained, tmp_path):
    run = trained[1]
    run_command("evaluate", f"--run={run}", "--split=val", "--limit=1")
    summary = json.loads((run / "eval" / "val" / "metrics.json").read_text())
    assert summary["method"] == "msnerf" and summary["results"]["psnr"] > 5.0
    # A point alone has neither density nor colour.
    out = tmp_path / "surface.ply"
    options = (f"--run={run}", "--what=mesh", f"--out={out}")
    refused = run_command("export", *options, fails=True)
    assert "kind msnerf, whose sub-spaces are blended" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1 and not out.exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sub_spaces": 0}, r"sub_spaces is 0\. Give 1 to 64"),
        ({"field": "zipnerf"}, r"sub_spaces=2 has no effect on field kind zipnerf"),
        ({"field": "msnef"}, r"field is 'msnef'.*msnerf"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_compiled(changes, message, monkeypatch):
    monkeypatch.setattr(jax, "jit", None)
    with pytest.raises(ValueError, match=message):
        fit.prepare(_config(**changes), report=lambda line: None)
