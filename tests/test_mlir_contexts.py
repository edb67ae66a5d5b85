"""Contexts of MLIR that programs of the suite share: how many, and by whom."""

import threading

import jax
import jax.numpy as jnp
import pytest
from jax._src.interpreters import mlir
from jax.extend import core

from tests.processes import mlir_contexts


@pytest.fixture
def made(monkeypatch):
    """The contexts that JAX has made since they are shared."""
    made, make = [], mlir.JaxIrContext
    monkeypatch.setattr(mlir, "make_ir_context", lambda: made.append(make()) or made[-1])
    mlir_contexts.reuse()
    return made


def test_a_context_is_renewed_after_some_programs(made):
    given = [mlir.make_ir_context() for _ in range(25)]
    assert len(made) == 3
    assert all(context is made[number // 10] for number, context in enumerate(given))


def test_no_context_is_shared_with_another_thread(made):
    given = [mlir.make_ir_context()]
    other = threading.Thread(target=lambda: given.append(mlir.make_ir_context()))
    other.start()
    other.join()
    assert given == made and given[0] is not given[1]


def test_what_is_lowered_within_another_program_has_a_context_of_its_own(made):
    outer = mlir.make_ir_context()
    with outer:
        inner = mlir.make_ir_context()
    assert inner is not outer and mlir.make_ir_context() is outer and len(made) == 2


def test_a_program_may_be_compiled_while_another_one_is_lowered(monkeypatch):
    monkeypatch.setattr(mlir, "make_ir_context", mlir.make_ir_context)
    mlir_contexts.reuse()
    offset = core.Primitive("offset")
    offset.def_abstract_eval(lambda x: x)

    def lowered(x):
        with jax.ensure_compile_time_eval():
            total = jnp.sum(jnp.arange(5.0))
        return x + total

    mlir.register_lowering(offset, mlir.lower_fun(lowered, multiple_results=False))
    assert jax.jit(lambda x: 2.0 * offset.bind(x))(jnp.float32(1.0)) == 22.0
