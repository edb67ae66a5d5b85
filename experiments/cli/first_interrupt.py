"""Ctrl-C from the first line of a command on, while Python still imports what reads its options."""

import os
import signal

INTERRUPTED = 130
"""Status of a command that was stopped by Ctrl-C, as shells have it."""


def take() -> None:
    """Ends the process at the first Ctrl-C, with one line; a process that ignores it still does."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def give_back() -> None:
    """Has Ctrl-C raise `KeyboardInterrupt` again, for whoever is there to handle it by now."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(number: int, frame: object) -> None:
    del number, frame
    os.write(2, b"Interrupted before it began.\n")
    os._exit(INTERRUPTED)
