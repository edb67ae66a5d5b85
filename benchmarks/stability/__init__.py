"""Extremes that light paths are tried at; `python -m benchmarks.stability` measures them."""
