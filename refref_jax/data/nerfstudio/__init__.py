"""Captures in nerfstudio's format: reading, conversion to scene folders, and writing."""
