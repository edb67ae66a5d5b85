"""Runs a command as a user does: in a process of its own, with its own options and output.

Importing takes longer than most of what the suite has commands do, so their processes are forked
from one that has imported what is not ours, and the library.
"""

import atexit
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]

# Options of a training that takes seconds.
TINY = (
    *("--steps=6", "--batch=64", "--log_every=3", "--checkpoint_every=3"),
    *("--pretraced_batches=4", "--samples_per_ray=8,6", "--max_res=32", "--log2_hashmap_size=10"),
)

_forks = multiprocessing.get_context("forkserver")
_forks.set_forkserver_preload(
    [
        "absl.app",
        "dm_pix",
        "flax.linen",
        "imageio.v3",
        "jax.experimental.multihost_utils",
        "matplotlib.pyplot",
        "optax",
        "orbax.checkpoint",
        "refref_jax.data.scene_source",
        "refref_jax.render",
        "refref_jax.training.loop",
        "rich.progress",
        "scipy.spatial",
        "trimesh",
    ]
)


def run_command(command, *options, fails=False, env=None):
    """Runs `python -m experiments.{command}` and checks whether it succeeds.

    In the suite's environment, whose code generator is the faster one, if `env` is not given.
    """
    return run_module(f"experiments.{command}", *options, fails=fails, env=env)


def run_module(module, *options, fails=False, env=None):
    """Runs `python -m {module}` likewise."""
    arguments = (module, *map(str, options))
    with tempfile.TemporaryDirectory() as folder:
        out, err = (Path(folder, name) for name in ("out", "err"))
        environment = dict(os.environ if env is None else env)
        process = _forks.Process(target=_become, args=(arguments, environment, out, err))
        process.start()
        process.join()
        status = process.exitcode
        result = subprocess.CompletedProcess(
            arguments, status, out.read_text("utf-8"), err.read_text("utf-8")
        )
    assert (status != 0) == fails, result.stdout + result.stderr
    return result


def _become(arguments, environment, out, err):
    """Makes of this process one that `python -m` has started."""
    for number, path in ((1, out), (2, err)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(ROOT)
    module, *sys.argv[1:] = arguments
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        atexit._run_exitfuncs()
