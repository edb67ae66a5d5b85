"""Sampling of fields along light paths."""
