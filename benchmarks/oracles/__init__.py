"""Slow references that benchmarks and tests compare the library with."""
