import dataclasses
import functools
import itertools
import json
import shutil
import time
import types
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics.path_settings import PAPER, STRAIGHT, TREE, capacities
from refref_jax.render import checkpoint_io
from refref_jax.render.checkpoint_io import load_model
from refref_jax.render.model import Params, path_detail
from refref_jax.training import devices, loop, run_folder
from refref_jax.training.loop import init_state
from refref_jax.training.run_folder import Checkpoints
from tests.factories import scenes, small_model
from tests.factories.small_model import MODEL, SAVED

pytestmark = [pytest.mark.loose, pytest.mark.longest]

# Steps of one epoch, fast enough to lower the loss: one program for all tests.
_SCHEDULE = dataclasses.replace(small_model.CONFIG.schedule, steps=32, peak=3e-2)
CONFIG = dataclasses.replace(small_model.CONFIG, schedule=_SCHEDULE)

# Keys that runs of earlier versions lack.
_ADDED_SINCE = {
    "config.json": [
        ("scene", "shading"),
        *(
            ("model", name)
            for name in (
                *("colour_network", "contraction", "near", "far", "sub_spaces"),
                "brightest",
            )
        ),
        *(("losses", name) for name in ("path_losses", "eikonal", "curvature")),
        ("schedule", "adam_b2"),
    ],
    "model.json": [("config", "field", name) for name in ("colour_network", "brightest")],
}

_GEOMETRY = scenes.build(scenes.ball(1.3, subdivisions=2))


def _setup(config=CONFIG, settings=PAPER, **options):
    pixels = small_model.sampler(config.seed)
    return loop.set_up(config, MODEL, settings, _GEOMETRY, pixels, **options)


def _start(config=CONFIG):
    return init_state(config.seed, MODEL, config.schedule)


def _train(setup, state, until):
    reports = []
    for stepped, report in loop.run_steps(setup, state, until):
        state = stepped
        reports.append(jax.device_get(report))
    return state, reports


def _assert_identical(a, b):
    leaves_a, tree_a = jax.tree.flatten(jax.device_get(a))
    leaves_b, tree_b = jax.tree.flatten(jax.device_get(b))
    assert tree_a == tree_b
    for x, y in zip(leaves_a, leaves_b, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
def test_checkpoints_are_written_while_the_clock_jumps(tmp_path, monkeypatch):
    state, jumps, now = _start(), np.random.default_rng(0), time.time
    monkeypatch.setattr(time, "time", lambda: now() + jumps.uniform(-1e6, 1e6))
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for step in range(6):
            checkpoints.save(state._replace(step=jnp.int32(step)))
        _assert_identical(checkpoints.restore(_start()), state._replace(step=jnp.int32(5)))


# Within a pool, and between two.
@pytest.mark.parametrize("pause", [4, 6])
@pytest.mark.slow
def test_a_resumed_run_continues_bit_for_bit(tmp_path, pause):
    straight_through, reports = _train(_setup(), _start(), 12)
    first, early = _train(_setup(), _start(), pause)
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        checkpoints.save(first)
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        assert checkpoints.newest() == pause
        restored = checkpoints.restore(_start())
    _assert_identical(restored, first)
    resumed, late = _train(_setup(), restored, 12)
    _assert_identical(resumed, straight_through)
    _assert_identical(early + late, reports)


class _ParamsOfBefore(NamedTuple):
    proposals: Any
    field: Any
    dyes: Any


def test_a_checkpoint_of_an_earlier_version_is_read(tmp_path):
    config = dataclasses.replace(MODEL, interior="absorbing", learned_tints=2)
    state = init_state(CONFIG.seed, config, CONFIG.schedule)
    before = jax.tree.map(
        lambda x: _ParamsOfBefore(*x[:3]) if isinstance(x, Params) else x,
        state,
        is_leaf=lambda x: isinstance(x, Params),
    )
    with Checkpoints(tmp_path, keep=1) as checkpoints:
        checkpoints.save(before)
    with Checkpoints(tmp_path, keep=1) as checkpoints:
        _assert_identical(checkpoints.restore(state), state)


@pytest.mark.parametrize("every", [pytest.param((3,), marks=pytest.mark.slow), (4,), (10, 5)])
def test_steps_taken_at_once_are_the_same_steps(every):
    one_by_one = {
        int(state.step): jax.device_get((state, report))
        for state, report in loop.run_steps(_setup(), _start(), 12)
    }
    seen = {
        int(state.step): jax.device_get((state, report))
        for state, report in loop.run_steps(_setup(), _start(), 12, every=every)
    }
    # Pools have four steps.
    assert list(seen) == [n for n in range(1, 13) if any(n % period == 0 for period in (*every, 4))]
    for step, found in seen.items():
        _assert_identical(found, one_by_one[step])


@pytest.mark.slow
def test_a_run_resumed_within_a_pool_may_take_other_strides(tmp_path):
    whole, _ = _train(_setup(), _start(), 11)
    for state, _ in loop.run_steps(_setup(), _start(), 6, every=(4,)):
        paused = state
    with Checkpoints(tmp_path, keep=1) as checkpoints:
        checkpoints.save(paused)
        resumed = checkpoints.restore(_start())
    assert int(resumed.step) == 6
    for state, _ in loop.run_steps(_setup(), resumed, 11, every=(5,)):
        last = state
    _assert_identical(last, whole)


@pytest.mark.slow
def test_one_pool_is_traced_ahead_and_no_more(monkeypatch):
    traced = []
    pretrace = loop.pretrace
    noted = lambda *arguments, **options: (
        traced.append(len(traced)) or pretrace(*arguments, **options)
    )
    noted.eval_shape = pretrace.eval_shape
    monkeypatch.setattr(loop, "pretrace", noted)
    setup = _setup()._replace(epoch=None)
    traced.clear()
    counts = [len(traced) for _ in loop.run_steps(setup, _start(), 12)]
    assert counts == [2] * 4 + [3] * 8


@pytest.mark.slow
@pytest.mark.parametrize("steps", [12, 34])
def test_what_is_compiled_before_the_first_step_is_not_compiled_again(steps, monkeypatch):
    monkeypatch.setattr(loop, "threads", lambda: 2)
    schedule = dataclasses.replace(CONFIG.schedule, steps=steps)
    config = dataclasses.replace(CONFIG, schedule=schedule, seed=77)  # of no other test
    setup = _setup(config, beside=loop.compile_steps)
    assert (setup.epoch is not None) == (steps > setup.sampler.batches)
    compiled = []

    def note(event, seconds, **details):
        if event.endswith("backend_compile_duration"):
            compiled.append(details.get("fun_name"))

    state = devices.put_everywhere(_start(config), mesh=None)
    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        taken = list(itertools.islice(loop.run_steps(setup, state, steps), 2))
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert int(taken[-1][0].step) == 2
    assert not [name for name in compiled if "train_steps" in name or "pretrace" in name]


@pytest.mark.slow
def test_paths_that_are_kept_train_like_paths_that_are_traced_anew():
    schedule = dataclasses.replace(CONFIG.schedule, steps=34)
    setup = _setup(dataclasses.replace(CONFIG, schedule=schedule))
    assert setup.epoch is not None and setup.epoch.rgb.shape[0] == setup.sampler.batches
    until = setup.sampler.batches + 2  # into the second epoch
    kept, kept_reports = _train(setup, _start(), until)
    traced, traced_reports = _train(setup._replace(epoch=None), _start(), until)
    _assert_identical(kept, traced)
    _assert_identical(kept_reports, traced_reports)


@pytest.mark.slow
def test_paths_are_not_kept_for_a_run_of_one_epoch():
    schedule = dataclasses.replace(CONFIG.schedule, steps=1)
    assert _setup(dataclasses.replace(CONFIG, schedule=schedule)).epoch is None


def test_paths_that_would_fill_the_memory_are_not_kept(monkeypatch):
    schedule = dataclasses.replace(CONFIG.schedule, steps=34)
    monkeypatch.setattr(loop, "_MOST_BYTES", 1000)
    assert _setup(dataclasses.replace(CONFIG, schedule=schedule)).epoch is None


@pytest.mark.slow
def test_the_same_seed_gives_the_same_run_and_another_one_does_not():
    _, reports = _train(_setup(), _start(), 3)
    _, again = _train(_setup(), _start(), 3)
    _assert_identical(reports, again)
    other = dataclasses.replace(CONFIG, seed=1)
    _, different = _train(_setup(other), _start(other), 3)
    assert different[0].loss != reports[0].loss


def test_training_lowers_the_loss():
    _, reports = _train(_setup(), _start(), CONFIG.schedule.steps)
    losses = [report.loss for report in reports]
    assert np.all(np.isfinite(losses))
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])


def test_reports_say_what_was_measured():
    _, (report,) = _train(_setup(), _start(), 1)
    weights = CONFIG.losses
    mse = 10.0 ** (-report.psnr / 10.0)
    expected = (
        mse
        + weights.interlevel * report.interlevel
        + weights.distortion * report.distortion
        + weights.hash_decay * report.hash_decay
    )
    np.testing.assert_allclose(report.loss, expected, rtol=1e-4)
    assert report.dropped == 0.0


@pytest.mark.slow
def test_the_ablation_counts_the_samples_inside_in_the_distortion_loss_alone():
    loss = dataclasses.replace(CONFIG.losses, distortion_over="everywhere")
    config = dataclasses.replace(CONFIG, losses=loss)
    _, (corrected,) = _train(_setup(), _start(), 1)
    _, (ablated,) = _train(_setup(config), _start(config), 1)
    assert ablated.distortion > 1.02 * corrected.distortion > 0.0
    np.testing.assert_allclose(ablated.interlevel, corrected.interlevel, rtol=1e-6)
    np.testing.assert_allclose(
        ablated.loss - corrected.loss,
        CONFIG.losses.distortion * (ablated.distortion - corrected.distortion),
        rtol=1e-2,  # of a difference in the fourth digit
    )


@pytest.mark.slow
def test_charbonnier_changes_the_loss_only():
    loss = dataclasses.replace(CONFIG.losses, data="charbonnier")
    config = dataclasses.replace(CONFIG, losses=loss)
    _, (mse,) = _train(_setup(), _start(), 1)
    _, (charbonnier,) = _train(_setup(config), _start(config), 1)
    np.testing.assert_allclose(charbonnier.psnr, mse.psnr, rtol=1e-6)
    assert charbonnier.loss > mse.loss


# Other tests train along the tree as well.
@pytest.mark.parametrize("settings", [STRAIGHT, TREE])
@pytest.mark.slow
def test_any_budget_can_be_trained_along(settings):
    setup = _setup(settings=settings)
    assert (
        CONFIG.schedule.batch <= setup.capacity <= capacities(settings, CONFIG.schedule.batch).paths
    )
    _, reports = _train(setup, _start(), 2)
    assert all(np.isfinite(report.loss) and report.dropped < 1e-3 for report in reports)


@pytest.mark.slow
def test_light_is_lost_only_where_paths_have_too_little_room():
    setup = _setup()
    assert setup.capacity > CONFIG.schedule.batch
    rays, detail = (
        setup.sampler.draw(np.arange(CONFIG.schedule.pretraced_batches)).rays,
        path_detail(MODEL, PAPER),
    )
    room = {"roomy": setup.capacity, "tight": CONFIG.schedule.batch}
    dropped = {
        name: loop.pretrace(
            setup.scene, rays, settings=PAPER, capacity=capacity, detail=detail
        ).dropped
        for name, capacity in room.items()
    }
    assert not np.any(dropped["roomy"])
    # No room for the second path of any ray that meets the ball: the weaker one is left out.
    assert np.all(dropped["tight"] >= 0.0) and np.all(dropped["tight"] < 1.0)
    assert np.all(np.mean(dropped["tight"], axis=(1, 2)) > 0.0)


def test_straight_light_needs_no_room_for_other_paths():
    assert _setup(settings=STRAIGHT).capacity == CONFIG.schedule.batch < _setup().capacity


def test_only_the_newest_checkpoints_are_kept_and_none_twice(tmp_path):
    taken = loop.run_steps(_setup(), _start(), 5)
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for state, _ in taken:
            checkpoints.save(state)
            checkpoints.save(state)
    kept = sorted(int(path.name) for path in (tmp_path / "checkpoints").iterdir())
    assert kept == [4, 5]


def test_a_folder_without_checkpoints_says_so(tmp_path):
    with Checkpoints(tmp_path, keep=1) as checkpoints:
        assert checkpoints.newest() is None
        with pytest.raises(ValueError, match="no checkpoint"):
            checkpoints.restore(_start())


def test_a_run_folder_holds_everything_that_rendering_needs(tmp_path):
    run = tmp_path / "run"
    run_folder.create(run, CONFIG, SAVED, _GEOMETRY)
    state, _ = next(loop.run_steps(_setup(), _start(), 1))
    with Checkpoints(run, keep=1) as checkpoints:
        checkpoints.save(state)
    model = load_model(run)
    assert model.config == MODEL and model.settings == PAPER
    _assert_identical(model.params, state.params)
    _assert_identical(model.scene, _GEOMETRY)
    with pytest.raises(ValueError, match=r"step 7.*\[1\]"):
        load_model(run, step=7)


def test_a_run_is_never_overwritten(tmp_path):
    run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    with pytest.raises(ValueError, match="Resume it"):
        run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    assert run_folder.read_config(tmp_path) == CONFIG


def test_a_run_can_not_change_its_options(tmp_path):
    run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    run_folder.check_unchanged(tmp_path, CONFIG, SAVED, _GEOMETRY)
    with pytest.raises(ValueError, match="other options"):
        run_folder.check_unchanged(tmp_path, dataclasses.replace(CONFIG, seed=5), SAVED, _GEOMETRY)
    model = dataclasses.replace(SAVED, config=dataclasses.replace(MODEL, samples=7))
    with pytest.raises(ValueError, match="other options"):
        run_folder.check_unchanged(tmp_path, CONFIG, model, _GEOMETRY)


def test_a_run_from_before_the_released_code_s_options_continues(tmp_path):
    model = dataclasses.replace(CONFIG.model, near=MODEL.near, far=MODEL.far)
    config = dataclasses.replace(CONFIG, model=model)
    run_folder.create(tmp_path, config, SAVED, _GEOMETRY)
    for name, added in _ADDED_SINCE.items():
        content = json.loads((tmp_path / name).read_text())
        for *sections, key in added:
            functools.reduce(lambda at, section: at[section], sections, content).pop(key)
        (tmp_path / name).write_text(json.dumps(content))
    assert checkpoint_io.read_static(tmp_path) == SAVED
    assert run_folder.read_config(tmp_path) == config
    assert run_folder.read_config(tmp_path).get("near") is None
    run_folder.check_unchanged(tmp_path, config, SAVED, _GEOMETRY)
    for changed in ({"adam_b2": 0.999}, {"path_losses": "transmitted"}, {"shading": "flat"}):
        with pytest.raises(ValueError, match=rf"other options \(.*{next(iter(changed))}"):
            run_folder.check_unchanged(tmp_path, config.decided(**changed), SAVED, _GEOMETRY)
    farther = dataclasses.replace(SAVED, config=dataclasses.replace(MODEL, far=20.0))
    with pytest.raises(ValueError, match="other options"):
        run_folder.check_unchanged(tmp_path, config.decided(far=20.0), farther, _GEOMETRY)


def test_a_scene_may_move_but_not_change(tmp_path):
    run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    scene = dataclasses.replace(CONFIG.scene, path="elsewhere")
    moved = dataclasses.replace(CONFIG, scene=scene)
    run_folder.check_unchanged(tmp_path, moved, SAVED, _GEOMETRY)
    normals = 0.5 * _GEOMETRY.surfaces.normals
    other = _GEOMETRY._replace(surfaces=_GEOMETRY.surfaces._replace(normals=normals))
    with pytest.raises(ValueError, match="other meshes"):
        run_folder.check_unchanged(tmp_path, moved, SAVED, other)


@pytest.mark.parametrize("left", ["checkpoints", "metrics.jsonl"])
def test_what_is_left_of_a_run_is_not_taken_over(tmp_path, left):
    (tmp_path / left).mkdir()
    with pytest.raises(ValueError, match=rf"cannot be continued.* Remove \S+/{left}, ") as refused:
        run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    assert "--resume" not in str(refused.value)


def test_the_interior_list_of_overlapping_parts_is_stored(tmp_path):
    balls = [scenes.ball(radius, subdivisions=1) for radius in (1.0, 0.7)]
    balls[1] = balls[1]._replace(vertices=balls[1].vertices + 0.5)
    scene = scenes.build(*balls, rule="facing")
    assert scene.interfaces.index_by_face.tolist() == [True]
    checkpoint_io.save_scene(tmp_path, SAVED, scene)
    _assert_identical(checkpoint_io.load_scene(tmp_path), scene)


def test_the_scene_of_an_earlier_version_is_read(tmp_path):
    checkpoint_io.save_scene(tmp_path, SAVED, _GEOMETRY)
    path = tmp_path / "geometry.npz"
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored if name != "index_by_face"}
    np.savez(path, **arrays)
    _assert_identical(checkpoint_io.load_scene(tmp_path), _GEOMETRY)


@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_a_damaged_geometry_is_named(tmp_path, damage):
    run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    path = tmp_path / "geometry.npz"
    content = path.read_bytes()
    path.unlink()
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"geometry\.npz cannot be read"):
        checkpoint_io.load_scene(tmp_path)


def test_a_damaged_checkpoint_is_named(tmp_path):
    run_folder.create(tmp_path, CONFIG, SAVED, _GEOMETRY)
    state, _ = next(loop.run_steps(_setup(), _start(), 1))
    with Checkpoints(tmp_path, keep=1) as checkpoints:
        checkpoints.save(state)
    folder = tmp_path / "checkpoints" / "1"
    largest = max((folder / "params").rglob("*"), key=lambda path: path.stat().st_size)
    content = largest.read_bytes()
    middle = len(content) // 2
    largest.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    with pytest.raises(ValueError, match=rf"checkpoints/1 is damaged: params/.*{largest.name}"):
        load_model(tmp_path)
    (folder / "checksums.json").unlink()  # as earlier versions wrote it
    load_model(tmp_path)
    shutil.rmtree(folder / "params")
    with pytest.raises(ValueError, match=r"checkpoints/1 cannot be read"):
        load_model(tmp_path)


def test_parameters_that_are_not_finite_are_never_saved(tmp_path):
    state, _ = next(loop.run_steps(_setup(), _start(), 1))
    broken = state._replace(params=jax.tree.map(lambda x: x.at[0].set(jnp.nan), state.params))
    with Checkpoints(tmp_path, keep=1) as checkpoints:
        with pytest.raises(ValueError, match="not finite at step 1"):
            checkpoints.save(broken)
        assert checkpoints.newest() is None


def test_metrics_rewind_to_the_resumed_step(tmp_path):
    assert run_folder.rewind_metrics(tmp_path, 0) == 0.0
    for step in range(1, 6):
        run_folder.append_metrics(tmp_path, {"step": step, "seconds": 2.0 * step})
    assert run_folder.rewind_metrics(tmp_path, 3) == 6.0
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2, 3]


def test_a_half_written_last_line_of_metrics_is_dropped(tmp_path):
    for step in range(1, 4):
        run_folder.append_metrics(tmp_path, {"step": step, "seconds": 2.0 * step})
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text()[:-8])
    assert run_folder.rewind_metrics(tmp_path, 3) == 4.0
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 2]


def test_a_damaged_line_of_metrics_is_named_and_nothing_is_lost(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "seconds": 1}\n{"st\n{"step": 3, "seconds": 1}\n')
    before = path.read_text()
    with pytest.raises(ValueError, match=r"Line 2 of .*metrics\.jsonl"):
        run_folder.rewind_metrics(tmp_path, 3)
    assert path.read_text() == before


def test_the_loop_can_stop_in_the_middle_of_a_pool():
    taken = list(itertools.islice(loop.run_steps(_setup(), _start(), 12), 5))
    assert int(taken[-1][0].step) == 5


def test_steps_that_cannot_fit_into_memory_are_refused_with_the_batch_that_could(monkeypatch):
    monkeypatch.setattr(loop.devices, "free_memory", lambda: 1 << 10)
    with pytest.raises(ValueError, match=r"batch=\d+ rays takes at least .* Lower batch to \d+ or"):
        _setup()
    monkeypatch.setattr(loop.devices, "free_memory", lambda: None)
    assert _setup().capacity > 0


@pytest.mark.parametrize(
    ("stats", "free"),
    [
        ({"bytes_in_use": 7}, None),
        ({"bytes_limit": 10, "bytes_in_use": 7}, 3),
        ({"bytes_limit": 10, "bytes_in_use": 12}, 0),
    ],
)
def test_memory_of_a_device_is_unknown_without_its_limit(stats, free, monkeypatch):
    device = types.SimpleNamespace(memory_stats=lambda: stats)
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    assert loop.devices.free_memory() == free


def test_a_check_that_fails_elsewhere_fails_here(monkeypatch):
    def broken():
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        loop.devices.in_all(broken)
    loop.devices.in_all(lambda: None)
    monkeypatch.setattr(loop.devices, "any_process", lambda flag: True)
    with pytest.raises(ValueError, match="Another process has stopped"):
        loop.devices.in_all(lambda: None)
