"""Reflection, refraction and absorption of light at and between surfaces, and path tracing."""
