"""When the viewer draws which size: a state machine without clock, threads or pictures.

Everything that changes what is to be seen, a moving camera or a slider, is a *change*. Pictures are
drawn in *stages*, small to large. While changes come, the first stage alone is drawn, again and
again; `STILL` seconds after the last one the larger stages follow, one after the other.

A change makes larger stages stale, and whoever draws one should stop. The first stage is never
stale: it is drawn to its end and shown, or a camera that never rests would show nothing.
"""

from typing import NamedTuple

STILL = 0.25
"""Seconds without a change after which a picture is refined."""


class State(NamedTuple):
    """What is known between two events.

    Attributes:
      stages: number of sizes.
      change: number of the last change, counted from 1; 0 before any.
      changed_at: time of the last change, seconds of any clock that runs evenly.
      drawn: stages that are drawn of the last change.
    """

    stages: int
    change: int = 0
    changed_at: float = 0.0
    drawn: int = 0


class Job(NamedTuple):
    """A picture to draw.

    Attributes:
      change: what it shows is as it was after this change, or later.
      stage: its size.
    """

    change: int
    stage: int


def changed(state: State, now: float) -> State:
    """Returns the state after a change at a time."""
    return state._replace(change=state.change + 1, changed_at=now, drawn=0)


def next_job(state: State, now: float) -> Job | None:
    """Returns what to draw at a time, or `None` if there is nothing to draw yet."""
    pause = wait(state, now)
    return Job(state.change, state.drawn) if pause == 0.0 else None


def wait(state: State, now: float) -> float | None:
    """Returns in how many seconds there is something to draw; `None`: not before a change."""
    if state.change == 0 or state.drawn >= state.stages:
        return None
    if state.drawn == 0:
        return 0.0
    return max(0.0, state.changed_at + STILL - now)


def is_stale(state: State, job: Job) -> bool:
    """Returns whether a job is not worth going on with."""
    return job.stage > 0 and job.change != state.change


def finished(state: State, job: Job) -> State:
    """Returns the state after a job; one that a change has overtaken leaves the state as it is."""
    if job.change != state.change:
        return state
    return state._replace(drawn=job.stage + 1)
