"""Ctrl-C and `kill` are noted while a step is finished, and stop a command at once after it."""

import os
import signal

import pytest

from experiments import commands

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", _SIGNALS)
def test_a_signal_is_noted_and_the_signals_are_given_back(number, capfd):
    before = [signal.getsignal(each) for each in _SIGNALS]
    with commands.Interrupt() as interrupt:
        assert not interrupt.requested
        os.kill(os.getpid(), number)
        assert interrupt.requested
        # The next one ends the process.
        assert signal.getsignal(number) is signal.SIG_DFL
    assert "Stopping after this step" in capfd.readouterr().out
    assert [signal.getsignal(each) for each in _SIGNALS] == before


def test_the_signals_are_given_back_after_an_error():
    before = [signal.getsignal(each) for each in _SIGNALS]
    with pytest.raises(ZeroDivisionError), commands.Interrupt():
        raise ZeroDivisionError
    assert [signal.getsignal(each) for each in _SIGNALS] == before
