"""The benchmark: scenes by methods, trained, evaluated and tabled; see docs/benchmark.md."""
