"""What all commands share: how they start, stop, and report errors and progress."""

import math
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Self

from absl import app, logging

from experiments.cli import command_line, first_interrupt
from experiments.cli.first_interrupt import INTERRUPTED
from experiments.cli.late_imports import late

if TYPE_CHECKING:
    from rich import progress
else:
    progress = late("rich.progress")

NOT_FINITE = ("inf", "-inf", "nan")
"""Names of the numbers that JSON does not know."""

STOP_WITH_INPUT = "REFREF_STOP_WITH_INPUT"
"""Variable of the environment: if it is set, a command stops when its standard input ends.

Whoever starts a command so, and holds the other end, takes it along when it ends or is killed.
"""


def run(
    main: Callable[..., None],
    *,
    arguments: Sequence[str] = (),
    first: Sequence[str] = (),
    again: str = "",
    settled: Callable[[], command_line.Settled | None] = lambda: None,
) -> None:
    """Runs a command; an error of the user's input ends it with one line and status 2.

    So do files that can not be read or written. Ctrl-C ends it with status 130. It begins with the
    options that hold, of which those of its module and those that this adopts are the command's.

    Args:
      main: the command; its parameters are its arguments, as text.
      arguments: what each argument is called, as `FOLDER`; all must be given.
      first: names of the options that decide most, which --help tells first.
      again: what happens when the same command is given again, after it was done or interrupted.
      settled: tells which options an earlier call has settled, if it has.
    """
    module = sys.modules[main.__module__]

    def parse(words: Sequence[str]) -> list[str]:
        return command_line.read(words, module, first=first, again=again)

    def guarded(words: Sequence[str]) -> None:
        if os.environ.pop(STOP_WITH_INPUT, ""):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.set_verbosity(logging.ERROR)
        command_line.refuse_words(module, words[1:], arguments)
        try:
            print(command_line.echo(module, words[1:], settled()), flush=True)
            main(*words[1:])
        except (ValueError, OSError) as error:
            command_line.fail(str(error))

    try:
        first_interrupt.give_back()
        app.run(guarded, flags_parser=parse)
    except KeyboardInterrupt:
        print(f"Interrupted. {again[:1].upper()}{again[1:]}".rstrip(), file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # Not `sys.exit`: XLA may be compiling on other threads, and crashes when Python goes.
        os._exit(INTERRUPTED)


def _stop_with_input() -> None:
    """Asks this process to stop, as `kill` would, when its standard input ends."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def stop_at_kill() -> None:
    """Has `kill` raise `KeyboardInterrupt` as Ctrl-C does, once: more of them are the same wish.

    A group of processes is often told twice: by who ends the group, and by one of its members.
    """

    def stop(number: int, frame: object) -> None:
        del frame
        # Not SIG_IGN, which a process that is started now would have too.
        signal.signal(number, lambda *_: None)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)


def shell(name: str, *options: str) -> str:
    """Returns the line that runs a command of `experiments`, quoted so that it can be pasted."""
    return shlex.join(["python", "-m", f"experiments.{name}", *options])


def string_safe(value: Any) -> Any:
    """Replaces numbers that JSON does not know by their names."""
    if isinstance(value, dict):
        return {key: string_safe(item) for key, item in value.items()}
    if isinstance(value, list):
        return [string_safe(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def from_string_safe(value: Any) -> Any:
    """Undoes `string_safe`."""
    if isinstance(value, dict):
        return {key: from_string_safe(item) for key, item in value.items()}
    if isinstance(value, list):
        return [from_string_safe(item) for item in value]
    return float(value) if isinstance(value, str) and value in NOT_FINITE else value


class Interrupt:
    """Notes that the user wants to stop, so that a step can be finished and saved.

    It has the signals of Ctrl-C and of `kill` as long as its context lasts. A second Ctrl-C ends
    the process at once. A second `kill` is the same wish as the first, for it may come from
    somebody else: `timeout` sends two, to its command and to the group that this is in.
    """

    def __init__(self) -> None:
        """Nothing is requested yet."""
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Takes the signals over."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *error: object) -> None:
        """Gives the signals back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: object) -> None:
        del frame
        more = b"."
        if number == signal.SIGINT:
            signal.signal(number, signal.SIG_DFL)
            more = b"; once more to stop at once."
        if number == signal.SIGINT or not self.requested:
            # Not `print`: the signal may have come while something was being printed.
            os.write(1, b"Stopping after this step" + more + b"\n")
        self.requested = True


class ProgressBar:
    """A progress bar with free text, or plain lines where the output is not a terminal."""

    _PLAIN_LINES = 20

    def __init__(self, label: str, total: int, done: int = 0) -> None:
        """Starts a bar.

        Args:
          label: what is being done.
          total: number of steps.
          done: steps already done.
        """
        self._bar = progress.Progress(
            progress.TextColumn("{task.description}"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[text]}"),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            disable=not sys.stdout.isatty(),
        )
        self._task = self._bar.add_task(label, total=total, completed=done, text="")
        self._label, self._total = label, total
        self._printed = done

    def __enter__(self) -> "ProgressBar":
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def move(self, done: int, total: int, text: str) -> None:
        """Moves the bar of work whose length was not known when it was started."""
        if total != self._total:
            self._total, self._printed = total, done
            self._bar.update(self._task, total=total)
        self.show(done, text)

    def show(self, done: int, text: str) -> None:
        """Moves the bar; on a plain output a line is printed every twentieth of the way."""
        self._bar.update(self._task, completed=done, text=text)
        due = done - self._printed >= self._total / self._PLAIN_LINES or done == self._total
        if self._bar.disable and due:
            print(f"{self._label} {done}/{self._total}  {text}", flush=True)
            self._printed = done
