"""Starts and stops commands, and reports errors.

Flags, help, flag files and messages about invalid flags are absl's. Errors of any kind become one
line with exit status 2. This module does not import JAX; commands import it lazily, so that invalid
flags are reported immediately.
"""

import difflib
import errno
import importlib
import importlib.util
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from types import ModuleType
from typing import Any, NoReturn, Self

from absl import app, flags, logging

from experiments.cli import program_cache
from refref_jax.data import ALLOW_OUTSIDE

INTERRUPTED = 130
"""Exit status of a command that was stopped by Ctrl-C, as in shells."""


STOP_WITH_INPUT = "REFREF_STOP_WITH_INPUT"
"""Environment variable: if it is set, a command stops when its standard input ends."""


# Errors of a full disk, and words in errors of JAX on a lack of memory.
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
_NO_MEMORY = ("RESOURCE_EXHAUSTED", "Out of memory", "bad_alloc", "Cannot allocate memory")

# Flags on which the memory of a command depends, by how much.
_TAKE_MEMORY = (
    "batch",
    "pretraced_batches",
    "chunk",
    "gaussians",
    "most_pixels",
    "heights",
    "resolution",
)

_LONGEST_REASON = 200


# `refref_jax.compilation.TRAVERSAL`, whose module imports JAX.
_TRAVERSAL = "REFREF_TRAVERSAL"


def run(main: Callable[..., None], *, arguments: Sequence[str] = (), again: str = "") -> None:
    """Runs a command; invalid input and unreadable files end it with one line.

    The exit status is 2 in that case, and 130 after Ctrl-C.

    Args:
      main: function of the command; it receives the command's arguments as text.
      arguments: names of the arguments, such as `FOLDER`; all are required.
      again: sentence printed on Ctrl-C that explains the effect of repeating the command.
    """
    module = sys.modules[main.__module__]

    def guarded(words: Sequence[str]) -> None:
        if os.environ.pop(STOP_WITH_INPUT, ""):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.set_verbosity(logging.FATAL)  # what Orbax logs as an error it raises, too
        refuse_words(module, words[1:], arguments)
        program_cache.keep()
        if importlib.util.find_spec("jax_plugins"):  # JAX may run on a GPU
            importlib.import_module("refref_jax.compilation").add_missing_flags()
        try:
            if "allow_outside" in flags.FLAGS and flags.FLAGS["allow_outside"].value:
                os.environ[ALLOW_OUTSIDE] = "1"  # other processes that this one starts inherit it
            if _TRAVERSAL in os.environ:
                importlib.import_module("refref_jax.compilation").chosen_traversal()
            main(*words[1:])
        except Exception as error:
            told = _shortage(error, module, again)
            if told is None and not isinstance(error, ValueError | OSError):
                raise
            fail(told or str(error))

    try:
        app.run(guarded, flags_parser=parse)
    except KeyboardInterrupt:
        print(f"Interrupted. {again[:1].upper()}{again[1:]}".rstrip(), file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # Not `sys.exit`: XLA may be compiling on other threads, and crashes at interpreter exit.
        os._exit(INTERRUPTED)


def _shortage(error: BaseException, module: ModuleType, again: str) -> str | None:
    """Returns what a full disk or a lack of memory means for the user; `None` for other errors."""
    reasons = [error]
    for each in reasons:  # it grows
        inner = (each.__cause__, each.__context__, *getattr(each, "exceptions", ()))
        reasons += [other for other in inner if other is not None and other not in reasons]
    texts = [" ".join(str(each).split())[:_LONGEST_REASON] for each in reasons]
    for each, text in zip(reasons, texts, strict=True):
        if getattr(each, "errno", None) in _NO_SPACE or "No space left" in str(each):
            return f"The disk is full ({text}). Make space. {again[:1].upper()}{again[1:]}".strip()
        if isinstance(each, MemoryError) or any(word in text for word in _NO_MEMORY):
            names = [f"--{name}" for name in _TAKE_MEMORY if name in flags_of(module)]
            lower = f"Lower {' or '.join(names)}, or use" if names else "Use"
            return f"Memory ran out ({text or 'MemoryError'}). {lower} smaller images and meshes."
    return None


def parse(words: Sequence[str]) -> list[str]:
    """Parses the flags of a command line and returns the other words; errors end the command."""
    try:
        return flags.FLAGS(words)
    except flags.Error as error:
        fail(str(error))
    except SystemExit:  # absl has printed help, and uses status 1 for it
        sys.exit(0)


def fail(message: str) -> NoReturn:
    """Ends the command with a one-line message about invalid input."""
    print(f"error: {' '.join(message.splitlines())}", file=sys.stderr)
    sys.exit(2)


def check(holder: flags.FlagHolder, refuse: Callable[[Any], Any]) -> None:
    """Registers a validator of a flag; `refuse` raises a `ValueError` with the reason."""

    def hold(value: Any) -> bool:
        try:
            refuse(value)
        except ValueError as error:
            raise flags.ValidationError(str(error)) from error
        return True

    flags.register_validator(holder.name, hold)


def refuse_words(module: ModuleType, given: Sequence[str], arguments: Sequence[str]) -> None:
    """Ends the command if it has too many or too few arguments."""
    if len(given) == len(arguments):
        return
    for word in given:
        if word.partition("=")[0] in flags_of(module):
            fail(f"Unexpected argument {word!r}. Did you mean --{word}?")
    if len(given) < len(arguments):
        fail(f"{arguments[len(given)]} is missing. Give {' '.join(arguments)}; see --help.")
    fail(f"Unexpected argument {given[len(arguments)]!r}. Flags begin with --; see --help.")


def did_you_mean(word: str, names: Iterable[str], *, most: int = 1) -> str:
    """Returns ` Did you mean NAME?` with the closest names, or nothing if none is similar."""
    near = difflib.get_close_matches(word, list(names), n=most)
    return f" Did you mean {' or '.join(near)}?" if near else ""


def flags_of(module: ModuleType) -> dict[str, flags.Flag]:
    """Returns the flags of a command by name."""
    return {flag.name: flag for flag in flags.FLAGS.get_key_flags_for_module(module)}


def name_of(module: ModuleType) -> str:
    """Returns the name of a command, such as `experiments.train`, however it was started."""
    spec = module.__spec__
    return module.__name__ if spec is None else spec.name.removesuffix(".__main__")


def shell(name: str, *options: str) -> str:
    """Returns the shell command line of a command of `experiments`, quoted."""
    return shlex.join(["python", "-m", f"experiments.{name}", *options])


def _stop_with_input() -> None:
    """Stops this process, as by `kill`, when its standard input ends."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def stop_at_kill() -> None:
    """Makes `kill` raise `KeyboardInterrupt` like Ctrl-C, once: groups often receive it twice."""

    def stop(number: int, frame: object) -> None:
        # Not SIG_IGN, which child processes would inherit.
        signal.signal(number, lambda *_: None)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)


class Interrupt:
    """Records Ctrl-C and `kill` inside the context, so that a step can be finished and saved.

    A second Ctrl-C ends the process at once. Repeated `kill`s are treated as one, because they may
    have one origin: `timeout` sends one to its command and one to its process group.
    """

    def __init__(self) -> None:
        """Starts without a request."""
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
            # Not `print`: the signal may have arrived during a print.
            os.write(1, b"Stopping after this step" + more + b"\n")
        self.requested = True
