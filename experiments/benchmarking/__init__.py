"""The benchmark: methods by scenes, trained, evaluated and tabulated; see docs/benchmark.md."""
