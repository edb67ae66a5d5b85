"""What holds for every finished run, whatever was trained."""

import pytest

from refref_jax.render import checkpoint_io
from refref_jax.training import fit, run_folder
from tests.laws import expectations


def assert_repeats(run, made, again):
    """Asserts that the model `made`, trained in `again` by the configuration of `run`, is the same.

    Resumed, it is done; with another option it is refused.
    """
    config, messages = run_folder.read_config(run), []
    assert run_folder.read_config(again) == config
    first = checkpoint_io.load_model(run)
    assert (first.config, first.settings) == (made.config, made.settings)
    expectations.assert_same(first.params, made.params)
    done = fit.fit(config, out=again, existing="resume", report=messages.append)
    assert any("given: scene=" in message for message in messages)
    assert "trained already" in messages[-1] and done.settings == made.settings
    with pytest.raises(ValueError, match=r"other options \(seed\)"):
        fit.fit(config.override(seed=3), out=again, existing="resume", report=messages.append)
    with pytest.raises(ValueError, match="contains a run already"):
        fit.fit(config, out=again, report=messages.append)


def assert_loads_quietly(run, step, caplog, capfd):
    """Asserts that loading a run's model prints, logs and writes nothing."""
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    checkpoint_io.load_model(run)
    assert checkpoint_io.latest_step(run) == step
    assert not caplog.records and capfd.readouterr() == ("", "")
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*")}
