"""Tests. They mirror the package; `reference` holds slow float64 oracles."""
