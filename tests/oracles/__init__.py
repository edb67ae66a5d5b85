"""Slow references that share nothing with the library."""
