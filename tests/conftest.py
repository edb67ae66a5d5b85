import atexit
import gc
import os
import shutil
import tempfile
from pathlib import Path

from tests.processes import bytecode, checked, code_generator

# Several processes share an accelerator.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

# The suite keeps all cores busy, and OpenBLAS's threads would spin while they wait for one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# What one process of the suite has compiled, the others and the commands need not compile again.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="refref_jax_tests_")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.update(code_generator.faster())

import jax
import pytest

# Imports JAX, which reads the environment.
from tests.processes import mlir_contexts

bytecode.reuse_that_of_other_packages()
checked.from_the_first_call()

# Traced programs are millions of objects: to look for garbage among them took a tenth of the time.
gc.set_threshold(100_000, 10, 10)

# A silent broadcast between different ranks is a bug.
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.get_closest_marker("longest") is None)


def pytest_sessionfinish():
    # pytest and Python collect garbage as a process ends, among all that it has traced: seconds.
    gc.freeze()


def pytest_configure(config):
    # Of commands, and XLA's flags, which are read with the first array. `_compiled_lightly` is for
    # the suite's own processes.
    if _is_quick(config):
        os.environ.update(code_generator.lighter())
        mlir_contexts.reuse()


def _is_quick(config):
    return config.getoption("markexpr") == "not slow"


# Compiled programs are mapped into memory one by one, and Linux allows a process 65,530 mappings:
# past them LLVM aborts.
_MOST_MAPPINGS = 30_000


@pytest.fixture(autouse=True, scope="module")
def _few_mappings():
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > _MOST_MAPPINGS:
        jax.clear_caches()


def _dtype_promotion(request):
    loose = request.node.get_closest_marker("loose")
    return jax.numpy_dtype_promotion("standard" if loose else "strict")


@pytest.fixture(autouse=True, scope="module")
def _strict_fixtures(request):
    """Traces fixtures of a module under its tests' setting, or else tests trace them again."""
    with _dtype_promotion(request):
        yield


@pytest.fixture(autouse=True)
def _strict_dtypes(request):
    with _dtype_promotion(request):
        yield


@pytest.fixture(autouse=True, scope="module")
def _compiled_lightly(request):
    """Compiles without LLVM's optimisations, which takes a quarter off the suite's time.

    Not where slow tests are run, nor by `pytest -m "slow or not slow"`.
    """
    computing = request.node.get_closest_marker("computing")
    lightly = _is_quick(request.config) and not computing
    jax.config.update("jax_disable_most_optimizations", lightly)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def ball_scene() -> Path:
    """The bundled scene: a glass ball between textured walls, rendered by Blender Cycles."""
    return Path(__file__).parents[1] / "experiments" / "data" / "cube_smcvx_ball"


@pytest.fixture(scope="module")
def slab():
    """A wide slab of glass, one unit thick."""
    from tests.factories import scenes

    return scenes.build(scenes.box((8.0, 8.0, 1.0)))
