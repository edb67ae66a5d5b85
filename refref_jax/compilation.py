"""Settings of compilation and of the host: native loops, platforms, threads, slow versions.

XLA:CPU runs a `while_loop` as many small kernels, dispatched one by one. A call with the attribute
set by `native_loop` is instead emitted as one function with real control flow, which makes BVH
traversal about five times faster. The attribute is internal to XLA: versions that do not know it
ignore it, and only the speed changes.

`chosen_by_platform` makes one function of two, for CPUs and for other devices. `at_once` runs
programs in several threads of the host, and `traced_once` lets one of them trace each program.

NVIDIA GPUs need flags of XLA with some versions (`NEEDED_FLAGS`): scatter-adds of single floats are
compiled as loops that compare and swap, hundreds of times slower than an addition in memory, and
steps of large presets compile for minutes. `add_missing_flags` sets them, before JAX starts.

The environment variable `REFREF_TRAVERSAL` chooses how closest hits are found. Programs that are
compiled already keep what they were compiled with.
"""

import contextlib
import functools
import importlib.metadata
import os
import threading
import warnings
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import jax
import numpy as np
from jax._src import config, core, xla_bridge
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array


class XlaFlag(NamedTuple):
    """A flag of XLA that NVIDIA GPUs need.

    Attributes:
      text: flag and value.
      versions: versions of jaxlib that need it; others may refuse it.
      suffices: parts of flags with the same effect, or by which users choose for themselves.
      problem: consequence of its absence.
      source: issue that reports the problem.
    """

    text: str
    versions: tuple[str, ...]
    suffices: tuple[str, ...]
    problem: str
    source: str


ATOMICS_FLAG = XlaFlag(
    "--xla_backend_extra_options=-nvptx-allow-ftz-atomics",
    versions=("0.10.2", "0.11.0"),
    suffices=("nvptx-allow-ftz-atomics", "--xla_gpu_ftz=true"),
    problem="scatter-adds compare and swap",
    source="jax-ml/jax#38806",
)
"""Turns `atom.cas.b32` into `atom.add.f32` in the PTX of jaxlib 0.10.2 for an H100
(`benchmarks.gpu_scatter_adds`)."""

AUTOTUNER_FLAG = XlaFlag(
    "--xla_gpu_experimental_enable_fusion_autotuner=false",
    versions=("0.10.0", "0.10.1", "0.10.2", "0.11.0", "0.11.1", "0.11.2"),
    suffices=("--xla_gpu_experimental_enable_fusion_autotuner",),
    problem="large training steps compile for minutes",
    source="tue-bmd/zea#599",
)
"""Reductions are then not compiled in several ways to choose from."""

NEEDED_FLAGS = (ATOMICS_FLAG, AUTOTUNER_FLAG)
"""All of these flags."""

_PLUGINS = ("jax-cuda12-plugin", "jax-cuda13-plugin")

TRAVERSAL = "REFREF_TRAVERSAL"
"""Environment variable: `xla`, the default, or `warp`."""

# Older versions do not offer kernels to JAX on CPUs.
_WARP = (1, 19)

# Chooses XLA:CPU's older code generator; versions other than 0.10 may not know the option.
_OLDER_GENERATOR = (
    {"xla_cpu_use_fusion_emitters": False}
    if importlib.metadata.version("jaxlib").startswith("0.10.")
    else None
)

jit_quickly = functools.partial(jax.jit, compiler_options=_OLDER_GENERATOR)
"""`jax.jit` for programs that the host calls, and that run no longer than they compile.

On CPUs, programs that trace paths compile in three quarters of the time and run as fast; steps of a
field are a twelfth slower, and take `jax.jit`. Such a program cannot be a part of another one.
"""

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Tree = TypeVar("_Tree")


def native_loop(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Marks a function of arrays for compilation as one native kernel.

    The function must use every argument and must not contain a sort, scatter or callback. The
    attribute is set on the call of a nested `jit`. Inside, it is reset; otherwise every small
    jitted function of `jax.numpy` would inherit it and become a real call.

    XLA aborts (JAX 0.10.2) if an argument of a marked call is a constant, such as a scene that a
    user's function closes over. Every argument therefore passes an optimization barrier first,
    which hides constants from XLA. The barrier does not copy.
    """

    def unmarked(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with set_xla_metadata(xla_cpu_small_call="false", inlineable="true"):
            return function(*args, **kwargs)

    compiled = jax.jit(unmarked)

    def marked(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        args, kwargs = jax.lax.optimization_barrier((args, kwargs))
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return compiled(*args, **kwargs)

    return marked


def record(values: Any, index: Array) -> Any:
    """Returns one record of arrays, as a native loop reads it."""

    def pick(x: Array) -> Array:
        return jax.lax.dynamic_index_in_dim(x, index, keepdims=False, allow_negative_indices=False)

    return jax.tree.map(pick, values)


def with_record(values: Array, at: Array, value: Array) -> Array:
    """Returns an array with one record replaced."""
    update = jax.lax.dynamic_update_index_in_dim
    return update(values, value, at, axis=0, allow_negative_indices=False)


def missing_flags() -> tuple[XlaFlag, ...]:
    """Returns the flags that this version of jaxlib needs and that are not set.

    Without a CUDA plugin, no flag is missing.
    """
    if not any(_version(each) for each in _PLUGINS):
        return ()
    flags, version = os.environ.get("XLA_FLAGS", ""), _version("jaxlib")
    needed = (each for each in NEEDED_FLAGS if version in each.versions)
    return tuple(each for each in needed if not any(part in flags for part in each.suffices))


def chosen_by_platform(
    name: str,
    *,
    cpu: Callable[..., Any],
    default: Callable[..., Any],
    like: Callable[..., Any],
) -> Callable[..., Any]:
    """Returns a function that is `cpu` in programs for CPUs, and `default` in others.

    Like `jax.lax.platform_dependent`, it depends on what a program is lowered for, not on the
    devices of this process; but only the chosen function is traced, and only once, which matters
    for large ones. It has no derivative.

    Args:
      name: name of the operation in printed programs.
      cpu: function of pytrees of arrays, with keyword arguments that can be hashed.
      default: function of the same arguments.
      like: function of the same arguments that returns arrays of the same shapes as both.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True

    def flat(function: Callable[..., Any]) -> Callable[..., list[Array]]:
        def of_leaves(*leaves: Array, tree: Any, options: Any, maps: tuple[Any, ...]) -> Any:
            def one(*leaves: Array) -> list[Array]:
                return jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves), **dict(options)))

            return functools.reduce(lambda f, axes: jax.vmap(f, in_axes=axes), maps, one)(*leaves)

        return of_leaves

    def shapes(*leaves: Any, **static: Any) -> list[jax.core.ShapedArray]:
        found = jax.eval_shape(functools.partial(flat(like), **static), *leaves)
        return [jax.core.ShapedArray(x.shape, x.dtype) for x in found]

    def mapped(
        leaves: Any, axes: Any, *, maps: tuple[Any, ...], **static: Any
    ) -> tuple[list[Array], list[int]]:
        found = primitive.bind(*leaves, maps=(*maps, tuple(axes)), **static)
        return found, [0] * len(found)

    bind = jax.jit(primitive.bind, static_argnames=("tree", "options", "maps"))
    primitive.def_impl(bind)
    primitive.def_abstract_eval(shapes)
    batching.primitive_batchers[primitive] = mapped
    mlir.register_lowering(primitive, mlir.lower_fun(flat(default), multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(flat(cpu), multiple_results=True), "cpu")

    def chosen(*arguments: Any, **options: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        result = jax.tree.structure(jax.eval_shape(functools.partial(like, **options), *arguments))
        static = {"tree": tree, "options": tuple(sorted(options.items())), "maps": ()}
        return jax.tree.unflatten(result, primitive.bind(*leaves, **static))

    return chosen


def runs_on_cpu() -> bool:
    """Returns whether this process computes on CPUs, for sizes that the host chooses."""
    return jax.default_backend() == "cpu"


def is_transforming() -> bool:
    """Returns whether JAX transforms the calling function, so that arrays may be tracers."""
    return not core.trace_state_clean()


def threads() -> int:
    """Returns how many elements `at_once` works on at the same time: two, or one.

    One program does not keep two cores busy: parts of it have one thread, and nothing runs while
    the host prepares its arguments. It is one on accelerators, if this process may use a single
    core only, and while JAX transforms the calling function.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # of Linux
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    return 1 if is_transforming() or not runs_on_cpu() else min(2, cores)


def at_once(function: Callable[..., _Result], *each: Sequence[Any]) -> list[_Result]:
    """Returns the results of a function for corresponding elements, `threads()` at a time.

    The threads get the settings that the calling one has by context managers of JAX.
    """
    if threads() == 1:
        return [function(*elements) for elements in zip(*each, strict=True)]
    states = config.config_states.values()
    changed = [(state, state.value) for state in states if state.value is not state.get_global()]

    def with_settings(*elements: Any) -> _Result:
        with contextlib.ExitStack() as stack:
            for state, value in changed:
                stack.enter_context(state(value))
            return function(*elements)

    with ThreadPoolExecutor(threads()) as workers:
        return list(workers.map(with_settings, *each))


def traced_once(program: Callable[..., _Result]) -> Callable[..., _Result]:
    """Wraps a jitted program so that it is traced once if several threads call it at first.

    JAX would trace and compile it in each of them. Here one does, for each kind of arguments, and
    the others wait.

    Args:
      program: jitted function; its static arguments can be hashed.
    """
    locks: dict[Hashable, threading.RLock] = {}
    done: set[Hashable] = set()

    @functools.wraps(program)
    def run(*arguments: Any, **options: Any) -> _Result:
        leaves, structure = jax.tree.flatten((arguments, options))
        kinds = tuple((getattr(x, "shape", x), getattr(x, "dtype", None)) for x in leaves)
        kind = structure, kinds
        if kind in done:
            return program(*arguments, **options)
        with locks.setdefault(kind, threading.RLock()):
            found = program(*arguments, **options)
            done.add(kind)
        return found

    return run


def refuse_tracers(tree: Any, *, instead: str) -> None:
    """Checks that a function that works on the host is not part of a transformed one.

    Args:
      tree: pytree of numbers and arrays.
      instead: advice at the end of the error message.

    Raises:
      TypeError: if an array is a tracer, because JAX transforms the calling function, or if all new
        arrays would be, because it compiles the function.
    """
    leaves = (*jax.tree.leaves(tree), jax.device_put(0.0))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        raise TypeError(
            "This function works tile by tile on the host and cannot be part of a function "
            f"that jit, vmap or grad transforms. {instead}"
        )


def fetch(tree: _Tree, *, instead: str) -> _Tree:
    """Converts all arrays of a pytree to NumPy arrays; arguments and errors of `refuse_tracers`."""
    refuse_tracers(tree, instead=instead)
    return jax.tree.map(np.asarray, jax.device_get(tree))


def add_missing_flags() -> None:
    """Sets the flags of XLA that this version needs on NVIDIA GPUs (`NEEDED_FLAGS`).

    Does nothing without a CUDA plugin. JAX reads flags when it starts, that is, with the first
    array: later, if it uses a GPU, and where a flag has another value already, a warning says what
    to do.
    """
    started, late = has_started(), []
    if started and jax.default_backend() != "gpu":
        return
    for flag in missing_flags():
        flags, name = os.environ.get("XLA_FLAGS", ""), flag.text.split("=")[0]
        if started or name in flags:
            late.append(flag)
        else:
            os.environ["XLA_FLAGS"] = f"{flags} {flag.text}".strip()
    if late:
        problems = "; ".join(f"{flag.problem} ({flag.source})" for flag in late)
        warnings.warn(
            f"jaxlib {_version('jaxlib')} is slow on NVIDIA GPUs: {problems}. Add to the variable "
            f"XLA_FLAGS before JAX starts: {' '.join(flag.text for flag in late)}",
            stacklevel=3,
        )


def chosen_traversal() -> Literal["xla", "warp"]:
    """Returns who finds closest hits: JAX alone (`xla`), or a kernel of NVIDIA Warp (`warp`).

    Raises:
      ValueError: if `REFREF_TRAVERSAL` is anything else, or Warp is missing or too old.
    """
    chosen = os.environ.get(TRAVERSAL) or "xla"
    if chosen == "xla":
        return "xla"
    if chosen != "warp":
        raise ValueError(f"{TRAVERSAL} is {chosen!r}. Set it to xla or warp.")
    version = _version("warp-lang")
    if version is None or tuple(map(int, version.split(".")[:2])) < _WARP:
        found = f"version {version} is installed" if version else "it is not installed"
        raise ValueError(
            f"{TRAVERSAL}=warp requires warp-lang 1.19 or newer, and {found}. Install it with "
            f"pip install -e '.[warp]', or unset {TRAVERSAL}."
        )
    return "warp"


def has_started() -> bool:
    """Returns whether JAX has read its flags, because an array or a device was used."""
    return xla_bridge.backends_are_initialized()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
