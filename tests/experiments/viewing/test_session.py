"""When the viewer draws: events in, jobs out."""

import random

from experiments.viewer import session
from experiments.viewer.session import STILL, Job, State


def test_a_camera_that_rests_is_refined_and_then_left_alone():
    state = State(stages=3)
    assert session.next_job(state, 5.0) is None and session.wait(state, 5.0) is None
    state = session.changed(state, 10.0)
    now, drawn = 10.0, []
    while (pause := session.wait(state, now)) is not None:
        now += pause
        job = session.next_job(state, now)
        drawn.append((round(now, 6), job.stage))
        state = session.finished(state, job)
    assert drawn == [(10.0, 0), (10.0 + STILL, 1), (10.0 + STILL, 2)]
    assert session.next_job(state, 1e9) is None


def test_a_moving_camera_gets_the_first_stage_alone_and_gets_it():
    state, now, shown = State(stages=3), 0.0, 0
    for _ in range(40):  # a change every 0.1 s, a drawing takes 0.15 s
        state = session.changed(state, now)
        job = session.next_job(state, now)
        assert job.stage == 0
        state = session.changed(state, now + 0.1)
        assert not session.is_stale(state, job)
        state = session.finished(state, job)
        shown, now = shown + 1, now + 0.2
    assert shown == 40
    # What was drawn last was overtaken: it is drawn once more, of the last change.
    assert session.next_job(state, now) == Job(state.change, 0)


def test_a_newer_camera_cancels_the_refinement_of_an_older_one():
    state = session.changed(State(stages=3), 0.0)
    state = session.finished(state, Job(1, 0))
    job = session.next_job(state, STILL)
    assert job == Job(1, 1) and not session.is_stale(state, job)
    state = session.changed(state, STILL + 0.01)
    assert session.is_stale(state, job)
    assert session.finished(state, job) == state
    assert session.next_job(state, STILL + 0.01) == Job(2, 0)


def test_any_order_of_events_ends_with_all_stages_of_the_last_change():
    for seed in range(50):
        rng = random.Random(seed)
        state, now, job, last = State(stages=rng.randint(1, 4)), 0.0, None, []
        for _ in range(60):
            now += rng.uniform(0.0, 0.2)
            if rng.random() < 0.4:
                state = session.changed(state, now)
            elif job is not None:
                state, job = session.finished(state, job), None
            else:
                job = session.next_job(state, now)
                assert job is None or job.stage == 0 or now - state.changed_at >= STILL
        state = session.changed(state, now)
        while (pause := session.wait(state, now)) is not None:
            now += pause
            job = session.next_job(state, now)
            last.append(job)
            state = session.finished(state, job)
        assert last == [Job(state.change, stage) for stage in range(state.stages)]
