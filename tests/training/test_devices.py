"""Training on several devices, and in several processes, is training on one."""

import functools
import json
import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from refref_jax.optics import light_paths
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import STRAIGHT
from refref_jax.training import devices, loop
from refref_jax.training.loop import init_state
from tests.factories import made_paths, scenes, small_model
from tests.factories.small_model import CONFIG, MODEL
from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

# Sums over devices add in another order, and 24 steps carry that on.
_ROUNDING = 1e-4

_EIGHT = "--xla_force_host_platform_device_count=8"


def _start(module, *arguments, flags=""):
    environment = os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()}
    return subprocess.Popen(
        [sys.executable, "-m", module, *map(str, arguments)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _result(process):
    """Returns what a process printed last, which is JSON."""
    try:
        printed, errors = process.communicate(timeout=1800)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    # Gloo prints a line of its own.
    return json.loads(printed.splitlines()[-1])


def _free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def _in_two_processes(module, *arguments):
    """Returns what each of two processes on this machine printed."""
    coordinator = f"127.0.0.1:{_free_port()}"
    started = [_start(module, *arguments, coordinator, 2, number) for number in (0, 1)]
    try:
        return [_result(process) for process in started]
    finally:
        for process in started:
            process.kill()


def _assert_same_curve(reports, others):
    reports, others = np.array(reports), np.array(others)
    assert reports.shape == others.shape and np.isfinite(reports).all()
    assert np.ptp(reports[:, 0]) > 1e-4
    np.testing.assert_allclose(reports, others, rtol=_ROUNDING, atol=1e-9)


def test_one_device_needs_no_mesh():
    assert devices.row(1) is None
    assert jax.device_count() > 1 or devices.row(None) is None


@pytest.mark.parametrize("count", [0, -1, 1 + jax.device_count()])
def test_devices_that_are_not_there_are_refused(count):
    with pytest.raises(
        ValueError, match=rf"^There .*, not {count}\. Give (1|1 to \d+), or use all"
    ):
        devices.row(count)


def test_arrays_are_put_on_every_device():
    tree = {"a": np.arange(6.0, dtype=np.float32).reshape(2, 3), "b": jnp.ones((), jnp.int32)}
    for mesh in (None, Mesh(jax.devices()[:1], (devices.AXIS,))):
        put = devices.put_everywhere(tree, mesh=mesh)
        jax.tree.map(np.testing.assert_array_equal, put, tree)
        assert all(leaf.is_fully_replicated for leaf in jax.tree.leaves(put))


@pytest.mark.parametrize("count", [5, 6])
@pytest.mark.parametrize("committed", [False, True])
def test_groups_are_written_one_after_the_other(count, committed):
    groups = [
        {"a": np.full((2, 3), n, np.float32), "b": np.arange(2, dtype=np.int32)} for n in range(3)
    ]
    place = jax.devices()[0] if committed else None
    made = (jax.device_put(group, place) for group in groups)
    result = devices.concatenated(made, count=count)
    for name in ("a", "b"):
        expected = np.concatenate([group[name] for group in groups])[:count]
        np.testing.assert_array_equal(result[name], expected)
        assert result[name].dtype == expected.dtype
        # An array that is bound to its device would be compiled for again.
        assert result[name].committed == committed


def test_one_process_agrees_with_itself():
    assert devices.is_first()
    assert devices.any_process(True) and not devices.any_process(False)
    assert devices.as_in_the_first((1.5, 2)) == (1.5, 2)
    devices.wait_for_all("nothing")


@pytest.mark.parametrize(("multiple", "room"), [(1, 3), (3, 3), (2, 4), (8, 8), (16, 16)])
def test_lists_are_filled_up_with_empty_slots(multiple, room):
    paths = made_paths.stack([made_paths.random_path(i, bends=1, segments=3) for i in range(3)])
    filled = jax.jit(functools.partial(light_paths.filled_up, multiple=multiple))(paths)
    assert filled.radii.shape == (room,)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:3], b), filled, paths)
    assert (filled.statuses[3:] == PathStatus.EMPTY).all() and not np.any(filled.throughput[3:])
    # Of an empty slot everything is a number that a full one may have.
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a[-1], b[2]), filled.points, paths.points
    )


@pytest.mark.slow
def test_a_mesh_of_one_device_trains_as_no_mesh():
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    curves = []
    for mesh in (None, Mesh(jax.devices()[:1], (devices.AXIS,))):
        setup = loop.set_up(CONFIG, MODEL, STRAIGHT, scene, small_model.sampler(), mesh=mesh)
        state = init_state(CONFIG.seed, MODEL, CONFIG.schedule)
        state = devices.put_everywhere(state, mesh=mesh)
        steps = loop.run_steps(setup, state, 12)
        curves.append([list(map(float, jax.tree.leaves(jax.device_get(r)))) for _, r in steps])
    _assert_same_curve(*curves)


@pytest.mark.slow
def test_eight_devices_train_as_one_does(tmp_path):
    saved = str(tmp_path / "saved")
    runs = {
        "one": {"devices": 1, "steps": 26},
        "eight": {"devices": 8, "steps": 24, "folder": saved},
        "five": {"devices": 5, "steps": 24, "kept": False},
        "on one": {"devices": 1, "steps": 26, "resumed": saved},
        "on five": {"devices": 5, "steps": 26, "resumed": saved},
    }
    runs = {name: {"settings": "paper", **options} for name, options in runs.items()}
    found = _result(_start("tests.processes.sharded", json.dumps(runs), flags=_EIGHT))
    one = found["one"]
    for name, steps in {"eight": (0, 24), "five": (0, 24), "on one": (24, 26)}.items():
        _assert_same_curve(found[name]["reports"], one["reports"][slice(*steps)])
    _assert_same_curve(found["on five"]["reports"], one["reports"][24:])
    for name in ("on one", "on five"):
        np.testing.assert_allclose(found[name]["params"], one["params"], rtol=_ROUNDING)
    assert [found[name]["parts"] for name in ("one", "eight", "five")] == [1, 8, 5]
    assert [found[name]["kept"] for name in ("one", "eight", "five")] == [True, True, False]
    # Room for 48 paths of 32 rays, which five devices do not share evenly.
    assert [found[name]["slots"] for name in ("one", "eight", "five")] == [48, 48, 50]
    for name in ("eight", "five"):
        light = found[name]["light"]
        np.testing.assert_allclose(light, one["light"][: len(light)], rtol=1e-6)


def test_two_processes_find_each_other_and_sum():
    for number, found in enumerate(_in_two_processes("tests.processes.two_processes")):
        assert found["first"] == (number == 0) and found["devices"] == 2
        assert found["any"] == [True, False]
        assert found["agreed"] == [1.5, 3.0]
        assert found["summed"] == 2.0 * sum(range(6))


@pytest.mark.slow
def test_two_processes_train_as_one_does(tmp_path):
    folder = str(tmp_path / "saved")
    together = {
        "two": {"devices": 1, "steps": 24, "settings": "paper", "folder": folder},
        "on": {"devices": 1, "steps": 26, "settings": "paper", "resumed": folder},
    }
    alone = {"one": {"devices": 1, "steps": 26, "settings": "paper"}}
    first, second = _in_two_processes("tests.processes.sharded", json.dumps(together))
    one = _result(_start("tests.processes.sharded", json.dumps(alone)))["one"]
    assert first == second and first["two"]["parts"] == 2
    _assert_same_curve(first["two"]["reports"], one["reports"][:24])
    _assert_same_curve(first["on"]["reports"], one["reports"][24:])
