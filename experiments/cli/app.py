"""How commands start, stop, and report what is wrong.

Flags are absl's, and so are help, flag files and what is said of a wrong flag. Here an error of any
kind becomes one line and status 2. Nothing here imports JAX: commands import what does lazily, so
that a wrong flag is refused at once.
"""

import difflib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from types import ModuleType
from typing import Any, NoReturn, Self

from absl import app, flags, logging

INTERRUPTED = 130
"""Status of a command that was stopped by Ctrl-C, as shells have it."""


STOP_WITH_INPUT = "REFREF_STOP_WITH_INPUT"
"""Variable of the environment: if it is set, a command stops when its standard input ends."""


def run(main: Callable[..., None], *, arguments: Sequence[str] = (), again: str = "") -> None:
    """Runs a command; wrong input, or a file that can not be read, ends it with one line.

    Its status is 2 then, and 130 after Ctrl-C.

    Args:
      main: function of the command; its parameters are the command's arguments, as text.
      arguments: names of the arguments, as `FOLDER`; all must be given.
      again: sentence on what the same command does when it is given again, told on Ctrl-C.
    """
    module = sys.modules[main.__module__]

    def guarded(words: Sequence[str]) -> None:
        if os.environ.pop(STOP_WITH_INPUT, ""):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.set_verbosity(logging.ERROR)
        refuse_words(module, words[1:], arguments)
        try:
            main(*words[1:])
        except (ValueError, OSError) as error:
            fail(str(error))

    try:
        app.run(guarded, flags_parser=parse)
    except KeyboardInterrupt:
        print(f"Interrupted. {again[:1].upper()}{again[1:]}".rstrip(), file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # Not `sys.exit`: XLA may be compiling on other threads, and crashes when Python goes.
        os._exit(INTERRUPTED)


def parse(words: Sequence[str]) -> list[str]:
    """Reads the flags of a command line and returns the other words; what is wrong ends it."""
    try:
        return flags.FLAGS(words)
    except flags.Error as error:
        fail(str(error))
    except SystemExit:  # absl has printed help, and calls that status 1
        sys.exit(0)


def fail(message: str) -> NoReturn:
    """Ends the command because of what the user gave, with one line."""
    print(f"error: {' '.join(message.splitlines())}", file=sys.stderr)
    sys.exit(2)


def check(holder: flags.FlagHolder, refuse: Callable[[Any], Any]) -> None:
    """Has absl check a flag; `refuse` raises a `ValueError` that says what is wrong."""

    def hold(value: Any) -> bool:
        try:
            refuse(value)
        except ValueError as error:
            raise flags.ValidationError(str(error)) from error
        return True

    flags.register_validator(holder.name, hold)


def refuse_words(module: ModuleType, given: Sequence[str], arguments: Sequence[str]) -> None:
    """Ends the command if there are more or fewer arguments than it takes."""
    if len(given) == len(arguments):
        return
    for word in given:
        if word.partition("=")[0] in flags_of(module):
            fail(f"Unexpected argument {word!r}. Did you mean --{word}?")
    if len(given) < len(arguments):
        fail(f"{arguments[len(given)]} is missing. Give {' '.join(arguments)}; see --help.")
    fail(f"Unexpected argument {given[len(arguments)]!r}. Flags begin with --; see --help.")


def did_you_mean(word: str, names: Iterable[str], *, most: int = 1) -> str:
    """Returns ` Did you mean NAME?`, of the likest names, or nothing if none is like the word."""
    near = difflib.get_close_matches(word, list(names), n=most)
    return f" Did you mean {' or '.join(near)}?" if near else ""


def flags_of(module: ModuleType) -> dict[str, flags.Flag]:
    """Returns the flags of a command by name."""
    return {flag.name: flag for flag in flags.FLAGS.get_key_flags_for_module(module)}


def name_of(module: ModuleType) -> str:
    """Returns the name of a command, as `experiments.train`, however it was started."""
    spec = module.__spec__
    return module.__name__ if spec is None else spec.name.removesuffix(".__main__")


def shell(name: str, *options: str) -> str:
    """Returns the line that runs a command of `experiments`, quoted so that it can be pasted."""
    return shlex.join(["python", "-m", f"experiments.{name}", *options])


def _stop_with_input() -> None:
    """Asks this process to stop, as `kill` would, when its standard input ends."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def stop_at_kill() -> None:
    """Has `kill` raise `KeyboardInterrupt` as Ctrl-C does, once: groups are often told twice."""

    def stop(number: int, frame: object) -> None:
        # Not SIG_IGN, which a process that is started now would have too.
        signal.signal(number, lambda *_: None)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)


class Interrupt:
    """Notes Ctrl-C and `kill` while its context lasts, so that a step can be finished and saved.

    A second Ctrl-C ends the process at once. A second `kill` is the same wish as the first, for it
    may come from somebody else: `timeout` sends two, to its command and to its group.
    """

    def __init__(self) -> None:
        """Nothing is requested yet."""
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: object) -> None:
        more = b"."
        if number == signal.SIGINT:
            signal.signal(number, signal.SIG_DFL)
            more = b"; once more to stop at once."
        if number == signal.SIGINT or not self.requested:
            # Not `print`: the signal may have come while something was being printed.
            os.write(1, b"Stopping after this step" + more + b"\n")
        self.requested = True
