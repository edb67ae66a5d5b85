"""Ctrl-C and `kill` are noted while a step is finished, and stop a command at once after it."""

import os
import signal

import pytest

from experiments.cli import app
from refref_jax.training import fit
from refref_jax.training.config import TrainConfig

pytestmark = pytest.mark.loose

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", _SIGNALS)
def test_a_signal_is_noted_and_the_signals_are_given_back(number, capfd):
    before = [signal.getsignal(each) for each in _SIGNALS]
    with app.Interrupt() as interrupt:
        assert not interrupt.requested
        os.kill(os.getpid(), number)
        assert interrupt.requested
        if number == signal.SIGINT:
            # The next one ends the process.
            assert signal.getsignal(number) is signal.SIG_DFL
        else:
            os.kill(os.getpid(), number)
    assert capfd.readouterr().out.count("Stopping after this step") == 1
    assert [signal.getsignal(each) for each in _SIGNALS] == before


def test_the_signals_are_given_back_after_an_error():
    before = [signal.getsignal(each) for each in _SIGNALS]
    with pytest.raises(ZeroDivisionError), app.Interrupt():
        raise ZeroDivisionError
    assert [signal.getsignal(each) for each in _SIGNALS] == before


@pytest.mark.slow
def test_before_its_first_step_a_training_ends_with_nothing_saved(
    ball_scene, tmp_path, monkeypatch, capfd
):
    set_up = fit.loop.set_up

    def interrupted(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return set_up(*arguments, **options)

    monkeypatch.setattr(fit.loop, "set_up", interrupted)
    monkeypatch.setattr(fit, "_take_steps", lambda *arguments: pytest.fail("it has begun"))
    options = {"scene": str(ball_scene), "paths": "straight", "far_field": "field", "batch": 64}
    config = TrainConfig().override(**options, steps=5)
    with pytest.raises(KeyboardInterrupt), app.Interrupt() as interrupt:
        fit.fit(config, out=tmp_path / "run", stop=lambda: interrupt.requested)
    assert "Stopping after this step" in capfd.readouterr().out
    assert not any((tmp_path / "run" / "checkpoints").iterdir())
