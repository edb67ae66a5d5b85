"""Syntax of the project's modules, each of which is parsed and walked once."""

import ast
import functools


@functools.cache
def nodes(path):
    """Returns all nodes of a module's syntax tree, the module itself first."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
