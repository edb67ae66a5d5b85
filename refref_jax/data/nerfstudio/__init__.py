"""Captures in nerfstudio's layout: read, turned into scenes, and written."""
