"""Ctrl-C and `kill` are noted while a step is finished, and stop a command at once after it."""

import os
import signal
import types

import pytest

from experiments.cli import app
from refref_jax.training import fit

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


def test_before_its_first_step_a_training_ends_with_nothing_saved(tmp_path, monkeypatch, capfd):
    def set_up(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return types.SimpleNamespace(hit_fraction=1.0)

    known = types.SimpleNamespace(
        schedule=types.SimpleNamespace(steps=5),
        scene=types.SimpleNamespace(path="scene"),
        settings=types.SimpleNamespace(bends=1),
        model=types.SimpleNamespace(far_field="field"),
        config=types.SimpleNamespace(backdrop=None, splats=None),
        seed=0,
    )
    for module, name in (
        (fit.run_folder, "read_config"),
        (fit.checkpoint_io, "read_static"),
        (fit.checkpoint_io, "load_scene"),
        (fit.scene_source, "open_scene"),
        (fit, "read_pixels"),
        (fit, "_report_misses"),
        (fit, "init_state"),
        (fit.devices, "put_everywhere"),
    ):
        monkeypatch.setattr(module, name, lambda *arguments, **options: known)
    monkeypatch.setattr(fit.loop, "set_up", set_up)
    monkeypatch.setattr(fit, "_take_steps", lambda *arguments: pytest.fail("it has begun"))
    with pytest.raises(KeyboardInterrupt), app.Interrupt() as interrupt:
        fit.train(tmp_path, stop=lambda: interrupt.requested)
    assert "Stopping after this step" in capfd.readouterr().out
    assert not any((tmp_path / "checkpoints").iterdir())
