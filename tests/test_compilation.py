"""Flags for slow versions of XLA, functions chosen by platform, and the choice of traversal.

Loops are tested where they are used.
"""

import functools
import importlib.metadata
import os
import subprocess
import sys
import threading
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax import compilation

_FLAG = "--xla_backend_extra_options=-nvptx-allow-ftz-atomics"
_NO_AUTOTUNER = "--xla_gpu_experimental_enable_fusion_autotuner=false"


@pytest.fixture
def installed(monkeypatch):
    """Sets the versions that are installed, and makes it seem that JAX has not started."""
    versions = {"jaxlib": "0.10.2", "jax-cuda13-plugin": "0.10.2"}

    def version(package):
        if package not in versions:
            raise importlib.metadata.PackageNotFoundError(package)
        return versions[package]

    monkeypatch.setattr(importlib.metadata, "version", version)
    monkeypatch.setattr(compilation, "has_started", lambda: False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    return versions


def test_a_slow_version_with_a_cuda_plugin_gets_the_flag(installed):
    compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == f"--xla_cpu_enable_fast_math=false {_FLAG} {_NO_AUTOTUNER}"
    compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"].count("nvptx") == os.environ["XLA_FLAGS"].count("tuner") == 1


@pytest.mark.parametrize("version", ["0.10.0", "0.10.1", "0.11.2"])
def test_other_versions_which_refuse_the_flag_do_not_get_it(installed, version):
    installed["jaxlib"] = version
    compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == f"--xla_cpu_enable_fast_math=false {_NO_AUTOTUNER}"


def test_versions_that_are_not_known_get_no_flag(installed):
    installed["jaxlib"] = "0.12.0"
    compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"


def test_the_autotuner_stays_as_a_user_has_set_it(installed, monkeypatch):
    chosen = f"{_FLAG} --xla_gpu_experimental_enable_fusion_autotuner=true"
    monkeypatch.setenv("XLA_FLAGS", chosen)
    compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == chosen


def test_nothing_is_set_without_a_cuda_plugin(installed):
    del installed["jax-cuda13-plugin"]
    compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"


@pytest.mark.parametrize(
    "flags", ["--xla_gpu_ftz=true", "--xla_backend_extra_options=-nvptx-allow-ftz-atomics=true"]
)
def test_flags_with_the_same_effect_are_left_alone(installed, monkeypatch, flags):
    monkeypatch.setenv("XLA_FLAGS", flags)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == f"{flags} {_NO_AUTOTUNER}"


def test_a_warning_says_what_to_do_where_it_is_too_late(installed, monkeypatch):
    monkeypatch.setattr(compilation, "has_started", lambda: True)
    compilation.add_missing_flags()  # no GPU is in use
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.warns(UserWarning, match=r"jaxlib 0\.10\.2 is slow on NVIDIA") as told:
        compilation.add_missing_flags()
    assert [str(each.message).partition("JAX starts: ")[2] for each in told] == [
        f"{_FLAG} {_NO_AUTOTUNER}"
    ]
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"


def test_other_options_of_the_same_flag_are_not_overwritten(installed, monkeypatch):
    flags = f"--xla_backend_extra_options=-x {_NO_AUTOTUNER}"
    monkeypatch.setenv("XLA_FLAGS", flags)
    with pytest.warns(UserWarning, match="Add to the variable XLA_FLAGS.*nvptx"):
        compilation.add_missing_flags()
    assert os.environ["XLA_FLAGS"] == flags


def test_it_is_known_whether_jax_has_started():
    words = (
        "from refref_jax import compilation; import jax.numpy as jnp; "
        "print(compilation.has_started()); jnp.zeros(1); print(compilation.has_started())"
    )
    answer = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True
    )
    assert answer.stdout.split() == ["False", "True"]


@pytest.mark.parametrize("value", [None, "", "xla"])
def test_rays_are_traced_by_jax_alone_unless_asked(installed, monkeypatch, value):
    monkeypatch.delenv(compilation.TRAVERSAL, raising=False)
    if value is not None:
        monkeypatch.setenv(compilation.TRAVERSAL, value)
    assert compilation.chosen_traversal() == "xla"


def test_warp_is_chosen_if_it_is_there(installed, monkeypatch):
    monkeypatch.setenv(compilation.TRAVERSAL, "warp")
    installed["warp-lang"] = "1.20.1"
    assert compilation.chosen_traversal() == "warp"


@pytest.mark.parametrize(
    ("value", "version", "message"),
    [
        ("Warp", "1.19.0", r"^REFREF_TRAVERSAL is 'Warp'\. Set it to xla or warp\.$"),
        (
            "warp",
            None,
            r"it is not installed\. Install it with pip install -e '\.\[warp\]', or unset",
        ),
        ("warp", "1.9.2", r"requires warp-lang 1\.19 or newer, and version 1\.9\.2 is installed"),
    ],
)
def test_a_traversal_that_cannot_be_had_is_an_error(
    installed, monkeypatch, value, version, message
):
    monkeypatch.setenv(compilation.TRAVERSAL, value)
    if version:
        installed["warp-lang"] = version
    with pytest.raises(ValueError, match=message):
        compilation.chosen_traversal()


def _by_platform(traced):
    def tripled(pair, *, offset):
        traced.append("cpu")
        return {"sum": 3.0 * pair[0] + pair[1], "same": pair[1] + offset}

    def halved(pair, *, offset):
        traced.append("other")
        return {"sum": jnp.sin(pair[0]) + pair[1], "same": pair[1] - offset}

    def like(pair, *, offset):
        return {"sum": pair[0] + pair[1], "same": pair[1]}

    return compilation.chosen_by_platform("tripled", cpu=tripled, default=halved, like=like)


def test_the_function_for_cpus_is_used_on_a_cpu_eagerly_compiled_and_mapped():
    chosen, pair = _by_platform([]), (jnp.arange(4.0), jnp.ones(4))
    expected = {"sum": 3.0 * np.arange(4.0) + 1.0, "same": np.full(4, 3.0)}
    for function in (chosen, jax.jit(chosen, static_argnames="offset")):
        jax.tree.map(np.testing.assert_array_equal, function(pair, offset=2.0), expected)
    mapped = jax.vmap(lambda x: chosen((x, jnp.ones(())), offset=2.0))(pair[0])
    jax.tree.map(np.testing.assert_array_equal, mapped, expected)
    over_both = jax.vmap(jax.vmap(lambda x, y: chosen((x, y), offset=2.0), (0, None)), (None, 0))
    found = over_both(pair[0], jnp.arange(3.0))["sum"]
    np.testing.assert_array_equal(found, 3.0 * np.arange(4.0) + np.arange(3.0)[:, None])


@pytest.mark.parametrize("maps", [0, 1, 2])
@pytest.mark.parametrize(
    ("platform", "name"), [("cpu", "cpu"), ("cuda", "other"), ("tpu", "other")]
)
def test_only_the_function_for_the_platform_is_traced_and_once(platform, name, maps):
    traced = []
    chosen, pair = _by_platform(traced), (jnp.ones((4, 3, 2)), jnp.ones((4, 3, 2)))
    function = functools.partial(chosen, offset=1.0)
    for _ in range(maps):
        function = jax.vmap(function)
    program = jax.jit(function).trace(pair)
    text = program.lower(lowering_platforms=(platform,)).as_text()
    assert traced == [name] and ("sine" in text) == (name == "other")


def test_a_process_with_one_core_works_in_its_own_thread(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3}, raising=False)
    assert compilation.threads() == 1
    here = compilation.at_once(lambda number: threading.get_ident(), range(3))
    assert here == [threading.get_ident()] * 3
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5}, raising=False)
    assert compilation.threads() == 2 and compilation.at_once(abs, range(3)) == [0, 1, 2]


def test_results_that_are_computed_at_once_keep_their_order(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    both = threading.Barrier(2, timeout=60.0)

    def wait(x, y):
        both.wait()  # breaks unless two run at once
        return x - y

    assert compilation.at_once(wait, range(4), (1, 2, 3, 4)) == [-1, -1, -1, -1]
    assert compilation.at_once(wait, (), ()) == []


def test_an_accelerator_takes_one_after_the_other(monkeypatch):
    monkeypatch.setattr(compilation, "runs_on_cpu", lambda: False)
    threads = compilation.at_once(lambda _: threading.get_ident(), range(8))
    assert set(threads) == {threading.get_ident()}


def test_no_other_thread_computes_while_jax_traces():
    numbers = (0.0, 1.0, 2.0)
    slope = jax.grad(lambda x: sum(compilation.at_once(lambda y: x * y, numbers)))(2.0)
    assert slope == 3.0


def test_threads_have_the_settings_of_the_calling_one():
    def doubled(x):
        return jnp.asarray(x).dtype, (jnp.arange(2) * jnp.float32(0.5)).dtype

    with jax.debug_nans(True), pytest.raises(FloatingPointError):
        compilation.at_once(jnp.log, [jnp.full(2, -1.0)])
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        assert compilation.at_once(doubled, [1.5]) == [(jnp.float64, jnp.float32)]
    with pytest.raises(ValueError, match="strict"):
        compilation.at_once(doubled, [1.5])  # the suite's promotion is strict


def test_the_first_error_ends_what_is_computed_at_once():
    begun = []

    def fail(x):
        begun.append(x)
        time.sleep(0.01 * x)
        raise KeyError(x)

    with pytest.raises(KeyError, match="0"):
        compilation.at_once(fail, range(100))
    assert len(begun) < 100


def test_threads_wait_for_one_that_traces_a_program(monkeypatch):
    monkeypatch.setattr(compilation, "runs_on_cpu", lambda: True)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    traced = []

    @compilation.traced_once
    @functools.partial(jax.jit, static_argnames="power")
    def raised(x, *, power):
        traced.append(x.shape)
        time.sleep(0.2)  # long enough for another thread to begin
        return x**power

    both = threading.Barrier(2, timeout=60.0)

    def together(x):
        both.wait()
        return raised(x, power=2)

    squares = compilation.at_once(together, [jnp.full(3, 2.0), jnp.full(3, 3.0)])
    np.testing.assert_array_equal(squares, [[4.0] * 3, [9.0] * 3])
    assert traced == [(3,)]
    assert raised(jnp.full(3, 2.0), power=3).tolist() == [8.0] * 3
    assert raised(jnp.full(4, 2.0), power=2).tolist() == [4.0] * 4
    assert traced == [(3,), (3,), (4,)]


def test_a_program_that_fails_while_it_is_traced_lets_others_try():
    begun = []

    @compilation.traced_once
    def fail(x):
        begun.append(x)
        raise KeyError(x)

    for _ in range(2):
        with pytest.raises(KeyError):
            fail(1.0)
    assert begun == [1.0, 1.0]


def test_programs_that_compile_quickly_compute_the_same():
    x = jnp.linspace(-3.0, 3.0, 101)

    def falling(x, *, power):
        return jnp.exp(-x) ** power

    quick = compilation.jit_quickly(falling, static_argnames="power")
    np.testing.assert_allclose(quick(x, power=2), np.exp(-2.0 * np.asarray(x)), rtol=1e-6)
