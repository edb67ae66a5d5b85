"""Syntax of the project's modules, each of which is parsed and walked once."""

import ast
import functools


@functools.cache
def nodes(path):
    """Returns all nodes of a module's syntax tree, the module itself first."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@functools.cache
def imports(path):
    """Returns the dotted names that a module imports, with the names taken from them."""
    found = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(found)
