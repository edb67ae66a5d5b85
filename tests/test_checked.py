"""What the suite has checked of arguments and results (`tests/processes/checked.py`)."""

import inspect

import jax.numpy as jnp
import jaxtyping
import pytest
from beartype import beartype
from jaxtyping import Array, Float, TypeCheckError

from refref_jax.optics import fresnel, path_settings
from tests.processes import checked

_checked = jaxtyping.jaxtyped(typechecker=beartype)


@_checked
def _added(
    points: Float[Array, "points 3"], offsets: Float[Array, "points 3"]
) -> Float[Array, "points 3"]:
    return points + offsets


@_checked
def _transposed(points: Float[Array, "points 3"]) -> Float[Array, "points 3"]:
    return points.T


@_checked
def _plain(points):
    return points


class _Cloud:
    def __init__(self, points):
        self.points = points

    @_checked
    def moved(self, offset: Float[Array, "3"]) -> Float[Array, "points 3"]:
        return self.points + offset[None]

    @classmethod
    @_checked
    def of_one(cls, point: Float[Array, "3"]) -> "_Cloud":
        return cls(point[None])


def test_a_function_of_the_library_is_checked():
    with pytest.raises(TypeCheckError, match=r"(?s)reflect.*normal"):
        fresnel.reflect(jnp.ones(3), jnp.ones(2))


def test_a_function_is_decorated_when_it_is_called():
    assert fresnel.reflect.__code__.co_filename == checked.__file__


def test_a_field_of_a_dataclass_is_checked():
    with pytest.raises(TypeCheckError, match="most"):
        path_settings.Detail("all", "3")


def test_sizes_are_the_same_in_all_arguments():
    _added(jnp.ones((4, 3)), jnp.ones((4, 3)))
    with pytest.raises(TypeCheckError, match="offsets"):
        _added(jnp.ones((4, 3)), jnp.ones((1, 3)))


def test_results_are_checked():
    _transposed(jnp.ones((3, 3)))
    with pytest.raises(TypeCheckError, match="return value"):
        _transposed(jnp.ones((4, 3)))


def test_methods_are_checked():
    cloud = _Cloud.of_one(jnp.ones(3))
    assert cloud.moved(jnp.ones(3)).shape == (1, 3)
    with pytest.raises(TypeCheckError, match="point"):
        _Cloud.of_one(jnp.ones(2))
    with pytest.raises(TypeCheckError, match="offset"):
        cloud.moved(jnp.ones(2))


def test_a_function_is_checked_at_every_call():
    for _ in range(2):
        with pytest.raises(TypeCheckError):
            _transposed(jnp.ones((4, 3)))


def test_a_function_in_another_is_checked():
    def rotated(matrix):
        @_checked
        def of_point(point: Float[Array, "3"]) -> Float[Array, "3"]:
            return matrix @ point

        return of_point

    with pytest.raises(TypeCheckError, match="point"):
        rotated(jnp.eye(3))(jnp.ones(2))
    with pytest.raises(TypeCheckError, match="return value"):
        rotated(jnp.eye(3)[:2])(jnp.ones(3))


def test_nothing_is_added_to_a_function_without_annotations():
    assert not hasattr(_plain, "__wrapped__")


def test_a_function_keeps_its_name_and_signature():
    assert _added.__name__ == "_added"
    assert list(inspect.signature(_added).parameters) == ["points", "offsets"]
