"""Ctrl-C and `kill` are noted while a step is finished, and stop a command at once after it."""

import os
import signal
import subprocess
import sys
import types

import pytest

from experiments.cli import commands, first_interrupt
from refref_jax.training import fit
from tests.experiments.command import ROOT

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", _SIGNALS)
def test_a_signal_is_noted_and_the_signals_are_given_back(number, capfd):
    before = [signal.getsignal(each) for each in _SIGNALS]
    with commands.Interrupt() as interrupt:
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
    with pytest.raises(ZeroDivisionError), commands.Interrupt():
        raise ZeroDivisionError
    assert [signal.getsignal(each) for each in _SIGNALS] == before


def test_before_its_first_step_a_training_ends_with_nothing_saved(tmp_path, monkeypatch, capfd):
    def set_up(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return types.SimpleNamespace(hit_fraction=1.0)

    known = types.SimpleNamespace(
        schedule=types.SimpleNamespace(steps=5),
        scene=types.SimpleNamespace(path="scene"),
        budget=types.SimpleNamespace(bends=1),
        config=None,
        seed=0,
    )
    for module, name in (
        (fit.run_folder, "read_config"),
        (fit.saved, "read_static"),
        (fit.saved, "load_geometry"),
        (fit.scene_source, "open_scene"),
        (fit, "_sampler"),
        (fit, "init_state"),
        (fit.devices, "put_everywhere"),
    ):
        monkeypatch.setattr(module, name, lambda *arguments, **options: known)
    monkeypatch.setattr(fit.loop, "set_up", set_up)
    monkeypatch.setattr(fit, "_take_steps", lambda *arguments: pytest.fail("it has begun"))
    with pytest.raises(KeyboardInterrupt), commands.Interrupt() as interrupt:
        fit.train(tmp_path, stop=lambda: interrupt.requested)
    assert "Stopping after this step" in capfd.readouterr().out
    assert not any((tmp_path / "checkpoints").iterdir())


# Starts a command as a shell does, or a script in the background, which has it ignore Ctrl-C.
_START = """
import os, signal, sys
signal.signal(signal.SIGINT, getattr(signal, sys.argv[1]))
os.execv(sys.executable, [sys.executable, "-m", "experiments.train"])
"""


def _interrupted_while_importing(folder, signals):
    """Runs a command whose import of absl meets Ctrl-C."""
    (folder / "absl").mkdir()
    text = "import os, signal, sys\nos.kill(os.getpid(), signal.SIGINT)\nsys.exit(3)\n"
    (folder / "absl" / "__init__.py").write_text(text)
    return subprocess.run(
        [sys.executable, "-c", _START, signals],
        env=os.environ | {"PYTHONPATH": str(folder)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_interrupt_of_the_first_imports_is_no_traceback(tmp_path):
    done = _interrupted_while_importing(tmp_path, "SIG_DFL")
    assert (done.returncode, done.stdout) == (commands.INTERRUPTED, "")
    assert done.stderr == "Interrupted before it began.\n"


def test_who_ignores_interrupts_still_does_in_the_first_imports(tmp_path):
    done = _interrupted_while_importing(tmp_path, "SIG_IGN")
    assert (done.returncode, done.stderr) == (3, "")


def test_the_commands_themselves_raise_at_an_interrupt():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        first_interrupt.take()
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        first_interrupt.give_back()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
