"""The options of several devices and processes, and a training that one of them interrupts."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import pytest
from absl import flags
from absl.testing import flagsaver

from experiments.cli import flags as cli_flags
from experiments.runs import processes
from refref_jax import compilation
from tests.processes import code_generator
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_DEVICES = cli_flags.devices()


@pytest.fixture(autouse=True)
def _parsed():
    flags.FLAGS.mark_as_parsed()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coordinator": "host:1"}, "Set --processes, or remove them"),
        ({"process": 0}, "Set --processes, or remove them"),
        ({"processes": 2, "process": 0}, "Pass the same --coordinator"),
        ({"processes": 2, "process": 0, "coordinator": "host"}, "the same --coordinator"),
        ({"processes": 2, "coordinator": "host:1"}, "Pass --process between 0 and 1"),
        ({"processes": 2, "process": 2, "coordinator": "host:1"}, "--process between 0 and 1"),
        ({"devices": "many"}, "devices=many: Give a number, or all"),
        ({"devices": "-1"}, "devices=-1: Give a number, or all"),
    ],
)
def test_options_that_make_no_sense_are_not_taken(options, message):
    with (
        pytest.raises(flags.IllegalFlagValueError, match=message),
        flagsaver.flagsaver(**options),
    ):
        pass


def test_a_traversal_that_does_not_exist_is_refused_before_anything_begins(ball_scene, tmp_path):
    environment = os.environ | {compilation.TRAVERSAL: "fast"}
    ended = run_command(
        "render_known", f"--scene={ball_scene}", f"--out={tmp_path}", fails=True, env=environment
    )
    assert ended.stderr == "error: REFREF_TRAVERSAL is 'fast'. Set it to xla or warp.\n"


def test_more_devices_than_there_are_are_refused():
    with flagsaver.flagsaver(devices="4096"):
        processes.connect(_DEVICES)
        with pytest.raises(
            ValueError, match=r"^There .*, not 4096\. Give (1|1 to \d+), or use all"
        ):
            processes.mesh(_DEVICES)


def test_one_process_connects_to_nobody_and_speaks(capsys):
    processes.connect(_DEVICES)
    assert not processes.together(_DEVICES) and processes.mesh(_DEVICES) is None
    with processes.first_speaks():
        print("heard")
    assert capsys.readouterr().out == "heard\n"


def test_several_processes_do_not_reconstruct(tmp_path):
    options = ["--method=r3f", "--processes=2", "--coordinator=localhost:1", "--process=0"]
    result = run_command("train", f"--out={tmp_path / 'run'}", *options, fails=True)
    assert "Several processes cannot reconstruct together" in result.stderr
    assert "Traceback" not in result.stderr and not (tmp_path / "run").exists()


@pytest.mark.slow
def test_an_interrupt_of_one_process_saves_and_ends_both(tmp_path):
    run = tmp_path / "run"
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    options = ["--scene=experiments/data/cube_smcvx_ball", f"--out={run}", "--paths=straight"]
    options += ["--batch=64", "--steps=400", "--log_every=1"]
    together = ["--processes=2", f"--coordinator=127.0.0.1:{port}"]
    started = [_start(*options, *together, f"--process={number}") for number in (0, 1)]
    metrics = run / "metrics.jsonl"
    try:
        while not (metrics.exists() and metrics.read_text().count("\n") > 3):
            assert started[0].poll() is None, started[0].communicate()
            time.sleep(0.1)
        started[1].send_signal(signal.SIGINT)
        first, second = (process.communicate(timeout=300) for process in started)
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [130, 130], first[1] + second[1]
    # Gloo speaks for itself.
    assert "Stopped at step" in first[0] and "Stopped at step" not in second[0]
    (saved,) = (int(path.name) for path in (run / "checkpoints").iterdir())
    assert 3 < saved < 400
    run_command("train", f"--out={run}", "--resume")
    steps = [json.loads(line)["step"] for line in metrics.read_text().splitlines()]
    assert steps[:saved] == list(range(1, saved + 1)) and steps[-1] == 400


def _start(*options):
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.train", *map(str, options)],
        cwd=ROOT,
        env=code_generator.of_users(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
