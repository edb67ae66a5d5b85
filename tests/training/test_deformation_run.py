"""A field that bends rays is trained, written, read and named like any other."""

import json

import jax
import numpy as np
import pytest

from refref_jax.fields.raydef import RaydefParams
from refref_jax.fields.rosenerf import RosenerfParams
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
    given = {"field": "raydef", "steps": 60, **changes}
    return TrainConfig().override(scene=str(_SCENE), pretraced_batches=4, **small, **given)


@pytest.fixture(scope="module", params=["raydef", "raydef_polyline", "rosenerf"])
def trained(request, tmp_path_factory):
    """A model, and the folder of its run."""
    run = tmp_path_factory.mktemp(request.param) / "run"
    silent = {"periods": _PERIODS, "report": lambda line: None}
    assert fit.train_into(run, _config(field=request.param), **silent)
    return checkpoint_io.load_model(run), run


@pytest.mark.slow
def test_some_steps_lower_the_loss_and_bend_rays(trained):
    lines = run_folder.read_metrics(trained[1])
    losses = [line["loss"] for line in lines]
    assert len(losses) == 60 and np.mean(losses[-10:]) < 0.7 * np.mean(losses[:3])
    names = ("bends", "turns", "offsets")
    assert all(np.isfinite([line[name] for name in names]).all() for line in lines)
    kind = trained[0].config.field.kind
    assert (lines[0]["offsets"] < 1e-12) == (kind == "rosenerf")  # which begins without
    assert lines[-1]["offsets"] > 10.0 * lines[2]["offsets"] > 0.0
    # The directions of a polyline are those of its segments. A second ray is straight, but samples
    # stay within the scene.
    most, least = max(abs(line["turns"]) for line in lines), {"raydef": 1e-5}.get(kind, -1.0)
    assert least < most < {"raydef": 1.0, "raydef_polyline": 1e-5, "rosenerf": 1e-3}[kind]


@pytest.mark.slow
def test_a_checkpoint_is_read_and_rendered(trained):
    read, run = trained
    assert (read.config, read.settings) == tuple(vars(checkpoint_io.read_static(run)).values())
    params = RosenerfParams if read.config.field.kind == "rosenerf" else RaydefParams
    assert isinstance(read.params.field, params) and read.settings.max_bends == 0
    image = render_image(read, jax.tree.map(lambda x: x[:4, :4], image_rays(CAMERAS, 0)))
    assert np.all(np.isfinite(image.rgb)) and np.all(image.distance > 0.0)


@pytest.mark.slow
def test_commands_name_the_kind_of_field(trained, tmp_path):
    made, run = trained
    kind = made.config.field.kind
    run_command("evaluate", f"--run={run}", "--split=val", "--limit=1")
    summary = json.loads((run / "eval" / "val" / "metrics.json").read_text())
    assert summary["method"] == kind and summary["results"]["psnr"] > 5.0
    out = tmp_path / "surface.ply"
    options = (f"--run={run}", "--what=mesh", f"--out={out}")
    refused = run_command("export", *options, fails=True)
    assert f"kind {kind}, which bend rays" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1 and not out.exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"paths": "tree"}, r"field=raydef bends straight rays, not those of paths=tree"),
        ({"max_bends": 2}, r"field=raydef bends straight rays"),
        ({"far_field": "backdrop"}, r"cannot model .*deformation \(field=raydef\)"),
        ({"deformation_weights": (1.0, 2.0)}, r"deformation_weights has 2 numbers"),
        ({"deformation_weights": (1.0, -2.0, 0.0)}, r"weight or blur of the losses is -2\.0"),
        (
            {"field": "zipnerf", "deformation_weights": (1.0, 1.0, 1.0)},
            r"deformation_weights has no effect on field kind zipnerf",
        ),
        ({"field": "raydeff"}, r"field is 'raydeff'.*raydef"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_compiled(changes, message, monkeypatch):
    monkeypatch.setattr(jax, "jit", None)
    with pytest.raises(ValueError, match=message):
        fit.prepare(_config(**changes), report=str)


@pytest.mark.slow
def test_weights_of_the_losses_are_those_of_the_kind():
    resolved, _ = fit.prepare(_config(), report=lambda line: None)
    assert resolved.config.losses.deformation_weights == (3e-3, 1e-3, 1e-4)
    given = _config(deformation_weights=(1e-2, 0.0, 0.0))
    resolved, _ = fit.prepare(given, report=lambda line: None)
    assert resolved.config.losses.deformation_weights == (1e-2, 0.0, 0.0)
    plain, _ = fit.prepare(_config(field="zipnerf", paths="straight"), report=lambda line: None)
    assert plain.config.losses.deformation_weights is None
