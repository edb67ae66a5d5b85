"""Compiles programs of the library for an H100, without one, and counts what they cost."""
