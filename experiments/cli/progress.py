"""A progress bar for commands."""

import sys
from typing import Self

from etils import epy

with epy.lazy_imports():
    from rich import progress


class ProgressBar:
    """A progress bar with free text, or plain lines where the output is not a terminal."""

    _PLAIN_LINES = 20

    def __init__(self, label: str, total: int, done: int = 0) -> None:
        """Starts a bar for `total` steps, of which `done` are finished already."""
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

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def move(self, done: int, total: int, text: str) -> None:
        """Updates a bar whose total was unknown when it was started."""
        if total != self._total:
            self._total, self._printed = total, done
            self._bar.update(self._task, total=total)
        self.show(done, text)

    def show(self, done: int, text: str) -> None:
        """Updates the bar, or prints 20 lines in total if the output is not a terminal."""
        self._bar.update(self._task, completed=done, text=text)
        due = done - self._printed >= self._total / self._PLAIN_LINES or done == self._total
        if self._bar.disable and due:
            print(f"{self._label} {done}/{self._total}  {text}", flush=True)
            self._printed = done
