"""Figures and videos, by matplotlib."""
